"""A function of many members, evaluated once for all that have the same structure.

What is traced and compiled for a scene grows with the number of kinds of its members, not of members: the constraints
of 512 joints one by one take hundreds of operations, and their derivatives again.
"""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lgsens._validate import array_of, is_concrete


class StackRow(NamedTuple):
    """One entry along the leading axis of a pytree of arrays."""

    of: Any
    index: int


def stacked(leaves: Sequence[Any]):
    """`jnp.stack`, which would compile a program for each number of leaves: numbers that are known go through NumPy."""
    if is_concrete(*leaves):
        return array_of(np.stack([np.asarray(leaf) for leaf in leaves]))
    if all(leaf is leaves[0] for leaf in leaves):  # gravity, say: its derivative is one sum
        return jnp.broadcast_to(leaves[0], (len(leaves), *leaves[0].shape))
    return jnp.stack(leaves)


def unstacked(rows) -> list[Array]:
    """The rows as arrays of JAX. Taken from an array of JAX each number of them is compiled: 2 s for 256 of 3 by 3."""
    if not is_concrete(rows):
        return list(rows)
    with jax.ensure_compile_time_eval():
        return [array_of(row) for row in np.asarray(rows)]


def joined(members: Sequence[Any]) -> Any:
    """Pytrees, or rows of such, along a new leading axis: of one structure but for names, of which the first counts."""
    rows = [isinstance(member, StackRow) for member in members]
    if not any(rows):
        leaves = zip(*map(jax.tree.leaves, members))
        return jax.tree.unflatten(jax.tree.structure(members[0]), map(stacked, leaves))
    alone = lambda member: StackRow(jax.tree.map(lambda leaf: stacked([leaf]), member), 0)
    members = [member if row else alone(member) for member, row in zip(members, rows)]
    sources = list({id(row.of): row.of for row in members}.values())
    lengths = [next(iter(leaf.shape[0] for leaf in jax.tree.leaves(source)), 0) for source in sources]
    starts = dict(zip(map(id, sources), np.cumsum([0, *lengths])))
    index = np.asarray([starts[id(row.of)] + row.index for row in members])

    def chosen(*leaves):  # by `take`, which is one program outside of `jit`; an index would be six
        if is_concrete(*leaves):
            return array_of(np.concatenate([np.asarray(leaf) for leaf in leaves])[index])
        whole = leaves[0] if len(leaves) == 1 else jnp.concatenate(leaves)
        return whole if np.array_equal(index, np.arange(whole.shape[0])) else jnp.take(whole, index, 0, mode="clip")

    return jax.tree.map(chosen, *sources)


def evaluated(function: Callable, members: Sequence[tuple[Any, ...]], kinds: Sequence[Hashable]) -> list[StackRow]:
    """`function(*member)` of each member, in their order; those of one kind at once.

    A member is a tuple of pytrees, rows of such and None; those of one kind have one structure but for names.
    """
    places: dict[Hashable, list[int]] = {}
    for i, kind in enumerate(kinds):
        places.setdefault(kind, []).append(i)
    found: dict[int, StackRow] = {}
    for own in places.values():
        columns = zip(*(members[i] for i in own))
        arguments = [None if column[0] is None else joined(column) for column in columns]
        results = _each(function, arguments)
        found |= {i: StackRow(results, place) for place, i in enumerate(own)}
    return [found[i] for i in range(len(members))]


@partial(jax.jit, static_argnums=0)
def _each(function, arguments):
    return jax.vmap(lambda arguments: function(*arguments))(arguments)
