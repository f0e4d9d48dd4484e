"""One search from many starts, compiled once, in batches over all devices."""

import os
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from lgsens._validate import as_count
from lgsens.optimize._augmented_lagrangian import NOT_YET
from lgsens.optimize._box import checked_box
from lgsens.optimize._minimize import REASONS, Problem, prepared
from lgsens.sweeps import as_designs, sweep


class MultiStartResult(NamedTuple):
    """The outcome of `multi_start`; NumPy arrays with a leading axis over the starts.

    Attributes:
        starts: where the searches began.
        x: where they ended, as `OptimizationResult.x`.
        objective, worst_constraint: f and max g there, shape (n,).
        feasible: whether max g ≤ constraint_tolerance, shape (n,).
        reason: why each ended, as `OptimizationResult.reason`; strings, shape (n,).
        steps: evaluations that each took, shape (n,).
        best: the index of the best of them: the lowest objective of the feasible ones, or else the least violation.
        compile_seconds, run_seconds: wall time of the compilation and of the searches [s].
    """

    starts: PyTree
    x: PyTree
    objective: np.ndarray
    worst_constraint: np.ndarray
    feasible: np.ndarray
    reason: np.ndarray
    steps: np.ndarray
    best: int
    compile_seconds: float
    run_seconds: float


def multi_start(
    fun: Problem,
    starts: int | PyTree,
    *,
    lower: PyTree,
    upper: PyTree,
    num_steps: int,
    log_scale: PyTree = False,
    tolerance: float = 1e-5,
    constraint_tolerance: float = 1e-3,
    forward: bool | None = None,
    seed: int = 0,
    progress: bool = True,
    batch_size: int | None = None,
    folder: str | os.PathLike | None = None,
) -> MultiStartResult:
    """`minimize` from many starts: where f has several minima, the best of those that are found.

    Arguments:
        fun, lower, upper, num_steps, log_scale, tolerance, constraint_tolerance, forward: as of `minimize`; the bounds
            have the shapes of x, unless `starts` shows them.
        starts: a number of random ones, uniform between the bounds (in the logarithm, where `log_scale`), or designs as
            `sweep` takes them.
        seed: of the random ones.
        progress, batch_size, folder: as of `lgsens.sweep`, which runs the searches: compiled once, in batches over all
            devices, and with a folder not lost when the process dies. The searches of a batch last as long as its
            longest: on one thread 16 of stiffness and damping took 88 s, one after another 69 s, SLSQP 54 s
            (`benchmarks/results/multi_start.json`). Not measured on a GPU.

    A start where f, g or the gradient is not finite ends as "stalled", with objective NaN, and leaves the others
    alone. Raises `ValueError` as `minimize` and `sweep`.
    """
    num_steps = as_count(num_steps, "num_steps")
    if isinstance(starts, int):
        count = as_count(starts, "starts")
        # Any point will do to learn shapes and bounds.
        x, unravel, box = checked_box(lower, lower, upper, log_scale)
        z = jax.random.uniform(jax.random.key(seed), (count, x.size), x.dtype)
        starts = jax.vmap(lambda z: unravel(box.value(z)))(z)
    else:
        starts, count = as_designs(starts)
        for i in range(count):
            x, unravel, box = checked_box(jax.tree.map(lambda leaf, i=i: leaf[i], starts), lower, upper, log_scale)
    begin, step, _ = prepared(fun, x, unravel, box, (tolerance, constraint_tolerance), forward)

    def search(x0: PyTree) -> dict[str, Any]:
        running = lambda carry: (carry.search.ended == NOT_YET) & (carry.search.step < num_steps)
        ended = jax.lax.while_loop(running, lambda carry: step(carry)[0], begin(ravel_pytree(x0)[0])).search
        best = ended.best
        return {
            "x": unravel(box.value(best.z)),
            "objective": jnp.where(jnp.isfinite(best.objective), best.objective, jnp.nan),
            "worst": best.worst,
            "ended": ended.ended,
            "steps": ended.step,
        }

    swept = sweep(search, starts, batch_size=batch_size, folder=folder, progress=progress)
    found = swept.values
    feasible = np.asarray(found["worst"] <= constraint_tolerance)
    order = np.lexsort(
        (np.where(feasible, found["objective"], found["worst"]), ~feasible, np.isnan(found["objective"]))
    )
    return MultiStartResult(
        starts=swept.designs,
        x=found["x"],
        objective=found["objective"],
        worst_constraint=found["worst"],
        feasible=feasible,
        reason=np.asarray(REASONS)[found["ended"]],
        steps=found["steps"],
        best=int(order[0]),
        compile_seconds=swept.compile_seconds,
        run_seconds=swept.run_seconds,
    )
