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
    """S⁻¹ itself, for the iterations of many steps: a product with it costs a fifth of two triangular solves."""

    inverse: Float[Array, "k+m k+m"]
    scale: Float[Array, ""]

    @classmethod
    def of(cls, dynamic, multiplier_columns, constraint_rows, scale) -> "Inverse":
        return cls(jnp.linalg.inv(_scaled(dynamic, multiplier_columns, constraint_rows, scale)), scale)

    def solve(self, force, rate):
        k = force.shape[0]
        solution = self.inverse @ jnp.concatenate([force, self.scale * rate])
        return solution[:k], self.scale * solution[k:]
