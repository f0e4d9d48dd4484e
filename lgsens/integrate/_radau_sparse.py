"""The equations of the stages (`_radau_stages`) by block elimination on the graph of bodies and joints.

Multiplied by h, h², σh and σh, σ the size of M, they are for û = u, ŷ = y, λ̂ = h² λ'/σ and μ̂ = h μ'/σ of all stages

    Σ_j ā_ij M T_i T_j⁻¹ u_j + h G_i u_i − M y_i − σ B_iᵀ μ̂_i = h ρ_1,
    Σ_j ā_ij M y_j + h² K_i u_i + h C_i y_i + σ J_iᵀ λ̂_i       = h² ρ_2,
    σ (J y + h V u)_i = σ h ρ_3,                               σ B_i u_i = σ h ρ_4.

A node of the graph is a body with its u and y in three stages, 36 numbers, or a joint with λ̂ and μ̂. That no pivots need
to be exchanged between nodes, nor within one in the order of these rows: ā has D ā + āᵀ D positive definite with D =
diag(b_i/c_i) (Hairer & Wanner II, theorem IV.14.5), so with K symmetric, not negative, the rows of u and y are an
operator with positive definite symmetric part in the product of D with (K, M), as −M y and h² K u cancel there, and in
every part of the mechanism by itself. For W = J M⁻¹ Jᵀ, and W_p that of the bodies that are gone, what these leave of
the rows of a joint is at h = 0

    [−a W_p, W_p − W; −a² W_p, a W_p],         with pivots −a W_p and a W,

regular as soon as W_p is, which the order of the graph sees to. With y eliminated before u, of half the numbers, what
is left would be ā² M + h ā C + h² K, whose leading minors vanish for some h² K: ā² has eigenvalues of negative real
part.

Source: elimination here; quasi-definite matrices as in `lgsens.linear._ordering`.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, in_blocks, mass_scale
from lgsens.integrate._linearized import Node
from lgsens.integrate._radau_dense import DenseStageFactors
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
from lgsens.linear import (
    LU,
    BlockFactors,
    BlockMatrix,
    Elimination,
    Graph,
    LinearEquations,
    SparseMatrix,
    linear_solve,
    tuned,
)


class _Places:
    """Where the unknowns of all stages are: u, y, λ̂ and μ̂, each stage after stage. Rows are named like them."""

    def __init__(self, k: int, m: int):
        sizes = np.repeat([k, k, m, m], 3)
        self.u, self.y, self.lam, self.mu = (np.cumsum([0, *sizes])[:-1]).reshape(4, 3)


def _staged(graph: Graph) -> tuple[Graph, float]:
    """The graph with these unknowns, and how long elimination on nullspaces takes."""
    at = _Places(*graph.sizes)
    staged = graph.with_unknowns([*at.u.tolist(), *at.y.tolist()], [*at.lam.tolist(), *at.mu.tolist()])
    return staged, 0.5 * tuned.nullspaces(*graph.sizes)  # else not worth up to a half more to compile


def stage_plan(system: AbstractSystem) -> Elimination | None:
    """The plan of block elimination; None: on nullspaces."""
    sparse = in_blocks(system)
    return None if sparse is None else sparse.arranged(_staged)


def stage_factors(system: AbstractSystem, node: Node, previous: State, found: RadauStages) -> AbstractStageFactors:
    """The linearized equations at some stages of a step, in factors."""
    plan = stage_plan(system)
    if plan is None:
        return DenseStageFactors.of(system, node, previous, found)
    return SparseStageFactors.of(system, node, previous, found, plan)


class SparseStageFactors(AbstractStageFactors):
    """Blocks of the matrices, and of the factors."""

    group: AbstractLieGroup = eqx.field(static=True)
    mass: SparseMatrix
    at: StageMatrices
    num_positions: int = eqx.field(static=True)
    scale: Float[Array, ""]  # σ
    factors: BlockFactors

    @classmethod
    def of(
        cls, system: Any, node: Node, previous: State, found: RadauStages, plan: Elimination
    ) -> "SparseStageFactors":
        """At some stages of a step; `system`: an `AbstractSparseSystem`."""
        group, mass, h = system.group, system.sparse_mass_matrix(), node.h
        scale, (k, m) = mass_scale(mass), (mass.shape[0], found.lam.shape[1])

        def stage(c, x, v, found: RadauStages):
            q, t = group.retract(previous.q, x), node.begin + c * h
            at = lambda lam: system.sparse_tangents(q, v, found.v, lam, t)
            (stiffness, damping, jacobian), (push, *_) = jax.jvp(at, (found.lam,), (found.mu,))
            turned = system.sparse_rate_stiffness(q, v, t)
            back = partial(group.tangent_inv_mv, x)
            by_place = lambda u: jax.jvp(lambda x: group.tangent_mv(x, found.x), (x,), (back(u),))[1]
            turning, *operators = map(system.rotation_operators, (by_place, partial(group.tangent_mv, x), back))
            none = -1.0 * mass.times_rotations(jnp.zeros_like(turning))  # translations do not turn
            turning = mass.times_rotations(turning) + none
            return StageMatrices(x, stiffness, damping, jacobian, turned, turning, push), operators

        stages = jnp.asarray(C, h.dtype), *advanced(h, previous.v, found), found
        at, (to, back) = jax.vmap(stage)(*stages)
        places, inverse = _Places(k, m), INVERSE.ravel()
        u, y, lam, mu = places.u, places.y, places.lam, places.mu
        # of two stages, the second the faster
        first, second = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
        between = jax.vmap(lambda a, operator: a * mass.times_rotations(operator))(inverse, to[first] @ back[second])
        still = jax.vmap(lambda a: a * mass)
        force = scale * at.jacobian.T
        parts = [
            (between, u[first], u[second]),
            (h * at.turning, u, u),
            (-h * at.push, u, u),
            (still(-np.ones(3)), u, y),
            (-1.0 * force, u, mu),
            (still(inverse), y[first], y[second]),
            (h**2 * at.stiffness, y, u),
            (h * at.damping, y, y),
            (force, y, lam),
            (scale * at.jacobian, lam, y),
            (scale * h * at.turned, lam, u),
            (scale * at.jacobian, mu, u),
        ]
        factors = BlockFactors.of(BlockMatrix.of(plan, *_entries(parts)), LU)
        return cls(group, mass, at, m, scale, factors)

    def solve(self, h, rows):
        return self._named(h, self.factors.solve(self._right(h, rows)))

    def exactly(self, h, rows):
        return linear_solve(_EQUATIONS, (self, h), rows)

    def _right(self, h, rows: RadauStages):
        """The right-hand side, in the order of the unknowns."""
        scale = self.scale * h
        return jnp.concatenate([h * rows.x, h**2 * rows.v, scale * rows.lam, scale * rows.mu], axis=None)

    def _named(self, h, found) -> RadauStages:
        """The unknowns of the stages from u, y, λ̂ and μ̂."""
        (k, m), inverse = (self.mass.shape[0], self.num_positions), jnp.asarray(INVERSE, h.dtype)
        u, y, lam, mu = jnp.split(found, np.cumsum([3 * k, 3 * k, 3 * m]))
        back = jax.vmap(self.group.tangent_inv_mv)(self.at.x, u.reshape(3, k))
        return RadauStages(
            inverse @ back / h,
            inverse @ y.reshape(3, k) / h**2,
            self.scale * lam.reshape(3, m) / h**2,
            self.scale * mu.reshape(3, m) / h,
        )

    def product(self, h, found: RadauStages) -> RadauStages:
        """The rows of variations, by their equations."""
        at, (x, v) = self.at, advanced(h, jnp.zeros_like(found.x[0]), found)
        u, y = jax.vmap(self.group.tangent_mv)(at.x, x), h * v
        _, _, first, second = self.balance(h, u, y)
        pushed = jax.vmap(lambda row, matrix: row @ matrix)
        return RadauStages(
            first - pushed(found.mu, at.jacobian),
            second + pushed(found.lam, at.jacobian),
            of_stages(at.jacobian, y) / h + of_stages(at.turned, u),
            of_stages(at.jacobian, u) / h,
        )


# Without exchanges a stiffness h² K far larger than M leaves errors of h² K/M times round-off in a solution: of a beam
# of 16 steel elements in steps of 4 ms 4e-10, of 0.4 s 5e-7. One turn of refinement leaves less than LU on nullspaces.


def _refined(solve, product, rhs: RadauStages) -> RadauStages:
    first = solve(rhs)
    return jax.tree.map(jnp.add, first, solve(jax.tree.map(jnp.subtract, rhs, product(first))))


def _product(of: tuple[SparseStageFactors, Array], found: RadauStages) -> RadauStages:
    return of[0].product(of[1], found)


def _solution(of: tuple[SparseStageFactors, Array], rows: RadauStages) -> RadauStages:
    return _refined(partial(of[0].solve, of[1]), partial(_product, of), rows)


def _transposed(of: tuple[SparseStageFactors, Array], found: RadauStages) -> RadauStages:
    factors, h = of
    right, named, flat = partial(factors._right, h), partial(factors._named, h), factors._right(h, found)
    of_right, of_named = jax.linear_transpose(right, found), jax.linear_transpose(named, flat)
    solve = lambda rhs: of_right(factors.factors.solve(*of_named(rhs), transposed=True))[0]
    turned = jax.linear_transpose(partial(_product, of), found)
    return _refined(solve, lambda x: turned(x)[0], found)


_EQUATIONS = LinearEquations(_product, _solution, _transposed)


def _entries(parts):
    """The entries of matrices of several stages, flat, and their rows and columns; `parts`: also where these begin."""
    values, rows, columns = [], [], []
    for matrix, row, column in (part for part in parts if part[0].parts):
        _, r, c = jax.tree.map(lambda leaf: leaf[0], matrix).entries()
        values.append(jax.vmap(lambda one: one.entries()[0])(matrix).ravel())
        rows.append((row[:, None] + r[None]).ravel())
        columns.append((column[:, None] + c[None]).ravel())
    return jnp.concatenate(values), np.concatenate(rows), np.concatenate(columns)
