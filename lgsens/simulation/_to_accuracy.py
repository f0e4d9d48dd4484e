"""As many steps as an accuracy takes: the number of steps is doubled until the runs say that it is reached.

Let ψ_n be what a scheme of order p computes in n equal steps, and d_n = |ψ_n − ψ_{n/2}| the distance of two such runs.
Errors that fall as n^(−p) have d_{n/2}/d_n = r → 2^p, and the error of the finer run is

    |ψ_n − ψ| ≈ d_n/(r − 1).

The r of the runs is used, where it is below 2^p: at a kink or an edge of a road between two times orders fall to one,
r to 2, and the estimate grows as it should. A single ratio may be an accident of coarse steps: below 0.7 · 2^p it is
believed if the one before says the same, and above 1.5 · 2^p the error is taken to be d_n. Without that nothing is
claimed, and more steps are taken.

Where runs are clearly of second order, three of them also give two that are extrapolated (`_richardson`), χ_n = ψ_n +
(ψ_n − ψ_{n/2})/3. The error of the finer one is taken to be their distance e_n = |χ_n − χ_{n/2}|, which smooth motions
have 15 times better: at an edge between two times what extrapolation leaves changes its size from run to run. Where a
fourth run shows that it does not, r = e_{n/2}/e_n is clearly 2⁴ and the order of the runs was clear before too, the
error is taken to be 2 e_n/(r − 1), twice what the order says. Then h⁴ may be removed as well, ω_n = χ_n + (χ_n −
χ_{n/2})/15, whose error is taken to be |ω_n − ω_{n/2}|: as large as r is off 2⁴. What no run sees, an event shorter
than all steps, is in no estimate.

In single precision the round-off of a run, which grows like n², may hide that errors fall at all. If no number of steps
has shown it, the run is taken that is nearest to both of its neighbours, ψ_{n/2} and ψ_{2n}, and twice the larger of
its distances from them is its error.

Sources: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.4 and §II.9; Roache,
Verification and validation in computational science and engineering (1998), §5 (observed order of convergence).
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lgsens.dynamics import RESULTS, AbstractSystem, State
from lgsens.integrate import MANY, AbstractIntegrator, AlignedSteps, piece_lengths, undivided
from lgsens.simulation._errors import SimulationError, primal_value
from lgsens.simulation._reached import Reached
from lgsens.simulation._richardson import Richardson, extrapolate_runs
from lgsens.simulation._settings import check_accuracy, interval
from lgsens.simulation._trajectory import Trajectory

_FEWEST = 64
_MOST = 2**17  # what a trajectory of a car keeps of them is 0.2 GB
_MOST_SINGLE = 2**13  # in single precision: changes of a pendulum do not fall any more from 2048 steps on
_CLEAR = (0.7, 1.5)  # of 2^p
_SAFETY = 2.0  # of what the order of extrapolated runs says
_LEAST = 1.4  # below that runs do not converge
_COARSE = (RESULTS.newton_failed, RESULTS.turn_not_resolved, RESULTS.singular_configuration)  # more steps may help


class Compared(NamedTuple):
    """How results of runs in more and more steps are compared.

    Attributes:
        distance: of a result from a finer one, relative as the accuracy is.
        extrapolated: of two or three results, each in twice as many steps as the one before.
        runs: the most that are extrapolated, 3 at most; 1: none are.
        best: whether of results that are accurate enough that with the least error is taken, not the first.
    """

    distance: Callable[[Any, Any], float]
    extrapolated: Callable[[Sequence[Any]], Any]
    runs: int = 3
    best: bool = False


def to_accuracy(
    run: Callable[[int, bool], Any],
    compared: Compared,
    accuracy: float,
    integrator: AbstractIntegrator,
    fewest: int | None = None,
) -> tuple[Any, Reached]:
    """What `run` gives where it is accurate enough, and how it got there.

    Arguments:
        run: number of steps, whether to raise if it fails ↦ a result with `result`, a value of `RESULTS`.
        compared: its results, with each other.
        accuracy: the largest error.
        integrator: the scheme in its steps, of order p.
        fewest: the first number of steps.

    Raises `SimulationError` if it is not reached.
    """
    n, results, tried, middle = fewest or _FEWEST, [], [], []
    single = jnp.result_type(float) == jnp.float32
    most = max(_MOST_SINGLE if single else _MOST, 8 * n)
    while n <= most:
        found = run(n, n > most // 8 and not tried)  # a scene that fails in any number of steps says why
        if int(found.result) == RESULTS.successful:
            results = [*results[-3:], found]
            tried.append((n, compared.distance(*results[-2:]) if len(results) > 1 else np.inf))
            reached = _reached(results, tried, compared, accuracy, integrator)
            if reached is not None:
                return reached
            if single and len(results) > 2:
                middle.append((_SAFETY * max(distance for _, distance in tried[-2:]), n // 2, results[-2]))
        elif int(found.result) in _COARSE:
            results = []
        else:
            run(n, True)
        n *= 2
    error, number, result = min(middle, key=lambda one: one[0], default=(np.inf, n, None))
    if error <= accuracy:
        return result, Reached(accuracy, error, number, 1, integrator, tuple(tried))
    last = ", ".join(f"{n}: {distance:.2e}" for n, distance in tried[-4:])
    raise SimulationError(
        f"`accuracy` = {accuracy:g} is not reached in {tried[-1][0]} steps. Steps and change from the run before: "
        f"{last}. Changes that do not fall are those of a chaotic motion, of forces that jump, or of round-off"
        + (" (this is single precision; set `jax_enable_x64`)" if single else "")
        + ": ask for less, shorten the run, or see `lgsens.certify`."
    )


def _reached(results, tried, compared: Compared, accuracy: float, integrator) -> tuple[Any, Reached] | None:
    """The result that is accurate enough, if there is one."""
    distances = [d for _, d in tried if np.isfinite(d)]
    if len(results) < 3 or len(distances) < 2:
        return None
    levels = _levels(results, distances, compared, integrator.scheme.convergence_order)
    enough = ((error, runs, result) for runs, (result, error) in enumerate(levels, 1) if error <= accuracy)
    one = min(enough, key=lambda one: one[0], default=None) if compared.best else next(enough, None)
    if one is None:
        return None
    error, runs, result = one
    return result, Reached(accuracy, float(error), tried[-1][0], runs, integrator, tuple(tried))


def _levels(results, distances, compared: Compared, order: int) -> Iterator[tuple[Any, float]]:
    """The results of one run, of two and of three, as far as they can be trusted, and their errors."""
    *_, before, last = distances
    ratio = before / last if last > 0.0 else np.inf
    if not ratio > _LEAST:
        return
    clear = _clear(ratio, order)
    if ratio < _CLEAR[0] * 2.0**order:
        earlier = distances[-3] / before if len(distances) > 2 else 0.0
        if earlier < _LEAST:
            return
        ratio = min(ratio, earlier)
    yield results[-1], last / (min(ratio, 2.0**order) - 1.0) if ratio <= _CLEAR[1] * 2.0**order else last
    if compared.runs < 2 or not clear:
        return
    coarse, fine = map(compared.extrapolated, itertools.pairwise(results[-3:]))
    error, clear = compared.distance(coarse, fine), False
    if len(results) > 3 and _clear(distances[-3] / before, order) and error > 0.0:
        ratio = compared.distance(compared.extrapolated(results[:2]), coarse) / error
        clear = _clear(ratio, 4)
        error = _SAFETY * error / (min(ratio, 2.0**4) - 1.0) if clear else error
    yield fine, error
    if compared.runs < 3 or not clear:
        return
    coarse, fine = compared.extrapolated(results[:3]), compared.extrapolated(results[1:])
    yield fine, compared.distance(coarse, fine)


def _clear(ratio: float, order: int) -> bool:
    """Whether distances that fall by this ratio are those of the order."""
    return _CLEAR[0] <= ratio / 2.0**order <= _CLEAR[1]


def simulate_to(simulate: Callable[..., Any], accuracy, model, num_steps: int | None, settings: dict) -> Trajectory:
    """`simulate` with `accuracy`: the numbers without derivatives decide, and the run with them follows."""
    check_accuracy(accuracy, num_steps, settings["integrator"], (model, settings))
    fixed, at = jax.tree.map(primal_value, (model, settings))
    integrator, fewest = aligned(settings["integrator"], fixed, at["t0"], at["t1"], num_steps)
    settings, at = settings | {"integrator": integrator}, at | {"integrator": integrator}

    def distance(coarse: Trajectory, fine: Trajectory) -> float:
        """The largest change of a configuration and of a velocity at common times, as `accuracy` is."""
        system, stride = coarse.system, (fine.t.shape[0] - 1) // (coarse.t.shape[0] - 1)
        return float(_distance(system, coarse.states, jax.tree.map(lambda leaf: leaf[::stride], fine.states)))

    run = lambda n, throw: simulate(fixed, num_steps=n, throw=throw, **at)
    extrapolated = lambda two: extrapolate_runs(two[0].system, *two)
    compared = Compared(distance, extrapolated, 2 if integrator.scheme.convergence_order == 2 else 1)
    found, reached = to_accuracy(run, compared, float(accuracy), integrator, fewest)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((model, settings))):
        two = {"integrator": Richardson(integrator), "num_steps": reached.num_steps // 2}
        one = {"num_steps": reached.num_steps}
        found = simulate(model, **(settings | (two if reached.extrapolated else one)))
    return dataclasses.replace(found, reached=reached)


def aligned(integrator: AbstractIntegrator, scene: Any, t0, t1, fewest: int | None):
    """The integrator in steps that end at the breaks of the scene, and the first number of them. Both are as given
    where there are no breaks, or too many for that. (Equal steps that meet all breaks are not enough: they stay where
    these move, and derivatives by their times are of first order.)"""
    t0, t1 = interval(t0, t1)
    pieces = int(np.sum(np.asarray(piece_lengths(scene, t0, t1)) > 0.0))
    if integrator.equal_steps and not 1 < pieces <= MANY:
        return integrator, fewest
    return AlignedSteps(integrator.scheme), max(fewest or _FEWEST, int(undivided(pieces)))


@eqx.filter_jit
def _distance(system: AbstractSystem, coarse: State, fine: State):
    group, scale = system.group, system.coordinate_scale()
    w = jax.vmap(lambda q, other: group.log(group.compose(group.inverse(q), other)))(coarse.q, fine.q)
    largest = jnp.max(jnp.abs(fine.v) / scale[None])
    v = jnp.max(jnp.abs(fine.v - coarse.v) / scale[None])
    return jnp.maximum(jnp.max(jnp.abs(w) / scale[None]), jnp.where(largest > 0.0, v / largest, v))
