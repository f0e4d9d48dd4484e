"""The linear space R^n, and the group of the pose of a rigid body."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from ._base import AbstractLieGroup
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


_POSITION = Rn(3)
_ORIENTATION = SO3()
_TRANSLATION, _ROTATION = slice(0, 3), slice(3, 6)  # the coordinates of a pose
_ROTATION_BLOCK, _TRANSLATION_BLOCK = slice(0, 3), slice(3, 7)  # the matrix of a pose, eq. (20)


def _split(x):
    return x[_TRANSLATION], x[_ROTATION]


class R3xSO3(AbstractLieGroup):
    """The direct product `R^3 × SO(3)`, `k = 6`: an element is a `Pose`.

    Coordinates are `[u, Ω]`: three of translation in the inertial frame (for a velocity `u = ẋ` [m/s]), then
    three of rotation in the body frame (`Ω~ = R^T Ṙ` [rad/s]). Not SE(3): `exp` does not couple the two.

    Source: paper, §3.2 and eq. (20); Brüls, Arnold & Cardona 2011.
    """

    @property
    def dim(self):
        return 6

    def identity(self, dtype=None):
        return Pose(_POSITION.identity(dtype), _ORIENTATION.identity(dtype))

    def compose(self, p, q):
        return Pose(p.position + q.position, _ORIENTATION.compose(p.orientation, q.orientation))

    def inverse(self, q):
        return Pose(-q.position, _ORIENTATION.inverse(q.orientation))

    def exp(self, x):
        u, r = _split(x)
        return Pose(u, _ORIENTATION.exp(r))

    def log(self, q):
        return jnp.concatenate([q.position, _ORIENTATION.log(q.orientation)])

    def wedge(self, x):
        u, r = _split(x)
        return block_diag(_ORIENTATION.wedge(r), _POSITION.wedge(u))

    def vee(self, X):
        u = _POSITION.vee(X[_TRANSLATION_BLOCK, _TRANSLATION_BLOCK])
        r = _ORIENTATION.vee(X[_ROTATION_BLOCK, _ROTATION_BLOCK])
        return jnp.concatenate([u, r])

    def matrix(self, q):
        """The 7×7 matrix of eq. (20), the rotation block first."""
        return block_diag(_ORIENTATION.matrix(q.orientation), _POSITION.matrix(q.position))

    def ad_mv(self, x, y):
        (u, r), (w, s) = _split(x), _split(y)
        return jnp.concatenate([_POSITION.ad_mv(u, w), _ORIENTATION.ad_mv(r, s)])

    def Ad_inv_mv(self, q, w):
        u, r = _split(w)
        return jnp.concatenate([u, _ORIENTATION.Ad_inv_mv(q.orientation, r)])

    def Ad_inv_rmv(self, q, w):
        u, r = _split(w)
        return jnp.concatenate([u, _ORIENTATION.Ad_inv_rmv(q.orientation, r)])

    def tangent_mv(self, x, y):
        u, r = _split(y)
        return jnp.concatenate([u, _ORIENTATION.tangent_mv(x[_ROTATION], r)])

    def tangent_rmv(self, x, y):
        u, r = _split(y)
        return jnp.concatenate([u, _ORIENTATION.tangent_rmv(x[_ROTATION], r)])

    def tangent_inv_mv(self, x, y):
        u, r = _split(y)
        return jnp.concatenate([u, _ORIENTATION.tangent_inv_mv(x[_ROTATION], r)])

    def to_ambient(self, q, w):
        u, r = _split(w)
        return Pose(u, _ORIENTATION.to_ambient(q.orientation, r))

    def from_ambient(self, q, dq):
        return jnp.concatenate([dq.position, _ORIENTATION.from_ambient(q.orientation, dq.orientation)])
