"""The equations of the stages (`_radau_stages`) with dense matrices, on the nullspaces of their constraints.

They are 3 (2k + m + m_p) rows, 564 of the quarter-car with its 3 degrees of freedom. But the constraints belong to each
stage alone. With Jᵀ = Q R, Z the columns of Q that B does not see and W those that J does not,

    u = u° + Z α,     y = y° + h E α + W β,     E = −J⁺ V Z,     u° = h B⁺ρ_4,     y° = h J⁺(ρ_3 − V u°),

and the first two rows, multiplied by h Zᵀ and h² Wᵀ, lose μ and λ. What is left for α and β is dense in the stages,

    Σ_j ā_ij Z_iᵀ M T_i T_j⁻¹ Z_j α_j + Z_iᵀ (h G Z − h M E)_i α_i − Z_iᵀ M W_i β_i,
    Σ_j ā_ij W_iᵀ M (h E α + W β)_j   + W_iᵀ (h² K_t Z + h² C_t E)_i α_i + h W_iᵀ C_t W_i β_i,

and has 3 · 2 f rows, f = k − m: 18 of the quarter-car, in which the step size stands beside stiffness and damping only.
Multipliers follow with R from what the first two rows leave. (LU of all rows takes 6 ms of the quarter-car; these
matrices, Q, R and LU 0.4 ms.)

Source: elimination here. Nullspaces by QR: Kim & Vanderploeg, Journal of Mechanisms, Transmissions, and Automation in
Design 108 (1986) 183.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, constraint_velocity
from lgsens.integrate._level_step import by_configuration
from lgsens.integrate._linearized import Node
from lgsens.integrate._radau_stages import (
    INVERSE,
    AbstractStageFactors,
    C,
    RadauStages,
    StageMatrices,
    advanced,
    of_stages,
)
from lgsens.liegroups import AbstractLieGroup


class _Nullspaces(NamedTuple):
    """Of the constraints of each stage."""

    basis: Float[Array, "3 k k"]  # Q
    triangle: Float[Array, "3 m m"]  # R
    dependent: Float[Array, "3 k f"]  # E


class DenseStageFactors(AbstractStageFactors):
    """Nullspaces, and LU factors of what is left."""

    group: AbstractLieGroup = eqx.field(static=True)
    mass: Float[Array, "k k"]
    at: StageMatrices
    num_positions: int = eqx.field(static=True)
    constraints: _Nullspaces
    reduced: tuple[Array, Array] | None  # for α and β; None: there is no freedom

    @classmethod
    def of(cls, system: AbstractSystem, node: Node, previous: State, found: RadauStages) -> "DenseStageFactors":
        group, mass, h, dtype = system.group, system.mass_matrix(), node.h, node.h.dtype
        m, p = (part.shape[1] for part in found[2:])

        def stage(c, x, v, found: RadauStages):
            at = _matrices(system, group.retract(previous.q, x), x, v, found, node.begin + c * h)
            basis, triangle = jnp.linalg.qr(at.jacobian.T, mode="complete")
            free, moving = basis[:, p:], basis[:, m:]
            dependent = -_least(basis, triangle[:m], at.turned @ free)
            carried = h * dependent
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
            nullspaces = _Nullspaces(basis, triangle[:m], dependent)
            return at, nullspaces, jnp.block(own), (weighted, positions), (moving.T @ mass, velocities)

        stages = jnp.asarray(C, dtype), *advanced(h, previous.v, found), found
        at, nullspaces, own, *pairs = jax.vmap(stage)(*stages)
        inverse, same = jnp.asarray(INVERSE, dtype), jnp.eye(3, dtype=dtype)
        between = [jnp.einsum("ij,iak,jkb->iajb", inverse, rows, columns) for rows, columns in pairs]
        matrix = jnp.concatenate(between, axis=1) + same[:, None, :, None] * own[:, :, None, :]
        size = 3 * own.shape[1]
        reduced = jsl.lu_factor(matrix.reshape(size, size)) if size else None
        return cls(group, mass, at, p, nullspaces, reduced)

    def solve(self, h, rows):
        at, (basis, triangle, dependent), m, p = self.at, self.constraints, rows.lam.shape[1], self.num_positions
        u = jax.vmap(_least)(basis, triangle[:, :p, :p], h * rows.mu)
        y = jax.vmap(_least)(basis, triangle, h * (rows.lam - of_stages(at.turned, u)))
        _, _, first, second = self.balance(h, u, y)
        free, moving = basis[:, :, p:], basis[:, :, m:]
        transposed = jax.vmap(lambda matrix, row: row @ matrix)
        missing = h * transposed(free, rows.x - first), h**2 * transposed(moving, rows.v - second)
        found = jnp.concatenate(missing, axis=1)
        if self.reduced is not None:
            found = jsl.lu_solve(self.reduced, found.ravel()).reshape(found.shape)
        alpha, beta = found[:, : free.shape[2]], found[:, free.shape[2] :]
        u, y = u + of_stages(free, alpha), y + h * of_stages(dependent, alpha) + of_stages(moving, beta)
        x, v, first, second = self.balance(h, u, y)
        mu = jax.vmap(_pushing)(basis, triangle[:, :p, :p], first - rows.x)
        return RadauStages(x, v, jax.vmap(_pushing)(basis, triangle, rows.v - second), mu)


def _matrices(system: AbstractSystem, q, x, v, found: RadauStages, t) -> StageMatrices:
    """At one stage."""
    group, mass = system.group, system.mass_matrix()
    along = jnp.concatenate([found.mu, jnp.zeros_like(found.lam[len(found.mu) :])])  # as λ of all rows
    at = lambda lam: system.tangents(q, v, found.v, lam, t)
    (stiffness, damping, jacobian), (push, *_) = jax.jvp(at, (found.lam,), (along,))
    turned = by_configuration(system, lambda q: constraint_velocity(system, q, v, t), q)
    turn = lambda u: mass @ group.tangent_mv(x + group.tangent_inv_mv(x, u), found.x)
    turning = jax.jacfwd(turn)(jnp.zeros_like(x))
    return StageMatrices(x, stiffness, damping, jacobian, turned, turning, push)


def _least(basis, triangle, rhs):
    """J⁺ rhs, J the rows of R."""
    size = triangle.shape[0]
    return basis[:, :size] @ (jsl.solve_triangular(triangle, rhs, trans=1) if size else rhs)


def _pushing(basis, triangle, force):
    """λ of Jᵀλ = force."""
    size = triangle.shape[0]
    rhs = force @ basis[:, :size]
    return jsl.solve_triangular(triangle, rhs) if size else rhs
