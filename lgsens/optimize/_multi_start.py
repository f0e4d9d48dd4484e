"""One search from many starts, compiled once."""

import os
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from lgsens._brief import brief
from lgsens._progress import compiling, progress_bar
from lgsens._validate import as_count
from lgsens.optimize import _reverse_steps, _slsqp
from lgsens.optimize._augmented_lagrangian import NOT_YET, REASONS
from lgsens.optimize._box import checked_box
from lgsens.optimize._checkpoint import Checkpoint
from lgsens.optimize._course import Course
from lgsens.optimize._minimize import checked_tolerances, prepared
from lgsens.optimize._problem import Problem
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

    __repr__ = brief


def multi_start(
    fun: Problem,
    starts: int | PyTree,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
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
        fun, lower, upper, num_steps, log_scale, tolerance, constraint_tolerance, forward: as of `minimize`; random
            `starts` need finite bounds of the shapes of x.
        starts: a number of random ones, uniform between the bounds (in the logarithm, where `log_scale`), or designs as
            `sweep` takes them.
        seed: of the random ones.
        progress: say what is compiled, and show a bar, if tqdm is installed.
        batch_size: as of `lgsens.sweep`, which runs the searches in reverse mode in batches over all devices, that last
            as long as their longest; in forward mode one search follows another.
        folder: keeps the searches, so that they go on when the process has died.

    A start where f, g or the gradient is not finite ends as "stalled", with objective NaN, and leaves the others
    alone. Raises `ValueError` as `minimize` and `sweep`.
    """
    num_steps = as_count(num_steps, "num_steps")
    if isinstance(starts, int | np.integer):
        count = as_count(starts, "starts")
        ends = jax.tree.leaves((lower, upper), is_leaf=lambda end: end is None)
        if not all(end is not None and np.all(np.isfinite(end)) for end in ends):
            raise ValueError(
                f"`starts`: {count} random designs need finite `lower` and `upper`; give them, or the designs."
            )
        x, unravel, box = checked_box(lower, lower, upper, log_scale)  # any point will do to learn shapes and bounds
        z = jax.random.uniform(jax.random.key(seed), (count, x.size), x.dtype)
        starts = jax.vmap(lambda z: unravel(box.value(z)))(z)
    starts, count = as_designs(starts)
    design = lambda i: jax.tree.map(lambda leaf: leaf[i], starts)
    x, unravel, box = checked_box(design(0), lower, upper, log_scale)
    xs = [x, *(checked_box(design(i), lower, upper, log_scale)[0] for i in range(1, count))]
    method, _ = prepared(fun, x, unravel, box, checked_tolerances(tolerance, constraint_tolerance), forward)
    if isinstance(method, _slsqp.Method):
        found, *seconds = _one_by_one(method, xs, num_steps, progress, folder)
    else:
        search = lambda x0: _searched(method, ravel_pytree(x0)[0], num_steps)
        swept = sweep(search, starts, batch_size=batch_size, folder=folder, progress=progress)
        found, *seconds = swept.values, swept.compile_seconds, swept.run_seconds
    feasible = np.asarray(found["worst"] <= constraint_tolerance)
    order = np.lexsort(
        (np.where(feasible, found["objective"], found["worst"]), ~feasible, np.isnan(found["objective"]))
    )
    return MultiStartResult(
        starts=starts,
        x=jax.tree.map(np.asarray, jax.vmap(unravel)(jnp.asarray(found["x"]))),
        objective=found["objective"],
        worst_constraint=found["worst"],
        feasible=feasible,
        reason=np.asarray(REASONS)[found["ended"]],
        steps=found["steps"],
        best=int(order[0]),
        compile_seconds=seconds[0],
        run_seconds=seconds[1],
    )


def _searched(method: _reverse_steps.Method, x: Array, num_steps: int) -> dict[str, Any]:
    """One search in a program."""
    running = lambda carry: (carry.search.ended == NOT_YET) & (carry.search.step < num_steps)
    ended = jax.lax.while_loop(running, lambda carry: method.one_step(carry)[0], method.start(x)).search
    best = ended.best
    return {
        "x": method.box.value(best.z),
        "objective": jnp.where(jnp.isfinite(best.objective), best.objective, jnp.nan),
        "worst": best.worst,
        "ended": ended.ended,
        "steps": ended.step,
    }


def _one_by_one(
    method: _slsqp.Method, xs: list[Array], num_steps: int, progress: bool, folder: str | os.PathLike | None
) -> tuple[dict[str, np.ndarray], float, float]:
    """What `_searched` would find from each x, and the seconds of compilation and of the searches."""
    started, found = time.perf_counter(), []
    with compiling("objective, constraints and their Jacobian", progress):
        method.compile(xs[0])
    compiled = time.perf_counter()
    with progress_bar(len(xs), "start", progress) as bar:
        for i, x in enumerate(xs):
            start = method.begin(x)
            path = None if folder is None else Path(folder) / f"start_{i}.npz"
            course = Course(start, num_steps, path and Checkpoint(path, method.box, x, method.tolerances))
            if not course.rows:
                course.add(*start)
            reason = method.go_on(course)
            best = course.rows[method.found(course).step]
            objective, worst = (best.objective, best.worst) if best.finite else (np.nan, np.inf)
            ended = REASONS.index(reason)
            found.append(
                {"x": best.x, "objective": objective, "worst": worst, "ended": ended, "steps": len(course.rows)}
            )
            bar.update()
    finished = time.perf_counter()
    return (
        {name: np.asarray([each[name] for each in found]) for name in found[0]},
        compiled - started,
        finished - compiled,
    )
