"""The initial state of a model, as a scheme starts from it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lgsens.dynamics import RESULTS, AbstractSystem, Initial, State, constraint_jacobian, initial_state
from lgsens.integrate import AbstractScheme, Start
from lgsens.linear import Matrix


class Begin(NamedTuple):
    """The initial state as the scheme starts from it, and how its computation ended."""

    start: Start
    jerk: Float[Array, " k"]  # v̈ there; zero where it is not known
    consistent_v: Float[Array, " k"]  # v_0 without the scheme's O(h²)
    result: Int[Array, ""]
    violation: Float[Array, " m"]
    jacobian: Matrix  # B there, (m, k)


def begin(
    scheme: AbstractScheme, system: AbstractSystem, t0, state0: State | None, initial: Initial | None = None
) -> Begin:
    """The state at t0: `state0` as it is, or the consistent one of the reference configuration, `initial` if known."""
    if state0 is not None:
        jacobian, start = constraint_jacobian(system, state0.q, t0), Start(scheme.resumed(system, state0, t0))
        none = jnp.zeros((), jnp.int32)
        return Begin(start, jnp.zeros_like(state0.v), state0.v, none, system.constraint(state0.q, t0), jacobian)
    initial = initial_state(system, t0) if initial is None else initial
    usable = initial.result == RESULTS.successful
    start = jax.tree.map(lambda leaf: jnp.where(usable, leaf, jnp.nan), scheme.start(system, initial, t0))
    jacobian = constraint_jacobian(system, initial.state.q, t0)
    return Begin(start, initial.jerk, initial.state.v, initial.result, initial.violation, jacobian)
