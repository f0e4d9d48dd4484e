"""Times at which the equations of motion are not smooth, as far as what they follow in time knows them."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class AbstractTimeFunction(eqx.Module):
    """What a system follows in time."""

    @property
    def breaks(self) -> Float[Array, " k"]:
        """The times [s] at which it, or a derivative of it, jumps, shape (k,), in any order; here those of functions of
        time that it holds. `AlignedSteps` and steps under error control end at them."""
        return breaks_of([getattr(self, field.name) for field in dataclasses.fields(self)])


def breaks_of(tree: Any) -> Float[Array, " k"]:
    """The breaks of all functions of time in a pytree, a system say, one or many of a kind."""
    is_one = lambda node: isinstance(node, AbstractTimeFunction)
    found = [jnp.ravel(node.breaks) for node in jax.tree.leaves(tree, is_leaf=is_one) if is_one(node)]
    return jnp.concatenate(found) if found else jnp.zeros(0)
