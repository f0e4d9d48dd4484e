"""Direct products: of different groups, and of many copies of one."""

import abc
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import block_diag

from ._base import AbstractLieGroup


class AbstractDirectProduct(AbstractLieGroup):
    """A direct product: each operation is that of the factors, side by side."""

    @abc.abstractmethod
    def _each(self, method: str, *args: Any) -> Any:
        """A method of every factor; arguments and results are elements of the product, or as `_split` returns them."""

    @abc.abstractmethod
    def _split(self, x) -> Any:
        """The coordinates of each factor."""

    @abc.abstractmethod
    def _join(self, pieces) -> Any:
        """The coordinates of the product from those of each factor."""

    @abc.abstractmethod
    def _diagonal(self, blocks) -> Any:
        """The matrix of the product from those of each factor."""

    @abc.abstractmethod
    def _blocks(self, X) -> Any:
        """The matrices of each factor."""

    def compose(self, p, q):
        return self._each("compose", p, q)

    def inverse(self, q):
        return self._each("inverse", q)

    def exp(self, x):
        return self._each("exp", self._split(x))

    def log(self, q):
        return self._join(self._each("log", q))

    def wedge(self, x):
        return self._diagonal(self._each("wedge", self._split(x)))

    def vee(self, X):
        return self._join(self._each("vee", self._blocks(X)))

    def matrix(self, q):
        return self._diagonal(self._each("matrix", q))

    def ad_mv(self, x, y):
        return self._join(self._each("ad_mv", self._split(x), self._split(y)))

    def Ad_inv_mv(self, q, w):
        return self._join(self._each("Ad_inv_mv", q, self._split(w)))

    def Ad_inv_rmv(self, q, w):
        return self._join(self._each("Ad_inv_rmv", q, self._split(w)))

    def tangent_mv(self, x, y):
        return self._join(self._each("tangent_mv", self._split(x), self._split(y)))

    def tangent_rmv(self, x, y):
        return self._join(self._each("tangent_rmv", self._split(x), self._split(y)))

    def tangent_inv_mv(self, x, y):
        return self._join(self._each("tangent_inv_mv", self._split(x), self._split(y)))

    def to_ambient(self, q, w):
        return self._each("to_ambient", q, self._split(w))

    def from_ambient(self, q, dq):
        return self._join(self._each("from_ambient", q, dq))


def _slices(sizes):
    return [slice(end - size, end) for size, end in zip(sizes, itertools.accumulate(sizes))]


def _diagonal_blocks(X, groups):
    sizes = [jax.eval_shape(lambda group=group: group.matrix(group.identity())).shape[0] for group in groups]
    return [X[part, part] for part in _slices(sizes)]


class Product(AbstractDirectProduct):
    """The direct product of groups: an element is the tuple of theirs, coordinates are concatenated in order.

    Arguments: `groups`, a tuple of Lie groups.
    """

    groups: tuple[AbstractLieGroup, ...] = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.groups, tuple) or not self.groups:
            raise ValueError(f"Product: `groups` is a non-empty tuple of Lie groups; got {self.groups!r}.")
        for i, group in enumerate(self.groups):
            if not isinstance(group, AbstractLieGroup):
                raise ValueError(f"Product: `groups[{i}]` is not a Lie group (such as SO3()); got {group!r}.")

    @property
    def dim(self):
        return sum(group.dim for group in self.groups)

    def identity(self, dtype=None):
        return tuple(group.identity(dtype) for group in self.groups)

    def _each(self, method, *args):
        return tuple(getattr(group, method)(*arg) for group, *arg in zip(self.groups, *args))

    def _split(self, x):
        if x.shape != (self.dim,):  # slicing alone would silently accept coordinates that are too long
            raise ValueError(f"Product: the coordinates have shape {x.shape}; expected ({self.dim},).")
        return [x[part] for part in _slices([group.dim for group in self.groups])]

    def _join(self, pieces):
        return jnp.concatenate(pieces)

    def _diagonal(self, blocks):
        return block_diag(*blocks)

    def _blocks(self, X):
        return _diagonal_blocks(X, self.groups)


class Power(AbstractDirectProduct):
    """The direct product of `n` copies of one group, each operation one `jax.vmap` over them.

    An element is the group's pytree with a leading axis `n` on each leaf; coordinates, shape (n*d,), are
    `x.reshape(n, d)` read row by row.

    Arguments: `group`, a Lie group; `n`, the number of copies, an integer.
    """

    group: AbstractLieGroup = eqx.field(static=True)
    n: int = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.group, AbstractLieGroup):
            raise ValueError(f"Power: `group` is not a Lie group (such as SO3()); got {self.group!r}.")
        if not isinstance(self.n, int) or self.n < 1:
            raise ValueError(f"Power: `n` is the number of copies, a positive Python integer; got {self.n!r}.")

    @property
    def dim(self):
        return self.n * self.group.dim

    def identity(self, dtype=None):
        one = self.group.identity(dtype)
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (self.n, *leaf.shape)), one)

    def _each(self, method, *args):
        return jax.vmap(getattr(self.group, method))(*args)

    def _split(self, x):
        return x.reshape(self.n, self.group.dim)

    def _join(self, pieces):
        return pieces.reshape(-1)

    def _diagonal(self, blocks):
        return block_diag(*blocks)

    def _blocks(self, X):
        return jnp.stack(_diagonal_blocks(X, [self.group] * self.n))
