"""The two sweeps over the steps of a known trajectory: forward substitution with L, and back substitution with Lᵀ.

Forwards, the direct differentiation method of the time integrator (§6.2): at each step all but δ_{n+1} is known, and
its linearized equations are solved, with one factorization per step, whatever the number of parameters (under `vmap`
over right-hand sides the matrix stays unbatched).

Backwards, the discrete adjoint variable method: given cotangents c_n of the states and c_p of the parameters, solve
Lᵀ (μ, p̄) = (c, c_p). With c_{n+1} already holding what later steps contribute, a step has

    E_{y⁺}ᵀ μ_{n+1} = c_{n+1},     c_n += −E_yᵀ μ_{n+1} (through y_n*),     p̄ += −E_pᵀ μ_{n+1},

and an empty step μ = c_{n+1}, which it adds to c_n. What is kept is the states.

Empty steps at the end of a grid with room for them are not gone through: there δ_{n+1} = δ_n + b, and μ = c_{n+1} with
c_n += c_{n+1}, are sums.

Blocks. The states are known before the sensitivities are, so what a step needs of them (tangents, factors, pseudo-loads
and their pull-back) does not wait for the step before it. It is evaluated for a block of steps at once, in the few
large operations that one step would cost; what remains in the sweep is one solve and a few products, and the derivative
of y_n* at the few steps that begin with another state than the last one ended with. Where several sweeps are gone
through at the same states, the steps may be linearized once for all of them (`linearized_steps`).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from lgsens._xla import scan
from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme, Variation, earlier, later, with_first
from lgsens.sensitivity._linearization import Parameters, place_tangents, steps, with_places
from lgsens.sensitivity._linearized_steps import LinearizedSteps, LinearStep
from lgsens.sensitivity._step_blocks import StepBlocks


class _Gone(NamedTuple):
    """What a sweep goes through: the steps, those that fill the last block too, and what linearizes a block of them."""

    equations: LinearizedSteps
    blocks: StepBlocks
    steps: Any
    linearized: Callable[[Any], LinearStep]

    @classmethod
    def of(cls, scheme: AbstractScheme, states: State, parameters: Parameters, linear: LinearStep | None) -> "_Gone":
        """`linear`: the steps, linearized, where they are known."""
        system, grid = parameters
        equations = LinearizedSteps.of(scheme, parameters)
        blocks = StepBlocks.of(grid.num_steps, scheme.numbers(system), grid.taken)
        if linear is not None:
            return cls(equations, blocks, linear, lambda steps: steps)
        return cls(equations, blocks, blocks.padded(steps(states, grid), repeat=True), jax.vmap(equations.linearized))


def linearized_steps(scheme: AbstractScheme, states: State, parameters: Parameters) -> LinearStep:
    """The steps of a run with their matrices and factors, and those that fill its last block: what its sweeps share."""
    _, blocks, every, linearized = _Gone.of(scheme, states, parameters, None)
    return blocks.scan(lambda _, steps: ((), linearized(steps)), (), every, filled=True)[1]


def direct_sweep(
    scheme: AbstractScheme,
    states: State,
    parameters: Parameters,
    b: Variation,
    d: Parameters | None,
    linear: LinearStep | None = None,
) -> tuple[Variation, Any]:
    """Solve L (δ, p') = (b, d) forwards in time; returns δ stacked, and p' = d; d None: p is no unknown.

    `linear`: the steps, linearized, where they are known.
    The steps after the last, which fill its block, are computed and dropped.
    """
    grid = parameters.grid
    equations, blocks, every, linearized = _Gone.of(scheme, states, parameters, linear)

    def one(previous: Variation, inputs):
        (linear, loads), row = inputs
        current = equations.forward(linear, previous, loads, row, d)
        return current, current

    def block(previous: Variation, inputs):
        given, rows, d_place = inputs
        steps = linearized(given)
        loads = jax.vmap(lambda step, d_place: equations.loads(step, d, d_place))(steps, d_place)
        return scan(one, previous, ((steps, loads), rows))

    first = jax.tree.map(lambda leaf: leaf[0], b)
    d_places = None if d is None else place_tangents(grid, d.grid)
    end, rest = blocks.scan(block, first, (every, *blocks.padded((later(b), d_places), repeat=True)))
    if grid.with_empty and blocks.count is not None:  # empty steps, which hand on what they get
        handed_on = lambda end, b: end[None] + jnp.cumsum(b, axis=0)
        rest = blocks.beyond(jax.tree.map(handed_on, end, blocks.beyond(later(b))), rest)
    return with_first(first, rest), d


def adjoint_sweep(
    scheme: AbstractScheme,
    states: State,
    parameters: Parameters,
    c: Variation,
    c_p: Parameters | None,
    linear: LinearStep | None = None,
) -> tuple[Variation, Any]:
    """Solve Lᵀ (μ, p̄) = (c, c_p) backwards in time; returns μ stacked (row 0: the cotangent of δ_0), and p̄.

    c_p None: p is no unknown. `linear`: as in `direct_sweep`.
    """
    grid = parameters.grid
    equations, blocks, every, linearized = _Gone.of(scheme, states, parameters, linear)
    flat, unravel = ravel_pytree(parameters)

    def one(loads, carry, inputs):
        (c, bar), (linear, own) = carry, inputs
        found = equations.backward(linear, c, loads)
        before = equations.before(linear, c, found, bar)
        c = jax.tree.map(jnp.add, own, before.previous)
        return (c, before.parameters), (found.mu, found.loads, before.place)

    def block(carry, inputs):
        c, bar = carry
        given, own = inputs
        steps = linearized(given)
        loads, pull_back = equations.pull_back(steps)
        (c, begun), (mu, of_loads, of_begun) = scan(
            partial(one, loads), (c, jnp.zeros_like(flat)), (steps, own), reverse=True
        )
        if c_p is None:
            return (c, None), (mu, None)
        of_parameters, of_places = pull_back(of_loads)
        bar = jax.tree.map(lambda *parts: sum(parts), bar, of_parameters, unravel(begun))
        return (c, bar), (mu, jax.tree.map(jnp.add, of_places, of_begun))

    with_empty = grid.with_empty and blocks.count is not None
    if with_empty:
        handed_on = lambda c: jnp.cumsum(c[::-1], axis=0)[::-1]
        c = blocks.beyond(jax.tree.map(handed_on, blocks.beyond(c)), c)
    after = later(c)
    # The steps that fill the last block come first, with zero cotangents, and leave them zero.
    c = blocks.padded(c, repeat=False)
    (first, bar), (rest, of_places) = blocks.scan(block, (blocks.last(c), c_p), (every, earlier(c)), reverse=True)
    rest = blocks.beyond(after, rest) if with_empty else rest
    return with_first(first, rest), None if c_p is None else with_places(grid, bar, of_places)
