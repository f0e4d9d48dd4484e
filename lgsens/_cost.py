"""What value and gradient cost on a scene, measured."""

import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from lgsens._advice import Costs
from lgsens._differentiate import differentiate
from lgsens._simulate import simulate
from lgsens._validate import as_count
from lgsens.criteria import Criterion
from lgsens.sensitivity import AdjointVariable, DirectDifferentiation


def median_seconds(function: Callable[[], Any], repeats: int = 5) -> float:
    """The wall time of a call, the median of several after one that compiles."""
    jax.block_until_ready(function())
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(function())
        taken.append(time.perf_counter() - started)
    return statistics.median(taken)


def measure_costs(
    criteria: PyTree, build: Callable[[Any], Any], p: PyTree, *, repeats: int = 5, **settings: Any
) -> Costs:
    """The costs of the direct and of the adjoint variable method on a scene, for `direct_or_adjoint`.

    Arguments:
        criteria, build, p: as in `differentiate`.
        repeats: timed calls of each kind, after one that compiles; the median counts.
        settings: t0, t1, num_steps, integrator, as in `differentiate`.

    Each method runs with all parameters and criteria and with one; the difference is the cost of each further one.
    Times are divided by that of `simulate` with the same settings, compiled. Raises as `differentiate`.
    """
    repeats = as_count(repeats, "repeats")
    leaves = jax.tree.leaves(criteria, is_leaf=lambda leaf: isinstance(leaf, Criterion))
    flat, unravel = ravel_pytree(p)

    seconds = partial(median_seconds, repeats=repeats)

    def gradient(method, criteria, build, p) -> float:
        return seconds(lambda: differentiate(criteria, build, p, method=method, **settings).gradient)

    def with_first(first):
        return unravel(flat.at[0].set(first))

    def of_first(function):
        return None if function is None else lambda s, first: function(s, with_first(first))

    one = tuple(Criterion(of_first(c.integrand), of_first(c.terminal)) for c in leaves)
    build_one = lambda first: build(with_first(first))

    forward = jax.jit(lambda p: simulate(build(p), throw=False, **settings).states)
    unit = seconds(lambda: forward(p))
    direct, adjoint = DirectDifferentiation(), AdjointVariable()
    direct_all = gradient(direct, criteria, build, p) / unit
    direct_one = gradient(direct, one, build_one, flat[0]) / unit if flat.size > 1 else direct_all
    adjoint_all = gradient(adjoint, criteria, build, p) / unit
    adjoint_one = gradient(adjoint, leaves[0], build, p) / unit if len(leaves) > 1 else adjoint_all
    per_parameter = max(direct_all - direct_one, 0.0) / max(flat.size - 1, 1)
    per_criterion = max(adjoint_all - adjoint_one, 0.0) / max(len(leaves) - 1, 1)
    return Costs(
        direct_fixed=direct_all - per_parameter * flat.size,
        direct_per_parameter=per_parameter,
        adjoint_fixed=adjoint_all - per_criterion * len(leaves),
        adjoint_per_criterion=per_criterion,
    )
