"""Variables of a search in place of physical ones: affine, logarithmic, or confined to an interval."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from lgsens._validate import as_float, require


class AbstractParametrization(eqx.Module):
    """A one-to-one map between a number x and a variable z that may be any real number and is of order 1."""

    @abc.abstractmethod
    def value(self, z: Float[Array, "..."]) -> Float[Array, "..."]:
        """x of z, entry by entry."""

    @abc.abstractmethod
    def variable(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """z of x, entry by entry."""


def _number(name: str, *, positive: bool = False, **default: Any) -> Any:
    def convert(value):
        array = as_float(value, None, f"`{name}`")
        if positive:
            require(lambda a: np.all(a > 0), lambda: f"`{name}` must be positive, got {value}.", array)
        return array

    return eqx.field(converter=convert, **default)


class Affine(AbstractParametrization):
    """x = offset + scale z.

    Arguments:
        scale: the size of a large change of x [unit of x], positive, shape () or that of x.
        offset: x at z = 0 [unit of x], shape () or that of x.
    """

    scale: Float[Array, "..."] = _number("scale", positive=True, default=1.0)
    offset: Float[Array, "..."] = _number("offset", default=0.0)

    def value(self, z):
        return self.offset + self.scale * z

    def variable(self, x):
        return (x - self.offset) / self.scale


class Log(AbstractParametrization):
    """x = scale exp(z): positive, a change of z is a relative change of x.

    Arguments:
        scale: x at z = 0 [unit of x], positive, shape () or that of x.
    """

    scale: Float[Array, "..."] = _number("scale", positive=True, default=1.0)

    def value(self, z):
        return self.scale * jnp.exp(z)

    def variable(self, x):
        return jnp.log(x / self.scale)


class Interval(AbstractParametrization):
    """x = lower + (upper − lower)/(1 + exp(−z)): between its bounds, which it never reaches.

    For methods that know no bounds; where the optimum may lie on one, `minimize` has them.

    Arguments:
        lower, upper: the ends [unit of x], shape () or that of x. Raises `ValueError` unless lower < upper.
    """

    lower: Float[Array, "..."] = _number("lower")
    upper: Float[Array, "..."] = _number("upper")

    def __check_init__(self):
        message = f"Interval: `lower` must be below `upper`, got {self.lower} and {self.upper}."
        require(lambda a, b: np.all(a < b), message, self.lower, self.upper)

    def value(self, z):
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(z)

    def variable(self, x):
        share = (x - self.lower) / (self.upper - self.lower)
        return jnp.log(share) - jnp.log1p(-share)


def magnitude(leaf: Float[Array, "..."]) -> Float[Array, ""]:
    """The largest absolute entry; 1 where that is 0."""
    size = jnp.max(jnp.abs(leaf), initial=0.0)
    return jnp.where(size > 0, size, 1.0)


def variables(parametrization: PyTree, x0: PyTree) -> tuple[Float[Array, " n"], Callable[[Array], PyTree]]:
    """The variables of a design as one vector, and the way back.

    Arguments:
        parametrization: an `Affine`, `Log` or `Interval` for every leaf of x, or a pytree like x0 of them (a prefix of
            it will do). None in place of one: `Affine` with the largest entry of the leaf at x0 for its scale.
        x0: the design, a pytree of arrays; a `Model` is one.

    Returns z0, shape (n,), and z ↦ x, a pytree as x0; both can be traced. Raises `ValueError` for a parametrization of
    another structure, and for an x0 out of its range.
    """
    x0 = jax.tree.map(lambda leaf: as_float(leaf, None, "`x0`"), x0)
    if not jax.tree.leaves(x0):
        raise ValueError("`x0` has no arrays; there is nothing to search.")
    single = lambda node: node is None or isinstance(node, AbstractParametrization)

    def spread(node, part):
        if not single(node):
            raise ValueError(f"`parametrization` must consist of Affine, Log, Interval or None, got {node!r}.")
        return jax.tree.map(lambda leaf: Affine(magnitude(leaf)) if node is None else node, part)

    try:
        maps = jax.tree.map(spread, parametrization, x0, is_leaf=single)
    except ValueError as error:
        raise ValueError(f"`parametrization` must be one for all, or a pytree like `x0`: {error}") from error
    z = jax.tree.map(lambda node, leaf: node.variable(leaf), maps, x0, is_leaf=_is_one)
    flat, unravel = ravel_pytree(z)
    require(
        lambda flat: np.all(np.isfinite(flat)),
        "`x0` is out of the range of its parametrization: Log needs x > 0, Interval lower < x < upper.",
        flat,
    )
    return flat, _Design(maps, unravel)


def _is_one(node: Any) -> bool:
    return isinstance(node, AbstractParametrization)


class _Design(eqx.Module):
    """z ↦ x. The same for the same numbers, so that what is compiled with it is found again."""

    maps: PyTree
    unravel: Callable[[Array], PyTree]

    def __call__(self, z: Array) -> PyTree:
        return jax.tree.map(lambda node, leaf: node.value(leaf), self.maps, self.unravel(z), is_leaf=_is_one)
