"""The matrix of a step, bordered by its constraints, in factors."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.linear._dense import LU, Inverse
from lgsens.linear._elimination import BlockFactors, BlockMatrix, Elimination
from lgsens.linear._mixed import factors_of, rounded_inverse
from lgsens.linear._sparse import SparseMatrix

Matrix = Any  # a SparseMatrix or an array

# Numbers in an inverse from which on it is rounded: a quarter of a megabyte, that of 70 links. Steps of chains of 128
# and 512 links then take 0.96 and 0.91 of the time; smaller scenes gain nothing.
_MANY = 2**15


class Factors(eqx.Module):
    """The factors of S = [[A, U], [L, 0]], its border scaled by σ to the size of A; U = Bᵀ and L = B T in a step."""

    factors: Any  # LU, Inverse or BlockFactors, or of mixed precision
    scale: Float[Array, ""]  # σ

    @classmethod
    def of(
        cls,
        dynamic: Matrix,
        upper: Matrix,
        lower: Matrix,
        scale,
        *,
        plan: Elimination | None = None,
        kind: Any = LU,
        softness: Float[Array, " m"] | None = None,
        mixed: bool = False,
        exact: bool = False,
    ) -> "Factors":
        """`plan`: None for arrays. `kind`: LU or `Inverse` of what is dense. `softness`: c of −diag(c) instead of 0.
        `mixed`: of mixed precision. `exact`: an `Inverse` of many numbers is kept as it is, not rounded."""
        m, size = lower.shape[0], dynamic.shape[0] + lower.shape[0]
        numbers = size**2 if plan is None else plan.numbers
        rounded = kind is Inverse and dynamic.dtype == jnp.float64 and numbers >= _MANY and not mixed and not exact

        def of(values, matrix):
            factors = lambda values: factors_of(matrix(values), kind, mixed=mixed)
            return cls(rounded_inverse(values, factors) if rounded else factors(values), scale)

        corner = None if softness is None else -(scale**2) * softness
        if not isinstance(dynamic, SparseMatrix):
            above = jnp.concatenate([dynamic, scale * upper], axis=1)
            below = jnp.concatenate(
                [scale * lower, jnp.zeros((m, m), dynamic.dtype) if corner is None else jnp.diag(corner)], axis=1
            )
            return of(jnp.concatenate([above, below]), lambda array: array)
        assert plan is not None
        k = dynamic.shape[0]
        (a, *at), (u, rows_u, columns_u), (b, rows_b, columns_b) = (x.entries() for x in (dynamic, upper, lower))
        values = jnp.concatenate([a, scale * u, scale * b])
        rows = np.concatenate([at[0], rows_u, k + rows_b])
        columns = np.concatenate([at[1], k + columns_u, columns_b])
        if corner is not None:
            own = np.arange(k, k + m)
            values, rows, columns = (jnp.concatenate([values, corner]), *(np.append(x, own) for x in (rows, columns)))
        return of(values, lambda values: BlockMatrix.of(plan, values, rows, columns))

    def largest_inverse(self) -> Float[Array, ""]:
        """The largest number in the inverses of a sparse matrix with `Inverse`: of blocks, and of what is left."""
        assert isinstance(self.factors, BlockFactors)
        inverses = [level.inverse for level in self.factors.eliminated] + [self.factors.rest.transpose]
        return jnp.max(jnp.stack([jnp.max(jnp.abs(inverse), initial=0.0) for inverse in inverses]))

    def solve(self, force, rate, *, transposed: bool = False):
        """S⁻¹ (or S⁻ᵀ) [force; rate], as its two parts. Both scalings are the same, so S and Sᵀ unscale alike."""
        k = force.shape[0]
        solution = self.factors.solve(jnp.concatenate([force, self.scale * rate]), transposed=transposed)
        return solution[:k], self.scale * solution[k:]
