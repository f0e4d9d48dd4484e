"""The box that a design lies in, scaled to [0, 1]."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from lgsens._validate import as_float, leaf_name


class Box(NamedTuple):
    """The map between x and z in [0, 1], linear or logarithmic entry by entry."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    log: Bool[Array, " n"]

    def _on_scale(self, x):
        return jnp.where(self.log, jnp.log(jnp.where(self.log, x, 1.0)), x)

    def scaled(self, x):
        lower, upper = self._on_scale(self.lower), self._on_scale(self.upper)
        return (self._on_scale(x) - lower) / (upper - lower)

    def value(self, z):
        y = (1.0 - z) * self._on_scale(self.lower) + z * self._on_scale(self.upper)  # exact at both ends
        # The clip keeps round-off of the logarithm from leaving the bounds.
        return jnp.clip(jnp.where(self.log, jnp.exp(jnp.where(self.log, y, 0.0)), y), self.lower, self.upper)


def checked_box(x0, lower, upper, log_scale) -> tuple[Array, Callable[[Array], PyTree], Box]:
    """x0 as a vector, the way back, and the box around it."""
    x0 = jax.tree.map(lambda leaf: as_float(leaf, None, "`x0`"), x0)
    if not jax.tree.leaves(x0):
        raise ValueError("`x0` has no arrays; there is nothing to design.")
    if isinstance(log_scale, bool):
        log_scale = jax.tree.map(lambda _: log_scale, x0)

    def vector(tree, what: str) -> Array:
        if jax.tree.structure(tree) != jax.tree.structure(x0):
            raise ValueError(
                f"`{what}` must be a pytree like `x0`, {jax.tree.structure(x0)}, got {jax.tree.structure(tree)}."
            )

        def leaf(path, x, value):
            value = jnp.asarray(value, bool) if what == "log_scale" else as_float(value, None, f"`{what}`")
            if value.shape not in ((), x.shape):
                name = jax.tree_util.keystr(path)
                raise ValueError(f"`{what}{name}` must have shape {x.shape} or (), got shape {value.shape}.")
            return jnp.broadcast_to(value, x.shape)

        return ravel_pytree(jax.tree_util.tree_map_with_path(leaf, x0, tree))[0]

    x, unravel = ravel_pytree(x0)
    box = Box(vector(lower, "lower"), vector(upper, "upper"), vector(log_scale, "log_scale"))
    for name, low, high, log, value in zip(entry_names(x0), *map(np.asarray, (*box, x))):
        if not low < high:
            raise ValueError(f"`lower` must be below `upper`, got {low} and {high} for {name}.")
        if not low <= value <= high:
            raise ValueError(f"`x0` must lie within the bounds: {name} = {value} is outside [{low}, {high}].")
        if log and not low > 0:
            raise ValueError(f"A logarithmic scale needs positive bounds, got {low} for {name}.")
    return x, unravel, box


def entry_names(tree) -> list[str]:
    """Names for the numbers of a pytree, in the order of `ravel_pytree`: stiffness, points[0, 2], x[1]."""
    return [
        leaf_name(path, "x") + (str(list(map(int, index))) if index else "")
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
        for index in np.ndindex(np.shape(leaf))
    ]
