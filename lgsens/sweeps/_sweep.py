"""`sweep`: a function of one design, for thousands of them, on all devices, not lost when the process dies."""

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import PyTree

from lgsens._brief import brief
from lgsens._progress import compiling, progress_bar
from lgsens._validate import as_count, leaf_name, optional
from lgsens.sweeps._batches import compile_batch, trace
from lgsens.sweeps._folder import Store, in_folder, in_memory


class SweepResult(NamedTuple):
    """What `sweep` found; NumPy arrays with a leading axis over the N designs.

    Attributes:
        designs: the designs, as a pytree of arrays.
        values: what `fn` returned; those of a design that failed are NaN or stop short, see `ok`.
        ok: whether a design succeeded: all of its values finite, and no `Trajectory` or `Saved` among them failed;
            shape (N,). A failed simulation is NaN in what is computed of it, which a comparison, an `argmax` or a
            `where` turns into a number: return the trajectory as well, or `jnp.where(run.result == 0, value, jnp.nan)`.
        batch_size: designs computed at once.
        compile_seconds, run_seconds: wall time of tracing and compilation, and of the batches [s].
    """

    designs: PyTree
    values: PyTree
    ok: np.ndarray
    batch_size: int
    compile_seconds: float
    run_seconds: float

    __repr__ = brief

    def design(self, index: int) -> PyTree:
        """One design. `fn(found.design(i))` on its own raises what a failed one has to say, with step and advice."""
        return jax.tree.map(lambda leaf: leaf[index], self.designs)

    def variables(self) -> dict[str, Any]:
        """The result as `xarray.Dataset.from_dict` takes it: dimension "design", designs as coordinates.

        A leaf is named by its path, `bodies.top.mass`; a design that is one array "x", a value that is one array
        "value"; "ok" is the mask, and a value of that name "value.ok". Where a design and a value share a name, the
        design's is prefixed by "design.".
        """

        def entries(tree, root, taken, prefix):
            named = [(leaf_name(path, root), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]
            return {prefix + name if name in taken else name: leaf for name, leaf in named}

        def variable(name, leaf):
            return {"dims": ("design", *(f"{name}_{axis}" for axis in range(leaf.ndim - 1))), "data": leaf}

        values = entries(self.values, "value", {"ok"}, "value.") | {"ok": self.ok}
        designs = entries(self.designs, "x", values, "design.")
        return {
            "coords": {name: variable(name, leaf) for name, leaf in designs.items()},
            "data_vars": {name: variable(name, leaf) for name, leaf in values.items()},
            "dims": {"design": len(self.ok)},
        }

    def to_xarray(self) -> Any:
        """An `xarray.Dataset` of `variables`; its `to_netcdf` writes a file.

        Raises `ImportError` if xarray is not installed (`pip install "lgsens[data]"`).
        """
        return optional("xarray", "to_xarray").Dataset.from_dict(self.variables())


def sweep(
    fn: Callable[[PyTree], PyTree],
    designs: PyTree,
    *,
    batch_size: int | None = None,
    folder: str | os.PathLike | None = None,
    devices: Sequence[Any] | None = None,
    progress: bool = True,
) -> SweepResult:
    """Evaluate a function of one design for each of N designs, in compiled batches over all devices.

    Arguments:
        fn: design ↦ a pytree of arrays, traced once: a criterion, `jax.value_and_grad` of one, a `Trajectory`. It is
            what it is for one design; a simulation in it that fails gives NaN here instead of raising.
        designs: a pytree whose arrays have a leading axis N (a `Model` made under `jax.vmap` is one), or a list of N
            pytrees of one structure.
        batch_size: the most designs computed at once, on all devices together; rounded up to a multiple of their
            number. None: per CPU device as many as carry 2 MiB around their loops, at most 256, since larger batches
            leave its caches; 8192 per other device; and no more than fit into half of the memory that is free.
        folder: where to keep the results as they come, a folder of `.npy` files. If it is there already, with the same
            designs, the sweep continues where it stopped; the arrays of the result are then mapped from its
            files. To recognize the results of another `fn`, one of its designs is computed again. None: in memory.
        devices: what to compute on. None: all devices, of all processes under `jax.distributed`; every process calls
            `sweep` with the same designs and gets all results, the first one writes the folder. A CPU is one device:
            `jax.config.update("jax_num_cpu_devices", n)` before any computation gives it n.
        progress: say what is compiled, and show a bar, if tqdm is installed (`pip install "lgsens[plot]"`).

    Every batch has the same size (the last one is filled up), so there is one compilation; it takes a second one
    only where memory asks for smaller batches. A design that fails, one with a value that is not finite, is marked in
    `SweepResult.ok` and leaves the others alone.

    Raises `ValueError` for designs without arrays or of different lengths, a `fn` that returns no array, a bad
    `batch_size`, no devices, and a folder of another sweep.
    """
    designs, count = as_designs(designs)
    batch_size = None if batch_size is None else as_count(batch_size, "batch_size")
    if not isinstance(devices, Sequence | np.ndarray | None):
        raise ValueError(f"`devices` must be some of `jax.devices()`, such as jax.devices()[:2], got {devices!r}.")
    devices = jax.devices() if devices is None else list(devices)
    if not devices:
        raise ValueError("`devices` is empty; leave it out for all of `jax.devices()`.")
    traced = trace(fn, designs)
    first = jax.process_index() == 0
    store = in_memory(traced.shapes, count)
    if folder is not None and first:
        store = in_folder(Path(folder), designs, traced.shapes, count)
    if jax.process_count() > 1:  # all go on from the store of the first, whose alone may be a folder
        agreed = multihost_utils.broadcast_one_to_all(tuple(store))
        store = store if first else Store(*jax.tree.map(np.array, agreed))

    done = np.flatnonzero(store.done)
    again = done[np.argsort(~store.ok[done], kind="stable")][:1]  # a design that succeeded, if one did
    rows = np.concatenate([again, np.flatnonzero(~store.done)])
    with compiling("a batch of designs", progress and first):
        program = compile_batch(traced, designs, len(rows), batch_size, devices)
    started = time.perf_counter()
    with progress_bar(count, "design", progress and first, initial=len(done)) as bar:
        for start in range(0, len(rows), program.size):
            own = rows[start : start + program.size]
            filled = np.concatenate([own, np.repeat(own[-1:], program.size - len(own))])
            values, ok = program.run([leaf[filled] for leaf in jax.tree.leaves(designs)])
            if start == 0 and len(again):
                _check_again(folder, int(again[0]), store, values, bool(ok[0]))
            new = slice(len(again) if start == 0 else 0, len(own))
            store.write(own[new], [leaf[new] for leaf in values], ok[new])
            bar.update(new.stop - new.start)
    return SweepResult(
        designs=designs,
        values=jax.tree.unflatten(jax.tree.structure(traced.shapes), store.values),
        ok=store.ok,
        batch_size=program.size,
        compile_seconds=traced.seconds + program.seconds,
        run_seconds=time.perf_counter() - started,
    )


def as_designs(designs: PyTree) -> tuple[PyTree, int]:
    """The designs as a pytree of NumPy arrays with a leading axis, and its length."""
    if isinstance(designs, list) and designs:
        structures = [jax.tree.structure(design) for design in designs]
        for i, structure in enumerate(structures):
            if structure != structures[0]:
                raise ValueError(f"`designs[{i}]` must be a pytree like the first, {structures[0]}, got {structure}.")
        try:
            designs = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *designs)
        except ValueError as error:
            raise ValueError(f"`designs` must have arrays of the same shapes: {error}.") from error
    arrays = jax.tree_util.tree_map_with_path(_as_array, designs)
    leaves = jax.tree_util.tree_leaves_with_path(arrays)
    if not leaves:
        raise ValueError("`designs` has no arrays; give a pytree with a leading axis over the designs.")
    lengths = {leaf_name(path, "x"): leaf.shape[0] for path, leaf in leaves}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"`designs` must have one leading axis, the same for all arrays; its lengths are {lengths}.")
    (count,) = set(lengths.values())
    if count == 0:
        raise ValueError("`designs` is empty; give at least one design.")
    return arrays, count


def _as_array(path, leaf) -> np.ndarray:
    array = np.asarray(leaf)
    name = leaf_name(path, "x")
    if array.dtype.kind not in "fiub":
        raise ValueError(f"`designs`: {name} must be an array of numbers, got {leaf!r}.")
    if array.ndim == 0:
        raise ValueError(
            f"`designs`: {name} must have a leading axis over the designs, got the number {leaf}. A list is a tree of "
            "numbers here: give an array, `jnp.array([…])`."
        )
    return array.astype(jax.dtypes.canonicalize_dtype(array.dtype))


def _check_again(folder, row: int, store: Store, values: list[np.ndarray], ok: bool) -> None:
    """Design `row` as it is in the folder, and as it was computed just now.

    They are equal to the round-off of another batch size; half of the digits leave room for that to grow in a motion.
    """
    same = bool(store.ok[row]) == ok
    if ok:
        for array, new in zip(store.values, values):
            if new.dtype.kind == "f":  # counts of iterations may differ
                tolerance = np.sqrt(np.finfo(new.dtype).eps) * np.abs(new[0]).max(initial=0.0)
                same = same and np.allclose(array[row], new[0], rtol=0, atol=tolerance)
    if not same:
        raise ValueError(
            f"`folder` {str(folder)!r} holds the results of another `fn`: design {row} has other values there. Name "
            "another folder, or delete this one."
        )
