"""Block elimination of a sparse matrix, level by level (`_ordering`): where everything is.

All entries that are ever needed lie in one array: the blocks S₁₁, S₁₂ and S₂₁ (`_block_factors`) of level after level,
and the rest; an entry belongs to the level that eliminates its row or its column first.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from lgsens.linear._ordering import Level


class Elimination:
    """What is eliminated in which level, and where entries are; static, and equal only to itself.

    `looped`: how many of the last levels one loop eliminates. They have the same shape, and compile once.
    `once`: the plan for a matrix that is factorized once in a run; None: this one.
    """

    def __init__(self, levels: Sequence[Level], size: int, looped: int = 0, once: "Elimination | None" = None):
        self.levels, self.size, self.looped, self.once = tuple(levels), size, looped, once or self
        self.unrolled = len(self.levels) - looped
        assert len({(own.shape, boundary.shape) for own, boundary in self.levels[self.unrolled :]}) <= 1
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

    @cached_property
    def loop(self) -> "Loop | None":
        """The places of the levels in the loop."""
        if not self.looped:
            return None
        first = self.unrolled
        own, size = self.levels[first].own, int(self._starts[2 * first + 2] - self._starts[2 * first])

        def from_the_first(places, size):
            """Of each level, counted from the end of the level: from the start of the first one."""
            moved = [np.where(some < 0, -1, some + size * i) for i, some in enumerate(places[first:], 1)]
            return np.stack(moved).astype(np.int32)

        return Loop(size, own.shape, from_the_first(self.coupled, size), from_the_first(self.boundaries, own.size))


class Loop(NamedTuple):
    """Levels of the same shape that are eliminated in a loop: they and the rest are the end of entries and vectors.

    size: how many entries a level has. own: the shape of its unknowns, (clusters, p).
    coupled: (levels, clusters q q) and boundary: (levels, clusters, q), where in those ends S₂₁ S₁₁⁻¹ S₁₂ and the
    boundaries of a level are; −1: nowhere.
    """

    size: int
    own: tuple[int, int]
    coupled: np.ndarray
    boundary: np.ndarray


def _sizes(own, boundary) -> tuple[int, int]:
    p, q = own.shape[1], boundary.shape[1]
    return len(own) * p * (p + q), len(own) * q * p
