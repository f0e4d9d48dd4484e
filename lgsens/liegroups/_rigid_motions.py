"""The poses of many bodies of which those with all six coordinates move on SE(3)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from ._groups import Pose
from ._poses import Poses
from ._products import AbstractDirectProduct
from ._screw import SE3

_ONE = SE3()
_SEVEN = np.arange(7)  # rows of the matrix of a pose in `Poses`, four of one in SE(3)


class RigidMotions(AbstractDirectProduct):
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
        """What `Poses` says of all bodies, and in it what SE(3) says of the whole ones; both, of matrices.

        JAX transposes only what writes to places that it is told to be different.
        """
        both = [each if type(each) is tuple else (self._own(each), each) for each in args]
        own = jax.vmap(getattr(_ONE, method))(*(first for first, _ in both))
        every = getattr(self._poses, method)(*(second for _, second in both))
        if isinstance(every, Pose):
            return Pose(*(leaf.at[self.whole].set(part, unique_indices=True) for leaf, part in zip(every, own)))
        return (own, every) if every.ndim == 2 else every.at[self.index].set(own, unique_indices=True)

    def _split(self, x):
        return x

    def _join(self, pieces):
        return pieces

    def _diagonal(self, blocks):
        """The matrices of the whole bodies, then those of the others."""
        own, every = blocks
        return block_diag(*own, every[self._others])

    def _blocks(self, X):
        count, size = 4 * len(self.whole), len(_SEVEN) * len(self.free)
        own = [X[i : i + 4, i : i + 4] for i in range(0, count, 4)]
        return jnp.stack(own), jnp.zeros((size, size), X.dtype).at[self._others].set(X[count:, count:])

    @property
    def dim(self):
        return self._poses.dim

    def identity(self, dtype=None):
        return self._poses.identity(dtype)
