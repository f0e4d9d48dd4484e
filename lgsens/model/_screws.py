"""A screw, and a rack and pinion: a body that advances as it turns.

Poses tell an angle but for whole turns. Where a body has advanced by s it should have turned by s/ρ, and only the angle
from there to where it is needs to be known: it is small, whatever the number of turns (`Angle`).
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import axis_field, point_field
from lgsens.model._constraints import AbstractClosedFormConstraint, InPlane
from lgsens.model._drivers import Angle
from lgsens.model._elements import body_fixed
from lgsens.model._frames import Frame, normals
from lgsens.model._free import TRANSLATIONS
from lgsens.model._joints import AbstractJoint
from lgsens.model._relative import ANGLE, DISPLACEMENT, frames_at
from lgsens.model._signal_fields import prescribed_field, require_ratio
from lgsens.model._signals import AbstractSignal, Prescribed, at_time, prepared
from lgsens.model._sliders import CylindricalJoint
from lgsens.model._stack import constraint_force, constraint_jacobian, constraint_stiffness


class Advance(AbstractClosedFormConstraint):
    """b advances along an axis of a as it turns about another: Φ = s − ρ θ, or s − f(θ); λ is a force [N].

    s as in `InPlane`, and θ the angle about the normal of `first_a` and `second_a`, that which is nearest to s/ρ. With
    B and K of s and of θ, f′ = ρ without a curve: B_s − f′ B_θ and K_s − f′ K_θ − λ f″ B_θᵀB_θ.
    """

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    axis_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    first_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    second_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    first_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    ratio: Prescribed  # ρ [m], for each `per` radians
    travel: AbstractSignal | None = eqx.field(metadata={"over": "angle"})  # f [m] over θ [rad]
    per: float = eqx.field(static=True)

    drawn = None
    num_rows = 1
    relative = True

    def _line(self) -> InPlane:
        return InPlane(self.point_a, self.point_b, self.axis_a)

    def _angle(self, from_angle: Array | float = 0.0) -> Angle:
        return Angle(self.first_a, self.second_a, self.first_b, jnp.asarray(from_angle, self.first_a.dtype))

    def _per_radian(self, t):
        return at_time(self.ratio, t) / self.per

    def _state(self, a, b, t):
        """ρ, s and θ − s/ρ."""
        per_radian, s = self._per_radian(t), self._line().value(a, b, t)[0]
        return per_radian, s, self._angle(s / per_radian).value(a, b, t)[0]

    def value(self, a, b, t):
        per_radian, s, rest = self._state(a, b, t)
        return (-per_radian * rest if self.travel is None else s - self.travel(s / per_radian + rest))[None]

    def _slopes(self, a, b, t):
        """f′ and f″, or ρ and None."""
        if self.travel is None:
            return self._per_radian(t), None
        per_radian, s, rest = self._state(a, b, t)
        return jax.jvp(jax.grad(self.travel), (s / per_radian + rest,), (jnp.ones_like(s),))

    def _tangent(self, of, a, b, *rest):
        return of(self._line(), a, b, *rest) - self._slopes(a, b, rest[-1])[0] * of(self._angle(), a, b, *rest)

    def jacobian(self, a, b, t):
        return self._tangent(constraint_jacobian, a, b, t)

    def force(self, a, b, lam, t):
        return self._tangent(constraint_force, a, b, lam, t)

    def geometric_stiffness(self, a, b, lam, t):
        stiffness, bend = self._tangent(constraint_stiffness, a, b, lam, t), self._slopes(a, b, t)[1]
        if bend is None:
            return stiffness
        (row,) = constraint_jacobian(self._angle(), a, b, t)
        return stiffness - lam[0] * bend * jnp.outer(row, row)


def _advance(joint: "ScrewJoint | RackAndPinionJoint", a: Frame, b: Frame, along, ratio, per: float) -> Advance:
    _, first, second = normals(joint.axis)
    points = a.local_point(joint.at), b.local_point(joint.at)
    axes = a.local_axis(along / jnp.linalg.norm(along)), a.local_axis(first), a.local_axis(second)
    return Advance(*points, *axes, b.local_axis(first), prepared(ratio), prepared(joint.travel), per)


def _travel_field() -> Any:
    return eqx.field(default=None, kw_only=True, metadata={"over": "angle"})


def _check_travel(joint: "ScrewJoint | RackAndPinionJoint", ratio: str) -> None:
    if not isinstance(joint.travel, AbstractSignal | None):
        raise ValueError(
            f"{type(joint).__name__}: `travel` must be a signal of the angle, got {joint.travel!r}; "
            f"a constant ratio is `{ratio}`."
        )


class ScrewJoint(AbstractJoint):
    """`b` turns about an axis of `a` and advances along it by a pitch in each turn, s = p θ/2π or f(θ); 5 equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: a point of the axis in the reference configuration [m], inertial frame, shape (3,).
        axis: direction of the axis, inertial frame, shape (3,), any length > 0.
        pitch: p [m per turn], shape (), right-handed if positive, not zero; any number of turns. Or a signal of time:
            s, not its rate, is p(t) θ/2π at every instant.
        travel: f [m] over θ [rad] of a thread of variable pitch, or of a barrel cam: as in `RackAndPinionJoint`, with
            `pitch` its mean, from which f departs by less than p/2.

    The multipliers are those of a `CylindricalJoint`, and the force of `b` on `a` along the axis [N]. Raises
    `ValueError` for a wrong shape, a zero axis, a missing or zero pitch, for which it is a RevoluteJoint, or a travel
    that is no signal. Source: Haug (1989), §9.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis: Float[Array, "3"] = axis_field("axis")
    pitch: Prescribed | None = prescribed_field("pitch", positional=True)
    travel: AbstractSignal | None = _travel_field()

    def __check_init__(self):
        require_ratio("ScrewJoint", "pitch", self.pitch, " m; without advance it is a RevoluteJoint")
        _check_travel(self, "pitch")

    @property
    def assembled(self):
        return self.travel is None

    coordinates = (ANGLE, DISPLACEMENT)
    slips = (0, 3)
    frames = frames_at

    @property
    def hinge(self):
        return self.axis

    def violable_about(self, name, free, axis):
        aside = any(name in free for i, name in enumerate(TRANSLATIONS) if i != axis)  # the rotation is the screw's
        return (False,), (False,), (aside,), (aside,), (True,)

    def constraints(self, a, b):
        sleeve = CylindricalJoint(self.a, self.b, at=self.at, axis=self.axis).constraints(a, b)
        return (*sleeve, _advance(self, a, b, self.axis, self.pitch, 2.0 * math.pi))


class RackAndPinionJoint(AbstractJoint):
    """The pinion `b` rolls along the rack `a`: its centre advances by s = r θ, or s = f(θ), along the rack; 1 equation.

    θ is its angle about `axis`, seen from the rack. A rack that slides in a housing, in which the pinion turns, moves
    by −s. Other joints hold the pinion's axis and the rack.

    Arguments:
        a, b: names of rack and pinion; None is the ground.
        at: centre of the pinion in the reference configuration [m], inertial frame, shape (3,).
        axis: direction of its axis, inertial frame, shape (3,), any length > 0.
        direction: direction of the rack, inertial frame, shape (3,), any length > 0; at any angle to `axis`.
        radius: r [m], shape (): travel per radian, negative for the other sense, not zero; any number of turns. Or a
            signal of time: s, not its rate, is r(t) θ at every instant.
        travel: f [m] over θ [rad] of a rack of variable ratio f′(θ), a signal of the angle in place of time, with two
            continuous derivatives (`Sampled(angles, travels, "cubic")`); None: r θ. `radius` is its mean ratio then:
            of the angles θ + 2πn that the poses do not tell apart that nearest to s/r is taken, so f departs from r θ
            by less than π r. Unless f(0) = 0 the mechanism is assembled before it moves.

    The multiplier is the force of `b` on `a` along the rack [N]. Raises `ValueError` for a wrong shape, a zero
    direction, a missing or zero radius, or a travel that is no signal. Source: Haug (1989), §3.4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis: Float[Array, "3"] = axis_field("axis")
    direction: Float[Array, "3"] = axis_field("direction")
    radius: Prescribed | None = prescribed_field("radius")
    travel: AbstractSignal | None = _travel_field()

    def __check_init__(self):
        require_ratio("RackAndPinionJoint", "radius", self.radius, " m; give the travel per radian")
        _check_travel(self, "radius")

    @property
    def assembled(self):
        return self.travel is None

    coordinates = (ANGLE,)
    frames = frames_at

    def constraints(self, a, b):
        return (_advance(self, a, b, self.direction, self.radius, 1.0),)
