"""Factors in single precision, refined in double.

With Ŝ⁻¹ from factors of S rounded to single precision, and residuals in double,

    x₀ = Ŝ⁻¹ b,     x_{i+1} = x_i + Ŝ⁻¹ (b − S x_i),

each turn multiplies the error by about κ ε₃₂, κ the condition of S: 1e-5 to 1e-4 for the scaled matrix of a step
(Higham 2002, Accuracy and Stability of Numerical Algorithms, ch. 12). The turns end where the next one would change
nothing but last digits, or where corrections have stopped to fall; what then is not small means a condition beyond
1/ε₃₂, and the solution is NaN. Modified Newton takes Ŝ⁻¹ as it is: its residuals are in double, and its matrix is off
by more than round-off anyway.

Two turns are what the matrix of a step needs: three solutions in single precision and two products for one in double,
besides S itself that must be kept. Factors in single precision save as much from about 200 unknowns on only.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._xla import while_loop
from lgsens.linear._block_factors import BlockFactors, BlockMatrix
from lgsens.linear._dense import Inverse

_ENOUGH = 1e-14  # of the solution: the estimated change in the next turn
_STALLED = 0.5
_WRONG = 1e-6  # of the solution: a last correction that no round-off of double precision explains
_TURNS = 40  # 0.5^40 is below round-off


def factors_of(matrix: Float[Array, "n n"] | BlockMatrix, kind: Any, *, mixed: bool = False) -> Any:
    """The factors of a matrix, of its own precision, or `mixed`; `kind`: LU or Inverse of what is dense."""
    if mixed and matrix.dtype == jnp.float64:
        single = Rounded(factors_of(jax.tree.map(lambda leaf: leaf.astype(jnp.float32), matrix), kind))
        return single if kind is Inverse else Refined(single, matrix)
    return BlockFactors.of(matrix, kind) if isinstance(matrix, BlockMatrix) else kind.of(matrix)


class Rounded(eqx.Module):
    """Ŝ⁻¹, or that of S in units of 1/`factor`."""

    factors: Any  # in single precision
    factor: Float[Array, ""] | None = None

    def solve(self, rhs, *, transposed: bool = False):
        """Ŝ⁻¹ rhs or Ŝ⁻ᵀ rhs, one column or several."""
        wanted = rhs if self.factor is None else self.factor * rhs
        return self.factors.solve(wanted.astype(jnp.float32), transposed=transposed).astype(rhs.dtype)


def rounded_inverse(values, factors: Callable[[Any], Any]) -> Rounded:
    """The inverse that many steps share, from `factors` of the numbers of S in units of the largest, rounded to single
    precision after it was made in double: half the memory to read in every iteration.

    Single precision has no numbers beyond 1e38: in these units the inverse is far from there, and right-hand sides are
    accelerations. The error is a few ε₃₂ of the numbers of S⁻¹, less than what modified Newton's matrix is off by
    anyway: chains of 128 links with bushings of 1e10 N/m for every fifth joint, with masses 1 : 1e4 and 1 : 1e-6, and
    with both take as many iterations as in double precision (6 to 9).
    """
    unit = jnp.max(jnp.abs(values))
    return Rounded(jax.tree.map(lambda leaf: leaf.astype(jnp.float32), factors(values / unit)), 1.0 / unit)


class Refined(eqx.Module):
    """S⁻¹ to double precision."""

    single: Rounded
    matrix: Any  # S, an array or a BlockMatrix

    def solve(self, rhs, *, transposed: bool = False):
        """S⁻¹ rhs or S⁻ᵀ rhs, one column or several."""
        if rhs.ndim == 2:
            return jax.vmap(partial(self.solve, transposed=transposed), in_axes=1, out_axes=1)(rhs)
        largest = lambda x: jnp.max(jnp.abs(x), initial=0.0)
        # single precision has no numbers beyond 1e38: right-hand sides are solved for in units of the largest entry
        unit = largest(rhs)
        unit = jnp.where(unit > 0.0, unit, 1.0)
        wanted = rhs / unit
        x = self.single.solve(wanted, transposed=transposed)

        def refined(carry):
            x, last, _, count = carry
            product = x @ self.matrix if transposed else self.matrix @ x
            change = self.single.solve(wanted - product, transposed=transposed)
            size = largest(change)
            return x + change, size, size / jnp.where(last > 0.0, last, 1.0), count + 1

        def unfinished(carry):
            x, last, ratio, count = carry
            falling = (ratio < _STALLED) | (count == 0)
            return (last * ratio > _ENOUGH * largest(x)) & falling & (count < _TURNS)

        start = (x, largest(x), jnp.ones((), x.dtype), jnp.zeros((), jnp.int32))
        x, last, _, _ = while_loop(unfinished, refined, start)
        return unit * jnp.where(last <= _WRONG * largest(x), x, jnp.nan)
