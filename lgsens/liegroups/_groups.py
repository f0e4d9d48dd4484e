"""The linear space R^n, and the group of the pose of a rigid body."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from ._base import AbstractLieGroup
from ._products import AbstractDirectProduct
from ._rotation import SO3


class Rn(AbstractLieGroup):
    """The linear space `R^n` with addition, `k = n`: an element is an array of shape (n,).

    `exp` and `log` are the identity map, brackets vanish, and `D = T = I` (end of §6.2).

    Arguments: `n`, the dimension, an integer.
    """

    n: int = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.n, int) or self.n < 0:
            raise ValueError(f"Rn: `n` is the dimension, a nonnegative Python integer; got {self.n!r}.")

    @property
    def dim(self):
        return self.n

    def identity(self, dtype=None):
        return jnp.zeros(self.n, dtype=dtype)

    def compose(self, p, q):
        return p + q

    def inverse(self, q):
        return -q

    def exp(self, x):
        return x

    def log(self, q):
        return q

    def wedge(self, x):
        return jnp.zeros((self.n + 1, self.n + 1), x.dtype).at[: self.n, self.n].set(x)

    def vee(self, X):
        return X[: self.n, self.n]

    def matrix(self, q):
        return jnp.eye(self.n + 1, dtype=q.dtype).at[: self.n, self.n].set(q)

    def ad_mv(self, x, y):
        return jnp.zeros_like(y)

    def Ad_inv_mv(self, q, w):
        return w

    def Ad_inv_rmv(self, q, w):
        return w

    def tangent_mv(self, x, y):
        return y

    def tangent_rmv(self, x, y):
        return y

    def tangent_inv_mv(self, x, y):
        return y

    def to_ambient(self, q, w):
        return w

    def from_ambient(self, q, dq):
        return dq


class Pose(NamedTuple):
    """The position and orientation of a rigid body.

    Arguments:

    - `position`: of the body's reference point, inertial frame [m], shape (3,).
    - `orientation`: rotation matrix from the body frame to the inertial frame, shape (3, 3).
    """

    position: Float[Array, "3"]
    orientation: Float[Array, "3 3"]


_FACTORS = Rn(3), SO3()


class R3xSO3(AbstractDirectProduct):
    """The direct product `R^3 × SO(3)`, `k = 6`: an element is a `Pose`.

    Coordinates are `[u, Ω]`: three of translation in the inertial frame (for a velocity `u = ẋ` [m/s]), then
    three of rotation in the body frame (`Ω~ = R^T Ṙ` [rad/s]). Not SE(3): `exp` does not couple the two.
    The matrix is the 7×7 one of eq. (20), the rotation block first.

    Source: paper, §3.2 and eq. (20); Brüls, Arnold & Cardona 2011.
    """

    @property
    def dim(self):
        return 6

    def identity(self, dtype=None):
        return Pose(*(group.identity(dtype) for group in _FACTORS))

    def _each(self, method, *args):
        return Pose(*(getattr(group, method)(*arg) for group, *arg in zip(_FACTORS, *args)))

    def _split(self, x):
        return x[:3], x[3:]

    def _join(self, pieces):
        return jnp.concatenate(pieces)

    def _diagonal(self, blocks):
        translation, rotation = blocks
        return block_diag(rotation, translation)

    def _blocks(self, X):
        return X[3:, 3:], X[:3, :3]
