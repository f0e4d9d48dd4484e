"""All steps in one scan, whatever the scheme, the grid and what is kept of each state."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._grid import AbstractGrid
from lgsens.integrate._linearized import Node
from lgsens.integrate._loops import over_steps, with_first
from lgsens.integrate._scheme import AbstractScheme, Memory, Stats

Output = Callable[[State, Any], Any]  # (state, t) ↦ pytree


class Walk(eqx.Module):
    """A scheme on a system, one step at a time."""

    scheme: AbstractScheme
    system: AbstractSystem
    shared: Any

    @classmethod
    def of(cls, scheme: AbstractScheme, system: AbstractSystem) -> "Walk":
        return cls(scheme, system, scheme.shared(system))

    def begin(self, grid: AbstractGrid, state: State, *, exact: bool = False) -> "Progress":
        """Before the first step; `exact`: every step will be linearized, and its exact matrix known."""
        node = Node(grid.t0, grid.t0 + grid.first_size, grid.first_size)
        memory = self.scheme.memory(self.shared, state, node, uneven=grid.h.ndim > 0, exact=exact)
        return Progress(state, memory, jnp.ones((), bool))

    def take(self, progress: "Progress", begun: State, node: Node, active) -> tuple["Progress", Stats]:
        """A step that begins with `begun`; it ends the simulation if it does not converge."""
        state, memory, stats = self.scheme.take(
            self.system, self.shared, progress.state, begun, progress.memory, node, active
        )
        return Progress(state, memory, stats.converged), stats

    def on(self, grid: AbstractGrid, progress: "Progress", place: Any) -> tuple["Progress", Stats]:
        """The step at a place of a grid; an empty one repeats the state."""
        node, empty = grid.node(place), grid.empty(place)
        begun = grid.begun_in_turn(self.scheme, self.system, place, progress.state)
        if empty is None:
            return self.take(progress, begun, node, progress.running)
        active = progress.running & ~empty
        done, stats = self.take(progress, begun, node, active)
        quiet = empty & progress.running
        stats = stats._replace(
            increment=jnp.where(quiet, 0.0, stats.increment),
            residual=jnp.where(quiet, 0.0, stats.residual),
            converged=jnp.where(quiet, True, stats.converged),
        )
        return done.where(active, progress), stats


class Progress(NamedTuple):
    """The last state, and what the next step needs of those before."""

    state: State
    memory: Memory
    running: Bool[Array, ""]

    def with_matrix(self, matrix) -> "Progress":
        return self._replace(memory=self.memory._replace(matrix=matrix))

    def where(self, which, before: "Progress") -> "Progress":
        """This where `which`, else `before`; the matrix, which is large, is this one in any case."""
        return selected(which, self, before.with_matrix(self.memory.matrix))


class Mark(NamedTuple):
    """Where a run can go on: the n-th state, and what is kept of the memory."""

    n: Float[Array, ""]
    progress: Progress


def selected(which, one, other):
    """`one` where `which`, leaf by leaf, else `other`."""
    return jax.tree.map(lambda one, other: one if one is other else jnp.where(which, one, other), one, other)


def march(
    scheme: AbstractScheme, system: AbstractSystem, grid: AbstractGrid, state0: State, output: Output
) -> tuple[Any, State, Stats]:
    """`output(state, t)` at all times, stacked along a leading axis n + 1, the final state, and what Newton did.

    A step that does not converge ends the simulation: it and the steps after it are NaN, and `Stats` says so.
    """
    walk = Walk.of(scheme, system)
    first = jax.tree.map(jnp.asarray, output(state0, grid.t0))
    later, end, stats = _marched(walk, grid, walk.begin(grid, state0), output, first)
    return with_first(first, later), end.state, stats


def states_of(scheme: AbstractScheme, system: AbstractSystem, grid: AbstractGrid, state0: State) -> tuple[State, Stats]:
    """All states, stacked, and what Newton did."""
    states, _, stats = march(scheme, system, grid, state0, lambda state, _: state)
    return states, stats


def _marched(walk: Walk, grid: AbstractGrid, progress: Progress, output: Output, first: Any = None):
    """`first`: what stands in rows beyond the last step: with it sweeps make matrices there that are regular."""

    def step(progress, place):
        progress, stats = walk.on(grid, progress, place)
        return progress, (output(progress.state, grid.node(place).t), stats)

    blank = None if grid.count is None else (first, Stats.none(grid.t0))
    end, (outputs, stats) = over_steps(step, progress, grid.places(), grid.count, blank)
    return outputs, end, stats


def first_mark(walk: Walk, grid: AbstractGrid, state0: State) -> Mark:
    """That of the beginning."""
    return Mark(jnp.zeros_like(grid.t0), walk.begin(grid, state0).with_matrix(None))


def march_on(walk: Walk, grid: AbstractGrid, mark: Mark, output: Output) -> tuple[Any, Mark, Stats]:
    """The steps of a grid that begins at a mark: `output(state, t)` after each; the mark that they reach."""
    begin = mark.progress.with_matrix(walk.begin(grid, mark.progress.state).memory.matrix)
    outputs, end, stats = _marched(walk, grid, begin, output)
    return outputs, Mark(mark.n + grid.num_steps, end.with_matrix(None)), stats
