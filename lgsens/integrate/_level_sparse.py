"""The stabilized step of `_level_step.py` by block elimination on the graph of bodies and joints.

N = M⁻¹B_nᵀ fills what S₂ has in the columns of ν. With y = N ν as unknowns of their own, all blocks are those of bodies
and joints: for (u, y; ν, λ), the rows r, M y − B_nᵀν = 0, Φ and B v + Φ_t,

    [[A,         P,     0,     Jᵀ],
     [0,         M,     −B_nᵀ, 0 ],          P = βh² K_t T,     A = c M + γh C_t + P.
     [B T,       B T,   0,     0 ],
     [B + g V T, g V T, 0,     0 ]]

A node of the graph is a body with its u and y, or a joint with ν and λ. No pivots need to be exchanged: those of bodies
are A, as in index 3, and M. What bodies leave of the rows of their joints is, for T → 1 and without V and C_t,

    [[c B A⁻¹B_nᵀ, −B A⁻¹Jᵀ], [−B A⁻¹P M⁻¹B_nᵀ, −B A⁻¹Jᵀ]],     with pivots c B A⁻¹B_nᵀ and −B M⁻¹Jᵀ/c,

as A − P = c M; both are regular as soon as B M⁻¹Bᵀ of the bodies that are gone is, which the order of the graph sees
to.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, in_blocks, mass_scale, times_tangent_operator
from lgsens.integrate._alpha import AbstractAlpha
from lgsens.linear import Elimination, Factors, Graph, SparseMatrix, tuned


def _with_corrections(graph: Graph) -> tuple[Graph, float]:
    """The graph with these unknowns, and how long a dense LU of S₂ takes."""
    k, m = graph.sizes
    return graph.with_unknowns([0, k], [2 * k, 2 * k + m]), tuned.dense(k + 2 * m)


def level_plan(scheme: AbstractAlpha, system: AbstractSystem) -> Elimination | None:
    """The plan of block elimination; None: all matrices are dense. Rows of velocities only have none, nor have forces
    that depend on λ, whose tangents are not those of the joints alone."""
    sparse = in_blocks(system) if scheme.stabilized and not system.reads_multipliers else None
    return None if sparse is None else sparse.arranged(_with_corrections)


class SparseLevelFactors(eqx.Module):
    """The factors of the matrix above, λ and B v + Φ_t as its border; ν/σ and σΦ are within."""

    factors: Factors
    scale: Float[Array, ""]  # σ

    @classmethod
    def of(cls, step: Any, at_state: Any, x, kind: Any) -> "SparseLevelFactors":
        """Of a `LevelStep`, from its `LevelTangents`."""
        shared, h = step.shared, step.node.h
        scheme, mass = shared.scheme, shared.mass
        velocity, position = scheme.gamma * h, scheme.beta * h**2
        k_t, c_t, jacobian, upper, rate_stiffness = at_state
        k_t, by_place, turned = times_tangent_operator(shared.system, x, (k_t, jacobian, rate_stiffness))
        scale, (m, k) = mass_scale(mass), jacobian.shape
        inside, turned = (2 * k + m,) * 2, (position / velocity) * turned
        at = lambda matrix, row, column: matrix.within(inside, row, column)
        border: Any = lambda matrix, column=0: matrix.within((m, inside[1]), 0, column)
        dynamic: SparseMatrix = (
            at(scheme.inertia_factor * mass + velocity * c_t + position * k_t, 0, 0)
            + at(position * k_t, 0, k)
            + at(mass, k, k)
            + at(-scale * step.before.T, k, 2 * k)
            + at(scale * by_place, 2 * k, 0)
            + at(scale * by_place, 2 * k, k)
        )
        lower = border(jacobian) + border(turned) + border(turned, k)
        upper = upper.within((inside[0], m))
        return cls(Factors.of(dynamic, upper, lower, scale, plan=shared.plan, kind=kind), scale)

    def solve(self, force, rows, *, transposed: bool = False):
        """S₂⁻¹ or S₂⁻ᵀ of `force` (k,) and `rows`: of the rows (Φ, B v + Φ_t) or of the columns (λ, ν)."""
        k, (first, second) = force.shape[0], jnp.split(rows, 2)
        own, border = (second, first) if transposed else (first, second)
        inside = jnp.concatenate([force, jnp.zeros_like(force), self.scale * own])
        inner, outer = self.factors.solve(inside, border, transposed=transposed)
        own = self.scale * inner[2 * k :]
        return inner[:k], jnp.concatenate([own, outer] if transposed else [outer, own])
