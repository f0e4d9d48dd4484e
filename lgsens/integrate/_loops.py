"""A loop over steps: all of those that arrays have room for, or only as many as there are; and stacks of instants.

`lax.scan` is compiled for one number of steps. A loop that writes into arrays with room for more serves all numbers up
to that with one program, ends after the last step, and takes as long.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from lgsens._xla import fori_loop, scan

Tree = TypeVar("Tree")


def over_steps(step: Callable, carry: Any, inputs: Any, count: Any = None, blank: Any = None, *, reverse: bool = False):
    """`lax.scan(step, carry, inputs)`, or that of the first `count` inputs, the last one first with `reverse`.

    `blank`: an output that stands in the rows beyond; None: zeros.
    """
    if count is None:
        return scan(step, carry, inputs, reverse=reverse)
    count = count.astype(jnp.int32)
    rows = jax.tree.leaves(inputs)[0].shape[0]
    at = lambda i: jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, i, keepdims=False), inputs)
    if blank is None:
        step = jax.jit(step, inline=True)  # traced once for the shapes and for the loop
        shapes = jax.eval_shape(step, carry, jax.eval_shape(at, 0))[1]
        blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    outputs = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (rows, *leaf.shape)), blank)

    def turn(i, found):
        place = count - 1 - i if reverse else i
        carry, new = step(found[0], at(place))
        written = lambda leaf, row: lax.dynamic_update_index_in_dim(leaf, row, place, 0)
        return carry, jax.tree.map(written, found[1], new)

    return fori_loop(0, count, turn, (carry, outputs))


def later(states: Tree) -> Tree:
    """All states but the first."""
    return jax.tree.map(lambda leaf: leaf[1:], states)


def earlier(states: Tree) -> Tree:
    """All states but the last."""
    return jax.tree.map(lambda leaf: leaf[:-1], states)


def with_first(first: Tree, rest: Tree) -> Tree:
    """One instant before a stack of others."""
    return jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), first, rest)


def with_last(rest: Tree, last: Tree) -> Tree:
    """One instant after a stack of others."""
    return jax.tree.map(lambda others, one: jnp.concatenate([others, one[None]]), rest, last)
