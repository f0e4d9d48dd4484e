"""A function of one design as a program for a batch of them, spread over devices.

Every device works through its share of the batch on its own (`shard_map` of `vmap`): partitioned by the compiler
instead, the loops of the lanes would wait for each other across devices at every iteration of Newton.
"""

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.extend.core import jaxpr_as_fun
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from lgsens.dynamics import RESULTS
from lgsens.linear import many_runs, programs_in, tuned
from lgsens.simulation import Saved, Trajectory, failures_by_callback
from lgsens.sweeps._one_by_one import WAITS, one_by_one

AXIS = "designs"


class BatchProgram(NamedTuple):
    """A compiled batch.

    Attributes:
        run: the leaves of `size` designs ↦ the leaves of their values, and ok; NumPy arrays with a leading axis.
        size: designs in a batch.
        memory: what it needs on each device [bytes].
        seconds: wall time [s].
    """

    run: Callable[[list[np.ndarray]], tuple[list[np.ndarray], np.ndarray]]
    size: int
    memory: float
    seconds: float


def succeeded(values: PyTree) -> jax.Array:
    """Whether the values of one design are finite, and every `Trajectory` or `Saved` among them successful, of whose
    `stats` some are infinite where nothing was looked at."""
    is_run = lambda node: isinstance(node, Trajectory | Saved)
    parts = jax.tree.leaves(values, is_leaf=is_run)
    runs = [part for part in parts if is_run(part)]
    asked = [dataclasses.replace(part, stats=None) if is_run(part) else part for part in parts]
    floats = [leaf for leaf in jax.tree.leaves(asked) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    checks = [jnp.all(jnp.isfinite(leaf)) for leaf in floats] + [run.result == RESULTS.successful for run in runs]
    return jnp.all(jnp.stack(checks)) if checks else jnp.ones((), bool)


class Traced(NamedTuple):
    """A function of one design, traced: it is called no more, whatever the batches.

    Attributes:
        run: the leaves of a design ↦ the leaves of its values, and whether it succeeded as the last.
        shapes: the values of one design, a pytree of shapes and dtypes.
        bytes_per_turn: what a turn of its largest loop reads [bytes].
        seconds: wall time [s].
    """

    run: Callable[..., list[jax.Array]]
    shapes: PyTree
    bytes_per_turn: int
    seconds: float


def _bytes_per_turn(jaxpr: Any) -> int:
    """The bytes that a turn of the largest loop in a program reads: what it carries, and its share of what it scans."""
    largest = 0
    for equation in jaxpr.eqns:
        inner = list(programs_in(equation))
        if equation.primitive.name in ("scan", "while"):
            largest = max(largest, *(sum(v.aval.size * v.aval.dtype.itemsize for v in body.invars) for body in inner))
        largest = max([largest, *map(_bytes_per_turn, inner)])
    return largest


def trace(fn: Callable[[PyTree], PyTree], designs: PyTree) -> Traced:
    """`fn` for one of `designs`, with failures as NaN."""
    leaves, structure = jax.tree.flatten(designs)
    one = [jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype) for leaf in leaves]

    def single(*leaves):
        values = jax.tree.map(jnp.asarray, fn(jax.tree.unflatten(structure, leaves)))
        if not jax.tree.leaves(values):
            raise ValueError(f"`fn` must return at least one array, got {values!r}.")
        return values, succeeded(values)

    started = time.perf_counter()
    with failures_by_callback(False), many_runs():
        jaxpr, (shapes, _) = jax.make_jaxpr(single, return_shape=True)(*one)
    run = jaxpr_as_fun(jaxpr)
    return Traced(run, shapes, _bytes_per_turn(jaxpr.jaxpr), time.perf_counter() - started)


def compile_batch(
    traced: Traced, designs: PyTree, count: int, batch_size: int | None, devices: Sequence[Any]
) -> BatchProgram:
    """A batch of `designs`, of which `count` are to be computed, in batches of nearly equal size.

    Without `batch_size` the largest batch is compiled first and, if it takes more memory than is free, once more for
    as many as fit: memory grows in proportion to the batch.
    """
    mesh = Mesh(np.asarray(devices), (AXIS,))
    rows = PartitionSpec(AXIS)
    sharding = NamedSharding(mesh, rows)
    run_all = batched = jax.vmap(traced.run)
    if WAITS and len(devices) > 1 and devices[0].platform == "cpu":
        run_all = lambda *leaves: one_by_one(jax.make_jaxpr(batched)(*leaves))(*leaves)
    spread = jax.jit(jax.shard_map(run_all, mesh=mesh, in_specs=rows, out_specs=rows, check_vma=False))

    def compiled(size):
        shape = lambda leaf: jax.ShapeDtypeStruct((size, *leaf.shape[1:]), leaf.dtype, sharding=sharding)
        return spread.lower(*map(shape, jax.tree.leaves(designs))).compile()

    started = time.perf_counter()
    in_cache = min(tuned.LANES, max(1, tuned.LANE_CACHE // max(traced.bytes_per_turn, 1)))
    lanes = in_cache if devices[0].platform == "cpu" else tuned.LANES_ELSEWHERE
    size = even(count, batch_size or lanes * len(devices), len(devices))
    program = compiled(size)
    if batch_size is None:
        fits = free_memory(devices) * tuned.FREE_SHARE / max(memory(program), 1.0)
        if jax.process_count() > 1:  # all must agree on the size of a batch
            fits = float(np.min(multihost_utils.process_allgather(np.asarray(fits, np.float32))))
        if fits < 1.0 and size > len(devices):
            size = even(count, int(size * fits), len(devices))
            program = compiled(size)
    seconds = time.perf_counter() - started

    def run(batch):
        place = lambda leaf: jax.make_array_from_callback(leaf.shape, sharding, lambda index: leaf[index])
        found = program(*map(place, batch))  # on all processes' devices; all of it is wanted in each process
        alone = jax.process_count() == 1
        *values, ok = jax.device_get(found) if alone else multihost_utils.process_allgather(found, tiled=True)
        return [np.asarray(leaf) for leaf in values], np.asarray(ok)

    return BatchProgram(run, size, memory(program), seconds)


def even(count: int, largest: int, devices: int) -> int:
    """The size of batches for `count` designs: at most `largest`, as even as can be, a multiple of `devices`."""
    per_device = max(largest // devices, 1)
    shares = -(-count // devices)  # designs per device, rounded up
    batches = -(-shares // per_device)
    return devices * -(-shares // batches)


def memory(program: Any) -> float:
    """What a compiled program needs on each device [bytes]; 0 where the backend does not say."""
    stats = program.memory_analysis()
    if stats is None:
        return 0.0
    return float(stats.temp_size_in_bytes + stats.argument_size_in_bytes + stats.output_size_in_bytes)


def free_memory(devices: Sequence[Any]) -> float:
    """The memory that is free for each device [bytes]: its own, or a share of the machine's."""
    local = [device for device in devices if device.process_index == jax.process_index()]
    if not local:
        return np.inf
    stats = local[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return float(stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    return _host_memory() / len(local)


def _host_memory() -> float:
    """Free memory of the machine [bytes]; all of it where the system does not tell what is free."""
    info = Path("/proc/meminfo")
    for line in info.read_text(encoding="ascii").splitlines() if info.exists() else ():
        if line.startswith("MemAvailable:"):
            return 1024.0 * int(line.split()[1])
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return np.inf
