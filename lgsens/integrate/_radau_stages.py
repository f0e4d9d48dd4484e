"""The equations of the three stages of a Radau step, and their matrix in factors (`_radau`).

Unknowns of a stage are ξ, w, λ, μ. Its rows depend on them, on q = q_n exp(x̃) and on v, with x_i = h Σ_j a_ij ξ_j and
v_i − v_n = h Σ_j a_ij w_j. Let u be the variation of q_i and y/h that of v_i; K_t, C_t and J the tangents there, B the
rows of positions in J, V u = Dc·(q ũ), G = M D_x(T ξ) T⁻¹ − D(Bᵀμ), and ρ the given variation of the rows:

    M T ξ' + G u − M y/h − Bᵀμ' = ρ_1,        M w' + K_t u + C_t y/h + Jᵀλ' = ρ_2,
    J y/h + V u = ρ_3,                        B u/h = ρ_4,
    ξ'_i = Σ_j ā_ij T_j⁻¹ u_j/h,              w'_i = Σ_j ā_ij y_j/h²,             ā = a⁻¹.

Dense, these are 3 (2k + m + m_p) rows, 564 of the quarter-car with its 3 degrees of freedom. But the constraints belong
to each stage alone. With Jᵀ = Q R, Z the columns of Q that B does not see and W those that J does not,

    u = u° + Z α,     y = y° + h E α + W β,     E = −J⁺ V Z,     u° = h B⁺ρ_4,     y° = h J⁺(ρ_3 − V u°),

and the first two rows, multiplied by h Zᵀ and h² Wᵀ, lose μ and λ. What is left for α and β is dense in the stages,

    Σ_j ā_ij Z_iᵀ M T_i T_j⁻¹ Z_j α_j + Z_iᵀ (h G Z − h M E)_i α_i − Z_iᵀ M W_i β_i,
    Σ_j ā_ij W_iᵀ M (h E α + W β)_j   + W_iᵀ (h² K_t Z + h² C_t E)_i α_i + h W_iᵀ C_t W_i β_i,

and has 3 · 2 f rows, f = k − m: 18 of the quarter-car, in which the step size stands beside stiffness and damping only.
Multipliers follow with R from what the first two rows leave. r is linear in λ, so D(Bᵀμ) is the derivative of K_t along
μ. (LU of all rows takes 6 ms of the quarter-car; these matrices, Q, R and LU 0.4 ms.)

Source: the equations of `_radau`; elimination here. Nullspaces by QR: Kim & Vanderploeg, Journal of Mechanisms,
Transmissions, and Automation in Design 108 (1986) 183.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, constraint_velocity
from lgsens.integrate._level_step import by_configuration
from lgsens.integrate._linearized import Node
from lgsens.liegroups import AbstractLieGroup

_R = np.sqrt(6.0)
C = np.array([(4.0 - _R) / 10.0, (4.0 + _R) / 10.0, 1.0])
A = np.array(
    [
        [(88.0 - 7.0 * _R) / 360.0, (296.0 - 169.0 * _R) / 1800.0, (-2.0 + 3.0 * _R) / 225.0],
        [(296.0 + 169.0 * _R) / 1800.0, (88.0 + 7.0 * _R) / 360.0, (-2.0 - 3.0 * _R) / 225.0],
        [(16.0 - _R) / 36.0, (16.0 + _R) / 36.0, 1.0 / 9.0],
    ]
)
_INVERSE = np.linalg.inv(A)  # ā


class RadauStages(NamedTuple):
    """The unknowns of three stages, or rows of their equations."""

    x: Float[Array, "3 k"]  # ξ = ẋ
    v: Float[Array, "3 k"]  # w = v̇
    lam: Float[Array, "3 m"]
    mu: Float[Array, "3 p"]


def advanced(h, v, found: RadauStages) -> tuple[Float[Array, "3 k"], Float[Array, "3 k"]]:
    """x_i and v_i from v_n = v."""
    a = h * jnp.asarray(A, v.dtype)
    return a @ found.x, v[None] + a @ found.v


def left(system: AbstractSystem, node: Node, previous: State, found: RadauStages) -> RadauStages:
    """What is left of the equations of the stages."""
    mass = system.mass_matrix()

    def stage(c, x, v, found: RadauStages):
        q, t = system.group.retract(previous.q, x), node.begin + c * node.h
        push = found.mu @ system.constraint_jacobian(q, t)
        return RadauStages(
            mass @ (system.group.tangent_mv(x, found.x) - v) - push,
            system.residual(q, v, found.v, found.lam, t),
            constraint_velocity(system, q, v, t),
            system.constraint(q, t) / node.h,
        )

    return jax.vmap(stage)(jnp.asarray(C, node.h.dtype), *advanced(node.h, previous.v, found), found)


class _AtStages(NamedTuple):
    """The matrices above at the stages."""

    x: Float[Array, "3 k"]
    stiffness: Float[Array, "3 k k"]  # K_t
    damping: Float[Array, "3 k k"]  # C_t
    turned: Float[Array, "3 m k"]  # V
    turning: Float[Array, "3 k k"]  # M D_x(T ξ) T⁻¹
    push: Float[Array, "3 k k"]  # D(Bᵀμ)
    basis: Float[Array, "3 k k"]  # Q
    triangle: Float[Array, "3 m m"]  # R
    dependent: Float[Array, "3 k f"]  # E

    @classmethod
    def of(cls, system: AbstractSystem, q, x, v, found: RadauStages, t) -> "_AtStages":
        """At one of them."""
        group, mass, (m, p) = system.group, system.mass_matrix(), (len(found.lam), len(found.mu))
        along = jnp.concatenate([found.mu, jnp.zeros_like(found.lam[p:])])
        at = lambda lam: system.tangents(q, v, found.v, lam, t)
        (stiffness, damping, jacobian), (push, *_) = jax.jvp(at, (found.lam,), (along,))
        turned = by_configuration(system, lambda q: constraint_velocity(system, q, v, t), q)
        turn = lambda u: mass @ group.tangent_mv(x + group.tangent_inv_mv(x, u), found.x)
        turning = jax.jacfwd(turn)(jnp.zeros_like(x))
        basis, triangle = jnp.linalg.qr(jacobian.T, mode="complete")
        dependent = -_least(basis, triangle[:m], turned @ basis[:, p:])
        return cls(x, stiffness, damping, turned, turning, push, basis, triangle[:m], dependent)


class StageFactors(eqx.Module):
    """The matrix of the stages in factors."""

    group: AbstractLieGroup = eqx.field(static=True)
    mass: Float[Array, "k k"]
    at: _AtStages
    reduced: tuple[Array, Array] | None  # LU, for α and β; None: there is no freedom

    @classmethod
    def of(cls, system: AbstractSystem, node: Node, previous: State, found: RadauStages) -> "StageFactors":
        group, mass, h, dtype = system.group, system.mass_matrix(), node.h, node.h.dtype
        m, p = (part.shape[1] for part in found[2:])

        def stage(c, x, v, found: RadauStages):
            q, t = group.retract(previous.q, x), node.begin + c * h
            at = _AtStages.of(system, q, x, v, found, t)
            free, moving, carried = at.basis[:, p:], at.basis[:, m:], h * at.dependent
            own = [
                [free.T @ (h * ((at.turning - at.push) @ free) - mass @ carried), -free.T @ (mass @ moving)],
                [
                    moving.T @ (h**2 * (at.stiffness @ free) + h * (at.damping @ carried)),
                    h * moving.T @ (at.damping @ moving),
                ],
            ]
            weighted = jax.vmap(partial(group.tangent_rmv, x))(free.T @ mass)
            back = jax.vmap(partial(group.tangent_inv_mv, x), 1, 1)(free)
            positions = jnp.concatenate([back, jnp.zeros_like(moving)], axis=1)
            velocities = jnp.concatenate([carried, moving], axis=1)
            return at, jnp.block(own), (weighted, positions), (moving.T @ mass, velocities)

        stages = jnp.asarray(C, dtype), *advanced(h, previous.v, found), found
        at, own, *pairs = jax.vmap(stage)(*stages)
        inverse, same = jnp.asarray(_INVERSE, dtype), jnp.eye(3, dtype=dtype)
        between = [jnp.einsum("ij,iak,jkb->iajb", inverse, rows, columns) for rows, columns in pairs]
        matrix = jnp.concatenate(between, axis=1) + same[:, None, :, None] * own[:, :, None, :]
        size = 3 * own.shape[1]
        return cls(group, mass, at, jsl.lu_factor(matrix.reshape(size, size)) if size else None)

    def solve(self, h, rows: RadauStages) -> RadauStages:
        """The variations whose rows these are."""
        at, m, p = self.at, rows.lam.shape[1], rows.mu.shape[1]
        inverse = jnp.asarray(_INVERSE, self.mass.dtype)
        of_stages = jax.vmap(jnp.matmul)

        def balance(u, y):
            """ξ', w', and what the first two rows are without multipliers."""
            x, v = inverse @ jax.vmap(self.group.tangent_inv_mv)(at.x, u) / h, inverse @ y / h**2
            first = (jax.vmap(self.group.tangent_mv)(at.x, x) - y / h) @ self.mass
            second = v @ self.mass + of_stages(at.stiffness, u) + of_stages(at.damping, y) / h
            return x, v, first + of_stages(at.turning - at.push, u), second

        u = jax.vmap(_least)(at.basis, at.triangle[:, :p, :p], h * rows.mu)
        y = jax.vmap(_least)(at.basis, at.triangle, h * (rows.lam - of_stages(at.turned, u)))
        _, _, first, second = balance(u, y)
        free, moving = at.basis[:, :, p:], at.basis[:, :, m:]
        transposed = jax.vmap(lambda matrix, row: row @ matrix)
        missing = h * transposed(free, rows.x - first), h**2 * transposed(moving, rows.v - second)
        found = jnp.concatenate(missing, axis=1)
        if self.reduced is not None:
            found = jsl.lu_solve(self.reduced, found.ravel()).reshape(found.shape)
        alpha, beta = found[:, : free.shape[2]], found[:, free.shape[2] :]
        u, y = u + of_stages(free, alpha), y + h * of_stages(at.dependent, alpha) + of_stages(moving, beta)
        x, v, first, second = balance(u, y)
        mu = jax.vmap(_pushing)(at.basis, at.triangle[:, :p, :p], first - rows.x)
        return RadauStages(x, v, jax.vmap(_pushing)(at.basis, at.triangle, rows.v - second), mu)

    def by_start(self, h, w, v) -> RadauStages:
        """The variation of the rows with that of (q_n, v_n): u is Ad(exp(−x)) w, y/h is v."""
        at, (m, p) = self.at, (self.at.triangle.shape[1], self.mass.shape[0] - self.at.dependent.shape[2])
        u = jax.vmap(lambda x: self.group.Ad_inv_mv(self.group.exp(x), w))(at.x)
        jacobian = jnp.swapaxes(at.basis[:, :, :m] @ at.triangle, 1, 2)
        of_stages = jax.vmap(jnp.matmul)
        return RadauStages(
            -of_stages(at.push, u) - (self.mass @ v)[None],
            of_stages(at.stiffness, u) + at.damping @ v,
            of_stages(at.turned, u) + jacobian @ v,
            of_stages(jacobian[:, :p], u) / h,
        )

    def end(self, h, w, v, found: RadauStages) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """The variation of (q_3, v_3) with that of (q_n, v_n) and of the stages."""
        x, v = advanced(h, v, found)
        last = self.at.x[-1]
        return self.group.Ad_inv_mv(self.group.exp(last), w) + self.group.tangent_mv(last, x[-1]), v[-1]


def _least(basis, triangle, rhs):
    """J⁺ rhs, J the rows of R."""
    size = triangle.shape[0]
    return basis[:, :size] @ (jsl.solve_triangular(triangle, rhs, trans=1) if size else rhs)


def _pushing(basis, triangle, force):
    """λ of Jᵀλ = force."""
    size = triangle.shape[0]
    rhs = force @ basis[:, :size]
    return jsl.solve_triangular(triangle, rhs) if size else rhs
