"""`differentiate` to an accuracy of values and gradients."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from lgsens.dynamics import RESULTS
from lgsens.integrate import AbstractIntegrator, Steps
from lgsens.simulation import Reached, richardson, to_accuracy


def differentiate_to(
    run: Callable[[int, bool], Any],
    accuracy: float,
    integrator: AbstractIntegrator,
    fewest: int | None,
    *,
    extrapolate: bool,
) -> Any:
    """The `Sensitivities` that have it, with `reached`; `run`: number of steps, whether to raise ↦ `Sensitivities`."""

    def extrapolated(coarse, fine):
        two = iter([coarse[:2], fine[:2]])
        value, gradient = richardson(lambda _: next(two), 1).value
        return fine._replace(value=value, gradient=gradient)

    run = functools.cache(run)
    how = extrapolated if extrapolate and integrator.scheme.convergence_order == 2 else None
    found, reached = to_accuracy(run, _distance, how, accuracy, integrator, fewest)
    found, reached = _in_less_work(run, how, found, reached)
    return found._replace(reached=reached)


def _in_less_work(run, extrapolated, found, reached: Reached) -> tuple[Any, Reached]:
    """The cheapest of the runs that have the accuracy too, as what was found tells in the end: their error is their
    distance from that, and its own. In loops this setting is taken again and again, so three quarters of its steps are
    tried as well, unless a program were compiled for them."""

    def accurate(n: int, two: bool) -> tuple[Any, Reached] | None:
        runs = [run(k, False) for k in ((n // 2, n) if two else (n,))]
        if any(int(one.result) != RESULTS.successful for one in runs):
            return None
        result = extrapolated(*runs) if two else runs[0]
        error = _distance(result, found) + reached.error
        now = reached._replace(error=error, num_steps=n, extrapolated=two)
        return (result, now) if error <= reached.asked else None

    work = lambda n, two: 1.5 * n if two else float(n)
    numbers = [n for n, _ in reached.tried]
    every = [(n, two) for n in numbers for two in (False, True) if not two or (extrapolated and n // 2 in numbers)]
    own = work(reached.num_steps, reached.extrapolated)
    less = sorted((setting for setting in every if work(*setting) < own), key=lambda setting: work(*setting))
    best = next((one for setting in less if (one := accurate(*setting)) is not None), (found, reached))
    n, two = best[1].num_steps, best[1].extrapolated
    compiled = n % 4 == 0 and Steps.of(3 * n // 4, float).room == Steps.of(n, float).room
    order: Any = 4 if two else reached.integrator.scheme.convergence_order
    if compiled and (4 / 3) ** order * best[1].error <= reached.asked:
        return accurate(3 * n // 4, two) or best
    return best


def _distance(coarse, fine) -> float:
    """The largest relative change of a value and of a gradient, the latter by its norm."""
    return max(map(_change, *map(_quantities, (coarse, fine))))


def _quantities(found) -> list[Any]:
    """All values, and the gradient of each."""
    values, structure = jax.tree.flatten(found.value)
    return [*map(np.ravel, values), *(ravel_pytree(part)[0] for part in structure.flatten_up_to(found.gradient))]


def _change(coarse, fine) -> float:
    size, change = np.linalg.norm(fine), np.linalg.norm(np.asarray(fine) - np.asarray(coarse))
    return float(change / size) if size > 0.0 else float(change > 0.0)
