"""All steps in one scan."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._guess import Guess
from lgsens.integrate._newton import Chord, Constants, Stats, Wear, no_solver, take_step
from lgsens.integrate._scheme import GeneralizedAlpha
from lgsens.integrate._singular import Watch


def integrate(
    scheme: GeneralizedAlpha, num_steps: int, system: AbstractSystem, state0: State, t0, h
) -> tuple[State, Stats]:
    """The states at t0 + n h, n = 0 … num_steps, stacked along a leading axis.

    A step that does not converge ends the simulation: it and the steps after it are NaN, and `Stats` says so.
    """
    states, _, stats = integrate_outputs(scheme, num_steps, system, state0, t0, h, lambda state, _: state)
    return states, stats


def integrate_outputs(
    scheme: GeneralizedAlpha,
    num_steps: int,
    system: AbstractSystem,
    state0: State,
    t0,
    h,
    output: Callable[[State, Any], Any],
) -> tuple[Any, State, Stats]:
    """`output(state, t)` stacked instead of the states, the final state, and what Newton did."""
    later, end, stats = integrate_onward(scheme, num_steps, system, Mark.first(state0), t0, h, output)
    first = jax.tree.map(jnp.asarray, output(state0, t0))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), first, later), end.state, stats


class Mark(NamedTuple):
    """Where a run can go on: the n-th state, and what the iteration of the next step knows of the steps before."""

    n: Float[Array, ""]
    state: State
    guess: Guess
    running: Bool[Array, ""]
    watch: Watch

    @classmethod
    def first(cls, state0: State) -> "Mark":
        dtype = state0.a.dtype
        return cls(jnp.zeros((), dtype), state0, Guess.first(state0), jnp.ones((), bool), Watch.first(dtype))


def integrate_onward(
    scheme: GeneralizedAlpha,
    num_steps: int,
    system: AbstractSystem,
    mark: Mark,
    t0,
    h,
    output: Callable[[State, Any], Any],
) -> tuple[Any, Mark, Stats]:
    """`num_steps` steps on from a mark: `output(state, t)` after each of them, stacked; the mark that they reach.

    The steps are those of one long run where n of the mark is a multiple of `factor_every`: the inverse of the
    iteration matrix is due there, and is not part of the mark.
    """
    constants = Constants.of(system, stabilized=scheme.stabilized)
    unknowns = system.group.dim + len(system.constraint_names)

    def step(carry, n):
        previous, guess, solver, wear, running, watch = carry
        chord, steps = None, jnp.maximum(wear.steps, 1).astype(h.dtype)
        if solver is not None:
            due = (jnp.mod(n, scheme.factor_every) == 0) | watch.ends_within(steps + 2.0 * scheme.factor_every)
            if scheme.iterations is None:
                due = due | wear.out(unknowns)
            chord = Chord(solver, due)
        t = t0 + (n + 1) * h
        state, guess, stats, chord = take_step(scheme, system, constants, previous, guess, chord, running, t, h)
        if chord is not None:
            solver, made = chord
            watch = jax.tree.map(partial(jnp.where, made), watch.after(stats.margin, steps), watch)
            wear = wear.after(made, stats.iterations)
        return (state, guess, solver, wear, stats.converged, watch), (output(state, t), stats)

    count = mark.n + jnp.arange(num_steps, dtype=constants.scale.dtype)
    solver = no_solver(scheme, system, constants, mark.state, t0, h) if scheme.factor_every else None
    start = (mark.state, mark.guess, solver, Wear.unused(), mark.running, mark.watch)
    (state, guess, _, _, running, watch), (outputs, stats) = lax.scan(step, start, count)
    return outputs, Mark(mark.n + num_steps, state, guess, running, watch), stats
