"""Dense factors of the matrices of a step: an LU, and an explicit inverse."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from lgsens._xla import alike, fori_loop
from lgsens.linear import tuned


class LU(eqx.Module):
    """P S = L U, and S⁻ᵀ = Pᵀ L⁻ᵀ U⁻ᵀ.

    The row exchanges are kept as permutations: made from pivots at every solve, they take as long as the solve.
    """

    lu: Float[Array, "n n"]
    permutation: Int[Array, " n"]  # P b = b[permutation]
    inverse_permutation: Int[Array, " n"]  # Pᵀ b = b[inverse_permutation]

    @classmethod
    def of(cls, matrix) -> "LU":
        lu, pivots, permutation = lax.linalg.lu(matrix)
        exchanged = lambda pivots, _: (_permutation(pivots), _permutation(pivots, inverse=True))
        # elsewhere a loop over rows would be as many kernels, one after the other, whatever the batch
        # what argsort returns does not vary over a mesh, as XLA's branches must alike
        by_sorting = lambda _, rows: (rows, alike(jnp.argsort(rows).astype(rows.dtype), rows))
        found = lax.platform_dependent(pivots, permutation, cpu=exchanged, default=by_sorting)
        return cls(lu, *found)

    def solve(self, rhs, *, transposed: bool = False):
        """S⁻¹ rhs or S⁻ᵀ rhs, one column or several."""
        if rhs.ndim == 1 and rhs.shape[0] <= tuned.SUBSTITUTED_ROWS:
            return lax.platform_dependent(
                self,
                rhs,
                cpu=lambda factors, rhs: factors._solve(rhs, _substituted, transposed),
                default=lambda factors, rhs: factors._solve(rhs, _triangular, transposed),
            )
        return self._solve(rhs, _triangular, transposed)

    def _solve(self, rhs, triangular, transposed: bool):
        if transposed:
            return triangular(self.lu, triangular(self.lu, rhs, False, True), True, True)[self.inverse_permutation]
        return triangular(self.lu, triangular(self.lu, rhs[self.permutation], True, False), False, False)


def _triangular(lu, rhs, of_lower: bool, transposed: bool):
    """L⁻¹ rhs or U⁻¹ rhs, or that with the transpose, by LAPACK."""
    columns = rhs if rhs.ndim == 2 else rhs[:, None]
    kind = {"left_side": True, "lower": of_lower, "transpose_a": transposed, "unit_diagonal": of_lower}
    return lax.linalg.triangular_solve(lu, columns, **kind).reshape(rhs.shape)


def _substituted(lu, rhs, of_lower: bool, transposed: bool):
    """The same of one column by substitution, column after column of the triangle."""
    size = rhs.shape[0]
    places, columns = jnp.arange(size), lu if transposed else lu.T
    downwards = of_lower != transposed

    def eliminate(i, x):
        j = i if downwards else size - 1 - i
        column = columns[j]
        known = x[j] if of_lower else x[j] / column[j]
        later = places > j if downwards else places < j
        return jnp.where(places == j, known, x - jnp.where(later, column, jnp.zeros_like(column)) * known)

    # of no rows, which block elimination may leave, none can be traced
    return fori_loop(0, size, eliminate, rhs) if size else rhs


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

    return fori_loop(0, size, exchange, places) if size else places


def _eliminated(matrix):
    """S⁻¹ by Gauss–Jordan elimination in place, with exchanges of rows for the largest pivot; without these and of many
    at once `_block_factors.inverses`.

    That is (P S)⁻¹ in the end, and S⁻¹ = (P S)⁻¹ P: its column k is the one of the place to which row k of S has gone.
    As exact as an LU and its solution: S⁻¹ S − I is 3e-15 … 6e-15 of 12 to 64 random rows, 3e-15 … 1e-14 by LAPACK.
    """
    size = matrix.shape[0]
    places = jnp.arange(size)

    def eliminate(j, carry):
        matrix, gone = carry
        here, column = places == j, matrix[:, j]
        other = jnp.argmax(jnp.where(places < j, -jnp.ones_like(column), jnp.abs(column)))
        there = places == other
        pivot = 1.0 / column[other]
        row = jnp.where(here, pivot, matrix[other] * pivot)
        exchanged = jnp.where(there[:, None], matrix[j][None, :], matrix)
        rest = jnp.where(here[None, :], jnp.zeros_like(matrix), exchanged)
        rest = rest - jnp.where(there, column[j], column)[:, None] * row[None, :]
        gone = jnp.where(gone == j, other, jnp.where(gone == other, j, gone))
        return jnp.where(here[:, None], row[None, :], rest), gone

    matrix, gone = fori_loop(0, size, eliminate, (matrix, places))
    return matrix[:, gone]


class Inverse(eqx.Module):
    """S⁻¹ itself, for the iterations of many steps: a product with it costs a tenth of two triangular solves.

    Kept as its transpose, because LAPACK's solution comes out by columns and a product reads rows: else XLA turns the
    matrix round in every step, which takes longer than all iterations of the step.
    """

    transpose: Float[Array, "n n"]

    @classmethod
    def of(cls, matrix) -> "Inverse":
        by_lu = lambda matrix: LU.of(matrix).solve(jnp.eye(matrix.shape[0], dtype=matrix.dtype), transposed=True)
        if 0 < matrix.shape[0] <= tuned.ELIMINATED_ROWS:
            return cls(lax.platform_dependent(matrix, cpu=lambda matrix: _eliminated(matrix.T), default=by_lu))
        return cls(by_lu(matrix))

    def solve(self, rhs, *, transposed: bool = False):
        """S⁻¹ rhs or S⁻ᵀ rhs, one column or several."""
        return self.transpose @ rhs if transposed else (rhs.T @ self.transpose).T
