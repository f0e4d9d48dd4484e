"""Ψ and dΨ/dp of a setting, compiled, what it costs, and how far two such results are apart."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from lgsens._validate import all_finite, as_float
from lgsens._xla import tracing
from lgsens.accuracy._setting import Build, Function, Setting
from lgsens.criteria import Criterion, Task, reverse_by_parts
from lgsens.dynamics import RESULTS
from lgsens.linear import tuned
from lgsens.sensitivity import DirectDifferentiation
from lgsens.simulation import Trajectory, check_integrator, check_sensitivity, cut, interval, richardson, simulate


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
        return cls(fn, build, p, _scales(p, scale), *interval(t0, t1))

    def require_number(self, setting: Setting) -> None:
        """Raises `ValueError` where a setting's model is none, or Ψ of its motion no number: told before it is
        compiled, since what raises later is a row that has failed."""
        fn, build = _with_parameters(self.fn), setting.version(self.build)
        run = lambda p: simulate(build(p), t0=self.t0, t1=self.t1, num_steps=setting.num_steps, throw=False)
        found = jax.eval_shape(lambda p: fn(run(p), p), self.p)
        shape = getattr(found, "shape", None)
        if shape != ():
            what = repr(found) if shape is None else f"shape {shape}"
            raise ValueError(f"`fn` must return a number, got {what}; reduce it (jnp.sum), or take one entry.")


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
        return all_finite((self.value, self.gradient))

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


def _called(function: Callable, *arguments):
    return function(*arguments)


class _OfTrajectory(NamedTuple):
    """A function of a trajectory as one of parameters, too."""

    function: Callable

    def __call__(self, trajectory: Trajectory, p):
        return self.function(trajectory)


def _with_parameters(fn: Function) -> Callable:
    return fn if isinstance(fn, Criterion) else _OfTrajectory(fn)


class Program:
    """A setting of a study, compiled; what another one has compiled before serves it as well."""

    def __init__(self, study: Study, setting: Setting):
        self.study, self.setting = study, setting
        self._integrator = setting.placed(study.fn, study.build, study.p, t0=study.t0, t1=study.t1)
        options = {"sensitivity": DirectDifferentiation(), "state0": None} | dict(setting.options)
        self._method, state0 = options.pop("sensitivity"), options.pop("state0")
        if options.keys() - {"throw"}:
            raise ValueError(f"Setting: `options` may be `sensitivity` and `state0`, got {sorted(options)}.")
        check_sensitivity(self._method)
        self._start = None if state0 is None else lambda p: state0
        self._build = setting.version(study.build)
        self._fn = _with_parameters(study.fn)
        self.temporary_bytes = None
        seconds = []
        for call in (self._watched, _called):
            started = time.perf_counter()
            self(call)
            seconds.append(time.perf_counter() - started)
        self.compile_seconds = max(seconds[0] - seconds[1], 0.0)

    def _watched(self, function, *arguments):
        """A call, after which the memory of the program is known."""
        found = function(*arguments)
        program = function.lower(*arguments).compile()  # made already
        memory = getattr(program, "compiled", program).memory_analysis()
        if memory is not None:
            self.temporary_bytes = max(self.temporary_bytes or 0, int(memory.temp_size_in_bytes))
        return found

    def __call__(self, call: Callable = _called) -> tuple[Any, Any, list[Trajectory]]:
        """Ψ, dΨ/dp, and the motions behind them."""
        study, integrator, motions = self.study, self._integrator, []

        def run(num_steps: int):
            check_integrator(integrator, num_steps)
            task = Task((self._fn,), self._build, self._start, integrator, num_steps, study.t0, study.t1)
            with tracing():
                parts, motion = reverse_by_parts(task, study.p, self._method, call=call)
            motions.append(motion if motion.states.v.shape[0] == num_steps + 1 else cut(motion, num_steps))
            return parts.value[0], parts.gradient[0]

        runs, num_steps = self.setting.runs, self.setting.num_steps
        value, gradient = run(num_steps) if runs == 1 else richardson(run, num_steps, runs).value
        return *jax.block_until_ready((value, gradient)), motions

    def evaluate(self) -> tuple[Evaluated, Trajectory]:
        """Value and gradient, NaN after a failure, and the finest motion."""
        value, gradient, motions = self()
        flat = np.asarray(ravel_pytree(gradient)[0]) * self.study.scale
        failed = [int(run.result) for run in motions if int(run.result) != RESULTS.successful]
        failure = RESULTS(failed[0]).message if failed else ""
        if not failure and not all_finite((value, flat)):
            failure = "Ψ or its gradient is not finite."
        if failure:
            value, flat = np.nan, np.full_like(flat, np.nan)
        return Evaluated(float(value), flat, failure), motions[-1]


def crowded() -> bool:
    """Whether programs have taken most of the memory maps that Linux gives a process."""
    try:
        with open("/proc/self/maps", "rb") as maps:
            return sum(1 for _ in maps) > tuned.MAPS
    except OSError:  # other systems count none
        return False


def make_room() -> None:
    """Forget programs, where that is needed for others."""
    if crowded():
        jax.clear_caches()


def evaluate(study: Study, setting: Setting) -> Evaluated:
    """Value and gradient of a setting; a failure is data."""
    make_room()
    try:
        return Program(study, setting).evaluate()[0]
    except Exception as error:  # whatever compiling and running the user's functions raises
        return failed(study, error)


def failed(study: Study, error: BaseException) -> Evaluated:
    """What is left of a setting that raised."""
    return Evaluated(np.nan, np.full(study.scale.shape, np.nan), f"{type(error).__name__}: {error}")


def in_turns(programs: Mapping[Any, Callable[[], Any]], rounds: int) -> dict[Any, tuple[float, float]]:
    """Median wall and processor time of a call of each [s]: in every round each is called once."""
    times = {key: [] for key in programs}
    for _ in range(rounds):
        for key, taken in times.items():
            started, busy = time.perf_counter(), time.process_time()
            programs[key]()
            taken.append((time.perf_counter() - started, time.process_time() - busy))
    medians = lambda taken: tuple(map(statistics.median, zip(*taken)))
    return {key: medians(taken) for key, taken in times.items()}
