"""Loads that resist a rotation or turn with a body, as stacked numbers.

A generalized force along s(q) is Q = −(∂s/∂q)ᵀ f, whose power is −f ṡ: with f = f(s) it has a potential.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens.liegroups import SO3, cross, skew, turn, turn_back
from lgsens.model._constraints import total
from lgsens.model._elements import body_fixed
from lgsens.model._frames import BODY_B, ROTATION, ROTATION_A, ROTATION_B, TRANSLATION_B, TURNING_A, TURNING_B, embedded
from lgsens.model._loads import AbstractClosedFormLoad, AbstractLoad, BushingLoad, LoadTangents
from lgsens.model._relative import but_for_turns
from lgsens.model._signals import AbstractSignal, Prescribed, at_time, constant_of
from lgsens.model._stack import load_tangents
from lgsens.model._turns import acting, branch_of, force_along, rotation_between


class HingeMoment(NamedTuple):
    """What is turned at one instant: angle [rad], rate [rad/s] and the moment on b about the axis [N m], shape ()."""

    angle: Float[Array, ""]
    rate: Float[Array, ""]
    moment: Float[Array, ""]

    __repr__ = brief


Curves = tuple[AbstractSignal | None, AbstractSignal | None, AbstractSignal | None]


def osculating(curves: Curves | None, x: Float[Array, "3"]) -> tuple[Any, Any]:
    """Values and slopes of three curves, each at its entry of x; zero where there is none."""
    if curves is None:
        return 0.0, 0.0
    at = lambda curve, x: (jnp.zeros_like(x),) * 2 if curve is None else jax.jvp(curve, (x,), (jnp.ones_like(x),))
    return tuple(map(jnp.stack, zip(*(at(curve, x[i]) for i, curve in enumerate(curves)))))


class CurveBushingLoad(AbstractClosedFormLoad):
    """A `BushingLoad` with curves f_i(u_i) and g_i(u̇_i) besides, along the columns of a triad in the frame of a.

    At every state it has the force and both tangents of the linear bushing that osculates it there, with f_i′ and g_i′
    among its rates and the rest in its preload.
    """

    linear: BushingLoad
    triad: Float[Array, "3 3"]
    springs: Curves | None = eqx.field(metadata={"over": "length"})
    dampers: Curves | None = eqx.field(metadata={"over": "rate"})

    balanced = True
    drawn = "joint"

    def fixed(self, kind, bodies="ab"):
        return self.linear.fixed(kind, bodies)

    def _osculating(self, a, b, va, vb) -> BushingLoad:
        of, triad = self.linear, self.triad
        u, rate = (turn_back(triad, x) for x in of.stretch(a, b, va, vb))
        (push, stiffness), (drag, damping) = osculating(self.springs, u), osculating(self.dampers, rate)
        along = lambda rates: (triad * (jnp.ones_like(u) * rates)[None]) @ triad.T
        preload = turn(triad, push + drag - stiffness * u - damping * rate)
        own = {"stiffness": along(stiffness), "damping": along(damping), "preload": preload}
        return dataclasses.replace(of, **{name: getattr(of, name) + more for name, more in own.items()})

    def force(self, a, b, va, vb, t):
        return self._osculating(a, b, va, vb).force(a, b, va, vb, t)

    def tangents(self, a, b, va, vb, t):
        return self._osculating(a, b, va, vb).tangents(a, b, va, vb, t)


class TorsionLoad(AbstractLoad):
    """M = motor(t) − M₀ − k (θ − θ₀) − c θ̇ on b about an axis of a; θ within half a turn of θ₀, unless counted."""

    first_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    second_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    first_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    free_angle: Float[Array, ""]
    preload: Float[Array, ""]
    motor: Prescribed | None

    balanced = True
    drawn = None
    acts_on = TURNING_A + TURNING_B

    def value(self, a, b):
        """θ and ∂θ/∂q: with β = Cβ₀, C = R_aᵀR_b, and g = ∂θ/∂β, δβ = β × δθ_a + C (δθ_b × β₀)."""
        relative = a.orientation.T @ b.orientation
        beta = turn(relative, self.first_b)
        x, y = jnp.sum(beta * self.first_a), jnp.sum(beta * self.second_a)
        g = (x * self.second_a - y * self.first_a) / (x * x + y * y)
        zero = jnp.zeros_like(g)
        row = jnp.concatenate([zero, cross(g, beta), zero, cross(self.first_b, turn_back(relative, g))])
        return but_for_turns(jnp.arctan2(y, x), self.free_angle), row

    def along(self, s, rate, t) -> HingeMoment:
        moment = -self.preload - self.stiffness * (s - self.free_angle) - self.damping * rate
        return HingeMoment(s, rate, moment if self.motor is None else moment + at_time(self.motor, t))

    def branch(self, a, b):
        return branch_of(self, a, b)

    def measure(self, a, b, va, vb, t) -> HingeMoment:
        return acting(self, a, b, va, vb, t)[0]

    def force(self, a, b, va, vb, t):
        return force_along(self, a, b, va, vb, t)


class RotationLoad(AbstractClosedFormLoad):
    """Springs and dampers against the rotation φ of b in a, by its vector: m = m₀ + K φ + C φ̇, E = ½ φᵀKφ + m₀ᵀφ;
    and f_i(φ_i), g_i(φ̇_i) more where there are curves.

    The columns of `triad_a` and `triad_b`, in the frames of the bodies, are three axes that coincide in the reference
    configuration; φ = log S with S = (R_a T_a)ᵀ R_b T_b, whose angular velocity in `triad_b` is

        ω = T(φ) φ̇ = E [Ω_a, Ω_b],     E = [−SᵀT_aᵀ, T_bᵀ],     so that Q = −Eᵀλ,     λ = T(φ)⁻ᵀ m = T(−φ)⁻¹ m.

    K and C are diagonal; the slopes of curves add to them. With δSᵀy = (Sᵀy)~ E δθ, and of the moment T_a S λ on a,

        ∂ω/∂θ = −(SᵀT_aᵀΩ_a)~ E,     −∂(Eᵀλ)/∂θ|_λ = [−T_a S λ̃ E, 0],
        ∂λ/∂θ = (∂(T(−φ)⁻¹m)/∂φ + T⁻ᵀ (K + C ∂(T⁻¹ω)/∂φ)) T⁻¹E + T⁻ᵀC T⁻¹ ∂ω/∂θ,     ∂λ/∂Ω = T⁻ᵀC T⁻¹E.
    """

    triad_a: Float[Array, "3 3"]
    triad_b: Float[Array, "3 3"]
    stiffness: Float[Array, "3"]
    damping: Float[Array, "3"]
    preload: Float[Array, "3"]
    springs: Curves | None = eqx.field(default=None, metadata={"over": "angle"})
    dampers: Curves | None = eqx.field(default=None, metadata={"over": "rate"})

    balanced = True
    drawn = None
    acts_on = TURNING_A + TURNING_B

    def _turned(self, a, b, va, vb):
        """Sᵀ, φ, SᵀT_aᵀΩ_a, ω and φ̇."""
        group = SO3()
        to_b = group.compose(self.triad_b.T, group.compose(b.orientation.T, group.compose(a.orientation, self.triad_a)))
        phi = group.log(to_b.T)
        spin_a = turn(to_b, turn_back(self.triad_a, va[ROTATION]))
        spin = turn_back(self.triad_b, vb[ROTATION]) - spin_a
        return to_b, phi, spin_a, spin, group.tangent_inv_mv(phi, spin)

    def branch(self, a, b):
        """φ where there are springs."""
        phi = rotation_between(a, self.triad_a, b, self.triad_b)
        return phi if self.springs is not None else jnp.where(self.stiffness == 0.0, 0.0, phi)

    def _moment(self, phi, rate):
        """m, and K and C with the slopes of the curves."""
        push, stiffness = osculating(self.springs, phi)
        drag, damping = osculating(self.dampers, rate)
        m = self.preload + self.stiffness * phi + self.damping * rate + push + drag
        return m, self.stiffness + stiffness, self.damping + damping

    def force(self, a, b, va, vb, t):
        to_b, phi, _, _, rate = self._turned(a, b, va, vb)
        m, _, _ = self._moment(phi, rate)
        on_a = SO3().tangent_inv_mv(-phi, m)  # T(φ)ᵀ = T(−φ)
        zero = jnp.zeros_like(m)
        moment_a = turn(self.triad_a, turn_back(to_b, on_a))
        return jnp.concatenate([zero, moment_a, zero, -turn(self.triad_b, on_a)])

    def tangents(self, a, b, va, vb, t):
        group = SO3()
        to_b, phi, spin_a, spin, rate = self._turned(a, b, va, vb)
        m, stiffness, damping = self._moment(phi, rate)
        to_a = self.triad_a @ to_b.T
        gradient = embedded(self.triad_b.T, None, ROTATION_B) - embedded(to_a.T, None, ROTATION_A)  # E
        slope = group.tangent_inv(phi)
        by_turns, by_rate = slope @ gradient, slope.T * damping[None, :]
        softness = slope.T * stiffness[None, :] - group.tangent_inv_gradient(-phi, m)
        softness += by_rate @ group.tangent_inv_gradient(phi, spin)
        position = softness @ by_turns - by_rate @ slope @ skew(spin_a) @ gradient
        moment = to_a @ skew(group.tangent_inv_mv(-phi, m)) @ gradient
        geometric = embedded(moment, ROTATION_A, None)
        return LoadTangents(-gradient.T @ position - geometric, -gradient.T @ by_rate @ by_turns)


class BallLoad(AbstractLoad):
    """The moment −k φ − c ω on b, its opposite on a: φ the rotation vector of b in a, ω their relative velocity.

    With S = (R_a T_a)ᵀ R_b T_b = exp(φ̃), φ is along the same axis for both; the moment −k φ has the energy ½ k |φ|².
    """

    triad_a: Float[Array, "3 3"]
    triad_b: Float[Array, "3 3"]
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]

    balanced = True
    drawn = None
    acts_on = TURNING_A + TURNING_B

    def branch(self, a, b):
        phi = rotation_between(a, self.triad_a, b, self.triad_b)
        return jnp.where(self.stiffness == 0.0, 0.0, phi)

    def force(self, a, b, va, vb, t):
        axes_a, axes_b = a.orientation @ self.triad_a, b.orientation @ self.triad_b
        phi = axes_a @ SO3().log(axes_a.T @ axes_b)
        moment = self.stiffness * phi + self.damping * (b.axis(vb[ROTATION]) - a.axis(va[ROTATION]))
        zero = jnp.zeros_like(moment)
        return jnp.concatenate([zero, a.local_axis(moment), zero, -b.local_axis(moment)])


class LoadSum(AbstractClosedFormLoad):
    """Several loads at one place, as one, times a signal s(t) if there is one; what is fixed to bodies and drawn is of
    the first."""

    parts: tuple[AbstractLoad, ...]
    signal: AbstractSignal | None = None

    @property
    def balanced(self):
        return all(part.balanced for part in self.parts)

    @property
    def drawn(self):
        return self.parts[0].drawn

    @property
    def driven(self):
        return None if self.signal is None else constant_of(self.signal)

    def fixed(self, kind, bodies="ab"):
        return self.parts[0].fixed(kind, bodies)

    def branch(self, a, b):
        found = [part.branch(a, b) for part in self.parts]
        angles = [jnp.atleast_1d(angle) for angle in found if angle is not None]
        return jnp.concatenate(angles) if angles else None

    def force(self, a, b, va, vb, t):
        return self._times(total(part.force(a, b, va, vb, t) for part in self.parts), t)

    def tangents(self, a, b, va, vb, t):
        every = zip(*(load_tangents(part, a, b, va, vb, t) for part in self.parts))
        given = ([part for part in parts if part is not None] for parts in every)
        return LoadTangents(*(self._times(total(parts), t) if parts else None for parts in given))

    def _times(self, value, t):
        return value if self.signal is None else self.signal(t) * value


class FollowingForce(AbstractClosedFormLoad):
    """A force s(t) R f on a point of b that turns with it, and a moment s(t) m: Q_b = s [R f, X × f + m]."""

    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    vector: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    moment: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    signal: AbstractSignal

    @property
    def driven(self):
        return constant_of(self.signal)

    def force(self, a, b, va, vb, t):
        zero = jnp.zeros(BODY_B.start, self.vector.dtype)
        moment = self.moment + cross(self.point_b, self.vector)
        return self.signal(t) * jnp.concatenate([zero, b.axis(self.vector), moment])

    def tangents(self, a, b, va, vb, t):
        by_turns = -self.signal(t) * (b.orientation @ skew(self.vector))
        return LoadTangents(embedded(by_turns, TRANSLATION_B, ROTATION_B), None)


class FixedMoment(AbstractClosedFormLoad):
    """A moment s(t) m on b of a fixed direction: s Rᵀm in the frame of b, and δ(Rᵀm) = (Rᵀm)~ δθ."""

    moment: Float[Array, "3"]
    signal: AbstractSignal

    drawn = None
    acts_on = TURNING_B

    def force(self, a, b, va, vb, t):
        return self.signal(t) * embedded(b.local_axis(self.moment), ROTATION_B)

    def tangents(self, a, b, va, vb, t):
        return LoadTangents(self.signal(t) * embedded(skew(b.local_axis(self.moment)), ROTATION_B, ROTATION_B), None)


class DragLoad(AbstractLoad):
    """F = −k |u| u on a point of b, u = its velocity − w; |u| u has one continuous derivative where u = 0."""

    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    per_square: Float[Array, ""]
    wind: Float[Array, "3"]

    drawn = None

    def force(self, a, b, va, vb, t):
        u = vb[: ROTATION.start] + b.axis(cross(vb[ROTATION], self.point_b)) - self.wind
        square = jnp.sum(u * u)
        still = square == 0.0
        speed = jnp.where(still, 0.0, jnp.sqrt(jnp.where(still, 1.0, square)))
        f = -self.per_square * speed * u
        return jnp.concatenate([jnp.zeros(BODY_B.start, f.dtype), f, cross(self.point_b, b.local_axis(f))])
