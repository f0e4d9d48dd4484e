"""Ψ and dΨ/dp of a setting as one compiled program, what it costs, and how far two such results are apart."""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from lgsens._validate import as_float
from lgsens.accuracy._setting import Build, Function, Setting
from lgsens.dynamics import RESULTS
from lgsens.simulation import Trajectory


class Study(NamedTuple):
    """What is differentiated: Ψ = fn(trajectory of build(p)), p ± a change of the size `scale`."""

    fn: Function
    build: Build
    p: Any
    scale: np.ndarray  # of every number of p, flat
    t0: Any
    t1: Any

    @classmethod
    def of(cls, fn: Function, build: Build, p, scale, t0, t1) -> "Study":
        for name, function in (("fn", fn), ("build", build)):
            if not callable(function):
                raise ValueError(f"`{name}` must be a function, got {function!r}.")
        p = jax.tree.map(lambda leaf: as_float(leaf, None, "`p`"), p)
        if not jax.tree.leaves(p):
            raise ValueError("`p` has no arrays; there is nothing to differentiate.")
        return cls(fn, build, p, _scales(p, scale), as_float(t0, (), "`t0`"), as_float(t1, (), "`t1`"))


def _scales(p, scale) -> np.ndarray:
    if scale is None:
        scale = jax.tree.map(lambda leaf: jnp.max(jnp.abs(leaf), initial=0.0), p)
        scale = jax.tree.map(lambda size: jnp.where(size > 0, size, 1.0), scale)
    try:
        full = jax.tree.map(lambda size, leaf: jnp.broadcast_to(as_float(size, None, "`scale`"), leaf.shape), scale, p)
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"`scale` must be a pytree as `p`, of numbers or of arrays of the shapes there: {error}"
        ) from error
    flat = np.asarray(ravel_pytree(full)[0])
    if not (flat > 0).all():
        raise ValueError(f"`scale` must be positive, got {flat.min()}.")
    return flat


class Evaluated(NamedTuple):
    """Ψ and, flat and times the scale of p, its gradient; both NaN after a failure, of which `failure` says what."""

    value: float
    gradient: np.ndarray
    failure: str = ""

    @property
    def finite(self) -> bool:
        return bool(np.isfinite(self.value) and np.isfinite(self.gradient).all())

    def relative(self, other: "Evaluated") -> tuple[float, float]:
        """How far value and gradient are from the other's, relative to it.

        Of the gradient the largest effect of a relative change of a parameter counts. What is zero has the size 1.
        """
        largest = float(np.abs(other.gradient).max(initial=0.0))
        return (
            abs(self.value - other.value) / (abs(other.value) or 1.0),
            float(np.abs(self.gradient - other.gradient).max(initial=0.0)) / (largest or 1.0),
        )

    def combined(self, weight: float, other: "Evaluated", share: float) -> "Evaluated":
        """weight · self + share · other."""
        return Evaluated(
            weight * self.value + share * other.value, weight * self.gradient + share * other.gradient, self.failure
        )


class Program:
    """A setting of a study, compiled."""

    def __init__(self, study: Study, setting: Setting):
        self.study, self.setting = study, setting

        def value(p):
            return setting.value_and_trajectory(study.fn, study.build, p, t0=study.t0, t1=study.t1, throw=False)

        started = time.perf_counter()
        self._executable = jax.jit(jax.value_and_grad(value, has_aux=True)).lower(study.p).compile()
        self.compile_seconds = time.perf_counter() - started
        memory = self._executable.memory_analysis()
        self.temporary_bytes = None if memory is None else int(memory.temp_size_in_bytes)

    def __call__(self) -> Any:
        return jax.block_until_ready(self._executable(self.study.p))

    def evaluate(self) -> tuple[Evaluated, Trajectory]:
        (value, trajectory), gradient = self()
        flat = np.asarray(ravel_pytree(gradient)[0]) * self.study.scale
        failure = ""
        if int(trajectory.result) != RESULTS.successful:
            failure = RESULTS(int(trajectory.result)).message
        elif not (np.isfinite(value) and np.isfinite(flat).all()):
            failure = "Ψ or its gradient is not finite."
        if failure:
            value, flat = np.nan, np.full_like(flat, np.nan)
        return Evaluated(float(value), flat, failure), trajectory


def evaluate(study: Study, setting: Setting) -> Evaluated:
    """Value and gradient of a setting; a failure is data."""
    try:
        return Program(study, setting).evaluate()[0]
    except Exception as error:  # whatever compiling and running the user's functions raises
        return failed(study, error)


def failed(study: Study, error: BaseException) -> Evaluated:
    """What is left of a setting that raised."""
    return Evaluated(np.nan, np.full(study.scale.shape, np.nan), f"{type(error).__name__}: {error}")
