"""What no equation of a step tells: turns that steps do not resolve or poses do not tell, and joints that came apart.

A load that is fixed in space turns against a body of angular velocity Ω, in the frame of the body: by h|Ω| in a step.
From π on its samples are those of a slower turn as well, or of none at 2π, and Newton converges to the
motion that belongs to these. No equation of a step tells them apart.

With Ω̇ = 0 in the body's frame the moment J Ω̇ + Ω × J Ω on it is the same at all samples, and the increment x = h Ω
is exact at any angle: a ball in flight, a body about a principal axis, a balanced rotor at constant speed in its
bearing. What changes Ω where it is not constant, samples more than half a turn apart do not tell; that Ω̇ is along Ω, as
for a pendulum that turns over, does not help. So a body counts as unsteady if

    |Ω̇| > ε^(2/3) |Ω|²,

where round-off makes Ω̇ = ε Ω², and more by the multipliers of joints, and no unsteady body may turn by π in a step.

A force that depends on an angle which poses tell within half a turn jumps where that jumps from π to −π.

Equations that were left out because others imply them are implied on one branch of the motion, for lengths and axes
that fit (the axes of a planar linkage are parallel). Beyond that the mechanism is another one.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lgsens.dynamics._constraints import missing
from lgsens.dynamics._system import AbstractSystem, State


def unsteady_rate(system: AbstractSystem, v: Float[Array, "*n k"], vdot: Float[Array, "*n k"]) -> Float[Array, "*n"]:
    """The largest |Ω| of an unsteady body [rad/s], along leading axes, without derivative; 0 if bodies are unknown."""
    v, vdot = lax.stop_gradient((v, vdot))
    square, change = (jnp.sum(system.angular_velocities(each) ** 2, axis=-1) for each in (v, vdot))
    unsteady = change > (jnp.finfo(v.dtype).eps ** (2.0 / 3.0) * square) ** 2
    return jnp.sqrt(jnp.max(jnp.where(unsteady, square, 0.0), axis=-1, initial=0.0))


def jumped(before: Float[Array, "n w"], after: Float[Array, "n w"]) -> Bool[Array, " n"]:
    """Whether one of the `AbstractSystem.branches` jumps from one instant to another."""
    return jnp.any(jnp.abs(after - before) > jnp.pi, axis=1)


def coming_to_half_a_turn(before: Float[Array, "n w"], at: Float[Array, "n w"]) -> Bool[Array, " n"]:
    """Whether one of the `AbstractSystem.branches` comes to where it jumps, at the rate from one instant to another."""
    return jnp.any((jnp.abs(at) <= jnp.pi) & (jnp.abs(2.0 * at - before) > jnp.pi), axis=1)


class Unseen(NamedTuple):
    """What tells it, at some instants: `unsteady_rate` [rad/s], `AbstractSystem.branches` [rad], and what is `missing`
    of equations that were left out."""

    rates: Float[Array, "*n"]
    branches: Float[Array, "*n w"]
    missing: Float[Array, "*n r"]

    @classmethod
    def at(cls, system: AbstractSystem, state: State, t) -> "Unseen":
        branches = lax.stop_gradient(system.branches(state.q))
        return cls(unsteady_rate(system, state.v, state.vdot), branches, missing(system, state.q, t))

    @classmethod
    def along(cls, system: AbstractSystem, states: State, t: Float[Array, " n+1"]) -> "Unseen":
        """At all instants of a motion."""
        return jax.vmap(lambda state, t: cls.at(system, state, t))(states, t)


class Faults(NamedTuple):
    """Of each step: how far an unsteady body turns in it [rad], whether an angle jumps, whether one comes to half a
    turn, at the rate of the step before: where Φ jumps, Newton fails or makes something up; and what is missing of
    equations that were left out at its end."""

    turned: Float[Array, " n"]
    jumped: Bool[Array, " n"]
    jumping: Bool[Array, " n"]
    missing: Float[Array, "n r"]

    @classmethod
    def between(cls, t: Float[Array, " n+1"], unseen: Unseen) -> "Faults":
        h, angles = jnp.diff(t), unseen.branches
        before = jnp.concatenate([angles[:1], angles[:-2]])
        ahead, jumps = coming_to_half_a_turn(before, angles[:-1]), jumped(angles[:-1], angles[1:])
        return cls(h * unseen.rates[1:], jumps & (h > 0.0), ahead, unseen.missing[1:])

    @property
    def apart(self) -> Bool[Array, " n"]:
        """Whether these do not hold."""
        return jnp.any(self.missing != 0.0, axis=1)
