"""The file that keeps a minimization: its evaluations and what the next one needs besides them, bit by bit."""

import hashlib
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lgsens.optimize._box import Box

FORMAT = 3


class Checkpoint:
    """One `.npz` file, replaced as a whole: a process that dies while writing leaves the one before."""

    def __init__(self, path: str | os.PathLike, box: Box, x0: Float[Array, " n"], tolerances: tuple[float, float]):
        self.path = Path(path)
        numbers = b"".join(np.ascontiguousarray(leaf).tobytes() for leaf in (*box, x0, tolerances))
        self.problem = f"{FORMAT} {hashlib.sha256(numbers).hexdigest()}"

    def save(self, carry: PyTree, rows: list[Any]) -> None:
        """The state after the evaluations `rows`."""
        draft = self.path.with_name(self.path.name + ".draft")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with draft.open("wb") as file:
            np.savez(file, problem=np.asarray(self.problem), **_arrays(carry, rows))
        os.replace(draft, self.path)

    def load(self, carry: PyTree, first: Any) -> tuple[PyTree, list[Any]]:
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
        known = _arrays(carry, [first])
        same = str(arrays.pop("problem", None)) == self.problem and arrays.keys() == known.keys()
        alike = lambda name, array: (array.dtype, array.shape[name.startswith("row_") :])
        if not same or any(alike(name, arrays[name]) != alike(name, array) for name, array in known.items()):
            raise ValueError(
                f"`checkpoint` {str(self.path)!r} belongs to another start, other bounds or tolerances, another "
                f"number of constraints or another mode; {remedy}"
            )
        rows = [type(first)(*row) for row in zip(*(arrays[f"row_{name}"] for name in first._fields))]
        # Another machine or version rounds otherwise, which a motion may enlarge: half of the digits are compared.
        close = np.sqrt(np.finfo(rows[0].objective.dtype).eps)
        for name in ("objective", "worst"):
            found, now = getattr(rows[0], name), np.asarray(getattr(first, name))
            if not np.allclose(found, now, rtol=close, atol=close):
                raise ValueError(
                    f"`checkpoint` {str(self.path)!r} belongs to another `fun`: {name} at `x0` was {found}, is {now}; "
                    f"{remedy}"
                )
        leaves, structure = jax.tree.flatten(carry)
        kept = [jnp.asarray(arrays[f"carry_{i}"]) for i in range(len(leaves))]
        return jax.tree.unflatten(structure, kept), rows


def _arrays(carry: PyTree, rows: list[Any]) -> dict[str, Any]:
    found = {f"carry_{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(carry))}
    return found | {f"row_{name}": np.stack(column) for name, column in zip(rows[0]._fields, zip(*rows))}
