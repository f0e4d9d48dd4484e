"""Sparse matrices as sums of small blocks, one stack of blocks for each type of element.

    A = Σ_e P_eᵀ A_e Q_e

with A_e the block of element e and P_e, Q_e the selections of its rows and columns. Nothing is assembled: a product
takes the columns' entries of x, multiplies the stacked blocks, and adds up by rows, three operations for each type of
element, whatever the number of elements.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens.linear import tuned


class Pattern:
    """Where the blocks of one stack are; static, and equal only to itself: make it once for each topology.

    rows: (E, r) integers, columns: (E, c) integers, −1 for a row or column that the matrix does not have.
    slots: (E, b) the bodies of the columns, where they belong to bodies: six for each, or its three rotations.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, slots: np.ndarray | None = None):
        # 32 bits in every mode: JAX remembers which type it gave to an array that it has seen
        self.rows, self.columns = rows.astype(np.int32), columns.astype(np.int32)
        self.slots = None if slots is None else slots.astype(np.int32)

    def transposed(self) -> "Pattern":
        return Pattern(self.columns, self.rows)

    @property
    def bodies(self) -> np.ndarray:
        """`slots` of a pattern that has them."""
        assert self.slots is not None, "the columns of this matrix do not belong to bodies"
        return self.slots


class Blocks(eqx.Module):
    """The blocks of one type of element."""

    values: Float[Array, "E r c"]
    pattern: Pattern = eqx.field(static=True)


class SparseMatrix(eqx.Module):
    """A matrix as a sum of blocks, with `+`, `@` from both sides and `*` by numbers.

    `@` takes vectors, and from the right matrices of columns. Entries may lie in several blocks; they add up. `T`, `+`
    and `*` are those of a stack of matrices, too, whose blocks have an axis more.
    """

    parts: tuple[Blocks, ...]
    shape: tuple[int, int] = eqx.field(static=True)
    dtype: Any = eqx.field(static=True)

    def _with(self, parts) -> "SparseMatrix":
        return SparseMatrix(tuple(parts), self.shape, self.dtype)

    @property
    def T(self) -> "SparseMatrix":
        turned = tuple(Blocks(jnp.swapaxes(p.values, -1, -2), p.pattern.transposed()) for p in self.parts)
        return SparseMatrix(turned, (self.shape[1], self.shape[0]), self.dtype)

    def __add__(self, other: "SparseMatrix") -> "SparseMatrix":
        return self._with(self.parts + other.parts)

    def __rmul__(self, factor) -> "SparseMatrix":
        return self._with(Blocks(factor * part.values, part.pattern) for part in self.parts)

    def __matmul__(self, x):
        if x.ndim == 2:
            return jax.vmap(self.__matmul__, in_axes=1, out_axes=1)(x)
        products = [
            (jnp.einsum("erc,ec->er", p.values, chosen(x, p.pattern.columns)), p.pattern.rows) for p in self.parts
        ]
        return added(products, self.shape[0], x.dtype)

    def __rmatmul__(self, x):
        products = [
            (jnp.einsum("erc,er->ec", p.values, chosen(x, p.pattern.rows)), p.pattern.columns) for p in self.parts
        ]
        return added(products, self.shape[1], x.dtype)

    def entries(self) -> tuple[Any, np.ndarray, np.ndarray]:
        """The entries of all blocks, flat, and their rows and columns."""
        found = []
        for part in self.parts:
            rows = np.broadcast_to(part.pattern.rows[:, :, None], part.values.shape).ravel()
            columns = np.broadcast_to(part.pattern.columns[:, None, :], part.values.shape).ravel()
            there = (rows >= 0) & (columns >= 0)
            values = part.values.ravel()
            if not there.all():
                values, rows, columns = values[np.flatnonzero(there)], rows[there], columns[there]
            found.append((values, rows, columns))
        if not found:
            return jnp.zeros(0, self.dtype), np.zeros(0, int), np.zeros(0, int)
        values, rows, columns = zip(*found)
        return jnp.concatenate(values), np.concatenate(rows), np.concatenate(columns)

    def within(self, shape: tuple[int, int], row: int = 0, column: int = 0) -> "SparseMatrix":
        """The matrix as a part of a larger one of zeros, from a row and a column on."""
        moved = lambda places, by: np.where(places < 0, places, places + by)
        patterns = [Pattern(moved(p.pattern.rows, row), moved(p.pattern.columns, column)) for p in self.parts]
        return SparseMatrix(tuple(Blocks(p.values, own) for p, own in zip(self.parts, patterns)), shape, self.dtype)

    def inverse(self) -> "SparseMatrix":
        """Of a matrix of square blocks on its diagonal, each of other rows, as that of masses by bodies is."""
        parts = []
        for part in self.parts:
            there = part.pattern.rows >= 0
            unit = jnp.eye(there.shape[1], dtype=self.dtype)[None]
            whole = jnp.where(there[:, :, None] & there[:, None, :], part.values, unit)
            parts.append(Blocks(jnp.linalg.inv(whole), part.pattern))
        return self._with(parts)

    def trace(self) -> Float[Array, ""]:
        values, rows, columns = self.entries()
        return jnp.sum(values[np.flatnonzero(rows == columns)])

    def dense(self) -> Float[Array, "r c"]:
        """The matrix as an array, in one scatter."""
        values, rows, columns = self.entries()
        height, width = self.shape
        return jnp.zeros(height * width, self.dtype).at[rows * width + columns].add(values).reshape(self.shape)

    def to_numpy(self) -> np.ndarray:
        """The matrix as an array, without JAX, for messages."""
        full = np.zeros((self.shape[0] + 1, self.shape[1] + 1), self.dtype)  # the last ones are nowhere
        for part in self.parts:
            rows, columns = part.pattern.rows[:, :, None], part.pattern.columns[:, None, :]
            np.add.at(full, (rows, columns), np.asarray(part.values))
        return full[:-1, :-1]

    def with_unit_rows(self) -> "SparseMatrix":
        """Each row divided by its norm; no row lies in two blocks."""
        norms = [(jnp.sum(p.values**2, axis=2), p.pattern.rows) for p in self.parts]
        squares = added(norms, self.shape[0], self.dtype)
        scale = lax.rsqrt(jnp.maximum(squares, jnp.finfo(self.dtype).tiny))
        scaled = [Blocks(chosen(scale, p.pattern.rows)[:, :, None] * p.values, p.pattern) for p in self.parts]
        return self._with(scaled)

    def times_rotations(self, operators: Float[Array, "N 3 3"]) -> "SparseMatrix":
        """A diag(I, operator_1, I, operator_2, …): an operator for the three last of the columns of each body."""
        parts = []
        for part in self.parts:
            slots = part.pattern.bodies
            width = part.values.shape[2] // slots.shape[1]
            split, own = part.values.reshape(*part.values.shape[:2], slots.shape[1], width), operators[slots][:, None]
            # written out, one loop over the result; as small products it took four times as long
            turned = sum(split[..., width - 3 + i, None] * own[..., i, :] for i in range(3))
            whole = jnp.concatenate([split[..., : width - 3], turned], axis=-1)
            parts.append(Blocks(whole.reshape(part.values.shape), part.pattern))
        return self._with(parts)

    def congruence(self, blocks: Float[Array, "N 6 6"]) -> Float[Array, "r r"]:
        """A diag(block_1, block_2, …) Aᵀ as an array: only rows that a body has are multiplied with each other.

        blocks: one for the six columns of each body, symmetric.
        """
        height = self.shape[0]
        widths = [part.values.shape[2] // part.pattern.bodies.shape[1] for part in self.parts]  # 6 or the rotations' 3
        rows = [
            jnp.pad(part.values.reshape(-1, width), ((0, 0), (6 - width, 0))) for part, width in zip(self.parts, widths)
        ]
        entries = jnp.concatenate([*rows, jnp.zeros((1, 6), self.dtype)])
        products, places = [jnp.zeros(0, self.dtype)], [np.zeros(0, int)]
        for bodies, table, at in _rows_of_bodies([part.pattern for part in self.parts]):
            panels = entries[table]
            products.append(jnp.einsum("bij,brj,bsi->brs", blocks[bodies], panels, panels).ravel())
            there = (at[:, :, None] >= 0) & (at[:, None, :] >= 0)
            places.append(np.where(there, at[:, :, None] * height + at[:, None, :], height**2).ravel())
        whole = jnp.zeros(height**2, self.dtype)
        # a scatter: `added` would gather here, 10 instead of 5 µs for the reduced quarter-car
        return whole.at[np.concatenate(places)].add(jnp.concatenate(products), mode="drop").reshape(height, height)


def diagonal(values: Float[Array, " k"]) -> SparseMatrix:
    places = np.arange(values.shape[0])[:, None]
    return SparseMatrix(
        (Blocks(values[:, None, None], Pattern(places, places)),), (len(places), len(places)), values.dtype
    )


def chosen(x: Float[Array, " k"], places: np.ndarray) -> Float[Array, "..."]:
    """The entries of x at `places`, zero where a place is −1."""
    if (places >= 0).all():
        return x[places]
    return jnp.concatenate([x, jnp.zeros(1, x.dtype)])[np.where(places < 0, x.shape[0], places)]


def added(arrays: Sequence[tuple[Any, np.ndarray]], size: int, dtype=None) -> Float[Array, " size"]:
    """The vector whose entries are the sums of those of the arrays with the same place; −1: nowhere."""
    if not arrays:
        return jnp.zeros(size, dtype)
    values = jnp.concatenate([values.ravel() for values, _ in arrays])
    places = np.concatenate([places.ravel() for _, places in arrays])
    there = np.flatnonzero(places >= 0)

    def scattered(values):
        return jnp.zeros(size, dtype).at[places[there]].add(values if len(there) == len(places) else values[there])

    table = _table(places[there], there, size, nowhere=len(places))
    if table is None:
        return scattered(values)

    # The derivative is the scatter's, whose transpose is a gather.
    @jax.custom_jvp
    def gathered(values):
        return jnp.sum(jnp.concatenate([values, jnp.zeros(1, values.dtype)])[table], axis=0)

    gathered.defjvp(lambda primals, tangents: (gathered(*primals), scattered(*tangents)))
    return gathered(values)


def _rows_of_bodies(patterns: Sequence[Pattern]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of bodies with about as many rows: their numbers (b,), which of all parts of rows that have one body they have
    (b, rows), and the rows that these are parts of (b, rows). Shorter ones are padded: the one after the last, −1."""
    ends = [np.broadcast_arrays(p.rows[:, :, None], p.bodies[:, None, :]) for p in patterns]
    rows, bodies = (np.concatenate([*(end[i].ravel() for end in ends), [-1]]).astype(int) for i in range(2))
    own = {body: np.flatnonzero((bodies == body) & (rows >= 0)) for body in np.unique(bodies[rows >= 0])}
    power = lambda body: (len(own[body]) - 1).bit_length()
    found = []
    for _, group in groupby(sorted(own, key=power), key=power):
        group = np.fromiter(group, int)
        most = max(len(own[body]) for body in group)
        table = np.stack(
            [np.pad(own[body], (0, most - len(own[body])), constant_values=len(rows) - 1) for body in group]
        )
        found.append((group, table, rows[table]))
    return found


def _table(places: np.ndarray, values: np.ndarray, size: int, *, nowhere: int) -> np.ndarray | None:
    """Which values each place has, `nowhere` after the last of them, shape (most, size); None: mostly nowhere."""
    counts = np.bincount(places, minlength=size)
    most = int(counts.max(initial=0))
    if most * size > tuned.GATHERED_PER_NUMBER * len(places) + tuned.GATHERED_ALWAYS:
        return None
    order = np.argsort(places, kind="stable")
    rank = np.arange(len(places)) - (np.cumsum(counts) - counts)[places[order]]  # among those of one place
    table = np.full((most, size), nowhere, np.int32)
    table[rank, places[order]] = values[order]
    return table
