"""Joints along a line: sliders, sleeves, and points on a line; from Haug's basic constraints.

Of bodies that move in a plane they keep what these can violate. Which equations these are depends on the directions
across the line; one of them is then the normal of the plane, whatever the line in it (`AbstractJoint.in_plane`).
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import axis_field, point_field, require
from lgsens.liegroups import cross
from lgsens.model._frames import normals
from lgsens.model._free import ROTATIONS, TRANSLATIONS
from lgsens.model._joints import AbstractJoint, _in_plane, _orthogonality, _same_orientation
from lgsens.model._relative import ANGLE, DISPLACEMENT, ROTATION_VECTOR, frames_at


def _triad_in_plane(line, normal: int):
    """The direction of a line in a plane, one across it in the plane, and the normal of the plane."""
    across = jnp.asarray(np.eye(3)[normal], line.dtype)
    along = line - across * line[normal]
    unit = along / jnp.linalg.norm(along)
    return unit, cross(across, unit), across


class AbstractAlongLine(AbstractJoint):
    """A joint at a point of a line."""

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis: Float[Array, "3"] = axis_field("axis")

    assembled = True
    frames = frames_at

    def in_plane(self, axis):
        found = _IN_PLANE.get(type(self))
        if found is None:
            return self
        require(
            lambda line: abs(line[axis]) <= np.sqrt(np.finfo(line.dtype).eps) * np.abs(line).max(),
            lambda: (
                f"{type(self).__name__} between {self.a!r} and {self.b!r}: `axis` {self.axis} leaves the plane of "
                f"their motion, normal to {TRANSLATIONS[axis]}; turn it into the plane, or free more of them. What a "
                "line normal to the plane does there, a RevoluteJoint or a SphericalJoint does."
            ),
            self.axis,
        )
        return found(self.a, self.b, at=self.at, axis=self.axis, normal=axis)

    def _triad(self):
        """The direction of the line, and two across it."""
        return normals(self.axis)


class PrismaticJoint(AbstractAlongLine):
    """Slider: `b` translates along an axis of `a` without rotation; 5 equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: a point of the sliding axis in the reference configuration [m], inertial frame, shape (3,).
        axis: direction of sliding, inertial frame, shape (3,), any length > 0.

    Between bodies that move in a plane (`RigidBody.free`), in which `axis` lies, 2 equations are left: the multipliers
    are a moment about the plane's normal, if they turn about it, and the force of `b` on `a` across the axis. Raises
    `ValueError` for a wrong shape, a zero axis, and one that leaves the plane of such bodies. Source: Haug (1989),
    §9.4.
    """

    coordinates = (DISPLACEMENT,)
    slips = (0,)

    def constraints(self, a, b):
        unit, first, second = self._triad()
        return (
            *_same_orientation(a, b, (unit, first, second)),
            _in_plane(a, b, self.at, first),
            _in_plane(a, b, self.at, second),
        )


class _PrismaticInPlane(PrismaticJoint):
    normal: int = eqx.field(static=True, kw_only=True)

    def _triad(self):
        return _triad_in_plane(self.axis, self.normal)

    def violable(self, constraints, free):
        return (bool(free & {*ROTATIONS}),), (False,), (False,), (True,), (False,)


class CylindricalJoint(AbstractAlongLine):
    """`b` slides along and turns about an axis of `a`; 4 equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: a point of the axis in the reference configuration [m], inertial frame, shape (3,).
        axis: direction of the axis, inertial frame, shape (3,), any length > 0.

    Raises `ValueError` for a wrong shape or a zero axis. Source: Haug (1989), §9.4.
    """

    coordinates = (ANGLE, DISPLACEMENT)
    slips = (0, 3)

    def constraints(self, a, b):
        unit, first, second = normals(self.axis)
        return (
            _orthogonality(a, b, first, unit),
            _orthogonality(a, b, second, unit),
            _in_plane(a, b, self.at, first),
            _in_plane(a, b, self.at, second),
        )


class PointOnLineJoint(AbstractAlongLine):
    """A point of `b` stays on a line of `a`, x·d = 0 and y·d = 0 with x, y orthogonal to the line; 2 equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: the point in the reference configuration [m], inertial frame, shape (3,).
        axis: direction of the line, inertial frame, shape (3,), any length > 0.

    The multipliers are the forces of `b` on `a` along x and y [N]. Between bodies that move in a plane
    (`RigidBody.free`), in which the line lies, 1 equation is left, across the line. Raises `ValueError` for a wrong
    shape, a zero axis, and one that leaves the plane of such bodies. Source: Haug (1989), §9.4.
    """

    coordinates = (DISPLACEMENT, *ROTATION_VECTOR)

    def constraints(self, a, b):
        return tuple(_in_plane(a, b, self.at, across) for across in self._triad()[1:])


class _PointOnLineInPlane(PointOnLineJoint):
    normal: int = eqx.field(static=True, kw_only=True)

    def _triad(self):
        return _triad_in_plane(self.axis, self.normal)

    def violable(self, constraints, free):
        return (True,), (False,)


_IN_PLANE: dict[type, Any] = {PrismaticJoint: _PrismaticInPlane, PointOnLineJoint: _PointOnLineInPlane}
