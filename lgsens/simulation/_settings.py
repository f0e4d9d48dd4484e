"""The arguments of `simulate`, checked."""

import warnings
from typing import Any

import jax
import numpy as np

from lgsens._validate import as_count, as_float, is_concrete, require
from lgsens.integrate import AbstractIntegrator, IndexReducedODE
from lgsens.sensitivity import AbstractSensitivity
from lgsens.simulation._errors import primal_value


def check_integrator(integrator: Any, num_steps: int) -> None:
    """Raise `ValueError` for what is no integrator of a scheme, or none of so many steps."""
    if not isinstance(integrator, AbstractIntegrator):
        raise ValueError(f"`integrator` must be a GeneralizedAlpha or another integrator, got {integrator!r}.")
    integrator.scheme.require_steps()
    integrator.check(num_steps)


def check_sensitivity(sensitivity: Any) -> None:
    """Raise `ValueError` for what is no method to differentiate a trajectory."""
    if not isinstance(sensitivity, AbstractSensitivity):
        raise ValueError(
            "`sensitivity` must be DirectDifferentiation(), AdjointVariable(), AssociativeScan(), ContinuousDirect() "
            f"or Autodiff(), got {sensitivity!r}; ContinuousAdjoint() needs a Criterion, see `differentiate`."
        )


def by_diffrax(integrator: Any) -> bool:
    return isinstance(integrator, IndexReducedODE) and integrator.rtol is not None


def interval(t0, t1):
    """The initial and the final time as arrays."""
    t0, t1 = as_float(t0, (), "`t0`"), as_float(t1, (), "`t1`")
    given = lambda: f"got t0 = {t0} s and t1 = {t1} s."
    require(lambda t0, t1: t1 > t0, lambda: f"`t1` must be later than `t0`, {given()}", t0, t1)
    require(lambda *t: np.isfinite(t).all(), lambda: f"`t0` and `t1` must be finite, {given()}", t0, t1)
    return t0, t1


def warn_of_single_precision(dtype) -> None:
    """Where numbers have it."""
    if dtype == np.float32:
        warnings.warn(
            "lgsens runs in single precision: positions carry seven digits, accelerations lose them as 1/h². Call "
            'jax.config.update("jax_enable_x64", True) before the model is built.',
            stacklevel=3,
        )


def warn_of_far_times(t0, t1, num_steps: int) -> None:
    """Where round-off of times, ε t, is more than 1e-6 of a step: signals then change by as much from step to step, and
    accelerations come from the change of that, which is smaller by as many steps as the signal takes."""
    known = primal_value(t0), primal_value(t1)
    if not is_concrete(known) or known[0].dtype != np.float64:
        return
    start, end = map(float, known)
    left = abs(start) * float(np.finfo(float).eps) * num_steps / (end - start)
    if left > 1e-6:
        warnings.warn(
            f"`t0` = {start:g} s is so far from 0 that times are known to {left:.0e} of a step, and forces of what "
            "follows them to less. Count time from the beginning of the run, in signals and roads, too.",
            stacklevel=3,
        )


def check_accuracy(accuracy: Any, num_steps: int | None, integrator: Any, arrays: Any) -> None:
    """Raise `ValueError` for what cannot reach an accuracy."""
    if not (isinstance(accuracy, float | int) and 0.0 < accuracy < 1.0):
        raise ValueError(f"`accuracy` must be a number between 0 and 1, got {accuracy!r}; 1e-4 is four digits.")
    first = 1 if num_steps is None else as_count(num_steps, "num_steps", " (the first one that is tried)")
    if not by_diffrax(integrator):
        check_integrator(integrator, first)
    order = None if by_diffrax(integrator) or integrator.extrapolated else integrator.scheme.convergence_order
    if order is None or not integrator.any_number:
        raise ValueError(
            "`accuracy` needs a scheme that says its order, as GeneralizedAlpha or RadauIIA, in any number of steps; "
            f"got {integrator!r}, which chooses its steps or extrapolates itself."
        )
    if not is_concrete(jax.tree.map(primal_value, arrays)):
        raise ValueError(
            "`accuracy` needs numbers, and chooses steps outside of `jit` and `vmap`. Call it once before, and take "
            "its setting: `found.reached.again(lambda n: differentiate(…, num_steps=n, "
            "integrator=found.reached.integrator)[:2])`."
        )
