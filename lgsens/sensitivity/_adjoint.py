"""The discrete adjoint variable method: back substitution with Lᵀ.

Given cotangents c_n of the states and c_p of the parameters, solve Lᵀ (μ, p̄) = (c, c_p). With c_{n+1} already holding
what later steps contribute, a step has

    E_{y⁺}ᵀ μ_{n+1} = c_{n+1},     c_n += −E_yᵀ μ_{n+1} (through y_n*),     p̄ += −E_pᵀ μ_{n+1},

and an empty step μ = c_{n+1}, which it adds to c_n. The pull-back of the loads to p̄ is that of a block of steps at
once. What is kept is the states.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme, Variation, earlier, with_first
from lgsens.sensitivity._blocks import Blocks, padded, sweep_blocks
from lgsens.sensitivity._linearization import Parameters, Step, steps


def adjoint_sweep(scheme: AbstractScheme, states: State, parameters: Parameters, c: Variation, c_p: Parameters):
    """Solve Lᵀ (μ, p̄) = (c, c_p) backwards in time; returns μ stacked (row 0: the cotangent of δ_0), and p̄."""
    system, grid = parameters
    shared, num_steps = scheme.shared(system), grid.num_steps
    blocks = Blocks.of(num_steps, scheme.numbers(system))

    every = steps(scheme, states, grid)

    def loads_of(system, grid, step: Step, place):
        return scheme.loads(shared, step.begun, step.state)(system, grid.node(place))

    def prepare(step: Step):
        return scheme.linearized(system, shared, grid.node(step.place), step.begun, step.state)

    def one(loads, c: Variation, inputs):
        linearized, step, own = inputs
        link = step.link
        begun, of_loads, mu = linearized.backward(shared, grid.node(step.place), c, loads)
        previous, of_place = link.begun_transposed(begun)
        previous = link.unless_empty(previous, c)
        of_loads = link.unless_empty(of_loads, jax.tree.map(jnp.zeros_like, of_loads))
        previous = jax.tree.map(jnp.add, own, previous)
        return previous, (link.unless_empty(mu, c), of_loads, of_place)

    def block(carry, inputs):
        c, bar = carry
        step, own = inputs

        def all_loads(system, grid, places):
            return jax.vmap(lambda step, place: loads_of(system, grid, step, place))(step, places)

        loads, pull_back = jax.vjp(all_loads, system, grid, step.place)
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), loads)
        inputs = (jax.vmap(prepare)(step), step, own)
        c, (mu, of_loads, of_place) = lax.scan(partial(one, shapes), c, inputs, reverse=True)
        of_system, of_grid, of_places = pull_back(of_loads)
        bar = jax.tree.map(jnp.add, bar, Parameters(of_system, of_grid))
        return (c, bar), (mu, grid.place_cotangents(of_places, of_place))

    # The steps that fill the last block come first, with zero cotangents, and leave them zero.
    c = padded(c, blocks.padding, repeat=False)
    last = jax.tree.map(lambda leaf: leaf[-1], c)
    inputs = (padded(every, blocks.padding, repeat=True), earlier(c))
    (first, bar), (rest, of_places) = sweep_blocks(blocks, block, (last, c_p), inputs, reverse=True)
    rest, of_places = jax.tree.map(lambda leaf: leaf[:num_steps], (rest, of_places))
    (of_grid,) = jax.vjp(lambda grid: grid.places(), grid)[1](of_places)
    return with_first(first, rest), Parameters(bar.system, jax.tree.map(jnp.add, bar.grid, of_grid))
