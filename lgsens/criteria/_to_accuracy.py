"""`differentiate` to an accuracy of values and gradients."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from lgsens.dynamics import RESULTS
from lgsens.integrate import AbstractIntegrator, Steps
from lgsens.simulation import Compared, Reached, richardson, to_accuracy

_LEFT = 3  # the order of what three runs of generalized-α leave
_SAFETY = 2.0
_PARTS = (5, 6)  # of eight: of the steps


def differentiate_to(
    run: Callable[[int, bool], Any],
    accuracy: float,
    integrator: AbstractIntegrator,
    fewest: int | None,
    *,
    extrapolate: bool,
) -> Any:
    """The `Sensitivities` that have it, with `reached`; `run`: number of steps, whether to raise ↦ `Sensitivities`."""

    def extrapolated(runs):
        each = iter([found[:2] for found in runs])
        value, gradient = richardson(lambda _: next(each), 1, len(runs)).value
        return runs[-1]._replace(value=value, gradient=gradient)

    run = functools.cache(run)
    several = extrapolate and integrator.scheme.convergence_order == 2
    compared = Compared(_distance, extrapolated, 3 if several else 1, best=True)
    found, reached = to_accuracy(run, compared, accuracy, integrator, fewest)
    found, reached = _in_less_work(run, compared, found, reached)
    return found._replace(reached=reached)


def _in_less_work(run, compared: Compared, found, reached: Reached) -> tuple[Any, Reached]:
    """The cheapest of the settings that have the accuracy too, as what was found tells in the end: their error is their
    distance D from that, and its own. In loops this setting is taken again and again, so five and six eighths of its
    steps are tried as well, unless a program were compiled for them.

    What is known of three runs is the error that half the steps have. Parts of the steps tell more: of errors that fall
    as h³, or faster, D/((n/m)³ − 1) are left in n steps, m the fewer ones; twice that is believed where it is less."""

    def own_error(setting: Reached, distance: float) -> float:
        ratio = reached.num_steps / setting.num_steps
        if setting.runs < 3 or reached.runs < 3 or ratio >= 2.0:
            return reached.error
        return min(reached.error, _SAFETY * distance / (ratio**_LEFT - 1.0))

    def accurate(setting: Reached) -> tuple[Any, Reached] | None:
        runs = [run(n, False) for n in setting.numbers]
        if any(int(one.result) != RESULTS.successful for one in runs):
            return None
        result = compared.extrapolated(runs) if setting.extrapolated else runs[0]
        distance = _distance(result, found)
        setting = setting._replace(error=distance + own_error(setting, distance))
        return (result, setting) if setting.error <= reached.asked else None

    work = lambda setting: sum(setting.numbers)
    numbers = [n for n, _ in reached.tried]
    every = [
        reached._replace(num_steps=n, runs=k + 1)
        for i, n in enumerate(numbers)
        for k in range(min(i + 1, compared.runs))
    ]
    less = sorted((setting for setting in every if work(setting) < work(reached)), key=work)
    best = next((one for setting in less if (one := accurate(setting)) is not None), (found, reached))
    setting = best[1]
    room = lambda n: Steps.of(n, float).room
    order: Any = (reached.integrator.scheme.convergence_order, 4)[min(setting.runs, 2) - 1]
    for part in _PARTS:
        fewer = setting._replace(num_steps=part * setting.num_steps // 8)
        divided = all(part * n % 8 == 0 for n in setting.numbers)
        compiled = divided and set(map(room, fewer.numbers)) <= set(map(room, numbers))
        hopeful = setting.runs == 3 or (8 / part) ** order * setting.error <= reached.asked
        if compiled and hopeful and (one := accurate(fewer)) is not None:
            return one
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
    return float(change / size) if size > 0.0 else float(change != 0.0)  # NaN is no answer that is reached
