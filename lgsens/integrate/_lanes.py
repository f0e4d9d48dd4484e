"""Loops that the lanes of a batch share.

JAX batches a `while_loop` whose predicate differs between lanes by a selection between old and new of all that the loop
carries, in every turn: of the inverse of a matrix too, which costs as much as an iteration with it.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

from lgsens._xla import while_loop

Found = TypeVar("Found")


@jax.custom_batching.custom_vmap
def in_any_lane(flag):
    """A flag that is the same in all lanes of a batch: whether it is raised in any. The predicate of a loop whose body
    leaves lanes alone that are done."""
    return flag


@in_any_lane.def_vmap
def _of_all_lanes(axis_size, in_batched, flag):
    return in_any_lane(jnp.any(flag)), False  # a batch of batches comes here again


@jax.custom_batching.custom_vmap
def most_of_lanes(count):
    """The largest of all lanes of a batch: the turns of a loop whose body leaves lanes alone that are done."""
    return count


@most_of_lanes.def_vmap
def _most_of_all(axis_size, in_batched, count):
    return most_of_lanes(jnp.max(count)), False


def renewed_where(due, new: Callable[[], Found], earlier: Found) -> Found:
    """`new()` where it is due. A loop of no or one turn, because `cond` would copy what is large."""
    renewed = lambda carry: (jnp.zeros((), bool), new())
    return while_loop(lambda carry: carry[0], renewed, (due, earlier))[1]
