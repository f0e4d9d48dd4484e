"""What is to be minimized: x ↦ f, or x ↦ (f, g) with constraints g ≤ 0."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

Problem = Callable[[PyTree], Float[Array, ""] | tuple[Float[Array, ""], Array]]


def as_pair(found):
    """(f, g) of what a problem returns; without constraints g is empty."""
    return found if isinstance(found, tuple) else (found, jnp.zeros(0))


def flattened(fun: Problem, unravel: Callable, x: Array) -> tuple[Callable, Array | jax.ShapeDtypeStruct]:
    """x ↦ (f, g) of vectors, which keeps its trace, and the shape of g as `fun` gives it.

    Raises `ValueError` for a `fun` that returns something else.
    """
    traced = jax.jit(lambda x: fun(unravel(x)))
    shape = jax.eval_shape(traced, x)
    parts = as_pair(shape)
    if len(parts) != 2 or not all(hasattr(part, "shape") for part in parts) or parts[0].shape != ():
        raise ValueError(
            f"`fun` must return its objective, shape (), or a pair (objective, array of constraints), got {shape}."
        )

    def flat_fun(x):
        f, g = as_pair(traced(x))
        return f, g.ravel()

    return flat_fun, parts[1]
