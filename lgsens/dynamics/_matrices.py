"""The matrices of a system as its linear solver wants them, sparse or dense, and the equations with M and B."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics._state import Tangents
from lgsens.dynamics._system import AbstractSparseSystem, AbstractSystem
from lgsens.linear import LU, Factors, Matrix, SparseMatrix


def is_sparse(system: AbstractSystem) -> bool:
    return isinstance(system, AbstractSparseSystem) and system.elimination is not None


def mass_matrix(system: AbstractSystem) -> Matrix:
    """M."""
    sparse = isinstance(system, AbstractSparseSystem) and is_sparse(system)
    return system.sparse_mass_matrix() if sparse else system.mass_matrix()


def constraint_jacobian(system: AbstractSystem, q) -> Matrix:
    """B."""
    sparse = isinstance(system, AbstractSparseSystem) and is_sparse(system)
    return system.sparse_constraint_jacobian(q) if sparse else system.constraint_jacobian(q)


def tangents(system: AbstractSystem, q, v, vdot, lam, t) -> Tangents:
    """K_t, C_t and B."""
    sparse = isinstance(system, AbstractSparseSystem) and is_sparse(system)
    return (system.sparse_tangents if sparse else system.tangents)(q, v, vdot, lam, t)


def factor_size(system: AbstractSystem) -> int:
    """How many numbers the factors of an iteration matrix are."""
    if isinstance(system, AbstractSparseSystem) and system.elimination is not None:
        return system.elimination.numbers
    return (system.group.dim + len(system.constraint_names)) ** 2


def mass_scale(mass: Matrix) -> Float[Array, ""]:
    """The size of M, by which the rows of B and the multipliers are scaled to it (DESIGN: Bottasso et al. 2007)."""
    trace = mass.trace() if isinstance(mass, SparseMatrix) else jnp.trace(mass)
    return lax.stop_gradient(trace / mass.shape[0])


def times_tangent_operator(system: AbstractSystem, x, matrices: tuple[Matrix, ...]) -> tuple[Matrix, ...]:
    """A T(x) for each of the matrices A."""
    if isinstance(system, AbstractSparseSystem) and is_sparse(system):
        operators = system.tangent_operators(x)
        return tuple(matrix.times_bodies(operators) for matrix in matrices)
    turned = jax.vmap(lambda row: system.group.tangent_rmv(x, row))(jnp.concatenate(matrices))
    heights = [matrix.shape[0] for matrix in matrices]
    return tuple(jnp.split(turned, [sum(heights[:i]) for i in range(1, len(heights))]))


def factorized(system: AbstractSystem, dynamic: Matrix, upper: Matrix, lower: Matrix, scale, kind: Any = LU) -> Factors:
    """The factors of [[A, U], [L, 0]] by the linear solver of the system; `kind` as in `Factors.of`."""
    plan = system.elimination if isinstance(system, AbstractSparseSystem) else None
    return Factors.of(dynamic, upper, lower, scale, plan=plan, kind=kind)


class ConstrainedMass(eqx.Module):
    """[[M, Bᵀ], [B, 0]] in factors, which serve any number of right-hand sides."""

    mass: Matrix
    jacobian: Matrix
    factors: Factors

    @classmethod
    def of(cls, system: AbstractSystem, q) -> "ConstrainedMass":
        mass, jacobian = mass_matrix(system), constraint_jacobian(system, q)
        fixed, border = lax.stop_gradient((mass, jacobian))
        return cls(mass, jacobian, factorized(system, fixed, border.T, border, mass_scale(mass)))

    def solve(self, force, rate) -> tuple[Float[Array, " k"], Float[Array, " m"]]:
        """x and μ of M x + Bᵀμ = force, B x = rate; differentiable through M and B, by one more solve."""
        k = force.shape[0]

        def product(unknown):
            x, mu = unknown[:k], unknown[k:]
            return jnp.concatenate([self.mass @ x + mu @ self.jacobian, self.jacobian @ x])

        solve = lambda _, rhs: jnp.concatenate(self.factors.solve(rhs[:k], rhs[k:]))
        solution = lax.custom_linear_solve(product, jnp.concatenate([force, rate]), solve, symmetric=True)
        return solution[:k], solution[k:]
