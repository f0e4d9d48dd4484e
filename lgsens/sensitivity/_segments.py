"""Two-level checkpointing: a run in segments, of which only the beginnings are kept.

The sweeps of the sensitivities need the states of all n steps. A run that keeps the mark at every s-th state (`Mark`:
what the march needs to go on from there) has the n/s segments between them integrated again, one at a time, when a
sweep comes to them: n/s + s states at a time instead of n, least for s = √n, for one more integration.

A segment is a run on a grid of its own, `AbstractGrid.segments`, and the long run receives the cotangents of its grid
through that function. Each segment begins without a matrix, so the steps of the second integration are those of the
first one. The steps after the last one, which fill its segment, are replaced by its state, with no cotangent.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from lgsens._xla import scan
from lgsens.dynamics import State
from lgsens.integrate import (
    AbstractGrid,
    AbstractScheme,
    Mark,
    Stats,
    Variation,
    Walk,
    first_mark,
    later,
    march_on,
    with_first,
)
from lgsens.sensitivity._linearization import (
    Parameters,
    cotangent_to_algebra,
    cotangent_to_ambient,
    to_algebra,
    to_ambient,
)
from lgsens.sensitivity._sweeps import adjoint_sweep, direct_sweep

Output = Callable[..., Any]  # (system, state, t) ↦ pytree


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

    def split(self, rows: Any) -> Any:
        """Rows of steps 1 … n by segment; zeros after the last one."""
        filling = self.count * self.length - self.num_steps

        def shaped(leaf):
            filled = jnp.concatenate([leaf, jnp.zeros((filling, *leaf.shape[1:]), leaf.dtype)])
            return filled.reshape(self.count, self.length, *leaf.shape[1:])

        return jax.tree.map(shaped, rows)

    def joined(self, rows: Any) -> Any:
        """The rows of steps 1 … n."""
        flat = lambda leaf: leaf.reshape(self.count * self.length, *leaf.shape[2:])[: self.num_steps]
        return jax.tree.map(flat, rows)

    def grids(self, grid: AbstractGrid) -> AbstractGrid:
        """Those of the segments, stacked."""
        return grid.segments(self.count, self.length)


class _Segment(NamedTuple):
    """The states at n₀, n₀ + 1, …; the last one that is not filling."""

    states: State
    last: Int[Array, ""]


def _integrated(scheme: AbstractScheme, segments: Segments, parameters: Parameters, mark: Mark):
    """The segment that begins at a mark, on a grid of its own; the mark at its end, and Newton's statistics."""
    walk = Walk.of(scheme, parameters.system)
    states, end, stats = march_on(walk, parameters.grid, mark, lambda state, _: state)
    last = jnp.minimum(segments.num_steps - mark.n.astype(int), segments.length)
    rows = jnp.minimum(jnp.arange(segments.length + 1), last)
    states = jax.tree.map(lambda leaf: leaf[rows], with_first(mark.progress.state, states))
    return _Segment(states, last), end, stats


def _outputs(output: Output, system, states: State, grid: AbstractGrid):
    """Those after each step of a segment."""
    return jax.vmap(partial(output, system))(states, grid.times()[1:])


def run_in_segments(output: Output, scheme, segments: Segments, state0: State, parameters: Parameters):
    """Outputs of all states, the final state, Newton's statistics; and the marks, stacked."""
    system, grid = parameters

    def segment(mark: Mark, own: AbstractGrid):
        found, end, stats = _integrated(scheme, segments, Parameters(system, own), mark)
        outputs = _outputs(output, system, later(found.states), own)
        return end, (mark, outputs, stats, jax.tree.map(lambda leaf: leaf[found.last], found.states))

    begin = first_mark(Walk.of(scheme, system), grid, state0)
    _, (marks, outputs, stats, ends) = scan(segment, begin, segments.grids(grid))
    first = jax.tree.map(jnp.asarray, output(system, state0, grid.t0))
    outputs = with_first(first, segments.joined(outputs))
    stats: Stats = segments.joined(stats)
    return outputs, jax.tree.map(lambda leaf: leaf[-1], ends), stats, marks


def _differentiable(output: Output) -> Output:
    """The outputs that are floats."""
    return lambda system, state, t: eqx.filter(output(system, state, t), eqx.is_inexact_array)


def direct_in_segments(output: Output, scheme, segments: Segments, marks: Mark, parameters: Parameters, tangents):
    """Tangents of the outputs and of the final state from those of (state0, parameters): `direct_sweep`, by segment."""
    d_state0, d = tangents
    system, grid = parameters
    output, group = _differentiable(output), system.group
    state0 = jax.tree.map(lambda leaf: leaf[0], marks.progress.state)
    grids, d_grids = jax.jvp(segments.grids, (grid,), (d.grid,))

    def segment(delta: Variation, inputs):
        mark, own, d_own = inputs
        found, _, _ = _integrated(scheme, segments, Parameters(system, own), mark)
        b = jax.tree.map(lambda zeros, leaf: zeros.at[0].set(leaf), Variation.none(found.states), delta)
        deltas, _ = direct_sweep(scheme, found.states, Parameters(system, own), b, Parameters(d.system, d_own))
        d_states = jax.vmap(partial(to_ambient, group))(found.states, deltas)
        _, d_outputs = jax.jvp(
            partial(_outputs, output), (system, later(found.states), own), (d.system, later(d_states), d_own)
        )
        ends = jax.tree.map(lambda leaf: leaf[found.last], (deltas, d_states))
        return ends[0], (d_outputs, ends[1])

    delta0 = to_algebra(group, state0, d_state0)
    _, (d_outputs, ends) = scan(segment, delta0, (marks, grids, d_grids))
    d_state0 = to_ambient(group, state0, delta0)
    _, first = jax.jvp(output, (system, state0, grid.t0), (d.system, d_state0, d.grid.t0))
    return with_first(first, segments.joined(d_outputs)), jax.tree.map(lambda leaf: leaf[-1], ends)


def adjoint_in_segments(output: Output, scheme, segments: Segments, marks: Mark, final: State, parameters, cotangents):
    """Cotangents of (state0, parameters) from those of outputs and of the final state: `adjoint_sweep`, by segment."""
    c_outputs, c_final = cotangents
    system, grid = parameters
    output, group = _differentiable(output), system.group
    state0 = jax.tree.map(lambda leaf: leaf[0], marks.progress.state)
    grids, of_grids = jax.vjp(segments.grids, grid)
    none = jax.tree.map(jnp.zeros_like, system)

    def segment(carry, inputs):
        c, bar = carry
        mark, own, c_outputs = inputs
        found, _, _ = _integrated(scheme, segments, Parameters(system, own), mark)
        _, pull_back = jax.vjp(partial(_outputs, output), system, later(found.states), own)
        of_system, of_states, of_grid = pull_back(c_outputs)
        rows = jax.vmap(partial(cotangent_to_algebra, group))(later(found.states), of_states)
        after_first = lambda row: jnp.concatenate([jnp.zeros_like(row[:1]), row])
        rows = jax.tree.map(lambda row, c: after_first(row).at[found.last].add(c), rows, c)
        zero = Parameters(none, jax.tree.map(jnp.zeros_like, own))
        mu, of_run = adjoint_sweep(scheme, found.states, Parameters(system, own), rows, zero)
        bar = jax.tree.map(lambda *terms: sum(terms), bar, of_run.system, of_system)
        return (jax.tree.map(lambda leaf: leaf[0], mu), bar), jax.tree.map(jnp.add, of_run.grid, of_grid)

    start = (cotangent_to_algebra(group, final, c_final), none)
    inputs = (marks, grids, segments.split(later(c_outputs)))
    (c, bar), bar_grids = scan(segment, start, inputs, reverse=True)
    _, pull_back = jax.vjp(output, system, state0, grid.t0)
    of_system, of_state0, of_t0 = pull_back(jax.tree.map(lambda leaf: leaf[0], c_outputs))
    c = jax.tree.map(jnp.add, c, cotangent_to_algebra(group, state0, of_state0))
    (bar_grid,) = of_grids(bar_grids)
    bar_grid = eqx.tree_at(lambda g: g.t0, bar_grid, bar_grid.t0 + of_t0)
    return cotangent_to_ambient(group, state0, c), Parameters(jax.tree.map(jnp.add, bar, of_system), bar_grid)
