"""Joints that keep a point or a face of one body on a plane or a line of another; from Haug's basic constraints."""

import equinox as eqx
from jaxtyping import Array, Float

from lgsens._validate import axis_field, point_field
from lgsens.model._frames import normals
from lgsens.model._free import TRANSLATIONS, single_rotation
from lgsens.model._joints import AbstractJoint, _in_plane, _orthogonality
from lgsens.model._relative import ANGLE, IN_PLANE, ROTATION_VECTOR, frames_at


class PlanarJoint(AbstractJoint):
    """A face of `b` slides and turns on a plane of `a`; 3 equations.

        n·d = 0,     x·n_b = 0,     y·n_b = 0

    with the normals n of `a` and n_b of `b`, x and y of `a` orthogonal to n, and d between the points at `at`.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: a point of the plane in the reference configuration [m], inertial frame, shape (3,).
        axis: normal of the plane, inertial frame, shape (3,), any length > 0.

    The multipliers are the force of `b` on `a` along the normal [N], and two moments along the plane [N m]. Raises
    `ValueError` for a wrong shape or a zero axis. Source: Haug (1989), §9.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis: Float[Array, "3"] = axis_field("axis")

    assembled = True
    coordinates = (*IN_PLANE, ANGLE)
    slips = (1, 2, 3)
    frames = frames_at

    @property
    def hinge(self):
        return self.axis

    def violable(self, constraints, free):
        axis = single_rotation(free)  # about the normal
        return (axis is None or TRANSLATIONS[axis] in free,), (False,), (False,)

    def constraints(self, a, b):
        unit, first, second = normals(self.axis)
        tilts = (_orthogonality(a, b, across, unit) for across in (first, second))
        return (_in_plane(a, b, self.at, unit), *tilts)


class PointOnPlaneJoint(AbstractJoint):
    """A point of `b` stays on a plane of `a`, n·d = 0; 1 equation.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: the point in the reference configuration [m], inertial frame, shape (3,).
        axis: normal n of the plane, inertial frame, shape (3,), any length > 0.

    The multiplier is the force of `b` on `a` along the normal [N]; the contact also pulls. Raises `ValueError` for a
    wrong shape or a zero axis. Source: Haug (1989), §9.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis: Float[Array, "3"] = axis_field("axis")

    assembled = True
    coordinates = (*IN_PLANE, *ROTATION_VECTOR)
    frames = frames_at

    def constraints(self, a, b):
        return (_in_plane(a, b, self.at, normals(self.axis)[0]),)
