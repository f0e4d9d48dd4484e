"""Drivers: joints that prescribe a displacement or an angle. Reference: Haug (1989), §3.5 and §9.6."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import axis_field, point_field
from lgsens.model._constraints import AbstractClosedFormConstraint, ConstraintSum, InPlane, Orthogonality
from lgsens.model._elements import body_fixed
from lgsens.model._frames import TURNING_A, TURNING_B, Frame, normals
from lgsens.model._joints import AbstractJoint
from lgsens.model._relative import ANGLE, DISPLACEMENT, but_for_turns, frames_along, frames_at
from lgsens.model._signal_fields import prescribed_field
from lgsens.model._signals import Prescribed, at_time, number_of, prepared


class Angle(AbstractClosedFormConstraint):
    """b has turned by a prescribed angle s(t) about an axis of a; λ is a moment [N m].

    With x, y fixed in a, normal to the axis, and β in b, which coincided with x before the turn:

        Φ = atan2(β·y, β·x) − s − 2πk,     k the integer with |Φ| ≤ π,

    the angle from the prescribed direction to β. It is smooth but for a misalignment of π: where atan2 jumps, k does.
    So s may grow beyond a turn. (With sin s and cos s within atan2 it would be one formula, with three times as many
    operations in the derivatives that a step behind a break asks for.)

    With x = β·x and y = β·y the components, and both vectors in a, δΦ = d·δβ, d = (x y − y x)/r², r² = x² + y²: B is
    that of `Orthogonality` of β and of d held in a, and as δd = −(d pᵀ + p dᵀ) δβ/r², p = x x + y y, the stiffness is
    its K less λ (wᵀB + Bᵀw)/r², w that row of p.
    """

    first_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    second_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    first_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    prescribed: Prescribed

    num_rows = 1
    acts_on = TURNING_A + TURNING_B

    @property
    def driven(self):
        return number_of(self.prescribed)

    @property
    def coupled(self):
        return (self.acts_on,)

    drawn = None

    def _components(self, a, b):
        """Those of β along x and y."""
        beta = a.local_axis(b.axis(self.first_b))
        return jnp.sum(beta * self.first_a), jnp.sum(beta * self.second_a)

    def _with_axis(self, axis) -> Orthogonality:
        return Orthogonality(axis, self.first_b)

    def _gradient(self, a, b) -> Orthogonality:
        x, y = self._components(a, b)
        return self._with_axis((x * self.second_a - y * self.first_a) / (x**2 + y**2))

    def value(self, a, b, t):
        x, y = self._components(a, b)
        return but_for_turns(jnp.arctan2(y, x) - at_time(self.prescribed, t))[None]

    def jacobian(self, a, b, t):
        return self._gradient(a, b).jacobian(a, b, t)

    def force(self, a, b, lam, t):
        return self._gradient(a, b).force(a, b, lam, t)

    def geometric_stiffness(self, a, b, lam, t):
        x, y = self._components(a, b)
        held = self._gradient(a, b)
        (row,) = held.jacobian(a, b, t)
        along = self._with_axis(x * self.first_a + y * self.second_a).force(a, b, lam / (x**2 + y**2), t)
        return held.geometric_stiffness(a, b, lam, t) - jnp.outer(along, row) - jnp.outer(row, along)


class TranslationDriver(AbstractJoint):
    """A prescribed displacement, a number or a function of time, of a point of `b` along an axis of `a`; 1 equation.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: the point in the reference configuration [m], inertial frame, shape (3,).
        axis: direction of the displacement, fixed in `a`, inertial frame, shape (3,), any length > 0.
        value: the displacement from the reference configuration [m], shape (), or a signal of it; None: 0. With a
            value the mechanism is assembled before it moves, with a signal it starts with its rate.
            `lgsens.kinematics` prescribes many.

    The multiplier is the force of `b` on `a` along the axis [N]: its negative drives `b`. Raises `ValueError` for a
    wrong shape, a zero axis, or samples joined by straight lines, at which velocities would jump. Source: Haug (1989),
    §9.6.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis: Float[Array, "3"] = axis_field("axis")
    value: Prescribed | None = prescribed_field("value", driven=True)

    @property
    def assembled(self):
        return self.value is None

    drives = True
    coordinates = (DISPLACEMENT,)
    frames = frames_at

    def constraints(self, a: Frame, b: Frame):
        unit = self.axis / jnp.linalg.norm(self.axis)
        line = InPlane(a.local_point(self.at), b.local_point(self.at), a.local_axis(unit))
        return (ConstraintSum((line,), _or_zero(self.value, unit.dtype)),)


class RotationDriver(AbstractJoint):
    """A prescribed angle, a number or a function of time, by which `b` has turned about an axis of `a`; 1 equation.

    Arguments:
        a, b: names of the two bodies; None is the ground. Another joint keeps their axes aligned.
        axis: direction of the axis, fixed in `a`, inertial frame, shape (3,), any length > 0.
        value: the angle from the reference configuration [rad], right-handed, any number of turns, shape (), or a
            signal of it; None: 0. With a value the mechanism is assembled before it moves, with a signal it starts
            with its rate. Poses tell no turns: what counts them (racks, screws, gears, couplings, springs about the
            axis) takes the angle at t0 between −π and π. `lgsens.kinematics` prescribes many.

    The multiplier is the moment of `b` on `a` about the axis [N m]: its negative drives `b`. Raises `ValueError` for a
    wrong shape, a zero axis, or samples joined by straight lines, at which velocities would jump. Source: Haug (1989),
    §9.6.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    axis: Float[Array, "3"] = axis_field("axis")
    value: Prescribed | None = prescribed_field("value", driven=True)

    @property
    def assembled(self):
        return self.value is None

    drives = True
    coordinates = (ANGLE,)

    @property
    def about(self):
        return self.axis

    @property
    def frames(self):
        anywhere = jnp.zeros_like(self.axis)  # it transmits no force
        return frames_along(anywhere, anywhere, self.axis)

    def constraints(self, a: Frame, b: Frame):
        _, first, second = normals(self.axis)
        axes = a.local_axis(first), a.local_axis(second), b.local_axis(first)
        return (Angle(*axes, _or_zero(self.value, first.dtype)),)


def _or_zero(value, dtype) -> Prescribed:
    return jnp.zeros((), dtype) if value is None else prepared(value)
