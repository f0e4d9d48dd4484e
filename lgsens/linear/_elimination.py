"""Block elimination of a sparse matrix, level by level (`_ordering`).

For a cluster with its own unknowns 1 and its boundary 2,

    [[S₁₁, S₁₂],  [x₁;  = [b₁;        x₁ = S₁₁⁻¹ (b₁ − S₁₂ x₂),     (S₂₂ − S₂₁ S₁₁⁻¹ S₁₂) x₂ = b₂ − S₂₁ S₁₁⁻¹ b₁
     [S₂₁, S₂₂]]   x₂]     b₂]

With X = S₁₁⁻¹ S₁₂ and Y = S₂₁ S₁₁⁻¹ kept, a solve is products only; that with Sᵀ exchanges X and Yᵀ. What the levels
leave is dense. All entries that are ever needed lie in one array: the blocks S₁₁, S₁₂ and S₂₁ of level after level, and
the rest; an entry belongs to the level that eliminates its row or its column first.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens.linear._ordering import Level
from lgsens.linear._sparse import added, chosen


class Elimination:
    """What is eliminated in which level, and where entries are; static, and equal only to itself."""

    def __init__(self, levels: Sequence[Level], size: int):
        self.levels, self.size = tuple(levels), size
        gone = np.concatenate([level.own.ravel() for level in levels]) if levels else np.zeros(0, int)
        self.rest = np.setdiff1d(np.arange(size), gone).astype(np.int32)  # as in `Pattern`

    @cached_property
    def _starts(self) -> np.ndarray:
        """Where S₁₁ and S₁₂ of each level, its S₂₁, and the rest begin."""
        sizes = [count for own, boundary in self.levels for count in _sizes(own, boundary)]
        return np.cumsum([0, *sizes])

    @property
    def numbers(self) -> int:
        """How many numbers the factors are."""
        return int(self._starts[-1]) + len(self.rest) ** 2

    @cached_property
    def _places(self):
        """Of each unknown the level, the cluster, the place in it; of (cluster, unknown) the place in its boundary."""
        level, cluster, place = (np.full(self.size + 1, -1) for _ in range(3))
        level[self.rest] = len(self.levels)
        place[self.rest] = np.arange(len(self.rest))
        keys, slots, first = [], [], 0
        for i, (own, boundary) in enumerate(self.levels):
            numbers = first + np.arange(len(own))
            level[own], cluster[own], place[own] = i, numbers[:, None], np.arange(own.shape[1])
            keys.append((numbers[:, None] * (self.size + 1) + boundary.astype(int)).ravel())
            slots.append(np.broadcast_to(np.arange(boundary.shape[1]), boundary.shape).ravel())
            first += len(own)
        keys, slots = (np.concatenate([*some, np.zeros(0, int)]) for some in (keys, slots))
        order = np.argsort(keys, kind="stable")
        return level, cluster, place, keys[order], slots[order]

    def places(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Where the entries (row, column) are; −1 for those of the filling unknown."""
        level, cluster, place, keys, slots = self._places
        found = np.full(rows.shape, -1)
        real = (rows < self.size) & (columns < self.size)

        def slot(clusters, unknowns):
            wanted = clusters * (self.size + 1) + unknowns
            at = np.searchsorted(keys, wanted)
            assert np.array_equal(np.take(keys, at, mode="clip"), wanted), "an entry that the graph does not have"
            return slots[at]

        first = 0
        for i, (own, boundary) in enumerate(self.levels):
            count, p, q = len(own), own.shape[1], boundary.shape[1]
            of_rows = real & (level[rows] == i) & (level[columns] >= i)
            r, c = rows[of_rows], columns[of_rows]
            across = np.full(r.shape, 0)
            inside = level[c] == i
            across[inside] = place[c[inside]]
            across[~inside] = p + slot(cluster[r[~inside]], c[~inside])
            found[of_rows] = self._starts[2 * i] + ((cluster[r] - first) * p + place[r]) * (p + q) + across
            of_columns = real & (level[columns] == i) & (level[rows] > i)
            r, c = rows[of_columns], columns[of_columns]
            down = (cluster[c] - first) * q + slot(cluster[c], r)
            found[of_columns] = self._starts[2 * i + 1] + down * p + place[c]
            first += count
        last = real & (level[rows] == len(self.levels)) & (level[columns] == len(self.levels))
        found[last] = self._starts[-1] + place[rows[last]] * len(self.rest) + place[columns[last]]
        return found

    def filling(self) -> np.ndarray:
        """The diagonal entries of the filling unknowns, which are 1."""
        found = []
        for i, (own, boundary) in enumerate(self.levels):
            p = own.shape[1]
            number, place = np.nonzero(own == self.size)
            found.append(self._starts[2 * i] + (number * p + place) * (p + boundary.shape[1]) + place)
        return np.concatenate([*found, np.zeros(0, int)])

    def blocks(self, entries, i: int):
        """S₁₁, S₁₂ and S₂₁ of level i."""
        return self.first(entries[self._starts[2 * i] :], i)[0]

    def first(self, entries, i: int):
        """S₁₁, S₁₂ and S₂₁ of level i, and the entries after them, from the entries of this level and later ones."""
        own, boundary = self.levels[i]
        count, p, q = len(own), own.shape[1], boundary.shape[1]
        middle, end = np.cumsum(_sizes(own, boundary))
        rows = entries[:middle].reshape(count, p, p + q)
        return (rows[:, :, :p], rows[:, :, p:], entries[middle:end].reshape(count, q, p)), entries[end:]

    @cached_property
    def coupled(self) -> list[np.ndarray]:
        """Of each level, where S₂₁ S₁₁⁻¹ S₁₂ goes among the entries after the level, shape (clusters q q)."""
        found = []
        for i, (_, boundary) in enumerate(self.levels):
            q = boundary.shape[1]
            across = np.broadcast_to(boundary[:, None, :], (len(boundary), q, q))
            places = self.places(np.swapaxes(across, 1, 2).ravel(), across.ravel())
            found.append(np.where(places < 0, -1, places - self._starts[2 * i + 2]))
        return found

    @cached_property
    def order(self) -> np.ndarray:
        """The unknowns as they are eliminated, level after level, and then the rest; −1 where one only fills up."""
        order = np.concatenate([*(own.ravel() for own, _ in self.levels), self.rest])
        return np.where(order == self.size, -1, order)

    @cached_property
    def position(self) -> np.ndarray:
        """Where each unknown is in that order."""
        found = np.zeros(self.size, np.int32)
        real = np.flatnonzero(self.order >= 0)
        found[self.order[real]] = real
        return found

    @cached_property
    def boundaries(self) -> list[np.ndarray]:
        """Of each level, where its boundary is among the unknowns after the level, in their order; −1: fills up."""
        found, end = [], 0
        for own, boundary in self.levels:
            end += own.size
            places = np.append(self.position, -1)[boundary]
            found.append(np.where(places < 0, -1, places - end))
        return found


def _sizes(own, boundary) -> tuple[int, int]:
    p, q = own.shape[1], boundary.shape[1]
    return len(own) * p * (p + q), len(own) * q * p


class Eliminated(eqx.Module):
    """One level: S₁₁⁻¹, X and Y of its clusters."""

    inverse: Float[Array, "c p p"]
    right: Float[Array, "c p q"]  # X
    left: Float[Array, "c q p"]  # Y


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

    eliminated: tuple[Eliminated, ...]
    rest: Any  # LU or Inverse
    plan: Elimination = eqx.field(static=True)

    @classmethod
    def of(cls, matrix: BlockMatrix, kind: Any) -> "BlockFactors":
        """`kind`: LU or Inverse, for the rest."""
        entries, plan = matrix.entries, matrix.plan
        eliminated = []
        for i, places in enumerate(plan.coupled):
            (pivot, right, left), entries = plan.first(entries, i)
            inverse = inverses(pivot)
            level = Eliminated(inverse, inverse @ right, left @ inverse)
            eliminated.append(level)
            there = np.flatnonzero(places >= 0)
            entries = entries.at[places[there]].add(-(level.left @ right).ravel()[there])
        return cls(tuple(eliminated), kind.of(entries.reshape(2 * (len(plan.rest),))), plan)

    def solve(self, rhs, *, transposed: bool = False):
        """S⁻¹ rhs or S⁻ᵀ rhs, one column or several.

        What a level leaves is the end of a vector in the order of elimination: no level touches those before it.
        """
        if rhs.ndim == 2:
            return jax.vmap(lambda column: self.solve(column, transposed=transposed), in_axes=1, out_axes=1)(rhs)
        b, known = chosen(rhs, self.plan.order), []
        for level, (own, _), boundary in zip(self.eliminated, self.plan.levels, self.plan.boundaries):
            left = _turned(level.right) if transposed else level.left
            known.append(b[: own.size].reshape(own.shape))
            b = b[own.size :]
            b = b - added([(_product(left, known[-1]), boundary)], len(b), b.dtype)
        x = self.rest.solve(b, transposed=transposed) if len(b) else b
        for level, own, boundary in reversed(list(zip(self.eliminated, known, self.plan.boundaries))):
            inverse, right = (
                (_turned(level.inverse), _turned(level.left)) if transposed else (level.inverse, level.right)
            )
            own = _product(inverse, own) - _product(right, chosen(x, boundary))
            x = jnp.concatenate([own.ravel(), x])
        return x[self.plan.position]


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

    return jnp.moveaxis(lax.fori_loop(0, size, eliminate, jnp.moveaxis(blocks, 0, 2)), 2, 0)


def _turned(blocks):
    return jnp.swapaxes(blocks, 1, 2)


def _product(blocks, x):
    return jnp.einsum("cij,cj->ci", blocks, x)
