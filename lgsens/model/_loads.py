"""Force elements as stacked numbers, with closed-form tangents.

Each returns the generalized force Q = [F_a, M_a, F_b, M_b] that it applies: forces in the inertial frame [N],
moments about the origin of the body frame, in that frame [N m]. The system subtracts it from the residual, so
f(q, v, t) of eq. (16) is −Q, and K_t, C_t receive −∂Q/∂q, −∂Q/∂v.
"""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens.liegroups import cross, skew
from lgsens.model._elements import AbstractElement, body_fixed, of_length
from lgsens.model._frames import (
    BODY_DIM,
    ROTATION,
    ROTATION_A,
    ROTATION_B,
    TRANSLATING_B,
    TRANSLATION_B,
    Frame,
    embedded,
    separation,
    separation_force,
    separation_stiffness,
)
from lgsens.model._signals import AbstractSignal, constant_of


class LoadTangents(NamedTuple):
    """∂Q/∂q and ∂Q/∂v of a force element, each (12, 12), or None where it is identically zero."""

    position: Float[Array, "12 12"] | None
    velocity: Float[Array, "12 12"] | None


class AbstractLoad(AbstractElement):
    """A force between the frames of two bodies; its tangents come from autodiff.

    `balanced` says whether action equals reaction, so that it does nothing between two parts of one body.
    """

    balanced: ClassVar[bool] = False
    drawn = "spring"

    @abc.abstractmethod
    def force(self, a: Frame, b: Frame, va, vb, t) -> Float[Array, "12"]:
        """Q = [F_a, M_a, F_b, M_b] at the given poses, velocities [ẋ, Ω] of shape (6,) each, and time [s]."""

    def measure(self, a: Frame, b: Frame, va, vb, t) -> Any:
        """What `Trajectory.force` shows of it."""
        return self.force(a, b, va, vb, t)


class AbstractDynamicLoad(AbstractElement):
    """A force between two bodies that depends on states of its own, which obey ż = g(q, v, z, t).

    A state is the velocity of a coordinate with unit mass, of which an element has as many as states: then Q and g
    together are one generalized force, and autodiff gives the tangents of both. `states` are their names; `balanced` as
    in `AbstractLoad`. A load that depends on the multipliers of a joint (`AbstractForce.reads`) says in its `reads` how
    many each basic constraint of the joint has: they follow the states in z.
    """

    states: ClassVar[Any]
    reads: ClassVar[Any] = ()
    balanced: ClassVar[bool] = False
    drawn = "spring"

    @abc.abstractmethod
    def force(self, a: Frame, b: Frame, va, vb, t, z) -> Float[Array, "12"]:
        """Q at the given poses, velocities [ẋ, Ω] of shape (6,) each, time [s], and states."""

    @abc.abstractmethod
    def rate(self, a: Frame, b: Frame, va, vb, t, z) -> Float[Array, " s"]:
        """g there."""

    @abc.abstractmethod
    def initial(self, a: Frame, b: Frame, va, vb, t) -> Float[Array, " s"]:
        """z at the start of a motion."""

    def size(self, length) -> Float[Array, " s"]:
        """A large change of each state over 1 s, in a scene of this length [m]: for tolerances of steps."""
        return jnp.ones(len(self.states), length.dtype)

    def measure(self, a: Frame, b: Frame, va, vb, t, z) -> Any:
        """What `Trajectory.force` shows of it."""
        return self.force(a, b, va, vb, t, z)


_COORDINATES = 3  # of one carrier of states: the translations of what else would be a body


def places_of_states(count: int) -> tuple[int, ...]:
    """Where states are among the coordinates of an element, after those of its two bodies: three in every six."""
    return tuple(2 * BODY_DIM + BODY_DIM * (i // _COORDINATES) + i % _COORDINATES for i in range(count))


def carriers(count: int) -> tuple[tuple[int, ...], ...]:
    """The free coordinates of each carrier of this many states."""
    return tuple(tuple(range(min(_COORDINATES, count - i))) for i in range(0, count, _COORDINATES))


def num_states(load: Any) -> int:
    return len(load.states) if isinstance(load, AbstractDynamicLoad) else 0


def of_states(load: AbstractDynamicLoad, method: str, value: Any) -> Any:
    """What a method returns that says something of each state."""
    return of_length(load, method, value, len(load.states), f"a number for each of the states {load.states}")


def generalized_force(load: Any, a: Frame, b: Frame, va, vb, t, *z) -> Float[Array, " n"]:
    """Q, and where there are states z the force g on their carriers, n = 12 + 6 for each three of them."""
    force = of_length(load, "force", load.force(a, b, va, vb, t, *z), 2 * BODY_DIM, "[F_a, M_a, F_b, M_b]")
    if not (count := num_states(load)):
        return force
    rate = of_states(load, "rate", load.rate(a, b, va, vb, t, *z))
    zeros = jnp.zeros(BODY_DIM * (2 + len(carriers(count))), force.dtype)
    return zeros.at[: 2 * BODY_DIM].set(force).at[np.asarray(places_of_states(count))].set(rate)


class AbstractClosedFormLoad(AbstractLoad):
    """A force element that brings its own tangents."""

    @abc.abstractmethod
    def tangents(self, a: Frame, b: Frame, va, vb, t) -> LoadTangents:
        """∂Q/∂q and ∂Q/∂v at the same arguments as `force`."""


class Weight(AbstractClosedFormLoad):
    """A force m g on the centre of mass of b."""

    mass: Float[Array, ""]
    acceleration: Float[Array, "3"]

    acts_on = TRANSLATING_B

    def force(self, a, b, va, vb, t):
        return embedded(self.mass * self.acceleration, TRANSLATION_B)

    def tangents(self, a, b, va, vb, t):
        return LoadTangents(None, None)


class LineForce(NamedTuple):
    """What a spring-damper does at one instant: length [m], rate [m/s] and tension [N], shape () each."""

    length: Float[Array, ""]
    rate: Float[Array, ""]
    tension: Float[Array, ""]

    __repr__ = brief


class SpringDamperLoad(AbstractClosedFormLoad):
    """A spring and damper in parallel along the line between two points: Q = −Dᵀ n F, n = d/|d|.

        F = F₀ + k (|d| − ℓ₀) + c nᵀ(D v)

    With P = (I − n nᵀ)/|d|, s = D v = ḋ and S = ∂(D v)/∂q|_v = [0, −R_a (X̃_a Ω_a)~, 0, R_b (X̃_b Ω_b)~], the tangents of
    Dᵀ n F are

        ∂/∂q = Dᵀ n (k nᵀD + c (sᵀ P D + nᵀS)) + F Dᵀ P D + D_q(Dᵀ f)|_{f = nF},     ∂/∂v = c Dᵀ n nᵀ D.

    Points that meet give no direction but that in which they part: n = ḋ/|ḋ| there, kept in derivatives; 0, and no
    force, at rest. A spring whose tension vanishes with its length pulls with k d all the same: the force on b is −f,

        f = F n = k d + (F₀ − k ℓ₀ + c ḋ·n) n,     F P/|d| = (k + (F₀ − k ℓ₀ + c ḋ·n)/|d|) (I − n nᵀ),

    with 1/|d| taken as 0 at d = 0.
    """

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    free_length: Float[Array, ""]
    preload: Float[Array, ""]

    balanced = True

    @property
    def drawn(self):
        return "spring" if float(self.stiffness) > 0 else "damper"

    def _line(self, a, b, va, vb):
        """d, 1/|d|, n and the rate of |d|."""
        d = b.point(self.point_b) - a.point(self.point_a)
        speed_a, speed_b = (
            v[: ROTATION.start] + frame.axis(cross(v[ROTATION], point))
            for v, frame, point in ((va, a, self.point_a), (vb, b, self.point_b))
        )
        speed = speed_b - speed_a
        meet = jnp.sum(d * d) == 0.0
        along = jnp.where(meet, lax.stop_gradient(speed), d)
        square = jnp.sum(along * along)
        inverse = jnp.where(square == 0.0, 0.0, lax.rsqrt(jnp.where(square == 0.0, 1.0, square)))
        n = inverse * along
        return d, jnp.where(meet, 0.0, inverse), n, jnp.sum(n * speed)

    def measure(self, a, b, va, vb, t) -> LineForce:
        d, _, n, rate = self._line(a, b, va, vb)
        length = jnp.sum(n * d)
        tension = self.preload + self.stiffness * (length - self.free_length) + self.damping * rate
        return LineForce(length, rate, tension)

    def _but_for_length(self, rate):
        """F − k |d|."""
        return self.preload - self.stiffness * self.free_length + self.damping * rate

    def force(self, a, b, va, vb, t):
        d, _, n, rate = self._line(a, b, va, vb)
        force = self.stiffness * d + self._but_for_length(rate) * n
        return -separation_force(a, b, self.point_a, self.point_b, force)

    def tangents(self, a, b, va, vb, t):
        _, inverse, n, rate = self._line(a, b, va, vb)
        d, gradient = separation(a, b, self.point_a, self.point_b)
        more = self._but_for_length(rate)
        along, per_length = n @ gradient, self.stiffness + more * inverse
        speed = gradient @ jnp.concatenate([va, vb])
        turning_a = a.orientation @ skew(cross(self.point_a, va[ROTATION]))
        turning_b = b.orientation @ skew(cross(self.point_b, vb[ROTATION]))
        turning = embedded(turning_b, None, ROTATION_B) - embedded(turning_a, None, ROTATION_A)
        across = gradient - jnp.outer(n, along)  # |d| P D
        rate_gradient = inverse * (speed @ across) + n @ turning
        position = (
            jnp.outer(along, self.stiffness * along + self.damping * rate_gradient)
            + per_length * (gradient.T @ across)
            + separation_stiffness(a, b, self.point_a, self.point_b, self.stiffness * d + more * n)
        )
        return LoadTangents(-position, -self.damping * jnp.outer(along, along))


class BushingLoad(AbstractClosedFormLoad):
    """Three springs and dampers between two points, along axes fixed to a: Q = −Uᵀ g, g = g₀ + K u + C u̇.

    u = R_aᵀ d is the vector between the points in the frame of a, and with r = X_a + u, where the point of b is in a,

        δu = U δq,    U = [−R_aᵀ,  r̃,  R_aᵀ,  −R_aᵀR_b X̃_b],     u̇ = U v,

    from δ(R_aᵀ) x = (R_aᵀ x)~ δθ_a. With s = ẋ_b + R_b (Ω_b × X_b) − ẋ_a, so that u̇ = R_aᵀ s + r × Ω_a, and
    l = R_bᵀR_a g,

        ∂u̇/∂q = [0,  (R_aᵀ s)~,  0,  −R_aᵀR_b (Ω_b × X_b)~] − Ω̃_a U,
        D_q(Uᵀ g)|_g: rows  R_a g̃ δθ_a,  g̃ U δq,  −R_a g̃ δθ_a,  X̃_b (l̃ δθ_b − R_bᵀR_a g̃ δθ_a),
        ∂Q/∂q = −Uᵀ (K U + C ∂u̇/∂q) − D_q(Uᵀ g),     ∂Q/∂v = −Uᵀ C U.
    """

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    stiffness: Float[Array, "3 3"] = eqx.field(metadata=body_fixed("tensor", "a"))
    damping: Float[Array, "3 3"] = eqx.field(metadata=body_fixed("tensor", "a"))
    preload: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))

    balanced = True
    drawn = "joint"

    def _gradient(self, a, b):
        """r and U."""
        r = a.local_point(b.point(self.point_b))
        back = a.orientation.T
        gradient = jnp.concatenate([-back, skew(r), back, -back @ b.orientation @ skew(self.point_b)], axis=1)
        return r, gradient

    def stretch(self, a, b, va, vb) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """u and u̇."""
        r, gradient = self._gradient(a, b)
        return r - self.point_a, gradient @ jnp.concatenate([va, vb])

    def _tension(self, r, gradient, va, vb):
        """g, on a, in the frame of a."""
        rate = gradient @ jnp.concatenate([va, vb])
        return self.preload + self.stiffness @ (r - self.point_a) + self.damping @ rate

    def force(self, a, b, va, vb, t):
        r, gradient = self._gradient(a, b)
        return -self._tension(r, gradient, va, vb) @ gradient

    def tangents(self, a, b, va, vb, t):
        r, gradient = self._gradient(a, b)
        g = self._tension(r, gradient, va, vb)
        relative = b.orientation.T @ a.orientation
        swing = cross(vb[ROTATION], self.point_b)
        speed = vb[: ROTATION.start] + b.axis(swing) - va[: ROTATION.start]
        rate = (
            embedded(skew(a.local_axis(speed)), None, ROTATION_A)
            - embedded(relative.T @ skew(swing), None, ROTATION_B)
            - skew(va[ROTATION]) @ gradient
        )
        turned, arm = a.orientation @ skew(g), skew(self.point_b)
        by_turns_of_a = jnp.concatenate([turned, jnp.zeros_like(turned), -turned, -arm @ relative @ skew(g)])
        geometric = (
            embedded(by_turns_of_a, None, ROTATION_A)
            + embedded(skew(g) @ gradient, ROTATION_A, None)
            + embedded(arm @ skew(relative @ g), ROTATION_B, ROTATION_B)
        )
        position = gradient.T @ (self.stiffness @ gradient + self.damping @ rate) + geometric
        return LoadTangents(-position, -gradient.T @ self.damping @ gradient)


class PointForce(AbstractClosedFormLoad):
    """A force f(t) = s(t) f on a point of b, fixed in the inertial frame, and a moment s(t) m fixed in b.

    Q_b = s [f, X̃ R^T f + m];  ∂Q/∂q = s D_q(Dᵀ f).
    """

    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    vector: Float[Array, "3"]
    moment: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    signal: AbstractSignal

    @property
    def driven(self):
        return constant_of(self.signal)

    def force(self, a, b, va, vb, t):
        moment = self.moment + cross(self.point_b, b.local_axis(self.vector))
        zero = jnp.zeros(6, self.vector.dtype)
        return self.signal(t) * jnp.concatenate([zero, self.vector, moment])

    def tangents(self, a, b, va, vb, t):
        stiffness = separation_stiffness(a, b, jnp.zeros_like(self.point_b), self.point_b, self.vector)
        return LoadTangents(self.signal(t) * stiffness, None)
