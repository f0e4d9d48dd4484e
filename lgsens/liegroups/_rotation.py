"""The rotation group SO(3)."""

from functools import reduce

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._xla import one_program

from ._base import AbstractLieGroup
from ._coefficients import c1, c2, c3, horner, inverse_tangent_coefficient

# arctan(√m)/√m = Σ_j (-m)^j / (2j+1). `SO3.log` calls it with m ≤ tan²(π/16) = 0.0396, where the first term left
# out of the second derivative, n (n-1) m^(n-2) / (2n+1), is 9e-17 for n = 14, against 2/5 for the whole.
_ARCTAN = tuple((-1) ** j / (2 * j + 1) for j in range(14))

# 4 p pᵀ = I + Σ_kl _QUATERNION[:, :, k, l] R_kl for the unit quaternion p = (cos θ/2, sin θ/2 n) of R.
_EYE = np.eye(3)
_QUATERNION = np.zeros((4, 4, 3, 3))
_QUATERNION[0, 0] = _EYE
_QUATERNION[0, 1:] = _QUATERNION[1:, 0] = np.cross(_EYE[None, :, :], _EYE[:, None, :])
_QUATERNION[1:, 1:] = _EYE[:, None, :, None] * _EYE[None, :, None, :] + _EYE[:, None, None, :] * _EYE[None, :, :, None]
_QUATERNION[1:, 1:] -= _EYE[:, :, None, None] * _EYE[None, None, :, :]


def nearest_rotation(R: Float[Array | np.ndarray, "... 3 3"]) -> Float[Array | np.ndarray, "... 3 3"]:
    """The rotation matrix nearest to `R`, for a matrix that is one but for a small error (an optimizer's step, say).

    The orthogonal factor of the polar decomposition by Newton-Schulz, `R <- R (3 I - R^T R) / 2`: four steps take an
    error of 0.1 below round-off, and leave a rotation as it is. The derivative is the projection on the tangent space.
    Source: Higham, Functions of Matrices (2008), eq. (8.20). Of NumPy's arrays by NumPy: nothing is compiled.
    """
    return reduce(lambda R, _: _nearer(R), range(4), R) if isinstance(R, np.ndarray) else _nearest(R)


def _nearer(R):
    eye = np.broadcast_to(np.eye(3, dtype=R.dtype), R.shape)
    return 0.5 * R @ (3.0 * eye - R.swapaxes(-1, -2) @ R)


@one_program  # not a loop, whose transpose JAX 0.10 compiles again wherever it is outside of `jit`
def _nearest(R):
    return reduce(lambda R, _: _nearer(R), range(4), R)


def _components(x):
    return tuple(lax.index_in_dim(x, i, keepdims=False) for i in range(3))


@one_program
def cross(x: Float[Array, "3"], y: Float[Array, "3"]) -> Float[Array, "3"]:
    """The cross product `x × y = x~ y`, shape (3,)."""
    (x1, x2, x3), (y1, y2, y3) = _components(x), _components(y)
    return jnp.stack([x2 * y3 - x3 * y2, x3 * y1 - x1 * y3, x1 * y2 - x2 * y1])


@one_program
def skew(x: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The skew-symmetric matrix `x~` with `x~ y = x × y` (§3.2). `x`: shape (3,)."""
    # Stacked, not summed over a constant tensor: with YNN fusions (`lgsens._xla`) XLA miscompiles `sum(constant * x)`
    # fused with other terms in float32, wrong signs past 32768 results.
    x1, x2, x3 = _components(x)
    o = jnp.zeros_like(x1)
    return jnp.stack([o, -x3, x2, x3, o, -x1, -x2, x1, o]).reshape(3, 3)


@one_program
def unskew(X: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """The vector `x`, shape (3,), whose `x~` is the skew-symmetric part of `X`, shape (3, 3)."""
    (_, X12, X13), (X21, _, X23), (X31, X32, _) = (_components(row) for row in _components(X))
    return 0.5 * jnp.stack([X32 - X23, X13 - X31, X21 - X12])


# Products this small are fused sums of products. As a `dot` each is an operation of its own, and a step is as slow as
# it has operations; in float32 it may be rounded to TF32 on a GPU, and a rotation would not stay one.


@one_program
def _matmul(A, B):
    return jnp.sum(A[:, :, None] * B[None, :, :], axis=1)


def _dot(x, y):
    return jnp.sum(x * y)


@one_program
def turn(rotation: Float[Array, "3 3"], x: Float[Array, "3"]) -> Float[Array, "3"]:
    """`R x`, shape (3,), for any matrix R."""
    return jnp.sum(rotation * x[None, :], axis=1)


@one_program
def turn_back(rotation: Float[Array, "3 3"], x: Float[Array, "3"]) -> Float[Array, "3"]:
    """`R^T x`, shape (3,), for any matrix R."""
    return jnp.sum(rotation * x[:, None], axis=0)


@one_program
def _quaternion(R):
    # The row of 4 p pᵀ with the largest diagonal entry (≥ 1, Shepperd 1978) is p up to a factor, free of
    # cancellation; normalizing it needs no other branch.
    linear = jnp.tensordot(jnp.asarray(_QUATERNION, R.dtype), R, 2, precision=lax.Precision.HIGHEST)
    rows = jnp.eye(4, dtype=R.dtype) + linear
    row = lax.dynamic_index_in_dim(rows, jnp.argmax(jnp.diagonal(rows)), keepdims=False)
    # Of the two quaternions ±p, the one with θ ≤ π. At θ = π both have cos θ/2 = 0 and this picks one.
    return row * lax.rsqrt(_dot(row, row)) * jnp.where(row[0] < 0.0, -1.0, 1.0).astype(R.dtype)


class SO3(AbstractLieGroup):
    """The group of rotations: orthogonal matrices `R`, shape (3, 3), of determinant 1, `k = 3`.

    `R` maps body-frame components to inertial-frame components; coordinates are rotation vectors and angular
    velocities in the body frame, `Ω~ = R^T Ṙ`.

    Source: paper, §3.2; Brüls & Cardona 2010, appendix; Iserles et al. 2000, appendix B.
    """

    @property
    def dim(self):
        return 3

    def identity(self, dtype=None):
        return jnp.eye(3, dtype=dtype)

    def compose(self, p, q):
        return _matmul(p, q)

    def inverse(self, q):
        return q.T

    def exp(self, x):
        """`R = I + sin θ/θ x~ + (1 - cos θ)/θ² x~²` (Rodrigues), `θ = |x|`.

        `x`: rotation vector [rad], shape (3,).
        """
        # I + c_1 x~ + c_2 x~² with x~² = x xᵀ - s I: no matrix product.
        s = _dot(x, x)
        a, b = c1(s), c2(s)
        return (1.0 - b * s) * jnp.eye(3, dtype=x.dtype) + skew(a * x) + (b * x)[:, None] * x[None, :]

    def log(self, q):
        """The rotation vector [rad], shape (3,), `|x| ≤ π`, with `exp(x~) = q`.

        Accurate to round-off, absolute near `π` and relative near 0. At an angle of exactly `π` both `x` and
        `-x` are right: this is one of the two, and there the map jumps from one to the other.
        """
        # tan(φ/2) = tan φ / (1 + √(1 + tan² φ)), along the axis n: from the quaternion to tan(θ/4) n, tan(θ/8) n
        # and tan(θ/16) n. There one short series serves all angles up to π: no switch, no singular square root.
        p = _quaternion(q)
        y = p[1:] / (1.0 + p[0])
        for _ in range(2):
            y = y / (1.0 + jnp.sqrt(1.0 + _dot(y, y)))
        return 16.0 * horner(_ARCTAN, _dot(y, y)) * y

    def wedge(self, x):
        return skew(x)

    def vee(self, X):
        return unskew(X)

    def matrix(self, q):
        return q

    def ad_mv(self, x, y):
        return cross(x, y)

    def Ad_inv_mv(self, q, w):
        """`D(R) w = R^T w`: inertial-frame components to body-frame components."""
        return turn_back(q, w)

    def Ad_inv_rmv(self, q, w):
        return turn(q, w)

    def tangent_mv(self, x, y):
        """`T(x) = I - (1 - cos θ)/θ² x~ + (θ - sin θ)/θ³ x~²`, applied to `y`."""
        # With x~² y = x (x·y) - s y, and 1 - s c_3 = c_1.
        s = _dot(x, x)
        return c1(s) * y - c2(s) * cross(x, y) + (c3(s) * _dot(x, y)) * x

    def tangent_rmv(self, x, y):
        """`T(x)^T = T(-x)`, applied to `y`."""
        return self.tangent_mv(-x, y)

    def tangent_inv_mv(self, x, y):
        """`T(x)^{-1} = I + x~/2 + (1 - (θ/2) cot(θ/2))/θ² x~²`, applied to `y`.

        Singular at `θ = 2π`, where `T(x)` itself loses rank: take increments shorter than that.
        """
        s = _dot(x, x)
        e = inverse_tangent_coefficient(s)
        return (1.0 - s * e) * y + 0.5 * cross(x, y) + (e * _dot(x, y)) * x

    def tangent_inv_gradient(self, x, y):
        """`∂(T(x)^{-1} y)/∂x`, shape (3, 3), `T(x)⁻¹ y = (1 - s e) y + x × y/2 + e (x·y) x`. `x`, `y`: shape (3,)."""
        s, along = _dot(x, x), _dot(x, y)
        e, slope = (inverse_tangent_coefficient(s, order) for order in range(2))
        by_angle = 2.0 * slope * along * x - 2.0 * (e + s * slope) * y
        products = by_angle[:, None] * x[None, :] + e * x[:, None] * y[None, :]
        return products + e * along * jnp.eye(3, dtype=x.dtype) - 0.5 * skew(y)

    def to_ambient(self, q, w):
        return _matmul(q, skew(w))

    def from_ambient(self, q, dq):
        """`w = unskew(R^T dR)`: the skew part, hence the orthogonal projection on the tangent space."""
        return unskew(_matmul(q.T, dq))
