"""Block elimination of a sparse matrix, level by level (`_ordering`): the numbers.

For a cluster with its own unknowns 1 and its boundary 2,

    [[S₁₁, S₁₂],  [x₁;  = [b₁;        x₁ = S₁₁⁻¹ (b₁ − S₁₂ x₂),     (S₂₂ − S₂₁ S₁₁⁻¹ S₁₂) x₂ = b₂ − S₂₁ S₁₁⁻¹ b₁
     [S₂₁, S₂₂]]   x₂]     b₂]

With X = S₁₁⁻¹ S₁₂ and Y = S₂₁ S₁₁⁻¹ kept, a solve is products only; that with Sᵀ exchanges X and Yᵀ. What the levels
leave is dense.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._xla import fori_loop, scan, while_loop
from lgsens.linear import tuned
from lgsens.linear._elimination import Elimination, Loop
from lgsens.linear._sparse import added, chosen


class Eliminated(eqx.Module):
    """One level: S₁₁⁻¹, X and Y of its clusters."""

    inverse: Float[Array, "*level c p p"]
    right: Float[Array, "*level c p q"]  # X
    left: Float[Array, "*level c q p"]  # Y

    @classmethod
    def of(cls, pivot, right, left) -> tuple["Eliminated", Float[Array, " c*q*q"]]:
        """The level, and what it adds to the entries after it."""
        inverse = inverses(pivot)
        level = cls(inverse, inverse @ right, left @ inverse)
        return level, -(level.left @ right).ravel()

    def transposed(self) -> "Eliminated":
        return Eliminated(_turned(self.inverse), _turned(self.left), _turned(self.right))


class BlockMatrix(eqx.Module):
    """A sparse matrix in the places of its factors, with `@` by vectors from both sides."""

    entries: Float[Array, " numbers"]
    plan: Elimination = eqx.field(static=True)

    @classmethod
    def of(cls, plan: Elimination, values, rows: np.ndarray, columns: np.ndarray) -> "BlockMatrix":
        entries = jnp.zeros(plan.numbers, values.dtype).at[plan.places(rows, columns)].add(values)
        return cls(entries.at[plan.filling()].set(1.0), plan)

    @property
    def dtype(self):
        return self.entries.dtype

    def rest(self, entries) -> Float[Array, "r r"]:
        """What the levels leave of the entries."""
        count = len(self.plan.rest)
        return entries[self.plan.numbers - count**2 :].reshape(count, count)

    def _times(self, x, turned: Callable, exchanged: bool):
        x = jnp.concatenate([x, jnp.zeros(1, x.dtype)])
        products = [(turned(self.rest(self.entries)[None])[0] @ x[self.plan.rest], self.plan.rest)]
        for i, (own, boundary) in enumerate(self.plan.levels):
            pivot, right, left = map(turned, self.plan.blocks(self.entries, i))
            right, left = (left, right) if exchanged else (right, left)
            products.append((_product(pivot, x[own]) + _product(right, x[boundary]), own))
            products.append((_product(left, x[own]), boundary))
        return added(products, len(x), x.dtype)[:-1]

    def __matmul__(self, x):
        return self._times(x, lambda blocks: blocks, exchanged=False)

    def __rmatmul__(self, x):
        return self._times(x, _turned, exchanged=True)


class BlockFactors(eqx.Module):
    """The factors of a sparse matrix: its levels, and what is left of it."""

    eliminated: tuple[Eliminated, ...]  # level after level; of those in the loop all together, stacked
    rest: Any  # LU or Inverse
    plan: Elimination = eqx.field(static=True)

    @classmethod
    def of(cls, matrix: BlockMatrix, kind: Any) -> "BlockFactors":
        """`kind`: LU or Inverse, for the rest."""
        entries, plan = matrix.entries, matrix.plan
        eliminated, loop = [], plan.loop
        for i, places in enumerate(plan.coupled[: plan.unrolled]):
            blocks, entries = plan.first(entries, i)
            level, change = Eliminated.of(*blocks)
            eliminated.append(level)
            there = np.flatnonzero(places >= 0)
            entries = entries.at[places[there]].add(change[there])
        if loop is not None:

            def eliminate(entries, at):
                start, places = at
                own = lax.dynamic_slice_in_dim(entries, start, loop.size)
                level, change = Eliminated.of(*plan.first(own, plan.unrolled)[0])
                return entries.at[places].add(change, mode="drop"), level

            places = np.where(loop.coupled < 0, len(entries), loop.coupled)
            entries, levels = scan(eliminate, entries, (loop.size * np.arange(plan.looped), places))
            eliminated.append(levels)
            entries = entries[loop.size * plan.looped :]
        return cls(tuple(eliminated), kind.of(entries.reshape(2 * (len(plan.rest),))), plan)

    def solve(self, rhs, *, transposed: bool = False):
        """S⁻¹ rhs or S⁻ᵀ rhs, one column or several.

        What a level leaves is the end of a vector in the order of elimination: no level touches those before it.
        """
        if rhs.ndim == 2:
            return jax.vmap(lambda column: self.solve(column, transposed=transposed), in_axes=1, out_axes=1)(rhs)
        plan, b, known = self.plan, chosen(rhs, self.plan.order), []
        levels = [level.transposed() for level in self.eliminated] if transposed else self.eliminated
        for level, (own, _), boundary in zip(levels, plan.levels[: plan.unrolled], plan.boundaries):
            known.append(b[: own.size].reshape(own.shape))
            b = b[own.size :]
            b = b - added([(_product(level.left, known[-1]), boundary)], len(b), b.dtype)
        rest = lambda b: self.rest.solve(b, transposed=transposed) if len(b) else b
        x = rest(b) if plan.loop is None else _solved_in_loop(plan.loop, levels[-1], b, rest)
        for level, own, boundary in reversed(list(zip(levels, known, plan.boundaries))):
            own = _product(level.inverse, own) - _product(level.right, chosen(x, boundary))
            x = jnp.concatenate([own.ravel(), x])
        return x[plan.position]


def _solved_in_loop(loop: Loop, levels: Eliminated, b, rest: Callable):
    """The unknowns of the levels of a loop and of the rest; `levels`: stacked, `rest`: solves for the rest."""
    count, size = len(loop.boundary), loop.own[0] * loop.own[1]
    starts, boundaries = size * np.arange(count), np.where(loop.boundary < 0, len(b), loop.boundary)

    def down(b, at):
        level, start, boundary = at
        own = lax.dynamic_slice_in_dim(b, start, size).reshape(loop.own)
        return b.at[boundary].add(-_summed(level.left, own), mode="drop"), own

    b, known = scan(down, b, (levels, starts, boundaries))

    def up(carry):
        # not a scan in reverse: XLA takes three rounds over all loops around it to see that its last index is constant
        x, i = carry
        at = jax.tree.map(lambda rows: lax.dynamic_index_in_dim(rows, i, keepdims=False), every)
        level, own, start, boundary = at
        own = _summed(level.inverse, own) - _summed(level.right, x[boundary])
        return lax.dynamic_update_slice_in_dim(x, own.ravel(), start, 0), i - 1

    end = jnp.concatenate([rest(b[count * size :]), jnp.zeros(1, b.dtype)])  # the last one is what fills up
    x = jnp.concatenate([jnp.zeros(count * size, b.dtype), end])
    every = levels, known, jnp.asarray(starts), jnp.asarray(boundaries)
    return while_loop(lambda carry: carry[1] >= 0, up, (x, jnp.asarray(count - 1, jnp.int32)))[0][:-1]


def inverses(blocks: Float[Array, "c p p"]) -> Float[Array, "c p p"]:
    """The inverses of small matrices by Gauss–Jordan elimination without exchanges, all matrices side by side.

    An eighth of the time of batched LAPACK on 256 matrices of 6 rows; and two batched LAPACK calls at once can wait for
    each other for ever on a machine of two cores (jaxlib 0.10).
    """
    size = blocks.shape[1]
    places = jnp.arange(size)

    def eliminate(j, matrix):
        here = places == j
        pivot = 1.0 / matrix[j, j]
        row = jnp.where(here[:, None], pivot[None, :], matrix[j] * pivot[None, :])
        column = jnp.where(here[:, None], -jnp.ones_like(row), matrix[:, j])
        rest = jnp.where((here[:, None] | here[None, :])[:, :, None], jnp.zeros_like(matrix), matrix)
        return rest - column[:, None, :] * row[None, :, :]

    looped = partial(fori_loop, 0, size, eliminate)
    # elsewhere: what is written out is fused, and no turn of a loop waits for the host
    written_out = partial(fori_loop, 0, size, eliminate, unroll=True)
    found = lax.platform_dependent(jnp.moveaxis(blocks, 0, 2), cpu=looped, default=written_out)
    return jnp.moveaxis(found, 2, 0)


def _turned(blocks):
    return jnp.swapaxes(blocks, -2, -1)


def _product(blocks, x):
    return jnp.einsum("cij,cj->ci", blocks, x)


def _summed(blocks, x):
    """The same in a loop that XLA fuses with what takes the blocks out of those of all levels."""
    if x.shape[1] > tuned.SUMMED_COLUMNS:
        return _product(blocks, x)
    return jnp.sum(blocks * x[:, None, :], axis=-1)
