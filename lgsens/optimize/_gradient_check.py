"""A gradient against central differences."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from lgsens._brief import brief
from lgsens._validate import as_float
from lgsens.optimize._box import entry_names
from lgsens.optimize._parametrization import magnitude


class GradientCheck(NamedTuple):
    """Derivatives of f along m directions, twice; NumPy arrays. One unit along a direction is the scale of x.

    Attributes:
        directions: what was perturbed: the name of an entry of x, or "direction 1", …; length m.
        exact: ∇f · d, by automatic differentiation, shape (m,).
        difference: (f(x + h d) − f(x − h d)) / (2 h), shape (m,).
        error: |exact − difference| over the largest |exact|, shape (m,).
        step: h [–].
    """

    directions: tuple[str, ...]
    exact: np.ndarray
    difference: np.ndarray
    error: np.ndarray
    step: float

    __repr__ = brief


def check_gradient(
    fun: Callable[[PyTree], Float[Array, ""]],
    x: PyTree,
    *,
    scale: PyTree | None = None,
    step: float | None = None,
    max_directions: int = 8,
    seed: int = 0,
    value_and_grad: Callable[[PyTree], tuple[Array, PyTree]] | None = None,
) -> GradientCheck:
    """Compare the gradient of f with central differences: entry by entry, or along random directions.

    Arguments:
        fun: x ↦ f, shape ().
        x: where, a pytree of arrays.
        scale: the size of a large change of x, a pytree as x whose leaves have the shape of x's or (); None:
            the largest absolute entry of each leaf.
        step: h as a fraction of the scale; None: the cube root of round-off, where truncation (h²) and
            round-off (ε/h) are of one size.
        max_directions: with more entries than this, so many random directions of unit length (in scaled
            variables) are taken in their place.
        seed: of the random directions.
        value_and_grad: x ↦ (f, ∇f), to use one that is compiled already; None: that of `fun`.

    Returns the comparison as data; nothing is raised where they differ. The difference of two f that agree to
    ε loses digits, so an error of about ε^(2/3), some 1e-9 in 64 bits, is as good as it gets. Raises
    `ValueError` for an f that is not a scalar, or a step that is not positive.
    """
    x = jax.tree.map(lambda leaf: as_float(leaf, None, "`x`"), x)
    flat, unravel = ravel_pytree(x)
    h: float = np.cbrt(float(np.finfo(flat.dtype).eps)) if step is None else step
    if not h > 0:
        raise ValueError(f"`step` must be positive, got {h}.")
    scale = jax.tree.map(magnitude, x) if scale is None else scale
    spread = lambda leaf, size: jnp.broadcast_to(as_float(size, None, "`scale`"), leaf.shape)
    size = np.asarray(ravel_pytree(jax.tree.map(spread, x, scale))[0])
    value_and_grad = jax.jit(jax.value_and_grad(fun)) if value_and_grad is None else value_and_grad

    if flat.size <= max_directions:
        names, directions = tuple(entry_names(x)), np.eye(flat.size)
    else:
        directions = np.random.default_rng(seed).standard_normal((max_directions, flat.size))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        names = tuple(f"direction {i + 1}" for i in range(max_directions))
    value, gradient = value_and_grad(x)
    if np.shape(value) != ():
        raise ValueError(f"`fun` must return a scalar, got shape {np.shape(value)}.")
    scaled_gradient = np.asarray(ravel_pytree(gradient)[0]) * size

    def at(offset) -> float:
        return float(value_and_grad(unravel(flat + jnp.asarray(offset * size, flat.dtype)))[0])

    exact = directions @ scaled_gradient
    difference = np.array([(at(h * d) - at(-h * d)) / (2 * h) for d in directions])
    largest = np.max(np.abs(exact))
    error = np.abs(exact - difference) / (largest if largest > 0 else 1.0)
    return GradientCheck(names, exact, difference, error, float(h))
