"""The box that a design lies in, scaled to [0, 1]; where it is open, by the size of the design."""

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from lgsens._validate import as_float, leaf_name
from lgsens.optimize._parametrization import magnitude


class Box(NamedTuple):
    """The map between x and z, linear or logarithmic entry by entry.

    z is 0 at the lower bound and 1 at the upper one. Where one of them is infinite, a unit of z is the largest entry of
    the leaf at x₀, or the factor e on a logarithmic scale; where both are, z is 0 at x₀.
    """

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    log: Bool[Array, " n"]
    zero: Float[Array, " n"]  # x at z = 0 and at z = 1, on its scale
    one: Float[Array, " n"]

    @property
    def ends(self) -> tuple[np.ndarray, np.ndarray]:
        """The bounds of z."""
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        open_below = np.isneginf(lower) | (np.asarray(self.log) & (lower == 0))
        return np.where(open_below, -np.inf, 0.0), np.where(np.isinf(upper), np.inf, 1.0)

    def clip(self, z: Array) -> Array:
        """The projection of z on the box."""
        return jnp.clip(z, *(end.astype(z.dtype) for end in self.ends))

    def descent(self, z: Any, gradient: Any) -> Array:
        """clip(z − ∇) − z: the projected gradient step, in which a small ∇ is not lost beside a large z."""
        lower, upper = (end.astype(z.dtype) - z for end in self.ends)
        return jnp.clip(-gradient, lower, upper)

    def scaled(self, x):
        return (_on_scale(x, self.log) - self.zero) / (self.one - self.zero)

    def value(self, z):
        y = (1.0 - z) * self.zero + z * self.one  # exact at both ends
        x = jnp.where(self.log, jnp.exp(jnp.where(self.log, y, 0.0)), y)
        # Round-off of the logarithm does not leave the bounds. The derivative of a clip is ½ at them.
        off = jax.lax.stop_gradient(jnp.clip(x, self.lower, self.upper) - x)
        return x + jnp.where(jnp.abs(off) <= 1e2 * jnp.finfo(x.dtype).eps * jnp.abs(x), off, 0.0)

    def rate(self, z):
        """dx/dz, entry by entry."""
        return jax.jvp(self.value, (z,), (jnp.ones_like(z),))[1]


def _on_scale(x, log):
    return jnp.where(log, jnp.log(jnp.where(log, x, 1.0)), x)


def checked_box(x0, lower, upper, log_scale) -> tuple[Array, Callable[[Array], PyTree], Box]:
    """x0 as a vector, the way back, and the box around it."""
    x0 = jax.tree.map(lambda leaf: as_float(leaf, None, "`x0`"), x0)
    if not jax.tree.leaves(x0):
        raise ValueError("`x0` has no arrays; there is nothing to design.")
    if isinstance(log_scale, bool):
        log_scale = jax.tree.map(lambda _: log_scale, x0)

    def vector(tree, what: str, missing: float) -> Array:
        everywhere = lambda bound, part: jax.tree.map(lambda _: missing, part) if bound is None else bound
        with contextlib.suppress(ValueError):  # told below
            tree = jax.tree.map(everywhere, tree, x0, is_leaf=lambda bound: bound is None)
        if jax.tree.structure(tree) != jax.tree.structure(x0):
            raise ValueError(
                f"`{what}` must be a pytree like `x0`, whose entries are {', '.join(entry_names(x0)[:9])}, with a "
                f"number (for all of an array) or an array in place of each array; got {tree!r}."
            )

        def leaf(path, x, value):
            value = jnp.asarray(value, bool) if what == "log_scale" else as_float(value, None, f"`{what}`")
            if value.shape not in ((), x.shape):
                name = jax.tree_util.keystr(path)
                raise ValueError(f"`{what}{name}` must have shape {x.shape} or (), got shape {value.shape}.")
            return jnp.broadcast_to(value, x.shape)

        return ravel_pytree(jax.tree_util.tree_map_with_path(leaf, x0, tree))[0]

    x, unravel = ravel_pytree(x0)
    if isinstance(x, Tracer):
        raise ValueError(
            "`x0` must be numbers that are known, and is traced: a search is no function for jit, vmap or grad. Call "
            "it outside; `multi_start` takes many starts at once, and `least_squares` is differentiable."
        )
    low, high, log = (
        vector(*bound)
        for bound in ((lower, "lower", -np.inf), (upper, "upper", np.inf), (log_scale, "log_scale", False))
    )
    for name, a, b, logarithmic, value in zip(entry_names(x0), *map(np.asarray, (low, high, log, x))):
        if not np.isfinite(value):
            raise ValueError(f"`x0` must be finite, got {value} for {name}.")
        if not a < b:
            fixed = "; leave what is fixed out of `x0`" if a == b else ""
            raise ValueError(f"`lower` must be below `upper`, got {a} and {b} for {name}{fixed}.")
        if not a <= value <= b:
            raise ValueError(f"`x0` must lie within the bounds: {name} = {value} is outside [{a}, {b}].")
        if logarithmic and not (a > 0 or (np.isneginf(a) and value > 0)):
            what = f"`x0`, got {value}" if np.isneginf(a) else f"bounds, got {a}"
            raise ValueError(f"A logarithmic scale needs positive {what} for {name}.")
    low = jnp.where(log & jnp.isneginf(low), 0.0, low)
    first, last, here = (_on_scale(end, log) for end in (low, high, x))
    size = ravel_pytree(jax.tree.map(lambda leaf: jnp.full(leaf.shape, magnitude(leaf), leaf.dtype), x0))[0]
    size = jnp.where(log, 1.0, size)
    zero = jnp.where(jnp.isfinite(first), first, jnp.where(jnp.isfinite(last), last - size, here))
    one = jnp.where(jnp.isfinite(last), last, zero + size)
    return x, unravel, Box(low, high, log, zero, one)


def entry_names(tree, root: str = "x") -> list[str]:
    """Names for the numbers of a pytree, in the order of `ravel_pytree`: stiffness, points[0, 2]; of one array x[1]."""
    return [
        leaf_name(path, root) + (str(list(map(int, index))) if index else "")
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
        for index in np.ndindex(np.shape(leaf))
    ]
