"""What a run in steps of any size continues from.

A state of index 3 belongs to the size h of the step that led to it: v is off the constraints by h² B c and a − v̇ stands
for Δ h v̈ (`AbstractAlphaBegin.resized`). With v̄ the consistent velocity, what a step of another size begins with is

    v̄ + h² v_2,   v_2 = (v − v̄)/h_n²,     v̇ + h a_1,   a_1 = (a − v̇)/h_n.

Schemes that remember no step have v̄ = v and a = v̇ but for round-off.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, consistent_velocity
from lgsens.integrate import Start


def continued(system: AbstractSystem, t: Float[Array, " n"], state: State, at: Float[Array, ""]) -> Start:
    """That of a state at one of the times t, of which several may be the same."""
    before = jnp.max(jnp.where(t < at, t, -jnp.inf))
    size = jnp.where(at > t[0], at - before, jnp.min(jnp.where(t > at, t, jnp.inf)) - at)
    v = consistent_velocity(system, state.q, state.v, at)
    started = dataclasses.replace(state, v=v, a=state.vdot)
    return Start(started, v_2=(state.v - v) / size**2, a_1=(state.a - state.vdot) / size)
