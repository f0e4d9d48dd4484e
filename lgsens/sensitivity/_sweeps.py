"""The two sweeps over the steps of a known trajectory: forward substitution with L, and back substitution with Lᵀ.

Forwards, the direct differentiation method of the time integrator (§6.2): at each step all but δ_{n+1} is known, and
its linearized equations are solved, with one factorization per step, whatever the number of parameters (under `vmap`
over right-hand sides the matrix stays unbatched).

Backwards, the discrete adjoint variable method: given cotangents c_n of the states and c_p of the parameters, solve
Lᵀ (μ, p̄) = (c, c_p). With c_{n+1} already holding what later steps contribute, a step has

    E_{y⁺}ᵀ μ_{n+1} = c_{n+1},     c_n += −E_yᵀ μ_{n+1} (through y_n*),     p̄ += −E_pᵀ μ_{n+1},

and an empty step μ = c_{n+1}, which it adds to c_n. What is kept is the states.

Blocks. The states are known before the sensitivities are, so what a step needs of them (tangents, factors, pseudo-loads
and their pull-back) does not wait for the step before it. It is evaluated for a block of steps at once, in the few
large operations that one step would cost; what remains in the sweep is one solve and a few products.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from lgsens._xla import scan
from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme, Variation, earlier, later, over_steps, with_first
from lgsens.linear import tuned
from lgsens.sensitivity._linearization import Parameters, Step, node_tangent, place_tangents, steps


class StepBlocks(NamedTuple):
    """How `num_steps` steps are divided: `length` in a block, `padding` in the last one; blocks up to the `count`th
    step are taken, None: all."""

    length: int
    padding: int
    count: Any = None

    @classmethod
    def of(cls, num_steps: int, numbers: int, count: Any = None) -> "StepBlocks":
        """Blocks for factors of `numbers` numbers; without padding where a divisor is near.

        Where steps are counted the last block is cut anywhere: shorter ones waste less in it.
        """
        most = num_steps if count is None else num_steps // tuned.COUNTED_BLOCKS
        longest = max(1, min(most, tuned.BLOCK_STEPS, tuned.BLOCK_NUMBERS // numbers))
        divisors = [n for n in range((longest + 1) // 2, longest + 1) if num_steps % n == 0]
        length = divisors[-1] if divisors else longest
        return cls(length, -num_steps % length, count)

    @property
    def blocks(self) -> Any:
        """How many are taken; None: all."""
        return None if self.count is None else jnp.ceil(self.count / self.length)

    def last(self, rows: Any) -> Any:
        """The row at the end of the last block."""
        if self.count is None:
            return jax.tree.map(lambda leaf: leaf[-1], rows)
        end = self.blocks.astype(jnp.int32) * self.length
        return jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, end, keepdims=False), rows)

    def padded(self, tree: Any, *, repeat: bool) -> Any:
        """What fills the last block along the leading axis: the last entry again, or zeros."""
        if not self.padding:
            return tree

        def longer(leaf):
            end = jnp.broadcast_to(leaf[-1:], (self.padding, *leaf.shape[1:]))
            return jnp.concatenate([leaf, end if repeat else jnp.zeros_like(end)])

        return jax.tree.map(longer, tree)

    def scan(self, sweep: Callable, carry: Any, inputs: Any, *, reverse: bool = False):
        """`over_steps` of `sweep(carry, block)`, where `block` and its outputs have a leading axis of steps.

        The leading axis of `inputs` is a multiple of the length of a block; the outputs are those of the steps alone.
        """
        # No −1 among the sizes: without constraints there are arrays of size 0.
        split = lambda leaf: leaf.reshape(leaf.shape[0] // self.length, self.length, *leaf.shape[1:])
        carry, outputs = over_steps(sweep, carry, jax.tree.map(split, inputs), self.blocks, reverse=reverse)

        def joined(leaf):
            size = leaf.shape[0] * self.length
            return leaf.reshape(size, *leaf.shape[2:])[: size - self.padding]

        return carry, jax.tree.map(joined, outputs)


def direct_sweep(scheme: AbstractScheme, states: State, parameters: Parameters, b: Variation, d: Parameters):
    """Solve L (δ, p') = (b, d) forwards in time; returns δ stacked, and p' = d.

    The steps after the last, which fill its block, are computed and dropped.
    """
    system, grid = parameters
    shared, blocks = scheme.shared(system), StepBlocks.of(grid.num_steps, scheme.numbers(system), grid.count)

    def prepare(step: Step, d_place):
        node = grid.node(step.place)
        d_node = node_tangent(grid, d.grid, step.place, d_place)
        loads = scheme.loads(shared, step.begun, step.state)
        _, of_parameters = jax.jvp(loads, (system, node), (d.system, d_node))
        return scheme.linearized(system, shared, node, step.begun, step.state), of_parameters

    def one(previous: Variation, inputs):
        (linearized, loads), step, row, d_place = inputs
        begun = step.link.begun(previous, d_place)
        current = linearized.forward(shared, grid.node(step.place), begun, loads, row)
        current = step.link.unless_empty(current, jax.tree.map(jnp.add, previous, row))
        return current, current

    def block(previous: Variation, inputs):
        step, rows, d_place = inputs
        return scan(one, previous, (jax.vmap(prepare)(step, d_place), step, rows, d_place))

    first = jax.tree.map(lambda leaf: leaf[0], b)
    inputs = (steps(scheme, states, grid), later(b), place_tangents(grid, d.grid))
    _, rest = blocks.scan(block, first, blocks.padded(inputs, repeat=True))
    return with_first(first, rest), d


def adjoint_sweep(scheme: AbstractScheme, states: State, parameters: Parameters, c: Variation, c_p: Parameters):
    """Solve Lᵀ (μ, p̄) = (c, c_p) backwards in time; returns μ stacked (row 0: the cotangent of δ_0), and p̄."""
    system, grid = parameters
    shared, blocks = scheme.shared(system), StepBlocks.of(grid.num_steps, scheme.numbers(system), grid.count)

    def prepare(step: Step):
        return scheme.linearized(system, shared, grid.node(step.place), step.begun, step.state)

    def one(loads, c: Variation, inputs):
        linearized, step, own = inputs
        begun, of_loads, mu = linearized.backward(shared, grid.node(step.place), c, loads)
        previous, of_ratio = step.link.begun_transposed(begun)
        previous = step.link.unless_empty(previous, c)
        of_loads = step.link.unless_empty(of_loads, jax.tree.map(jnp.zeros_like, of_loads))
        previous = jax.tree.map(jnp.add, own, previous)
        return previous, (step.link.unless_empty(mu, c), of_loads, of_ratio)

    def block(carry, inputs):
        c, bar = carry
        step, own = inputs

        def all_loads(system, grid, places):
            at = lambda step, place: scheme.loads(shared, step.begun, step.state)(system, grid.node(place))
            return jax.vmap(at)(step, places)

        loads, pull_back = jax.vjp(all_loads, system, grid, step.place)
        shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), loads)
        inputs = (jax.vmap(prepare)(step), step, own)
        c, (mu, of_loads, of_ratio) = scan(partial(one, shapes), c, inputs, reverse=True)
        of_system, of_grid, of_places = pull_back(of_loads)
        if of_ratio is not None:
            of_places = of_places._replace(ratio=of_places.ratio + of_ratio)
        bar = jax.tree.map(jnp.add, bar, Parameters(of_system, of_grid))
        return (c, bar), (mu, of_places)

    # The steps that fill the last block come first, with zero cotangents, and leave them zero.
    c = blocks.padded(c, repeat=False)
    inputs = (blocks.padded(steps(scheme, states, grid), repeat=True), earlier(c))
    (first, bar), (rest, of_places) = blocks.scan(block, (blocks.last(c), c_p), inputs, reverse=True)
    (of_grid,) = jax.vjp(lambda grid: grid.places(), grid)[1](of_places)
    return with_first(first, rest), Parameters(bar.system, jax.tree.map(jnp.add, bar.grid, of_grid))
