"""Dense factors of the matrices of a step: an LU, and an explicit inverse."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


class LU(eqx.Module):
    """P S = L U.

    The row exchanges are kept as a permutation: made from pivots at every solve, it takes as long as the solve.
    """

    lu: Float[Array, "n n"]
    permutation: Int[Array, " n"]

    @classmethod
    def of(cls, matrix) -> "LU":
        lu, pivots, _ = lax.linalg.lu(matrix)
        return cls(lu, _permutation(pivots))

    def solve(self, rhs, *, transposed: bool = False):
        """S⁻¹ rhs or S⁻ᵀ rhs, one column or several."""
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
        return columns.reshape(rhs.shape)


def _permutation(pivots: Int[Array, " n"], *, inverse: bool = False) -> Int[Array, " n"]:
    """The rows of P S in S (or those of S in P S), from LAPACK's exchanges of rows.

    JAX's own are eight operations for each row, which took a third of a gradient with few steps at a time. Without
    scatters the exchanges can be one function of XLA's.
    """
    size = pivots.shape[0]
    places = jnp.arange(size, dtype=pivots.dtype)

    def exchange(i, rows):
        first = size - 1 - i if inverse else i
        second = pivots[first]
        return jnp.where(places == first, rows[second], jnp.where(places == second, rows[first], rows))

    return lax.fori_loop(0, size, exchange, places)


class Inverse(eqx.Module):
    """S⁻¹ itself, for the iterations of many steps: a product with it costs a tenth of two triangular solves.

    Kept as its transpose, because LAPACK's solution comes out by columns and a product reads rows: else XLA turns the
    matrix round in every step, which takes longer than all iterations of the step.
    """

    transpose: Float[Array, "n n"]

    @classmethod
    def of(cls, matrix) -> "Inverse":
        lu, pivots, _ = lax.linalg.lu(matrix)
        # P S = L U, so S⁻ᵀ = Pᵀ L⁻ᵀ U⁻ᵀ
        eye = jnp.eye(lu.shape[0], dtype=lu.dtype)
        rows = lax.linalg.triangular_solve(lu, eye, left_side=True, lower=False, transpose_a=True)
        rows = lax.linalg.triangular_solve(lu, rows, left_side=True, lower=True, transpose_a=True, unit_diagonal=True)
        return cls(rows[_permutation(pivots, inverse=True)])

    def solve(self, rhs, *, transposed: bool = False):
        """S⁻¹ rhs or S⁻ᵀ rhs, one column or several."""
        return self.transpose @ rhs if transposed else (rhs.T @ self.transpose).T
