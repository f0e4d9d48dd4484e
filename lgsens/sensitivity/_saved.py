"""A run that keeps what was asked of each state, and no state; and with checkpoints, the states of some steps.

The scan of the integrator stacks the outputs of a function of the state instead of the states themselves, so that a
batch of designs does not stack whole trajectories. Derivatives need the states (`_methods.py`), so the rule makes the
trajectory and takes the same function of it: the values are the same, and so is what is differentiated.

Two-level checkpointing: the sweeps of the sensitivities need the states of all n steps. A run that keeps the mark at
every s-th state (`Mark`: what the march needs to go on from there) has the n/s segments between them integrated again,
one at a time, when a sweep comes to them: n/s + s states at a time instead of n, least for s = √n, for one more
integration. To JAX a segment is a checkpoint: the march finds its states, of which nothing is differentiated, and the
rule of the method says how they depend on its first one.

A segment is a run on a grid of its own, `AbstractGrid.segments`, and the long run receives the cotangents of its grid
through that function. Each segment begins without a matrix, so the steps of the second integration are those of the
first one. The steps after the last one, which fill its segment, are replaced by its state, with no cotangent.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State
from lgsens.integrate import (
    AbstractGrid,
    AbstractScheme,
    Mark,
    Stats,
    Walk,
    first_mark,
    later,
    march,
    march_on,
    with_first,
)
from lgsens.sensitivity._linearization import Parameters
from lgsens.sensitivity._methods import AbstractDiscrete, AbstractSensitivity, DirectDifferentiation

Output = Callable[..., Any]  # (system, state, t) ↦ pytree


class SavedRun(NamedTuple):
    """The outputs, stacked along a leading axis n + 1, the final state, and Newton's statistics."""

    outputs: Any
    final: State
    stats: Stats


class _OfPhysical(eqx.Module):
    """An output of physical states as one of the scheme's; equal, for one compilation, where both are."""

    output: Output = eqx.field(static=True)
    scheme: AbstractScheme = eqx.field(static=True)

    def __call__(self, system, state: State, t):
        return self.output(system, self.scheme.physical(system, state), t)


def saved_run(
    method: AbstractSensitivity, output: Output, scheme: AbstractScheme, state0: State, parameters: Parameters
) -> SavedRun:
    """`output(system, state, t)` at all times of the grid.

    The default method does without the states where nothing is differentiated, those with `checkpoints` always.
    """
    output = _OfPhysical(output, scheme)
    if isinstance(method, AbstractDiscrete) and method.checkpoints is not None:
        segments = Segments.of(parameters.grid.num_steps, method.checkpoints)
        method = dataclasses.replace(method, checkpoints=None)
        return _in_segments(segments, method, output, scheme, state0, parameters)
    if method == DirectDifferentiation():
        return _saved(output, scheme, state0, parameters)
    return _from_states(method, output, scheme, state0, parameters)


def _from_states(method: AbstractSensitivity, output: Output, scheme, state0, parameters: Parameters) -> SavedRun:
    states, stats = method.trajectory(scheme, state0, parameters)
    outputs = jax.vmap(partial(output, parameters.system))(states, parameters.grid.times())
    return SavedRun(outputs, jax.tree.map(lambda leaf: leaf[-1], states), stats)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _saved(output, scheme, state0, parameters) -> SavedRun:
    system, grid = parameters
    outputs, final, stats = march(scheme, system, grid, state0, lambda state, t: output(system, state, t))
    return SavedRun(outputs, final, stats)


@_saved.defjvp
def _rule(output, scheme, primals, tangents):
    return jax.jvp(partial(_from_states, DirectDifferentiation(), output, scheme), primals, tangents)


class Segments(NamedTuple):
    """How `num_steps` steps are divided: `count` segments of `length`."""

    num_steps: int
    length: int

    @classmethod
    def of(cls, num_steps: int, checkpoints: str | int) -> "Segments":
        """At most `checkpoints` segments; "sqrt": about √n."""
        return cls(
            num_steps, math.isqrt(num_steps - 1) + 1 if checkpoints == "sqrt" else -(-num_steps // int(checkpoints))
        )

    @property
    def count(self) -> int:
        return -(-self.num_steps // self.length)

    def joined(self, rows: Any) -> Any:
        """The rows of steps 1 … n."""
        flat = lambda leaf: leaf.reshape(self.count * self.length, *leaf.shape[2:])[: self.num_steps]
        return jax.tree.map(flat, rows)

    def grids(self, grid: AbstractGrid) -> AbstractGrid:
        """Those of the segments, stacked."""
        return grid.segments(self.count, self.length)


def _in_segments(
    segments: Segments, method: AbstractDiscrete, output: Output, scheme, state0, parameters: Parameters
) -> SavedRun:
    system, grid = parameters

    @partial(jax.checkpoint, prevent_cse=False)
    def segment(system, mark: Mark, own: AbstractGrid):
        fixed = lax.stop_gradient((system, mark, own))
        states, end, stats = march_on(Walk.of(scheme, fixed[0]), fixed[2], fixed[1], lambda state, _: state)
        last = jnp.minimum(segments.num_steps - fixed[1].n.astype(int), segments.length)
        rows = jnp.minimum(jnp.arange(segments.length + 1), last)
        found = jax.tree.map(lambda leaf: leaf[rows], with_first(fixed[1].progress.state, states))
        states, _ = method.trajectory(scheme, mark.progress.state, Parameters(system, own), (found, stats))
        outputs = jax.vmap(partial(output, system))(later(states), own.times()[1:])
        final = jax.tree.map(lambda leaf: leaf[last], states)
        return end._replace(progress=end.progress._replace(state=final)), (outputs, stats)

    begin = first_mark(Walk.of(scheme, system), grid, state0)
    begin = lax.stop_gradient(begin)._replace(progress=lax.stop_gradient(begin.progress)._replace(state=state0))
    end, (outputs, stats) = lax.scan(partial(segment, system), begin, segments.grids(grid))
    first = jax.tree.map(jnp.asarray, output(system, state0, grid.t0))
    return SavedRun(with_first(first, segments.joined(outputs)), end.progress.state, segments.joined(stats))
