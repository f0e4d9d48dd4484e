"""The poses of many bodies of which those with all six coordinates move on SE(3)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from ._base import AbstractLieGroup
from ._groups import Pose
from ._poses import Poses
from ._screw import SE3

_ONE = SE3()
_SEVEN = np.arange(7)  # rows of the matrix of a pose in `Poses`, four of one in SE(3)


class RigidMotions(AbstractLieGroup):
    """The poses of N bodies: `SE3` of each that has all six coordinates, and of the others what `Poses` has of them.

    An element is a `Pose` with a leading axis N on each array; coordinates, shape (k,), are those that the bodies have,
    body by body: of a whole body `[u, ω]` in its own frame, of another one as in `Poses`.

    Arguments: `free`, as in `Poses`, which raises `ValueError` for what is no group.
    """

    free: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def __check_init__(self):
        Poses(self.free)

    @property
    def whole(self) -> np.ndarray:
        """The bodies with all six coordinates, shape (W,)."""
        return np.flatnonzero([len(own) == _ONE.dim for own in self.free])

    @property
    def index(self) -> np.ndarray:
        """Where their coordinates are in x, shape (W, 6)."""
        return self._poses.index[self.whole]

    @property
    def _poses(self) -> Poses:
        return Poses(self.free)

    @property
    def _others(self):
        """Where in a matrix of `Poses` those of the other bodies are."""
        size = len(_SEVEN)
        bodies = np.setdiff1d(np.arange(len(self.free)), self.whole)
        rows = (size * bodies[:, None] + _SEVEN).ravel()
        return np.ix_(rows, rows)

    def _own(self, argument):
        """A pose, or coordinates, of each whole body."""
        if isinstance(argument, Pose):
            return Pose(*(leaf[self.whole] for leaf in argument))
        return argument[self.index]

    def _each(self, method, *args):
        """What `Poses` says of all bodies, and in it what SE(3) says of the whole ones."""
        every = getattr(self._poses, method)(*args)
        own = jax.vmap(getattr(_ONE, method))(*map(self._own, args))
        if isinstance(every, Pose):
            return Pose(*(leaf.at[self.whole].set(part) for leaf, part in zip(every, own)))
        return every.at[self.index].set(own)

    @property
    def dim(self):
        return self._poses.dim

    def identity(self, dtype=None):
        return self._poses.identity(dtype)

    def compose(self, p, q):
        return self._each("compose", p, q)

    def inverse(self, q):
        return self._each("inverse", q)

    def exp(self, x):
        return self._each("exp", x)

    def log(self, q):
        return self._each("log", q)

    def wedge(self, x):
        return self._diagonal(jax.vmap(_ONE.wedge)(x[self.index]), self._poses.wedge(x))

    def vee(self, X):
        count = len(self.whole)
        blocks = [X[4 * i : 4 * i + 4, 4 * i : 4 * i + 4] for i in range(count)]
        size = len(_SEVEN) * len(self.free)
        rest = jnp.zeros((size, size), X.dtype).at[self._others].set(X[4 * count :, 4 * count :])
        return self._poses.vee(rest).at[self.index].set(jax.vmap(_ONE.vee)(jnp.stack(blocks)))

    def matrix(self, q):
        return self._diagonal(jax.vmap(_ONE.matrix)(self._own(q)), self._poses.matrix(q))

    def _diagonal(self, own, every):
        """The matrices of the whole bodies, then those of the others."""
        return block_diag(*own, every[self._others])

    def ad_mv(self, x, y):
        return self._each("ad_mv", x, y)

    def Ad_inv_mv(self, q, w):
        return self._each("Ad_inv_mv", q, w)

    def Ad_inv_rmv(self, q, w):
        return self._each("Ad_inv_rmv", q, w)

    def tangent_mv(self, x, y):
        return self._each("tangent_mv", x, y)

    def tangent_rmv(self, x, y):
        return self._each("tangent_rmv", x, y)

    def tangent_inv_mv(self, x, y):
        return self._each("tangent_inv_mv", x, y)

    def to_ambient(self, q, w):
        return self._each("to_ambient", q, w)

    def from_ambient(self, q, dq):
        return self._each("from_ambient", q, dq)
