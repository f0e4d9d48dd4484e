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
from lgsens.sensitivity._linearization import Parameters, Step, place_tangents, steps, with_places
from lgsens.sensitivity._linearized_steps import LinearizedSteps


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

    def beyond(self, rows: Any, others: Any = None) -> Any:
        """The rows after the blocks taken, before them those of `others`, or zeros."""
        others = jax.tree.map(jnp.zeros_like, rows) if others is None else others
        end = self.blocks * self.length

        def joined(row, other):
            after = jnp.arange(row.shape[0], dtype=end.dtype) >= end
            return jnp.where(jnp.expand_dims(after, range(1, row.ndim)), row, other)

        return jax.tree.map(joined, rows, others)

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
    equations = LinearizedSteps.of(scheme, parameters)
    blocks = StepBlocks.of(grid.num_steps, scheme.numbers(system), grid.taken)

    def prepare(step: Step, d_place):
        linear = equations.linearized(step)
        return linear, equations.loads(linear, d, d_place)

    def one(previous: Variation, inputs):
        (linear, loads), row = inputs
        current = equations.forward(linear, previous, loads, row)
        return current, current

    def block(previous: Variation, inputs):
        step, rows, d_place = inputs
        return scan(one, previous, (jax.vmap(prepare)(step, d_place), rows))

    first = jax.tree.map(lambda leaf: leaf[0], b)
    inputs = (steps(states, grid), later(b), place_tangents(grid, d.grid))
    end, rest = blocks.scan(block, first, blocks.padded(inputs, repeat=True))
    if grid.resizes and blocks.count is not None:  # empty steps, which hand on what they get
        handed_on = lambda end, b: end[None] + jnp.cumsum(b, axis=0)
        rest = blocks.beyond(jax.tree.map(handed_on, end, blocks.beyond(later(b))), rest)
    return with_first(first, rest), d


def adjoint_sweep(scheme: AbstractScheme, states: State, parameters: Parameters, c: Variation, c_p: Parameters):
    """Solve Lᵀ (μ, p̄) = (c, c_p) backwards in time; returns μ stacked (row 0: the cotangent of δ_0), and p̄."""
    system, grid = parameters
    equations = LinearizedSteps.of(scheme, parameters)
    blocks = StepBlocks.of(grid.num_steps, scheme.numbers(system), grid.taken)

    def one(loads, c: Variation, inputs):
        linear, own = inputs
        found = equations.backward(linear, c, loads)
        return jax.tree.map(jnp.add, own, found.previous), found._replace(previous=None)

    def block(carry, inputs):
        c, bar = carry
        step, own = inputs
        linear = jax.vmap(equations.linearized)(step)
        loads, pull_back = equations.pull_back(linear)
        c, found = scan(partial(one, loads), c, (linear, own), reverse=True)
        of_parameters, of_places = pull_back(found)
        return (c, jax.tree.map(jnp.add, bar, of_parameters)), (found.mu, of_places)

    with_empty = grid.resizes and blocks.count is not None
    if with_empty:
        handed_on = lambda c: jnp.cumsum(c[::-1], axis=0)[::-1]
        c = blocks.beyond(jax.tree.map(handed_on, blocks.beyond(c)), c)
    after = later(c)
    # The steps that fill the last block come first, with zero cotangents, and leave them zero.
    c = blocks.padded(c, repeat=False)
    inputs = (blocks.padded(steps(states, grid), repeat=True), earlier(c))
    (first, bar), (rest, of_places) = blocks.scan(block, (blocks.last(c), c_p), inputs, reverse=True)
    rest = blocks.beyond(after, rest) if with_empty else rest
    return with_first(first, rest), with_places(grid, bar, of_places)
