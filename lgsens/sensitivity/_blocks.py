"""A sweep over the steps of a known trajectory, in blocks of steps.

The states are known before the sensitivities are, so what a step needs of them (tangents, factors, pseudo-loads) does
not wait for the step before it. It is evaluated for a block of steps at once, in the few large operations that one step
would cost; what remains in the sweep is one solve and a few products.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.linear import tuned


class Blocks(NamedTuple):
    """How `num_steps` steps are divided: `length` in a block, `padding` in the last one."""

    length: int
    padding: int

    @classmethod
    def of(cls, num_steps: int, numbers: int) -> "Blocks":
        """Blocks for factors of `numbers` numbers; without padding where a divisor is near."""
        longest = max(1, min(num_steps, tuned.BLOCK_STEPS, tuned.BLOCK_NUMBERS // numbers))
        divisors = [n for n in range((longest + 1) // 2, longest + 1) if num_steps % n == 0]
        length = divisors[-1] if divisors else longest
        return cls(length, -num_steps % length)


def padded(tree: Any, count: int, *, repeat: bool) -> Any:
    """`count` more entries along the leading axis: the last one again, or zeros."""
    if not count:
        return tree

    def longer(leaf):
        end = (
            jnp.broadcast_to(leaf[-1:], (count, *leaf.shape[1:]))
            if repeat
            else jnp.zeros_like(leaf, shape=(count, *leaf.shape[1:]))
        )
        return jnp.concatenate([leaf, end])

    return jax.tree.map(longer, tree)


def sweep_blocks(blocks: Blocks, sweep: Callable, carry: Any, inputs: Any, *, reverse: bool = False):
    """`lax.scan` of `sweep(carry, block)` over blocks, where `block` and its outputs have a leading axis of steps.

    The leading axis of `inputs` is a multiple of the length of a block; that of the outputs is the same.
    """
    # No −1 among the sizes: without constraints there are arrays of size 0.
    length = blocks.length
    split = jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] // length, length, *leaf.shape[1:]), inputs)
    carry, outputs = lax.scan(sweep, carry, split, reverse=reverse)
    return carry, jax.tree.map(lambda leaf: leaf.reshape(leaf.shape[0] * length, *leaf.shape[2:]), outputs)
