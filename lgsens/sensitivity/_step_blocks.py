"""The steps of a run, divided into blocks: what is evaluated for a block takes few large operations, and stays in a
core's cache."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.integrate import over_steps
from lgsens.linear import tuned


class StepBlocks(NamedTuple):
    """How `num_steps` steps are divided: `length` in a block, `padding` in the last one; blocks up to the `count`th
    step are taken, None: all."""

    length: int
    padding: int
    count: Any = None

    @classmethod
    def of(cls, num_steps: int, numbers: int, count: Any = None) -> "StepBlocks":
        """Blocks for `numbers` numbers in a step; without padding where a divisor is near.

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

    def scan(self, sweep: Callable, carry: Any, inputs: Any, *, reverse: bool = False, filled: bool = False):
        """`over_steps` of `sweep(carry, block)`, where `block` and its outputs have a leading axis of steps.

        The leading axis of `inputs` is a multiple of the length of a block; the outputs are those of the steps alone,
        unless those that fill the last block are to be kept.
        """
        # No −1 among the sizes: without constraints there are arrays of size 0.
        split = lambda leaf: leaf.reshape(leaf.shape[0] // self.length, self.length, *leaf.shape[1:])
        carry, outputs = over_steps(sweep, carry, jax.tree.map(split, inputs), self.blocks, reverse=reverse)

        def joined(leaf):
            size = leaf.shape[0] * self.length
            return leaf.reshape(size, *leaf.shape[2:])[: size if filled else size - self.padding]

        return carry, jax.tree.map(joined, outputs)
