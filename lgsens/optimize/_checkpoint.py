"""The file that keeps a minimization: what its next evaluation needs, and what the ones before found, bit by bit."""

import hashlib
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lgsens.optimize._augmented_lagrangian import Row
from lgsens.optimize._box import Box

FORMAT = 2


def columns(rows: list[Row]) -> dict[str, np.ndarray]:
    """The members of all rows, with a leading axis over the rows."""
    return {name: np.stack(column) for name, column in zip(Row._fields, zip(*rows))}


class Checkpoint:
    """One `.npz` file, replaced as a whole: a process that dies while writing leaves the one before."""

    def __init__(self, path: str | os.PathLike, box: Box, x0: Float[Array, " n"], tolerances: tuple[float, float]):
        self.path = Path(path)
        numbers = b"".join(np.ascontiguousarray(leaf).tobytes() for leaf in (*box, x0, tolerances))
        self.problem = f"{FORMAT} {hashlib.sha256(numbers).hexdigest()}"

    def save(self, carry: PyTree, rows: list[Row]) -> None:
        """The state after the evaluations `rows`."""
        arrays: dict[str, Any] = {f"carry_{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(carry))}
        arrays |= {f"row_{name}": column for name, column in columns(rows).items()}
        draft = self.path.with_name(self.path.name + ".draft")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with draft.open("wb") as file:
            np.savez(file, problem=np.asarray(self.problem), **arrays)
        os.replace(draft, self.path)

    def load(self, carry: PyTree, first: Row) -> tuple[PyTree, list[Row]]:
        """What the file holds; `carry`, the one at x₀, and no rows where there is none.

        Raises `ValueError` for a file of another problem, or where `fun` does not give `first` at x₀.
        """
        if not self.path.exists():
            return carry, []
        remedy = "name another file, or delete this one."
        try:
            with np.load(self.path) as file:
                arrays = dict(file)
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"`checkpoint` {str(self.path)!r} holds no minimization; {remedy}") from error
        leaves, structure = jax.tree.flatten(carry)
        kept = [arrays.get(f"carry_{i}") for i in range(len(leaves))]
        same = str(arrays.get("problem")) == self.problem and all(
            found is not None and (found.shape, found.dtype) == (leaf.shape, leaf.dtype)
            for found, leaf in zip(kept, leaves)
        )
        if not same:
            raise ValueError(
                f"`checkpoint` {str(self.path)!r} belongs to another start, other bounds or tolerances, another "
                f"number of constraints or another mode; {remedy}"
            )
        rows = [Row(*row) for row in zip(*(arrays[f"row_{name}"] for name in Row._fields))]
        # Another machine or version rounds otherwise, which a motion may enlarge: half of the digits are compared.
        close = np.sqrt(np.finfo(rows[0].objective.dtype).eps)
        for name in ("objective", "worst"):
            found, now = getattr(rows[0], name), np.asarray(getattr(first, name))
            if not np.allclose(found, now, rtol=close, atol=close):
                raise ValueError(
                    f"`checkpoint` {str(self.path)!r} belongs to another `fun`: {name} at `x0` was {found}, is {now}; "
                    f"{remedy}"
                )
        return jax.tree.unflatten(structure, [jnp.asarray(leaf) for leaf in kept]), rows
