"""The initial state of a model, as the scheme starts from it."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lgsens.dynamics import (
    RESULTS,
    AbstractSystem,
    Initial,
    State,
    constraint_jacobian,
    given_way,
    initial_state,
    split_velocity,
)
from lgsens.integrate import GeneralizedAlpha, missed_increment
from lgsens.linear import Matrix


class Begin(NamedTuple):
    """The initial state as the scheme starts from it, and how its computation ended."""

    state: State
    consistent_v: Float[Array, " k"]  # v_0 without the scheme's O(h²)
    result: Int[Array, ""]
    violation: Float[Array, " m"]
    jacobian: Matrix  # B there, (m, k)


def begin(
    integrator: GeneralizedAlpha, system: AbstractSystem, t0, h, state0: State | None, initial: Initial | None = None
) -> Begin:
    """The state at t0: `state0` as it is, or the consistent one of the reference configuration, `initial` if known."""
    if state0 is not None:
        jacobian = constraint_jacobian(system, state0.q, t0)
        return Begin(state0, state0.v, jnp.zeros((), jnp.int32), system.constraint(state0.q, t0), jacobian)
    initial = initial_state(system, t0) if initial is None else initial
    usable = initial.result == RESULTS.successful
    state = jax.tree.map(lambda leaf: jnp.where(usable, leaf, jnp.nan), _started(integrator, system, initial, t0, h))
    jacobian = constraint_jacobian(system, initial.state.q, t0)
    return Begin(state, initial.state.v, initial.result, initial.violation, jacobian)


def _started(integrator: GeneralizedAlpha, system: AbstractSystem, initial: Initial, t0, h) -> State:
    """The starting values of the scheme; see `GeneralizedAlpha.second_order_start`.

    With exact values, and a_n = v̇(t_n + Δ h), Δ = α_m − α_f, the increment (27) misses the true one by h³ c
    (`missed_increment`). The constraint at t_{n+1} takes B c h³ out again, through the velocity once the scheme is
    under way: B v_n = −h² B c there. Started with B v_0 = 0 it must do so through the first accelerations, and λ is
    off by O(h) for some steps. So v_0 receives h² P c, P the M-orthogonal projection on the constraint directions.
    Stabilized index 2 keeps B v = 0, and takes B c h³ out by its correction. Where constraints may be redundant, the
    joints start with what they give way in a step.
    """
    if not integrator.second_order_start:
        return initial.state
    state = initial.state
    delta = integrator.alpha_m - integrator.alpha_f
    a = state.vdot + (delta * h) * initial.jerk
    if integrator.stabilized:
        return dataclasses.replace(state, a=a)
    missed = missed_increment(integrator, system, state.v, state.vdot, initial.jerk)
    _, normal = split_velocity(system, state.q, missed, t0, initial.factors)
    return State(
        q=given_way(system, state.q, state.lam, integrator.beta * h**2, t0),
        v=state.v + h**2 * normal,
        vdot=state.vdot,
        lam=state.lam,
        a=a,
    )
