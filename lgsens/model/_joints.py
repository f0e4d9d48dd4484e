"""Joints: hard constraints between two bodies, or a body and the ground.

A joint is given in the reference configuration: its hardpoint `at` and axes in the inertial frame.
The body-fixed points and axes follow from the poses of the bodies there, so the gradient with
respect to `at` is the gradient with respect to geometry. Reference: Haug (1989), §9.4.
"""

import abc
from collections.abc import Sequence, Set
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._brief import as_called
from lgsens._validate import axis_field, point_field, require
from lgsens.liegroups import cross
from lgsens.model._constraints import AbstractRows, Coincidence, Distance, InPlane, Orthogonality
from lgsens.model._frames import Frame, normals
from lgsens.model._free import ROTATIONS, TRANSLATIONS, is_along, single_rotation
from lgsens.model._relative import (
    ANGLE,
    ARM_ANGLES,
    LENGTH,
    ROTATION_VECTOR,
    Coordinate,
    frames_along,
    frames_at,
)
from lgsens.model._signal_fields import prescribed_field
from lgsens.model._signals import Prescribed, prepared


def _coincidence(a: Frame, b: Frame, at) -> Coincidence:
    return Coincidence(a.local_point(at), b.local_point(at))


def _orthogonality(a: Frame, b: Frame, axis_a, axis_b) -> Orthogonality:
    return Orthogonality(a.local_axis(axis_a), b.local_axis(axis_b))


def _in_plane(a: Frame, b: Frame, at, axis) -> InPlane:
    return InPlane(a.local_point(at), b.local_point(at), a.local_axis(axis))


class AbstractJoint(eqx.Module):
    """A joint between bodies `a` and `b`; None is the ground.

    A joint of one's own has these two names, leaves for its numbers, and `constraints`. It is `assembled` if the
    reference configuration satisfies it by construction, and `rigid` if its bodies move as one. `coordinates` are those
    that it leaves them, or `drives`: functions of the pose of its frame on b in that on a (`lgsens.model.Coordinate`);
    what drives it must be positive where it is a `distance`; `slips` the velocities [ẋ, ω] of that pose that rub,
    0 … 5, and 6 … 8 those of ω about the axes of b's frame.
    """

    a: eqx.AbstractVar[str | None]
    b: eqx.AbstractVar[str | None]
    assembled: ClassVar[Any] = False
    rigid: ClassVar[bool] = False
    drives: ClassVar[bool] = False
    distance: ClassVar[bool] = False
    coordinates: ClassVar[tuple[Coordinate, ...]] = ()
    slips: ClassVar[tuple[int, ...]] = ()

    __repr__ = as_called

    @property
    def others(self) -> tuple[str, ...]:
        """Further bodies that it depends on: their frames are the last arguments of `constraints` and `value`."""
        return ()

    @property
    def frames(self) -> tuple[Frame, Frame] | None:
        """Its frames on a and on b, inertial frame, in the reference configuration; None: both at the centre of mass of
        b, with the axes of the inertial frame."""
        return None

    @property
    def hinge(self) -> Float[Array, "3"] | None:
        """The axis about which its bodies turn in each other, inertial frame, if about no other; None: it says nothing.
        Of bodies with one rotation it must be that of the rotation."""
        return None

    @property
    def about(self) -> Float[Array, "3"] | None:
        """The axis about which it prescribes a turn, inertial frame, that of the hinge between its bodies; None: it
        prescribes none."""
        return None

    def violable(self, constraints: Sequence[AbstractRows], free: Set[str]) -> Sequence[tuple[bool, ...]]:
        """Which equations of each of its constraints its bodies could violate, as in `AbstractConstraint.violable`."""
        return [constraint.violable(free) for constraint in constraints]

    def violable_about(self, name: str, free: Set[str], axis: int) -> Sequence[tuple[bool, ...]] | None:
        """The same where its bodies turn about one inertial axis (0, 1, 2) and the joint, `name` in messages, knows
        more than its constraints; None: it does not."""
        return None

    def in_plane(self, axis: int) -> "AbstractJoint":
        """The same joint between bodies that all move in the plane normal to an inertial axis (0, 1, 2), where its
        constraints can say what of them these can violate."""
        return self

    @abc.abstractmethod
    def constraints(self, a: Frame, b: Frame) -> tuple[AbstractRows, ...]:
        """The basic constraints of the joint, given the reference frames of its two bodies."""


class SphericalJoint(AbstractJoint):
    """Ball joint: one point of `a` coincides with one point of `b`; 3 equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: the hardpoint in the reference configuration [m], inertial frame, shape (3,).

    The multiplier is the force of `b` on `a` [N], inertial frame, shape (3,).
    Raises `ValueError` for a wrong shape. Source: paper eq. (23); Haug (1989), §9.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")

    assembled = True
    coordinates = ROTATION_VECTOR
    slips = (3, 4, 5)
    frames = frames_at

    def constraints(self, a, b):
        return (_coincidence(a, b, self.at),)


class RevoluteJoint(AbstractJoint):
    """Hinge: a common point and a common axis; 5 equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: a point of the axis in the reference configuration [m], inertial frame, shape (3,).
        axis: direction of the hinge in the reference configuration, inertial frame, shape (3,), any length > 0.

    Raises `ValueError` for a wrong shape or a zero axis. Source: Haug (1989), §9.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis: Float[Array, "3"] = axis_field("axis")

    assembled = True
    coordinates = (ANGLE,)
    slips = (3,)
    frames = frames_at

    @property
    def hinge(self):
        return self.axis

    def violable(self, constraints, free):
        return constraints[0].violable(free), (False,), (False,)  # the one rotation is about the hinge

    def constraints(self, a, b):
        unit, first, second = normals(self.axis)
        return (
            _coincidence(a, b, self.at),
            _orthogonality(a, b, first, unit),
            _orthogonality(a, b, second, unit),
        )


class UniversalJoint(AbstractJoint):
    """Cardan joint: a common point and two orthogonal axes, one in each body; 4 equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: centre of the cross in the reference configuration [m], inertial frame, shape (3,).
        axis_a: arm of the cross fixed in `a`, inertial frame, shape (3,), any length > 0.
        axis_b: arm of the cross fixed in `b`; only its part orthogonal to `axis_a` is used, so the
            cross stays a right one whatever the two gradients do.

    Raises `ValueError` for a wrong shape, a zero axis or parallel axes. Source: Haug (1989), §9.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis_a: Float[Array, "3"] = axis_field("axis_a")
    axis_b: Float[Array, "3"] = axis_field("axis_b")

    def __check_init__(self):
        require(
            lambda a, b: np.linalg.norm(np.cross(a, b)) > 1e-6 * np.linalg.norm(a) * np.linalg.norm(b),
            lambda: (
                f"UniversalJoint: `axis_a` {self.axis_a} and `axis_b` {self.axis_b} are parallel; "
                "the arms of the cross must be orthogonal."
            ),
            self.axis_a,
            self.axis_b,
        )

    assembled = True
    coordinates = ARM_ANGLES
    slips = (3, 7)

    def _arms(self):
        arm_a = self.axis_a / jnp.linalg.norm(self.axis_a)
        arm_b = self.axis_b - jnp.dot(arm_a, self.axis_b) * arm_a
        return arm_a, arm_b / jnp.linalg.norm(arm_b)

    @property
    def frames(self):
        arm_a, arm_b = self._arms()
        own = Frame(self.at, jnp.stack([arm_a, arm_b, cross(arm_a, arm_b)], axis=1))
        return own, own

    def violable_about(self, name, free, axis):
        require(
            lambda a, b: is_along(a, axis) or is_along(b, axis),
            lambda: (
                f"Joint {name!r}: one of its arms, `axis_a` {self.axis_a} or `axis_b` {self.axis_b}, must be that of "
                f"{ROTATIONS[axis]!r}, the only rotation that {self.a!r} and {self.b!r} have; turn it, or free all "
                "rotations of one of them."
            ),
            self.axis_a,
            self.axis_b,
        )
        return tuple(i != axis or TRANSLATIONS[i] in free for i in range(3)), (False,)  # they turn about that arm

    def constraints(self, a, b):
        arm_a, arm_b = self._arms()
        return (_coincidence(a, b, self.at), _orthogonality(a, b, arm_a, arm_b))


class FixedJoint(AbstractJoint):
    """`b` is rigidly attached to `a`; 6 equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: the point of attachment in the reference configuration [m], inertial frame, shape (3,): the
            multiplier's force and moments are those at this point.

    Raises `ValueError` for a wrong shape. Source: Haug (1989), §9.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")

    assembled = True
    rigid = True
    frames = frames_at

    def violable(self, constraints, free):
        # of the orthogonalities x·y, y·z, z·x only that of the two axes other than that of the one rotation changes
        axis = single_rotation(free)
        return constraints[0].violable(free), *(((i + 2) % 3 == axis,) for i in range(3))

    def constraints(self, a, b):
        eye = jnp.eye(3, dtype=self.at.dtype)
        return (_coincidence(a, b, self.at), *_same_orientation(a, b, (eye[0], eye[1], eye[2])))


class DistanceJoint(AbstractJoint):
    """A massless rod: a point of `a` and a point of `b` have a given distance; 1 equation.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at_a, at_b: the two ends in the reference configuration [m], inertial frame, shape (3,).
        length: length of the rod [m], shape (), or a signal of it, positive; None: the distance of the two points in
            the reference configuration. With another length the mechanism is assembled before it moves.

    The multiplier is the tension of the rod [N]. Raises `ValueError` for a wrong shape, a length
    ≤ 0 or along straight lines between samples, or coinciding ends. Source: Haug (1989), §9.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: Float[Array, "3"] = point_field("at_a")
    at_b: Float[Array, "3"] = point_field("at_b")
    length: Prescribed | None = prescribed_field("length", driven=True)

    def __check_init__(self):
        require(
            lambda a, b: np.linalg.norm(b - a) > 0,
            lambda: (
                f"DistanceJoint: `at_a` and `at_b` coincide at {self.at_a}, so the rod has no direction; "
                "use a SphericalJoint, or move one end."
            ),
            self.at_a,
            self.at_b,
        )
        if eqx.is_array(self.length):
            require(
                lambda length: length > 0,
                lambda: f"DistanceJoint: `length` must be positive, got {self.length} m.",
                self.length,
            )

    @property
    def assembled(self):
        return self.length is None

    coordinates = (LENGTH,)
    distance = True

    @property
    def frames(self):
        return frames_along(self.at_a, self.at_b, self.at_b - self.at_a)

    def constraints(self, a, b):
        length = jnp.linalg.norm(self.at_b - self.at_a) if self.length is None else prepared(self.length)
        return (Distance(a.local_point(self.at_a), b.local_point(self.at_b), length),)


def _same_orientation(a: Frame, b: Frame, triad) -> tuple[Orthogonality, ...]:
    """Three orthogonalities of a right-handed triad: at the reference only δθ_a = δθ_b satisfies them."""
    return tuple(_orthogonality(a, b, triad[i], triad[(i + 1) % 3]) for i in range(3))
