"""`steps_for`: steps placed where they serve a criterion and its gradient."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from lgsens._brief import brief
from lgsens._validate import as_count, as_parameters, is_concrete
from lgsens.criteria._criterion import Criterion
from lgsens.criteria._defect_density import Densities, defect_densities
from lgsens.criteria._differentiate import differentiate
from lgsens.criteria._placed_steps import Placed, placed_steps
from lgsens.dynamics import RESULTS, State
from lgsens.integrate import AbstractScheme, GeneralizedAlpha, GivenSteps
from lgsens.simulation import interval, raise_if_failed

_LEAST_STEPS = 8
_LONGEST = 3  # steps of the pilot
_TRIED = (8, _LONGEST, 1)  # with a tolerance: longer than `_LONGEST` must be confirmed, others must not fail
_KNOWN = 0.1  # of the errors of the pilot, to which these are known
_UNRESOLVED = 0.5  # relative error of a pilot run whose estimates are worth nothing
_UNCANCELLED = 0.03  # of what adds up regardless of signs: these are known to leading order, of the pilot's motion
_MOST = 100_000


class PlacedSteps(NamedTuple):
    """Steps for criteria, and the errors that are expected with them.

    Attributes:
        integrator: the steps, `GivenSteps`.
        value_error: the expected error of each Ψ relative to it, a pytree as the criteria, leaves of shape ().
        gradient_error: that of each dΨ/dp by its norm, relative to it, as `value_error`.
    """

    integrator: GivenSteps
    value_error: PyTree
    gradient_error: PyTree

    @property
    def num_steps(self) -> int:
        return self.integrator.num_steps

    __repr__ = brief


def steps_for(
    criteria: PyTree,
    build: Callable[[Any], Any],
    p: PyTree,
    *,
    t0=0.0,
    t1,
    pilot: int,
    tolerance: float | None = None,
    num_steps: int | None = None,
    integrator: AbstractScheme = GeneralizedAlpha(),
    state0: Callable[[Any], State] | None = None,
) -> PlacedSteps:
    """Steps for a criterion: as few as give Ψ **and** dΨ/dp a tolerance, or so many where they serve both best.

    ```python
    steps = lg.steps_for(criterion, build, p, t1=2.0, pilot=250, tolerance=1e-3)
    lg.differentiate(criterion, build, p, t1=2.0, num_steps=steps.num_steps, integrator=steps.integrator)
    ```

    Arguments:
        criteria: a `Criterion`, or a pytree of them: the steps serve all.
        build, p, t0, t1, state0: as in `differentiate`.
        pilot: the number of equal steps of a run that tells where errors come from: such that the motion is resolved,
            and the shortest event (the bump of a road) seen.
        tolerance: the relative error that is wanted of each value, and of each gradient by its norm.
        num_steps: how many steps there are to be; then `tolerance` is left out.
        integrator: the scheme, of order 2 with `defects`: `GeneralizedAlpha` of index 3, without forces that depend on
            multipliers.

    From the pilot run, its adjoint variables and eight derivatives of what they say of its defects. The steps are those
    for the numbers p: they serve designs nearby, as smoothly as equal ones, and derivatives on them are exact. The
    errors are estimates to leading order, with 3 % of what adds up regardless of signs on top. With a `tolerance` steps
    may be eight of the pilot's where no criterion looks: `differentiate` on them, which compiles what is called next
    anyway, says whether Ψ and dΨ/dp are within it of what the pilot says without its errors. If not, or if the run
    fails, none is longer than three, and one if that fails too. `AdaptiveSteps` has steps for the motion.

    With `num_steps` no step is longer than about three of the pilot's, and nothing else is run. It may be inside of
    `jit` and `vmap` then, which gives each design its own steps; those are constants for derivatives. If the pilot
    fails there, the steps are equal ones.

    Raises `ValueError` for criteria that are no `Criterion`, both or none of `tolerance` and `num_steps`, a pilot of
    fewer than eight steps or one that does not resolve what is asked for, another scheme, and a tolerance that takes
    more than 100000 steps; `SimulationError` if the pilot fails. Source: Becker & Rannacher, Acta Numerica 10 (2001).
    """
    leaves, structure = jax.tree.flatten(criteria, is_leaf=lambda leaf: isinstance(leaf, Criterion))
    if not leaves or not all(isinstance(leaf, Criterion) for leaf in leaves):
        raise ValueError(f"`criteria` must be a Criterion or a pytree of them, got {criteria!r}.")
    if not callable(build):
        raise ValueError(f"`build` must be a function of the parameters that returns a Model, got {build!r}.")
    pilot = as_count(pilot, "pilot", " (it is static)")
    if pilot < _LEAST_STEPS:
        raise ValueError(f"`pilot` must be at least {_LEAST_STEPS} steps, got {pilot}.")
    if (tolerance is None) == (num_steps is None):
        raise ValueError(
            "Give either `tolerance`, the relative error of values and gradients that is wanted, or `num_steps`, how "
            f"many steps there are to be; got tolerance={tolerance!r}, num_steps={num_steps!r}."
        )
    if num_steps is not None and as_count(num_steps, "num_steps", " (it is static)") < _fewest(pilot, _LONGEST):
        raise ValueError(
            f"`num_steps` = {num_steps} is too few beside a pilot of {pilot} steps: none may be longer than {_LONGEST} "
            f"of those; give at least {_fewest(pilot, _LONGEST)}, or a pilot of fewer steps if that resolves it all."
        )
    if tolerance is not None and not (isinstance(tolerance, float | int) and 0.0 < tolerance < 1.0):
        raise ValueError(f"`tolerance` must be a number between 0 and 1, got {tolerance!r}.")
    if not (isinstance(integrator, AbstractScheme) and integrator.order == 2):
        raise ValueError(
            f"`integrator` must be a scheme of order 2, GeneralizedAlpha(), got {integrator!r}; AdaptiveSteps has "
            "steps for the motion by any scheme."
        )
    t0, t1 = interval(t0, t1)
    p, t0, t1 = jax.lax.stop_gradient((as_parameters(p), t0, t1))  # and below what `build` has from elsewhere
    found = jax.lax.stop_gradient(defect_densities(tuple(leaves), build, state0, p, t0, t1, pilot, integrator))
    if is_concrete(found.rows, found.trajectory.result):
        raise_if_failed(found.trajectory)
        _check_resolved(found.rows, pilot)
    elif tolerance is not None:
        raise ValueError("`tolerance`: inside of `jit` and `vmap` the number of steps must be known; give `num_steps`.")
    settings: Any = {"t0": t0, "t1": t1, "state0": state0, "throw": False}
    rows, count = found.rows.reshape(-1, pilot), len(leaves)
    for longest in (_LONGEST,) if tolerance is None else _TRIED:
        number = num_steps if tolerance is None else _enough(rows, count, float(tolerance), pilot, longest)
        placed = placed_steps(rows, as_count(number, "num_steps"), longest)
        steps = GivenSteps(placed.fractions, integrator, fixed=True)
        if tolerance is None or longest == _TRIED[-1]:
            break
        run = differentiate(criteria, build, p, num_steps=steps.num_steps, integrator=steps, **settings)
        each = (structure.flatten_up_to(part) for part in run[:2])
        away = tolerance if longest > _LONGEST else np.inf
        if int(run.result) == RESULTS.successful and _confirmed(found, away, *each):
            break
    of_values, of_gradients = (structure.unflatten(list(part)) for part in _expected(placed, count))
    return PlacedSteps(steps, of_values, of_gradients)


def _confirmed(pilot: Densities, most: float, values, gradients) -> bool:
    """Whether those of another run are so near to what the pilot says without its errors, as far as it knows."""
    slopes = np.stack([ravel_pytree(each)[0] for each in gradients]) @ np.asarray(pilot.directions).T
    size = lambda rows: np.linalg.norm(rows, axis=1)
    relative = lambda away, whole: size(away) / np.where(size(whole) == 0.0, 1.0, size(whole))
    value, slope, rows = (np.asarray(part) for part in (pilot.values[:, None], pilot.slopes, np.sum(pilot.rows, 2)))
    away = relative(np.stack(values)[:, None] - value, value), relative(slopes - slope, slope)
    known = np.abs(rows[:, 0]), size(rows[:, 1:])
    return all(np.all(found <= most + _KNOWN * own) for found, own in zip(away, known))  # NaN is not


def _expected(placed: Placed, count: int) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """The relative errors of values and of gradients."""
    errors = (jnp.abs(placed.errors) + _UNCANCELLED * placed.bounds).reshape(count, -1)
    return errors[:, 0], jnp.linalg.norm(errors[:, 1:], axis=1)


def _check_resolved(rows, pilot: int) -> None:
    totals = np.sum(np.asarray(rows), axis=2)
    found = np.maximum(np.abs(totals[:, 0]).max(), np.linalg.norm(totals[:, 1:], axis=1).max())  # of NaN as well
    if np.isnan(found):
        raise ValueError("`criteria`: a value or a gradient is not finite; `differentiate` says where that comes from.")
    if found > _UNRESOLVED:
        raise ValueError(
            f"`pilot` = {pilot} equal steps do not resolve the criteria: their errors are estimated as {found:.1g} of "
            "the values and gradients, which says nothing of where they come from. Take more steps for the pilot "
            "run; a value or gradient that is zero has no relative error."
        )


def _enough(rows, count: int, tolerance: float, pilot: int, longest: int) -> int:
    """A number of steps whose expected errors have the tolerance, and not one that is 5 % less, by bisection."""

    def reached(num_steps: int) -> bool:
        expected = _expected(placed_steps(rows, num_steps, longest), count)
        return max(float(jnp.max(part)) for part in expected) <= tolerance

    fewest = most = _fewest(pilot, longest)
    while not reached(most):
        fewest, most = most, 2 * most
        if most > _MOST:
            raise ValueError(
                f"`tolerance` = {tolerance:g} would take more than {_MOST} steps by the estimate; ask for less, or for "
                "`accuracy` in `differentiate`, which extrapolates."
            )
    while most - fewest > max(0.05 * fewest, 1.0):
        between = round(np.sqrt(fewest * most))
        fewest, most = (fewest, between) if reached(between) else (between, most)
    return most


def _fewest(pilot: int, longest: int) -> int:
    return max(-(-pilot // longest), _LEAST_STEPS)
