"""A setting of the dial: what is chosen between speed and accuracy, as one value."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from lgsens._validate import as_count
from lgsens.criteria import Criterion, steps_for
from lgsens.dynamics import RESULTS
from lgsens.integrate import GeneralizedAlpha, IndexReducedODE
from lgsens.simulation import Trajectory, richardson, simulate

# A user's own function: of the trajectory, or a `Criterion`, which is one of the trajectory and the parameters.
Function = Callable[[Trajectory], Any] | Criterion
Build = Callable[..., Any]


def _items(options: Any) -> tuple[tuple[str, Any], ...]:
    if not isinstance(options, Mapping):
        try:
            options = dict(options)
        except (TypeError, ValueError) as error:
            raise ValueError(f"Setting: options must be a dict of names and values, got {options!r}.") from error
    return tuple(sorted(options.items()))


class _Given(NamedTuple):
    """A builder with some of its arguments; equal, for one compilation, where all of these are."""

    build: Build
    options: tuple[tuple[str, Any], ...]

    def __call__(self, p):
        return self.build(p, **dict(self.options))


class Setting(eqx.Module):
    """How a simulation is done: steps, integrator, and the version of the model.

    Arguments:
        num_steps: the number of steps, or of output intervals, of `simulate`.
        integrator: anything that `simulate` takes.
        extrapolate: evaluate the criterion with `num_steps` and with twice as many steps and extrapolate it, by
            `richardson`; a number: with so many runs, of 1, 2, 4, … times as many steps. For schemes of second order; a
            criterion with a kink between two steps loses less than by `integrator=Richardson(…)`, which extrapolates
            the states.
        pilot: place the steps where they serve the criterion and its gradient, by `steps_for` with a pilot run of so
            many equal steps at the parameters; None: as `integrator` has them. Of a `Criterion`, not extrapolated.
        model: keyword arguments for the builder of the model, `{"links": "rods"}`: its fidelity, a linear solver.
        options: further keyword arguments for `simulate`.
        name: how tables call it; else what differs from the defaults.
        family: settings of one family are one curve in the plot; else the integrator and the version of the model.

    All static and hashable. Raises `ValueError` for a number of steps that is none, for one run to extrapolate, and for
    both of `pilot` and `extrapolate`.
    """

    num_steps: int = eqx.field(static=True)
    integrator: Any = eqx.field(static=True, default=GeneralizedAlpha())
    extrapolate: bool | int = eqx.field(static=True, default=False, kw_only=True)
    pilot: int | None = eqx.field(static=True, default=None, kw_only=True)
    model: Any = eqx.field(static=True, default=(), kw_only=True, converter=_items)
    options: Any = eqx.field(static=True, default=(), kw_only=True, converter=_items)
    name: str = eqx.field(static=True, default="", kw_only=True)
    family: str = eqx.field(static=True, default="", kw_only=True)

    def __check_init__(self):
        as_count(self.num_steps, "num_steps", " (it is static)")
        if not isinstance(self.extrapolate, bool) and not (isinstance(self.extrapolate, int) and self.extrapolate > 1):
            raise ValueError(
                "Setting: `extrapolate` must be True, False, or a number of runs of at least 2, "
                f"got {self.extrapolate!r}."
            )
        if self.pilot is not None:
            as_count(self.pilot, "pilot", " (it is static)")
            if self.runs > 1:
                raise ValueError(
                    "Setting: `pilot` places so many steps as there are, whose errors do not cancel in those of twice "
                    "as many; give `extrapolate` or `pilot`."
                )

    @property
    def runs(self) -> int:
        """How many are extrapolated; 1: it is not."""
        return 1 + self.extrapolate if isinstance(self.extrapolate, bool) else self.extrapolate

    @property
    def label(self) -> str:
        """The name, or the integrator and the options as they are written in Python."""
        return self.name or self._described(described(self.integrator))

    @property
    def curve(self) -> str:
        """The family, or what the integrator and the options are without their numbers."""
        return self.family or self._described(described(self.integrator, numbers=False))

    def _described(self, integrator: str) -> str:
        options = [f"{name}={value!r}" for name, value in (*self.model, *self.options)]
        how = {1: "", 2: "extrapolated "}.get(self.runs, f"extrapolated ({self.runs} runs) ")
        return ", ".join([("placed " if self.pilot else how) + integrator, *options])

    def version(self, build: Build) -> Callable[[Any], Any]:
        """p ↦ model, with the options `model`."""
        return _Given(build, self.model)

    def placed(self, fn: Function, build: Build, p: Any, *, t0=0.0, t1) -> Any:
        """The integrator, with the steps that `pilot` asks for, placed at the parameters p; arguments as `evaluate`."""
        if self.pilot is None:
            return self.integrator
        state0 = dict(self.options).get("state0")
        steps = steps_for(
            fn,
            self.version(build),
            p,
            t0=t0,
            t1=t1,
            pilot=self.pilot,
            num_steps=self.num_steps,
            integrator=self.integrator,
            state0=None if state0 is None else lambda _: state0,
        )
        return steps.integrator

    def trajectory(self, build: Build, p: Any, *, t0=0.0, t1, throw: bool = True) -> Trajectory:
        """The motion of build(p), with `num_steps` steps that no criterion places; arguments as in `evaluate`."""
        if self.pilot is not None:
            raise ValueError("Setting: steps of a `pilot` are placed for a criterion; `value_and_trajectory` has one.")
        return self._motion(self.integrator, self.num_steps, build, p, t0, t1, throw)

    def _motion(self, integrator: Any, num_steps: int, build: Build, p: Any, t0, t1, throw: bool) -> Trajectory:
        options = dict(self.options) | {"integrator": integrator, "throw": throw}
        return simulate(self.version(build)(p), t0=t0, t1=t1, num_steps=num_steps, **options)

    def evaluate(self, fn: Function, build: Build, p: Any, *, t0=0.0, t1, throw: bool = True) -> Any:
        """Ψ of the parameters p with this setting, to be differentiated as usual.

        Arguments:
            fn: the criterion, a function of a trajectory or a `Criterion`.
            build: p ↦ model; the options `model` of the setting come as keyword arguments.
            p: the parameters, a pytree.
            t0, t1: initial and final time [s], shape ().
            throw: raise if the simulation fails.
        """
        return self.value_and_trajectory(fn, build, p, t0=t0, t1=t1, throw=throw)[0]

    def value_and_trajectory(self, fn: Function, build: Build, p, *, t0=0.0, t1, throw: bool = True):
        """`evaluate`, and the motion behind it: of several runs the finest one, with the result of all."""
        found, integrator = [], self.placed(fn, build, p, t0=t0, t1=t1)

        def value(num_steps: int):
            found.append(self._motion(integrator, num_steps, build, p, t0, t1, throw))
            return fn(found[-1], p) if isinstance(fn, Criterion) else fn(found[-1])

        if self.runs == 1:
            return value(self.num_steps), found[0]
        extrapolated = richardson(value, self.num_steps, self.runs).value
        result = reduce(lambda a, b: jnp.where(a == RESULTS.successful, b, a), [run.result for run in found])
        return extrapolated, eqx.tree_at(lambda run: run.result, found[-1], result)


def described(value: Any, numbers: bool = True) -> str:
    """A value as it is written in Python, defaults left out; without numbers: the types in it."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return repr(value)
    fields = ((field, getattr(value, field.name)) for field in dataclasses.fields(value))
    given = {field.name: own for field, own in fields if own != field.default}
    name = type(value).__name__
    if numbers:
        return f"{name}({', '.join(f'{key}={described(own)}' for key, own in given.items())})"
    inside = [described(own, False) for own in given.values() if dataclasses.is_dataclass(own)]
    return f"{name}({', '.join(inside)})" if inside else name


def grid(num_steps: Any, *integrators: Any, **options: Any) -> tuple[Setting, ...]:
    """Every integrator with every number of steps.

    Arguments:
        num_steps: numbers of steps, a sequence of ints.
        integrators: values of `integrator=` of `simulate`; none: `GeneralizedAlpha()`.
        options: `extrapolate`, `pilot`, `model`, `options`, `family` of all of them, as in `Setting`.
    """
    integrators = integrators or (GeneralizedAlpha(),)
    return tuple(Setting(n, integrator, **options) for integrator in integrators for n in num_steps)


def ladder(coarsest: int = 50, *, model: Mapping[str, Any] | None = None) -> tuple[Setting, ...]:
    """A ladder of settings that covers a few digits to many: steps × ρ∞ × routes.

    Arguments:
        coarsest: the fewest steps that the motion can be resolved with: about ten in its shortest period.
        model: options for the builder, as in `Setting`.

    Seventeen settings: generalized-α with ρ∞ = 0.9 and 0.5, its criteria extrapolated, and explicit Runge–Kutta schemes
    of order 5 and 8 on the index-reduced equations, which fail where forces are stiff. `grid` makes others.
    """
    import diffrax  # takes its time to import

    n, options = as_count(coarsest, "coarsest"), {"model": model or {}}
    return (
        *grid([n * k for k in (1, 4, 16, 64)], GeneralizedAlpha(0.9), **options),
        *grid([n * k for k in (4, 16)], GeneralizedAlpha(0.5), **options),
        *grid([n * k for k in (1, 2, 4, 8)], GeneralizedAlpha(0.9), extrapolate=True, **options),
        *grid([n * k for k in (1, 2, 4)], IndexReducedODE(), **options),
        *grid([-(-n // 2), n, 2 * n, 4 * n], IndexReducedODE(diffrax.Dopri8()), **options),
    )
