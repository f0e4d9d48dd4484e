"""Direct products: of different groups, and of many copies of one."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import block_diag

from ._base import AbstractLieGroup


def _slices(sizes):
    return [slice(end - size, end) for size, end in zip(sizes, itertools.accumulate(sizes))]


def _pieces(x, sizes):
    """Cuts coordinates in consecutive pieces of the given sizes."""
    if x.shape != (sum(sizes),):  # slicing alone would silently accept coordinates that are too long
        raise ValueError(f"Product: the coordinates have shape {x.shape}; expected ({sum(sizes)},).")
    return [x[part] for part in _slices(sizes)]


def _diagonal_blocks(X, sizes):
    return [X[part, part] for part in _slices(sizes)]


def _matrix_size(group):
    return jax.eval_shape(lambda: group.matrix(group.identity())).shape[0]


class Product(AbstractLieGroup):
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
    def _dims(self):
        return [group.dim for group in self.groups]

    def _each(self, method, *args):
        return tuple(getattr(group, method)(*arg) for group, *arg in zip(self.groups, *args))

    def _joined(self, method, *args):
        return jnp.concatenate(self._each(method, *args))

    @property
    def dim(self):
        return sum(self._dims)

    def identity(self, dtype=None):
        return tuple(group.identity(dtype) for group in self.groups)

    def compose(self, p, q):
        return self._each("compose", p, q)

    def inverse(self, q):
        return self._each("inverse", q)

    def exp(self, x):
        return self._each("exp", _pieces(x, self._dims))

    def log(self, q):
        return self._joined("log", q)

    def wedge(self, x):
        return block_diag(*self._each("wedge", _pieces(x, self._dims)))

    def vee(self, X):
        return self._joined("vee", _diagonal_blocks(X, [_matrix_size(group) for group in self.groups]))

    def matrix(self, q):
        return block_diag(*self._each("matrix", q))

    def ad_mv(self, x, y):
        return self._joined("ad_mv", _pieces(x, self._dims), _pieces(y, self._dims))

    def Ad_inv_mv(self, q, w):
        return self._joined("Ad_inv_mv", q, _pieces(w, self._dims))

    def Ad_inv_rmv(self, q, w):
        return self._joined("Ad_inv_rmv", q, _pieces(w, self._dims))

    def tangent_mv(self, x, y):
        return self._joined("tangent_mv", _pieces(x, self._dims), _pieces(y, self._dims))

    def tangent_rmv(self, x, y):
        return self._joined("tangent_rmv", _pieces(x, self._dims), _pieces(y, self._dims))

    def tangent_inv_mv(self, x, y):
        return self._joined("tangent_inv_mv", _pieces(x, self._dims), _pieces(y, self._dims))

    def to_ambient(self, q, w):
        return self._each("to_ambient", q, _pieces(w, self._dims))

    def from_ambient(self, q, dq):
        return self._joined("from_ambient", q, dq)


class Power(AbstractLieGroup):
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

    def _rows(self, x):
        return x.reshape(self.n, self.group.dim)

    def _blocks(self, method, *args):
        return block_diag(*jax.vmap(method)(*args))

    @property
    def dim(self):
        return self.n * self.group.dim

    def identity(self, dtype=None):
        one = self.group.identity(dtype)
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (self.n, *leaf.shape)), one)

    def compose(self, p, q):
        return jax.vmap(self.group.compose)(p, q)

    def inverse(self, q):
        return jax.vmap(self.group.inverse)(q)

    def exp(self, x):
        return jax.vmap(self.group.exp)(self._rows(x))

    def log(self, q):
        return jax.vmap(self.group.log)(q).reshape(-1)

    def wedge(self, x):
        return self._blocks(self.group.wedge, self._rows(x))

    def vee(self, X):
        blocks = _diagonal_blocks(X, [_matrix_size(self.group)] * self.n)
        return jax.vmap(self.group.vee)(jnp.stack(blocks)).reshape(-1)

    def matrix(self, q):
        return self._blocks(self.group.matrix, q)

    def ad_mv(self, x, y):
        return jax.vmap(self.group.ad_mv)(self._rows(x), self._rows(y)).reshape(-1)

    def Ad_inv_mv(self, q, w):
        return jax.vmap(self.group.Ad_inv_mv)(q, self._rows(w)).reshape(-1)

    def Ad_inv_rmv(self, q, w):
        return jax.vmap(self.group.Ad_inv_rmv)(q, self._rows(w)).reshape(-1)

    def tangent_mv(self, x, y):
        return jax.vmap(self.group.tangent_mv)(self._rows(x), self._rows(y)).reshape(-1)

    def tangent_rmv(self, x, y):
        return jax.vmap(self.group.tangent_rmv)(self._rows(x), self._rows(y)).reshape(-1)

    def tangent_inv_mv(self, x, y):
        return jax.vmap(self.group.tangent_inv_mv)(self._rows(x), self._rows(y)).reshape(-1)

    def to_ambient(self, q, w):
        return jax.vmap(self.group.to_ambient)(q, self._rows(w))

    def from_ambient(self, q, dq):
        return jax.vmap(self.group.from_ambient)(q, dq).reshape(-1)
