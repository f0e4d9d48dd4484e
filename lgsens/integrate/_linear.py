"""The linear solver of a step: dense LU of the scaled iteration matrix."""

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Float, Int


class Factors(eqx.Module):
    """LU factors of S = [[A, Bᵀ], [B T, 0]], its border scaled by σ to the size of A."""

    lu: Float[Array, "k+m k+m"]
    pivots: Int[Array, " k+m"]
    scale: Float[Array, ""]  # σ

    @classmethod
    def of(cls, dynamic, multiplier_columns, constraint_rows, scale) -> "Factors":
        m = constraint_rows.shape[0]
        upper = jnp.concatenate([dynamic, scale * multiplier_columns], axis=1)
        lower = jnp.concatenate([scale * constraint_rows, jnp.zeros((m, m), dynamic.dtype)], axis=1)
        lu, pivots = jsl.lu_factor(jnp.concatenate([upper, lower]))
        return cls(lu, pivots, scale)

    def solve(self, force, rate, *, transposed: bool = False):
        """S⁻¹ (or S⁻ᵀ) [force; rate], as its two parts. Both scalings are the same, so S and Sᵀ unscale alike."""
        k = force.shape[0]
        rhs = jnp.concatenate([force, self.scale * rate])
        solution = jsl.lu_solve((self.lu, self.pivots), rhs, trans=1 if transposed else 0)
        return solution[:k], self.scale * solution[k:]
