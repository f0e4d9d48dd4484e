"""Where the results of a sweep are kept: in memory, or in a folder that survives the process.

A folder has one `.npy` file for each array (a row for each design), mapped into memory: what is written stays, whatever
becomes of the process, and results may be larger than memory. `done.npy` marks a design after all of its numbers
are written. `sweep.json` names the arrays and holds the fingerprint of the designs, which lie beside the values.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree
from numpy.lib.format import open_memmap

from lgsens._validate import leaf_name

FORMAT = 1


class Store(NamedTuple):
    """The results of a sweep so far, arrays with a row for each design.

    Attributes:
        values: the leaves of what fn returns.
        ok, done: whether a design succeeded, and whether it was computed at all; shape (N,).
    """

    values: list[np.ndarray]
    ok: np.ndarray
    done: np.ndarray

    def write(self, rows: np.ndarray, values: list[np.ndarray], ok: np.ndarray) -> None:
        """Results of the designs `rows`; they count as done once everything else is on disk."""
        for array, new in zip((*self.values, self.ok, self.done), (*values, ok, True)):
            array[rows] = new
            if isinstance(array, np.memmap):
                array.flush()


def in_memory(shapes: PyTree, count: int) -> Store:
    """An empty store for `count` designs, each with values as `shapes`."""
    values = [np.zeros((count, *leaf.shape), leaf.dtype) for leaf in jax.tree.leaves(shapes)]
    return Store(values, np.zeros(count, bool), np.zeros(count, bool))


def in_folder(folder: Path, designs: PyTree, shapes: PyTree, count: int) -> Store:
    """The store in `folder`, continued if it is there. Raises `ValueError` if it is another sweep's."""
    wanted = _description(designs, shapes, count)
    if not folder.exists():
        _create(folder, wanted, designs)
    try:
        found = json.loads((folder / "sweep.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"`folder` {str(folder)!r} is there and holds no sweep; name another one.") from error
    for key, what in (
        ("format", "is of another version of lgsens"),
        ("designs", "belongs to other designs"),
        ("values", "holds the results of another `fn`"),
    ):
        if found.get(key) != wanted[key]:
            has, own = (json.dumps(each.get(key)) for each in (found, wanted))
            raise ValueError(
                f"`folder` {str(folder)!r} {what}: it has {has[:200]}, this sweep {own[:200]}. Name another folder, or "
                "delete this one."
            )
    files = [entry["file"] for entry in wanted["values"]] + ["ok.npy", "done.npy"]
    *values, ok, done = (open_memmap(folder / name, mode="r+") for name in files)
    return Store([*values], ok, done)


def _description(designs: PyTree, shapes: PyTree, count: int) -> dict[str, Any]:
    """What a folder says of itself; equal for equal sweeps."""

    def arrays(tree, kind, root, own_shape):
        return [
            {
                "name": leaf_name(path, root),
                "file": f"{kind}_{i}.npy",
                "dtype": str(leaf.dtype),
                "shape": list(own_shape(leaf)),
            }
            for i, (path, leaf) in enumerate(jax.tree_util.tree_leaves_with_path(tree))
        ]

    parameters = arrays(designs, "design", "x", lambda leaf: leaf.shape[1:])
    fingerprint = hashlib.sha256(json.dumps(parameters).encode())
    for leaf in jax.tree.leaves(designs):
        fingerprint.update(np.ascontiguousarray(leaf).tobytes())
    return {
        "format": FORMAT,
        "designs": {"count": count, "sha256": fingerprint.hexdigest()},
        "parameters": parameters,
        "values": arrays(shapes, "value", "value", lambda leaf: leaf.shape),
    }


def _create(folder: Path, description: dict[str, Any], designs: PyTree) -> None:
    """A folder of nothing done, complete from the moment that it has its name."""
    draft = folder.with_name(folder.name + ".draft")
    shutil.rmtree(draft, ignore_errors=True)
    draft.mkdir(parents=True)
    count = description["designs"]["count"]
    for entry in description["values"]:
        open_memmap(draft / entry["file"], "w+", np.dtype(entry["dtype"]), (count, *entry["shape"]))
    for name in ("ok.npy", "done.npy"):
        open_memmap(draft / name, "w+", np.dtype(bool), (count,))
    for entry, leaf in zip(description["parameters"], jax.tree.leaves(designs)):
        np.save(draft / entry["file"], leaf)
    (draft / "sweep.json").write_text(json.dumps(description, indent=1), encoding="utf-8")
    os.replace(draft, folder)
