"""The poses of many bodies of which each moves with some of its six coordinates only."""

from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._base import AbstractLieGroup
from ._groups import Pose, R3xSO3
from ._products import Power
from ._rotation import SO3

_BODY = 6  # coordinates of a pose: three of translation, three of rotation
_TRANSLATION, _ROTATION = slice(0, 3), slice(3, 6)
_ORIENTATION = SO3()


@lru_cache(maxsize=64)
def _numbered(free: tuple[tuple[int, ...], ...]) -> np.ndarray:
    index = np.full((len(free), _BODY), -1)
    start = 0
    for row, own in zip(index, free):
        row[list(own)] = start + np.arange(len(own))
        start += len(own)
    index.setflags(write=False)
    return index


class Poses(AbstractLieGroup):
    """The poses of N bodies, each with some of its six coordinates [u, Ω]: a subgroup of `Power(R3xSO3(), N)`.

    An element is that of the power, a `Pose` with a leading axis N on each array; coordinates, shape (k,), are
    those that the bodies have, body by body. So `retract` moves any pose, also one outside the subgroup, by the
    free coordinates alone.

    Why it is a group, and why its operations are those of the power with rows and columns left out. Let h be the
    span of the free coordinates. Translations commute with everything, and [e_i, e_j] = e_i × e_j among the
    rotations of one body, so h is closed under the bracket exactly if each body has none, one or all three of its
    rotations (two axes generate the third). Then exp(h) generates a subgroup H, and for x in h

        T(x) = Σ_n (−ad x)ⁿ/(n+1)!     and     D(exp x) = exp(−ad x)

    map h into itself, as each power of ad x does; T(x) restricted to h is injective where T(x) is, so its inverse
    is the restriction of the inverse. With the selection E of columns the restriction of A is EᵀA E, its transpose
    EᵀAᵀE. Where a body has no rotation or one, ad x = 0 on its part of h: T = D = I there, and the three rotations of
    the others are all that is computed.

    Arguments: `free`, for each body the coordinates it has, in increasing order: 0, 1, 2 are the translations along
    the inertial axes, 3, 4, 5 the rotations about the body axes.

    Raises `ValueError` for coordinates out of range or order, two rotations of three, or no coordinate at all.
    """

    free: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __check_init__(self):
        for body, own in enumerate(self.free):
            if list(own) != sorted(set(own) & set(range(_BODY))):
                raise ValueError(f"Poses: `free[{body}]` must be increasing integers from 0 to 5; got {own!r}.")
            if sum(coordinate >= _ROTATION.start for coordinate in own) == 2:
                raise ValueError(
                    f"Poses: `free[{body}]` = {own!r} has two rotations, which are no subgroup: turning about two axes "
                    "in turn is turning about the third; give one rotation, all three or none."
                )
        if not any(self.free):
            raise ValueError(f"Poses: `free` = {self.free!r} leaves no coordinate; give at least one.")

    @property
    def index(self) -> np.ndarray:
        """The place in x of each coordinate of each body, shape (N, 6); −1 where the body does not have it."""
        return _numbered(self.free)

    @property
    def _own(self) -> np.ndarray:
        """The coordinates of the power that this group has, shape (k,)."""
        return np.flatnonzero(self.index.ravel() >= 0)

    @property
    def _turning(self) -> np.ndarray:
        """The bodies with three rotations."""
        return np.flatnonzero((self.index[:, _ROTATION] >= 0).all(axis=1))

    @property
    def _all(self) -> Power:
        return Power(R3xSO3(), len(self.free))

    def rows(self, x: Float[Array, "*batch k"]) -> Float[Array, "*batch N 6"]:
        """The coordinates body by body, zero where a body does not have them."""
        zero = jnp.zeros((*x.shape[:-1], 1), x.dtype)
        return jnp.concatenate([x, zero], axis=-1)[..., np.where(self.index < 0, self.dim, self.index)]

    @property
    def _turns(self) -> np.ndarray:
        """Where the three rotations of the bodies that have them are in x, shape (bodies, 3)."""
        return self.index[self._turning, _ROTATION]

    def _rotated(self, method, arguments, at, y, others):
        """`others` with the rotations of bodies that have three replaced by `method(argument, those of y)`; `at`: where
        theirs are among the arguments."""
        if not len(self._turning):
            return others
        rotations = jax.vmap(method)(arguments[at], y[self._turns])
        source = np.arange(self.dim)
        source[self._turns.ravel()] = self.dim + np.arange(self._turns.size)
        return jnp.concatenate([others, rotations.ravel()])[source]

    @property
    def dim(self):
        return sum(map(len, self.free))

    def identity(self, dtype=None):
        return self._all.identity(dtype)

    def compose(self, p, q):
        return self._all.compose(p, q)

    def inverse(self, q):
        return self._all.inverse(q)

    def exp(self, x):
        rows = self.rows(x)
        if (self.index[:, _ROTATION] < 0).all():
            return Pose(rows[:, _TRANSLATION], self.identity(x.dtype).orientation)
        return Pose(rows[:, _TRANSLATION], jax.vmap(_ORIENTATION.exp)(rows[:, _ROTATION]))

    def log(self, q):
        return self._all.log(q)[self._own]

    def wedge(self, x):
        return self._all.wedge(self.rows(x).ravel())

    def vee(self, X):
        return self._all.vee(X)[self._own]

    def matrix(self, q):
        return self._all.matrix(q)

    def ad_mv(self, x, y):
        return self._rotated(_ORIENTATION.ad_mv, x, self._turns, y, jnp.zeros_like(y))

    def Ad_inv_mv(self, q, w):
        return self._rotated(_ORIENTATION.Ad_inv_mv, q.orientation, self._turning, w, w)

    def Ad_inv_rmv(self, q, w):
        return self._rotated(_ORIENTATION.Ad_inv_rmv, q.orientation, self._turning, w, w)

    def tangent_mv(self, x, y):
        return self._rotated(_ORIENTATION.tangent_mv, x, self._turns, y, y)

    def tangent_rmv(self, x, y):
        return self._rotated(_ORIENTATION.tangent_rmv, x, self._turns, y, y)

    def tangent_inv_mv(self, x, y):
        return self._rotated(_ORIENTATION.tangent_inv_mv, x, self._turns, y, y)

    def to_ambient(self, q, w):
        rows = self.rows(w)
        return Pose(rows[:, _TRANSLATION], jax.vmap(_ORIENTATION.to_ambient)(q.orientation, rows[:, _ROTATION]))

    def from_ambient(self, q, dq):
        return self._all.from_ambient(q, dq)[self._own]
