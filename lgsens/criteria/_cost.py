"""What value and gradient cost on a scene, measured."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from lgsens._progress import progress_bar
from lgsens._validate import as_count
from lgsens.criteria._advice import TYPICAL, Costs
from lgsens.criteria._criterion import Criterion
from lgsens.criteria._differentiate import differentiate
from lgsens.sensitivity import AdjointVariable, DirectDifferentiation
from lgsens.simulation import simulate


def median_seconds(*functions: Callable[[], Any], repeats: int = 5, progress: bool = False) -> list[float]:
    """The wall time of each call, the median of several rounds in which they take turns, after one that compiles."""
    taken: list[list[float]] = [[] for _ in functions]
    with progress_bar((1 + repeats) * len(functions), "call", progress) as bar:
        for turn in range(1 + repeats):
            bar.set_postfix({"": "timing" if turn else "compiling"})
            for function, times in zip(functions, taken):
                started = time.perf_counter()
                jax.block_until_ready(function())
                if turn:
                    times.append(time.perf_counter() - started)
                bar.update()
    return [statistics.median(times) for times in taken]


def measure_costs(
    criteria: PyTree,
    build: Callable[[Any], Any],
    p: PyTree,
    *,
    repeats: int = 5,
    progress: bool = True,
    **settings: Any,
) -> Costs:
    """The costs of the direct and of the adjoint variable method on a scene, for `direct_or_adjoint`.

    Arguments:
        criteria, build, p: as in `differentiate`.
        repeats: timed calls of each kind, after one that compiles; the median counts.
        progress: show a bar, where tqdm is installed.
        settings: t0, t1, num_steps, integrator, as in `differentiate`.

    Each method runs with all parameters and criteria and with one; the difference is the cost of each further one.
    Where the noise of the machine is larger than that difference, or there is but one, the share of `TYPICAL` counts: a
    further parameter or criterion that seems to cost nothing would decide every choice. Times are divided by that of
    `simulate` with the same settings, compiled. Raises as `differentiate`.
    """
    repeats = as_count(repeats, "repeats")
    leaves = jax.tree.leaves(criteria, is_leaf=lambda leaf: isinstance(leaf, Criterion))
    flat, unravel = ravel_pytree(p)

    gradient = lambda method, *of: lambda: differentiate(*of, method=method, **settings).gradient
    with_first = lambda first: unravel(flat.at[0].set(first))
    of_first = lambda function: function and (lambda s, first: function(s, with_first(first)))
    one = tuple(Criterion(of_first(c.integrand), of_first(c.terminal)) for c in leaves)
    forward = jax.jit(lambda p: simulate(build(p), throw=False, **settings).states)
    direct, adjoint = DirectDifferentiation(), AdjointVariable()
    unit, *times = median_seconds(
        lambda: forward(p),
        gradient(direct, criteria, build, p),
        gradient(direct, one, lambda first: build(with_first(first)), flat[0]),
        gradient(adjoint, criteria, build, p),
        gradient(adjoint, leaves[0], build, p),
        repeats=repeats,
        progress=progress,
    )
    direct_all, direct_one, adjoint_all, adjoint_one = (seconds / unit for seconds in times)

    def share(difference: float, others: int, typical: float) -> float:
        return difference / others if others > 0 and difference > 0.0 else typical

    per_parameter = share(direct_all - direct_one, flat.size - 1, TYPICAL.direct_per_parameter)
    per_criterion = share(adjoint_all - adjoint_one, len(leaves) - 1, TYPICAL.adjoint_per_criterion)
    return Costs(
        direct_fixed=direct_all - per_parameter * flat.size,
        direct_per_parameter=per_parameter,
        adjoint_fixed=adjoint_all - per_criterion * len(leaves),
        adjoint_per_criterion=per_criterion,
    )
