"""The special Euclidean group SE(3): poses composed as motions."""

import jax
import jax.numpy as jnp

from ._base import AbstractLieGroup
from ._coefficients import inverse_tangent_coefficient
from ._groups import Pose
from ._rotation import SO3, cross, skew, turn, turn_back, unskew

_ROTATION = SO3()


def _dual(mv, x, y):
    """`T(x) y` or `T(x)^{-1} y` from `mv` of SO(3): coordinates of SE(3) are dual vectors of SO(3), ω + ε u, ε² = 0.

    The bracket `[x, y] = (u_x × ω_y + ω_x × u_y, ω_x × ω_y)` is the cross product of dual vectors, so each power series
    in `ad x` is that of SO(3) in dual numbers, F(ω + ε u) (y_ω + ε y_u) = F(ω) y_ω + ε (F(ω) y_u + DF(ω)[u] y_ω).
    """
    (u, w), (yu, yw) = (x[:3], x[3:]), (y[:3], y[3:])
    rotation, translation = jax.jvp(mv, (w, yw), (u, yu))
    return jnp.concatenate([translation, rotation])


def _exchanged(z):
    return jnp.concatenate([z[3:], z[:3]])


def _skew_product(x, y):
    """x~ y~ = y xᵀ − (x·y) I."""
    return y[:, None] * x[None, :] - jnp.sum(x * y) * jnp.eye(3, dtype=x.dtype)


class SE3(AbstractLieGroup):
    """The group of rigid motions SE(3), `k = 6`: an element is a `Pose`, and `p q` is the pose q in the frame of p.

        (x, R) (y, S) = (x + R y, R S),     exp(u, ω) = (T_SO(3)(ω)ᵀ u, exp ω̃)

    Coordinates are `[u, ω]`: three of translation, then three of rotation, both in the body frame: for a velocity the
    twist `u = R^T ẋ` [m/s], `ω~ = R^T Ṙ` [rad/s]. The matrix is the 4×4 one of homogeneous coordinates. `log` is
    accurate where that of SO(3) is, below an angle of π, `tangent_inv` below 2π.

    Source: Müller (2021), arXiv 2303.07928, §2; Sonneville, Cardona & Brüls (2014), CMAME 268, appendix A.
    """

    @property
    def dim(self):
        return 6

    def identity(self, dtype=None):
        return Pose(jnp.zeros(3, dtype), _ROTATION.identity(dtype))

    def compose(self, p, q):
        return Pose(p.position + turn(p.orientation, q.position), _ROTATION.compose(p.orientation, q.orientation))

    def inverse(self, q):
        return Pose(-turn_back(q.orientation, q.position), q.orientation.T)

    def exp(self, x):
        return Pose(_ROTATION.tangent_rmv(x[3:], x[:3]), _ROTATION.exp(x[3:]))

    def log(self, q):
        """The screw `[u, ω]`, shape (6,), `|ω| ≤ π`, with `exp(x~) = q`: `ω` as in SO(3), `u = T_SO(3)(ω)^{-T} x`."""
        w = _ROTATION.log(q.orientation)
        return jnp.concatenate([_ROTATION.tangent_inv_mv(-w, q.position), w])

    def wedge(self, x):
        return jnp.zeros((4, 4), x.dtype).at[:3, :3].set(skew(x[3:])).at[:3, 3].set(x[:3])

    def vee(self, X):
        return jnp.concatenate([X[:3, 3], unskew(X[:3, :3])])

    def matrix(self, q):
        return jnp.eye(4, dtype=q.position.dtype).at[:3, :3].set(q.orientation).at[:3, 3].set(q.position)

    def ad_mv(self, x, y):
        (u, w), (yu, yw) = (x[:3], x[3:]), (y[:3], y[3:])
        return jnp.concatenate([cross(w, yu) + cross(u, yw), cross(w, yw)])

    def Ad_inv_mv(self, q, w):
        """`D(q) [v, ω] = [Rᵀ (v + ω × x), Rᵀ ω]`."""
        moved = w[:3] + cross(w[3:], q.position)
        return jnp.concatenate([turn_back(q.orientation, moved), turn_back(q.orientation, w[3:])])

    def Ad_inv_rmv(self, q, w):
        force = turn(q.orientation, w[:3])
        return jnp.concatenate([force, turn(q.orientation, w[3:]) + cross(q.position, force)])

    def tangent_mv(self, x, y):
        return _dual(_ROTATION.tangent_mv, x, y)

    def tangent_rmv(self, x, y):
        # [[A, B], [0, A]]ᵀ [f, m] = [Aᵀ f, Bᵀ f + Aᵀ m]: the dual covector is f + ε m.
        return _exchanged(_dual(_ROTATION.tangent_rmv, x, _exchanged(y)))

    def tangent_inv_mv(self, x, y):
        return _dual(_ROTATION.tangent_inv_mv, x, y)

    def tangent_inv_rmv(self, x, y):
        """`T(x)^{-T} y`, the transpose of `tangent_inv_mv`. `y`: a covector, shape (6,)."""
        return _exchanged(_dual(lambda w, y: _ROTATION.tangent_inv_mv(-w, y), x, _exchanged(y)))

    def tangent_inv_gradient(self, x, y):
        """`∂(T(x)^{-1} y)/∂x`, shape (6, 6). `x`, `y`: shape (6,).

        With ε: (u, ω) → (ω, 0), p = u·ω and the e(s) of SO(3), s = ω·ω, the dual vectors of `_dual` give

            T(x)⁻¹ = I + ad/2 + (e + 2 p e′ ε) ad²,     ad = ad(x) = [[ω~, u~], [0, ω~]],

        and as ad(δx) z = −ad(z) δx and ε commutes with ad, with S = ad(ad y) + ad ad(y),

            ∂/∂x = −ad(y)/2 − (e + 2 p e′ ε) S + (2 e′ + 4 p e″ ε) ad² y [0, ω]ᵀ + 2 e′ ε ad² y [ω, u]ᵀ.
        """
        (u, w), zero = (x[:3], x[3:]), jnp.zeros_like(x[:3])
        s, p = jnp.sum(w * w), jnp.sum(u * w)
        e, first, second = (inverse_tangent_coefficient(s, order) for order in range(3))
        once = self.ad_mv(x, y)
        twice = self.ad_mv(x, once)
        moved = jnp.concatenate([twice[3:], zero])
        (yu, yw), (zu, zw) = (y[:3], y[3:]), (once[:3], once[3:])
        rotation = skew(zw) + _skew_product(w, yw)
        translation = skew(zu) + _skew_product(u, yw) + _skew_product(w, yu)
        diagonal = -0.5 * skew(yw) - e * rotation
        corner = -0.5 * skew(yu) - e * translation - 2.0 * p * first * rotation
        by_angle = 2.0 * first * twice + 4.0 * p * second * moved
        matrix = jnp.block([[diagonal, corner], [jnp.zeros_like(corner), diagonal]])
        return (
            matrix
            + by_angle[:, None] * jnp.concatenate([zero, w])[None, :]
            + 2.0 * first * moved[:, None] * jnp.concatenate([w, u])[None, :]
        )

    def tangent_inv_rmv_gradient(self, x, y):
        """`∂(T(x)^{-T} y)/∂x`, shape (6, 6). `y`: a covector, shape (6,)."""
        # T(x)⁻ᵀ y is T(−x)⁻¹ y with both exchanged, as in `tangent_inv_rmv`.
        return -_exchanged(self.tangent_inv_gradient(-x, _exchanged(y)))

    def to_ambient(self, q, w):
        return Pose(turn(q.orientation, w[:3]), _ROTATION.to_ambient(q.orientation, w[3:]))

    def from_ambient(self, q, dq):
        rotation = _ROTATION.from_ambient(q.orientation, dq.orientation)
        return jnp.concatenate([turn_back(q.orientation, dq.position), rotation])
