"""`differentiate` to an accuracy of values and gradients."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from lgsens.integrate import AbstractIntegrator
from lgsens.simulation import richardson, to_accuracy


def differentiate_to(
    run: Callable[[int, bool], Any],
    accuracy: float,
    integrator: AbstractIntegrator,
    fewest: int | None,
    *,
    extrapolate: bool,
) -> Any:
    """The `Sensitivities` that have it, with `reached`; `run`: number of steps, whether to raise ↦ `Sensitivities`."""

    def distance(coarse, fine) -> float:
        """The largest relative change of a value and of a gradient, the latter by its norm."""
        return max(map(_change, *map(_quantities, (coarse, fine))))

    def extrapolated(coarse, fine):
        two = iter([coarse[:2], fine[:2]])
        value, gradient = richardson(lambda _: next(two), 1).value
        return fine._replace(value=value, gradient=gradient)

    how = extrapolated if extrapolate and integrator.scheme.convergence_order == 2 else None
    found, reached = to_accuracy(run, distance, how, accuracy, integrator, fewest)
    return found._replace(reached=reached)


def _quantities(found) -> list[Any]:
    """All values, and the gradient of each."""
    values, structure = jax.tree.flatten(found.value)
    return [*map(np.ravel, values), *(ravel_pytree(part)[0] for part in structure.flatten_up_to(found.gradient))]


def _change(coarse, fine) -> float:
    size, change = np.linalg.norm(fine), np.linalg.norm(np.asarray(fine) - np.asarray(coarse))
    return float(change / size) if size > 0.0 else float(change > 0.0)
