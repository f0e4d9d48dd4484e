"""The equations of the three stages of a Radau step (`_radau`), and their linearization.

Unknowns of a stage are ξ, w, λ, μ. Its rows depend on them, on q = q_n exp(x̃) and on v, with x_i = h Σ_j a_ij ξ_j and
v_i − v_n = h Σ_j a_ij w_j. Let u be the variation of q_i and y/h that of v_i; K_t, C_t and J the tangents there, B the
rows of positions in J, V u = Dc·(q ũ), G = M D_x(T ξ) T⁻¹ − D(Bᵀμ), and ρ the given variation of the rows:

    M T ξ' + G u − M y/h − Bᵀμ' = ρ_1,        M w' + K_t u + C_t y/h + Jᵀλ' = ρ_2,
    J y/h + V u = ρ_3,                        B u/h = ρ_4,
    ξ'_i = Σ_j ā_ij T_j⁻¹ u_j/h,              w'_i = Σ_j ā_ij y_j/h²,             ā = a⁻¹.

r is linear in λ, so D(Bᵀμ) is the derivative of K_t along μ. How they are solved: `_radau_dense`, `_radau_sparse`.
"""

import abc
import operator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, constraint_velocity
from lgsens.integrate._linearized import Node
from lgsens.liegroups import AbstractLieGroup
from lgsens.linear import Matrix

_R = np.sqrt(6.0)
C = np.array([(4.0 - _R) / 10.0, (4.0 + _R) / 10.0, 1.0])
A = np.array(
    [
        [(88.0 - 7.0 * _R) / 360.0, (296.0 - 169.0 * _R) / 1800.0, (-2.0 + 3.0 * _R) / 225.0],
        [(296.0 + 169.0 * _R) / 1800.0, (88.0 + 7.0 * _R) / 360.0, (-2.0 - 3.0 * _R) / 225.0],
        [(16.0 - _R) / 36.0, (16.0 + _R) / 36.0, 1.0 / 9.0],
    ]
)
INVERSE = np.linalg.inv(A)  # ā

of_stages = jax.vmap(operator.matmul)


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


class StageMatrices(NamedTuple):
    """The matrices above at the stages, arrays or `SparseMatrix` of three."""

    x: Float[Array, "3 k"]
    stiffness: Matrix  # K_t, (3, k, k)
    damping: Matrix  # C_t, (3, k, k)
    jacobian: Matrix  # J, (3, m, k)
    turned: Matrix  # V, (3, m, k)
    turning: Matrix  # M D_x(T ξ) T⁻¹, (3, k, k)
    push: Matrix  # D(Bᵀμ), (3, k, k)


class AbstractStageFactors(eqx.Module):
    """The linearized equations of the stages, and their matrix in factors.

    Attributes:
        mass: M, (k, k).
        at: the other matrices.
        num_positions: how many rows are of position level (static).
    """

    group: eqx.AbstractVar[AbstractLieGroup]
    mass: eqx.AbstractVar[Matrix]
    at: eqx.AbstractVar[StageMatrices]
    num_positions: eqx.AbstractVar[int]

    @abc.abstractmethod
    def solve(self, h, rows: RadauStages) -> RadauStages:
        """The variations whose rows these are, as near as an iteration needs."""

    def exactly(self, h, rows: RadauStages) -> RadauStages:
        """The same to round-off, and transposed where derivatives are taken in reverse."""
        return self.solve(h, rows)

    def balance(self, h, u, y):
        """ξ', w', and what ρ_1 and ρ_2 are without multipliers, each (3, k)."""
        inverse, at, mass = jnp.asarray(INVERSE, h.dtype), self.at, jax.vmap(lambda row: self.mass @ row)
        x, v = inverse @ jax.vmap(self.group.tangent_inv_mv)(at.x, u) / h, inverse @ y / h**2
        first = mass(jax.vmap(self.group.tangent_mv)(at.x, x) - y / h)
        second = mass(v) + of_stages(at.stiffness, u) + of_stages(at.damping, y) / h
        return x, v, first + of_stages(at.turning, u) - of_stages(at.push, u), second

    def by_start(self, h, w, v) -> RadauStages:
        """The variation of the rows with that of (q_n, v_n): u is Ad(exp(−x)) w, y/h is v."""
        at, y = self.at, jnp.broadcast_to(v, self.at.x.shape)
        u = jax.vmap(lambda x: self.group.Ad_inv_mv(self.group.exp(x), w))(at.x)
        return RadauStages(
            -of_stages(at.push, u) - (self.mass @ v)[None],
            of_stages(at.stiffness, u) + of_stages(at.damping, y),
            of_stages(at.turned, u) + of_stages(at.jacobian, y),
            of_stages(at.jacobian, u)[:, : self.num_positions] / h,
        )

    def end(self, h, w, v, found: RadauStages) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """The variation of (q_3, v_3) with that of (q_n, v_n) and of the stages."""
        x, v = advanced(h, v, found)
        last = self.at.x[-1]
        return self.group.Ad_inv_mv(self.group.exp(last), w) + self.group.tangent_mv(last, x[-1]), v[-1]
