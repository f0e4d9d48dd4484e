"""A run that keeps what was asked of each state, and no state.

The scan of the integrator stacks the outputs of a function of the state instead of the states themselves, so that a
batch of designs does not stack whole trajectories. Derivatives need the states (`_methods.py`), so the rule makes the
trajectory and takes the same function of it: the values are the same, and so is what is differentiated.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate import GeneralizedAlpha, Stats, integrate_outputs
from lgsens.sensitivity._linearization import Parameters, times
from lgsens.sensitivity._methods import AbstractSensitivity, DirectDifferentiation, decoded, encoded

Output = Callable[[AbstractSystem, State, Any], Any]


class SavedRun(NamedTuple):
    """The outputs, stacked along a leading axis n + 1, the final state, and Newton's statistics."""

    outputs: Any
    final: State
    stats: Stats


def saved_run(
    method: AbstractSensitivity,
    output: Output,
    scheme: GeneralizedAlpha,
    num_steps: int,
    state0: State,
    parameters: Parameters,
) -> SavedRun:
    """`output(system, state, t)` at t0 + n h, n = 0 … num_steps; only the default method does without the states."""
    if method == DirectDifferentiation():
        return _decoded(_saved(output, scheme, num_steps, state0, parameters))
    return _from_states(method, output, scheme, num_steps, state0, parameters)


def _from_states(method, output, scheme, num_steps, state0, parameters) -> SavedRun:
    states, stats = method.trajectory(scheme, num_steps, state0, parameters)
    outputs = jax.vmap(partial(output, parameters.system))(states, times(num_steps, parameters))
    return SavedRun(outputs, jax.tree.map(lambda leaf: leaf[-1], states), stats)


def _decoded(run: SavedRun) -> SavedRun:
    return run._replace(stats=decoded(run.stats))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _saved(output, scheme, num_steps, state0, parameters):
    system, t0, h = parameters
    outputs, final, stats = integrate_outputs(scheme, num_steps, system, state0, t0, h, partial(output, system))
    return SavedRun(outputs, final, encoded(stats, h.dtype))


@_saved.defjvp
def _rule(output, scheme, num_steps, primals, tangents):
    def whole(state0, parameters):
        run = _from_states(DirectDifferentiation(), output, scheme, num_steps, state0, parameters)
        return run._replace(stats=encoded(run.stats, parameters.h.dtype))

    return jax.jvp(whole, primals, tangents)
