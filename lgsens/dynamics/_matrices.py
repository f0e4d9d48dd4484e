"""The matrices of a system as its linear solver wants them, sparse or dense, and the equations with M and B."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics._constraints import full_jacobian
from lgsens.dynamics._redundant import refined, softness
from lgsens.dynamics._system import AbstractSparseSystem, AbstractSystem, Tangents
from lgsens.linear import LU, Factors, Inverse, LinearEquations, Matrix, SparseMatrix, linear_solve, tuned


def in_blocks(system: AbstractSystem) -> AbstractSparseSystem | None:
    """The system, if its linear solver is sparse."""
    return system if isinstance(system, AbstractSparseSystem) and system.elimination is not None else None


def mass_matrix(system: AbstractSystem) -> Matrix:
    """M."""
    sparse = in_blocks(system)
    return system.mass_matrix() if sparse is None else sparse.sparse_mass_matrix()


def constraint_jacobian(system: AbstractSystem, q, t) -> Matrix:
    """J = [B; A]."""
    sparse = in_blocks(system)
    return full_jacobian(system, q, t) if sparse is None else sparse.sparse_constraint_jacobian(q, t)


def tangents(system: AbstractSystem, q, v, vdot, lam, t) -> Tangents:
    """K_t, C_t and J."""
    sparse = in_blocks(system)
    return (system.tangents if sparse is None else sparse.sparse_tangents)(q, v, vdot, lam, t)


def multiplier_jacobian(system: AbstractSystem, jacobian: Matrix, q, v, lam, t) -> Matrix:
    """∂r/∂λ, of the kind of J: Jᵀ, unless forces depend on λ."""
    if not system.reads_multipliers:
        return jacobian.T
    every = system.multiplier_jacobian(q, v, lam, t)
    return every if isinstance(jacobian, SparseMatrix) else dense(every)


def require_linear(system: AbstractSystem, method: str) -> None:
    """Raise `ValueError` where forces depend on λ, for a method that solves linear equations for it."""
    if system.reads_multipliers:
        raise ValueError(
            f"{method} needs forces that do not depend on multipliers, and the model has friction from the forces of "
            "its joints. Use `simulate` by GeneralizedAlpha, with DirectDifferentiation() or AdjointVariable(), or "
            "give the friction a `preload` and own_forces=False."
        )


def factor_size(system: AbstractSystem) -> int:
    """How many numbers the factors of an iteration matrix are."""
    plan = system.elimination if isinstance(system, AbstractSparseSystem) else None
    return plan.numbers if plan is not None else (system.group.dim + len(system.constraint_names)) ** 2


def mass_scale(mass: Matrix) -> Float[Array, ""]:
    """The size of M, by which the rows of B and the multipliers are scaled to it (DESIGN: Bottasso et al. 2007)."""
    trace = mass.trace() if isinstance(mass, SparseMatrix) else jnp.trace(mass)
    return lax.stop_gradient(trace / mass.shape[0])


def times_tangent_operator(system: AbstractSystem, x, matrices: tuple[Matrix, ...]) -> tuple[Matrix, ...]:
    """A T(x) for each of the matrices A."""
    sparse = in_blocks(system)
    if sparse is not None:
        operators = sparse.rotation_operators(partial(system.group.tangent_mv, x))
        return tuple(matrix.times_rotations(operators) for matrix in matrices)
    turned = jax.vmap(lambda row: system.group.tangent_rmv(x, row))(jnp.concatenate(matrices))
    heights = [matrix.shape[0] for matrix in matrices]
    return tuple(jnp.split(turned, [sum(heights[:i]) for i in range(1, len(heights))]))


def factorized(
    system: AbstractSystem,
    dynamic: Matrix,
    upper: Matrix,
    lower: Matrix,
    scale,
    kind: Any = LU,
    softness=None,
    *,
    once: bool = False,
    exact: bool = False,
) -> Factors:
    """The factors of [[A, U], [L, 0]] by the linear solver of the system; `kind`, `softness` as in `Factors.of`.

    `once`: once in a run, where compilation takes longest. `exact`: never of mixed precision, nor rounded.
    """
    sparse = system if isinstance(system, AbstractSparseSystem) else None
    plan, solver = (None, None) if sparse is None else (sparse.elimination, sparse.linear_solver)
    if plan is not None and once:
        plan = plan.once
    mixed = solver is not None and solver.mixed and not exact
    return Factors.of(dynamic, upper, lower, scale, plan=plan, kind=kind, softness=softness, mixed=mixed, exact=exact)


def for_once(*matrices: Matrix) -> tuple[Matrix, ...]:
    """Matrices that are factorized once in a run, as arrays where that takes less than the blocks take to compile."""
    few = sum(matrix.shape[0] for matrix in matrices) <= tuned.DENSE_ONCE
    return tuple(map(dense, matrices)) if few else matrices


def dense(matrix: Matrix) -> Array:
    """The matrix as an array."""
    return matrix.dense() if isinstance(matrix, SparseMatrix) else matrix


def kkt_solve(mass, jacobian, force, rate) -> tuple[Float[Array, " k"], Float[Array, " m"]]:
    """Solve [[M, Bᵀ], [B, 0]] [x; λ] = [force; rate], constraint rows and multipliers scaled to M."""
    k, m = mass.shape[0], jacobian.shape[0]
    scale = mass_scale(mass)
    scaled = scale * jacobian
    matrix = jnp.block([[mass, scaled.T], [scaled, jnp.zeros((m, m), mass.dtype)]])
    solution = jnp.linalg.solve(matrix, jnp.concatenate([force, scale * rate]))
    return solution[:k], scale * solution[k:]


def kkt_product(mass: Matrix, jacobian: Matrix, x, mu) -> tuple[Float[Array, " k"], Float[Array, " m"]]:
    """[[M, Bᵀ], [B, 0]] [x; μ]."""
    return mass @ x + mu @ jacobian, jacobian @ x


class ConstrainedMass(eqx.Module):
    """[[M, Jᵀ], [J, 0]]."""

    mass: Matrix
    jacobian: Matrix
    factors: Factors | None  # None: dense, where `kkt_solve` makes them
    soft: bool = eqx.field(static=True)  # whether they are those of K_c (`_redundant`)

    @classmethod
    def of(cls, system: AbstractSystem, q, t, factors: Factors | None = None) -> "ConstrainedMass":
        """`factors`: those at q, if they are known: to compile them is most of what this costs."""
        mass, jacobian = mass_matrix(system), constraint_jacobian(system, q, t)
        soft = softness(system)
        if factors is not None or (in_blocks(system) is None and soft is None):
            return cls(mass, jacobian, factors, soft is not None)
        fixed, border = for_once(*lax.stop_gradient((mass, jacobian)))
        # what blocks leave is small, and a product with its inverse compiles sooner than two loops for each solution
        kind = Inverse if isinstance(fixed, SparseMatrix) else LU
        factors = factorized(system, fixed, border.T, border, mass_scale(mass), kind, soft, once=True, exact=True)
        return cls(mass, jacobian, factors, soft is not None)

    @classmethod
    def in_steps(cls, system: AbstractSystem, q, t) -> "ConstrainedMass":
        """With factors for every step of a run, which know no derivative and need none."""
        mass, jacobian = mass_matrix(system), constraint_jacobian(system, q, t)
        soft, (fixed, border) = softness(system), lax.stop_gradient((mass, jacobian))
        factors = factorized(system, fixed, border.T, border, mass_scale(mass), softness=soft)
        return cls(mass, jacobian, factors, soft is not None)

    def solve(self, force, rate) -> tuple[Float[Array, " k"], Float[Array, " m"]]:
        """x and μ of M x + Jᵀμ = force, J x = rate; differentiable through M and J, by one more solve."""
        if self.factors is None:
            return kkt_solve(self.mass, self.jacobian, force, rate)
        return linear_solve(_WITH_FACTORS, self, (force, rate))

    def least(self, rates: Float[Array, "n m"]) -> Float[Array, "n k"]:
        """For each row the least x, in the metric of M, with J x = rate."""
        return jax.vmap(lambda rate: self.solve(jnp.zeros(self.jacobian.shape[1], rate.dtype), rate)[0])(rates)

    def product(self, unknown):
        """The two rows for x and μ."""
        return kkt_product(self.mass, self.jacobian, *unknown)

    def with_factors(self, rhs):
        """x and μ by the factors."""
        assert self.factors is not None
        solve = self.factors.solve
        once = lambda rhs: solve(*rhs)
        return refined(self.product, once, rhs) if self.soft else once(rhs)


_WITH_FACTORS = LinearEquations(ConstrainedMass.product, ConstrainedMass.with_factors)
