"""The direct differentiation method of the time integrator (§6.2): forward substitution with L.

At each step all but δ_{n+1} is known: its linearized equations are solved, with one factorization per step, whatever
the number of parameters (under `vmap` over right-hand sides the matrix stays unbatched). The steps after the last,
which fill its block, are computed and dropped.
"""

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme, Variation, later, with_first
from lgsens.sensitivity._blocks import Blocks, padded, sweep_blocks
from lgsens.sensitivity._linearization import Parameters, Step, node_tangent, place_tangents, steps


def direct_sweep(scheme: AbstractScheme, states: State, parameters: Parameters, b: Variation, d: Parameters):
    """Solve L (δ, p') = (b, d) forwards in time; returns δ stacked, and p' = d."""
    system, grid = parameters
    shared, num_steps = scheme.shared(system), grid.num_steps
    blocks = Blocks.of(num_steps, scheme.numbers(system))

    def prepare(step: Step, d_place):
        node = grid.node(step.place)
        d_node = node_tangent(grid, d.grid, step.place, d_place)
        loads = scheme.loads(shared, step.begun, step.state)
        _, of_parameters = jax.jvp(loads, (system, node), (d.system, d_node))
        linearized = scheme.linearized(system, shared, node, step.begun, step.state)
        return linearized, of_parameters, step

    def one(previous: Variation, inputs):
        (linearized, loads, step), row, d_place = inputs
        link, node = step.link, grid.node(step.place)
        current = linearized.forward(shared, node, link.begun(previous, d_place), loads, row)
        current = link.unless_empty(current, jax.tree.map(jnp.add, previous, row))
        return current, current

    def block(previous: Variation, inputs):
        step, rows, d_place = inputs
        return lax.scan(one, previous, (jax.vmap(prepare)(step, d_place), rows, d_place))

    first = jax.tree.map(lambda leaf: leaf[0], b)
    inputs = (steps(scheme, states, grid), later(b), place_tangents(grid, d.grid))
    _, rest = sweep_blocks(blocks, block, first, padded(inputs, blocks.padding, repeat=True))
    return with_first(first, jax.tree.map(lambda leaf: leaf[:num_steps], rest)), d
