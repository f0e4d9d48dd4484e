"""`differentiate` to an accuracy of values and gradients."""

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

    how = extrapolated if extrapolate and integrator.scheme.convergence_order == 2 else None
    found, reached = to_accuracy(run, _distance, how, accuracy, integrator, fewest)
    found, reached = _in_fewer(run, extrapolated, found, reached)
    return found._replace(reached=reached)


def _in_fewer(run, extrapolated, found, reached: Reached) -> tuple[Any, Reached]:
    """Three quarters of the steps, where they have the accuracy too: their error is their distance from what was found,
    and the error of that. Numbers of steps are doubled in the search, and in loops the last one is taken again. Not where
    a program would be compiled for that."""
    n = 3 * reached.num_steps // 4
    order = 4 if reached.extrapolated else reached.integrator.scheme.convergence_order
    compiled = Steps.of(n, float).room == Steps.of(reached.num_steps, float).room
    if n % 4 or not compiled or (4 / 3) ** order * reached.error > reached.asked:
        return found, reached
    runs = [run(k, False) for k in ((n // 2, n) if reached.extrapolated else (n,))]
    if any(int(one.result) != RESULTS.successful for one in runs):
        return found, reached
    fewer = extrapolated(*runs) if reached.extrapolated else runs[0]
    apart = _distance(fewer, found)
    if apart + reached.error > reached.asked:
        return found, reached
    return fewer, reached._replace(error=apart + reached.error, num_steps=n, tried=(*reached.tried, (n, apart)))


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
