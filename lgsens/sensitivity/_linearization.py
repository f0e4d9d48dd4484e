"""The linearized trajectory, L δ = b: the one operator behind both sensitivity methods, whatever scheme and grid.

Let δ_n be the sensitivities of the state at t_n in Lie-algebra coordinates, and p the parameters: the numbers of the
system and of the grid. Row 0 of L is δ_0 = b_0, those of a step are its equations E(y_n*, y_{n+1}; p) = 0 linearized
(`integrate/_linearized.py`; each scheme derives its own), with y_n* what the step begins with (`integrate/_grid.py`),

    E_{y⁺} δ_{n+1} + E_y δ_n* + E_p p' = b_{n+1},

and the last row is p' = b.p. Where sizes change, y_n* depends on p as well. A step of size 0 has the equations
δ_{n+1} − δ_n = b. L is block lower bidiagonal with a border for p. A derivative has b_0 and b.p only (all other rows
zero); derivatives of derivatives fill the other rows.

Forward substitution with L is the direct differentiation method, back substitution with Lᵀ the discrete adjoint
variable method (`_sweeps.py`). Both solve with the exact iteration matrix of eq. (30).
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate import (
    AbstractGrid,
    AbstractScheme,
    Node,
    Variation,
    earlier,
    later,
    rows,
    with_first,
)
from lgsens.linear import tuned
from lgsens.sensitivity._step_blocks import StepBlocks


class Parameters(NamedTuple):
    """What a trajectory depends on besides its initial state, or a tangent or cotangent of it."""

    system: AbstractSystem
    grid: AbstractGrid


class Step(NamedTuple):
    """One converged step: where it is, and the states at both ends."""

    place: Any
    before: State
    state: State


def steps(states: State, grid: AbstractGrid) -> Step:
    """All steps of a trajectory, stacked."""
    return Step(grid.places(), earlier(states), later(states))


def place_tangents(grid: AbstractGrid, d: AbstractGrid) -> Any:
    """The tangents of the places, stacked."""
    return jax.jvp(lambda grid: grid.places(), (grid,), (d,))[1]


def with_places(grid: AbstractGrid, bar: Parameters, of_places: Any) -> Parameters:
    """p̄ with what cotangents of the places say of the grid."""
    (of_grid,) = jax.vjp(lambda grid: grid.places(), grid)[1](of_places)
    return Parameters(bar.system, jax.tree.map(jnp.add, bar.grid, of_grid))


def node_tangent(grid: AbstractGrid, d: AbstractGrid, place, d_place) -> Node:
    """The tangent of a step in time."""
    return jax.jvp(lambda grid, place: grid.node(place), (grid, place), (d, d_place))[1]


def matvec(
    scheme: AbstractScheme,
    states: State,
    parameters: Parameters,
    delta: Variation,
    d: Parameters | None,
    *,
    at_once: bool = False,
):
    """L (δ, p'), the tangents of all equations: what JAX differentiates a second time; d None: p is no unknown.

    By blocks of steps, of which a derivative in reverse mode keeps what goes in, and no more; `at_once`: by one.
    """
    system, grid = parameters
    group = system.group

    def row(place, d_place, before: State, state: State, previous: Variation, current: Variation) -> Variation:
        def equations(system, grid, place, before, state):
            return rows(scheme, system, grid.node(place), grid.begun(scheme, system, place, before), state)

        d_states = to_ambient(group, before, previous), to_ambient(group, state, current)
        if d is None:
            _, found = jax.jvp(partial(equations, system, grid, place), (before, state), d_states)
        else:
            _, found = jax.jvp(equations, (system, grid, place, before, state), (*d, d_place, *d_states))
        return grid.unless_empty(place, found, jax.tree.map(jnp.subtract, current, previous))

    def taken(rows: Variation) -> Variation:
        """The rows of steps; those beyond the last one say δ = b."""
        if grid.count is None:
            return rows
        beyond = jnp.arange(grid.num_steps, dtype=grid.count.dtype) >= grid.count
        where = lambda row, own: jnp.where(jnp.expand_dims(beyond, range(1, row.ndim)), own, row)
        return jax.tree.map(where, rows, later(delta))

    numbers = max(1, scheme.numbers(system) // tuned.PRODUCT_BLOCKS)
    blocks = StepBlocks(grid.num_steps, 0) if at_once else StepBlocks.of(grid.num_steps, numbers)
    block = jax.checkpoint(lambda inputs: jax.vmap(row)(*inputs), prevent_cse=False)  # a loop keeps them apart
    d_places = None if d is None else place_tangents(grid, d.grid)
    every = (grid.places(), d_places, earlier(states), later(states), earlier(delta), later(delta))
    _, found = blocks.scan(lambda _, inputs: ((), block(inputs)), (), blocks.padded(every, repeat=True))
    return with_first(jax.tree.map(lambda leaf: leaf[0], delta), taken(found)), d


# Conversion between Lie-algebra coordinates and the arrays of q: the only place where it happens.


def to_algebra(group, state: State, tangent: State) -> Variation:
    """The Lie-algebra coordinates of a tangent of a state's arrays."""
    return Variation.of(group.from_ambient(state.q, tangent.q), tangent)


def to_ambient(group, state: State, delta: Variation) -> State:
    """The tangent of a state's arrays with the given Lie-algebra coordinates."""
    return State(group.to_ambient(state.q, delta.w), *delta[1:])


def cotangent_to_algebra(group, state: State, cotangent: State) -> Variation:
    """The transpose of `to_ambient`: what a cotangent of the arrays says of the coordinates."""
    (w,) = jax.linear_transpose(lambda w: group.to_ambient(state.q, w), state.v)(cotangent.q)
    return Variation.of(w, cotangent)


def cotangent_to_ambient(group, state: State, delta: Variation) -> State:
    """The transpose of `to_algebra`."""
    return State(configuration_cotangent(group, state.q, delta.w), *delta[1:])


def configuration_cotangent(group, q, w):
    """The cotangent of the arrays of q that acts as w acts on Lie-algebra coordinates."""
    return jax.linear_transpose(lambda dq: group.from_ambient(q, dq), q)(w)[0]
