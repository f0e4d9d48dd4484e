"""The matrix of a step, bordered by its constraints, in factors."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.linear import tuned
from lgsens.linear._block_factors import BlockFactors, BlockMatrix
from lgsens.linear._dense import LU, Inverse
from lgsens.linear._elimination import Elimination
from lgsens.linear._mixed import factors_of, rounded_inverse
from lgsens.linear._sparse import SparseMatrix

Matrix = Any  # a SparseMatrix or an array

_in_a_batch = jax.make_user_context(False)  # JAX keys its caches on it


def many_runs():
    """A context in which what is traced is one of many runs of a batch."""
    return _in_a_batch(True)


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
        m = lower.shape[0]
        corner = None if softness is None else -(scale**2) * softness
        if not isinstance(dynamic, SparseMatrix):
            below = jnp.zeros((m, m), dynamic.dtype) if corner is None else jnp.diag(corner)
            values = jnp.block([[dynamic, scale * upper], [scale * lower, below]])
            numbers = values.size
            factors = partial(factors_of, kind=kind, mixed=mixed)
        else:
            assert plan is not None
            numbers, (values, rows, columns) = plan.numbers, _bordered(dynamic, upper, lower, scale, corner)
            factors = lambda values: factors_of(BlockMatrix.of(plan, values, rows, columns), kind, mixed=mixed)
        many = numbers >= (tuned.ROUNDED_NUMBERS_IN_A_BATCH if _in_a_batch.value else tuned.ROUNDED_NUMBERS)
        if kind is Inverse and values.dtype == jnp.float64 and many and not (mixed or exact):
            return cls(rounded_inverse(values, factors), scale)
        return cls(factors(values), scale)

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


def _bordered(dynamic: SparseMatrix, upper: SparseMatrix, lower: SparseMatrix, scale, corner):
    """The entries of S, flat, and their rows and columns."""
    k, size = dynamic.shape[0], dynamic.shape[0] + lower.shape[0]
    (a, *at), (u, rows_u, columns_u), (b, rows_b, columns_b) = (x.entries() for x in (dynamic, upper, lower))
    values, own = [a, scale * u, scale * b], np.arange(k, size)
    rows, columns = [at[0], rows_u, k + rows_b], [at[1], k + columns_u, columns_b]
    if corner is not None:
        values, rows, columns = [*values, corner], [*rows, own], [*columns, own]
    return jnp.concatenate(values), np.concatenate(rows), np.concatenate(columns)
