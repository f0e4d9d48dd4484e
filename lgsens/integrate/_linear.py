"""The linear solvers of a step: dense LU of the scaled iteration matrix, and its explicit inverse."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


def _scaled(dynamic, multiplier_columns, constraint_rows, scale) -> Float[Array, "k+m k+m"]:
    m = constraint_rows.shape[0]
    upper = jnp.concatenate([dynamic, scale * multiplier_columns], axis=1)
    lower = jnp.concatenate([scale * constraint_rows, jnp.zeros((m, m), dynamic.dtype)], axis=1)
    return jnp.concatenate([upper, lower])


class Factors(eqx.Module):
    """LU factors of S = [[A, Bᵀ], [B T, 0]], its border scaled by σ to the size of A.

    The row exchanges are kept as a permutation: made from pivots at every solve, it takes as long as the solve.
    """

    lu: Float[Array, "k+m k+m"]
    permutation: Int[Array, " k+m"]
    scale: Float[Array, ""]  # σ

    @classmethod
    def of(cls, dynamic, multiplier_columns, constraint_rows, scale) -> "Factors":
        lu, _, permutation = lax.linalg.lu(_scaled(dynamic, multiplier_columns, constraint_rows, scale))
        return cls(lu, permutation, scale)

    def solve(self, force, rate, *, transposed: bool = False):
        """S⁻¹ (or S⁻ᵀ) [force; rate], as its two parts. Both scalings are the same, so S and Sᵀ unscale alike."""
        k = force.shape[0]
        rhs = jnp.concatenate([force, self.scale * rate])
        columns = rhs if rhs.ndim == 2 else rhs[:, None]

        def triangular(columns, *, lower: bool):
            return lax.linalg.triangular_solve(
                self.lu, columns, left_side=True, lower=lower, transpose_a=transposed, unit_diagonal=lower
            )

        if transposed:
            columns = triangular(triangular(columns, lower=False), lower=True)
            columns = jnp.zeros_like(columns).at[self.permutation].set(columns, unique_indices=True)
        else:
            columns = triangular(triangular(columns[self.permutation], lower=True), lower=False)
        solution = columns.reshape(rhs.shape)
        return solution[:k], self.scale * solution[k:]


class Inverse(eqx.Module):
    """S⁻¹ itself, for the iterations of many steps: a product with it costs a tenth of two triangular solves.

    Kept as its transpose, because LAPACK's solution comes out by columns and a product reads rows: else XLA turns the
    matrix round in every step, which takes longer than all iterations of the step.
    """

    transposed: Float[Array, "k+m k+m"]
    scale: Float[Array, ""]

    @classmethod
    def of(cls, dynamic, multiplier_columns, constraint_rows, scale) -> "Inverse":
        lu, _, permutation = lax.linalg.lu(_scaled(dynamic, multiplier_columns, constraint_rows, scale))
        # P S = L U, so S⁻ᵀ = Pᵀ L⁻ᵀ U⁻ᵀ
        eye = jnp.eye(lu.shape[0], dtype=lu.dtype)
        rows = lax.linalg.triangular_solve(lu, eye, left_side=True, lower=False, transpose_a=True)
        rows = lax.linalg.triangular_solve(lu, rows, left_side=True, lower=True, transpose_a=True, unit_diagonal=True)
        return cls(rows[jnp.argsort(permutation)], scale)

    def solve(self, force, rate):
        k = force.shape[0]
        solution = jnp.concatenate([force, self.scale * rate]) @ self.transposed
        return solution[:k], self.scale * solution[k:]
