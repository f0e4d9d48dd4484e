"""What a scene need not model: what reductions change of a criterion and of its gradient, without compiling them.

Let Ψ(p, s) be the criterion of the rich scene on its way to the lean ones, a number s_i for each reduction
(`lgsens.model._reductions`): s = 0 is the rich scene, s_i = 1 the lean one. One reverse run gives ∂Ψ/∂p and all of
∂Ψ/∂s_i. With y(t; s) the motion, r(y, s) = 0 its equations and λ its adjoint, ∂Ψ/∂s_i = −λᵀ ∂r/∂s_i: what the inertia
of a link, the yield of a bushing or a force is in the equations, weighted by the adjoint (a dual-weighted residual). So

    Ψ(e_i) − Ψ(0) = ∂Ψ/∂s_i + ½ ∂²Ψ/∂s_i² + …

is predicted for all reductions at once. A second run for each, half way and in the same compiled program, leaves the
third derivative, by the midpoint rule, and tells the change of the gradient, with half of its second-order term left,

    Ψ(e_i) − Ψ(0) = ∂Ψ/∂s_i(½ e_i) + Ψ'''/24,
    ∂Ψ/∂p(e_i) − ∂Ψ/∂p(0) = 2 (∂Ψ/∂p(½ e_i) − ∂Ψ/∂p(0)) + ¼ ∂³Ψ/∂p∂s_i² + …

A coordinate that is held has no small parameter. Its run is at s_i = 1, where a spring a hundred times faster than a
step holds it, and leaves no more than the virtual compliance, some (ωh/100)² of what the coordinate did. Changes of
several reductions add up to terms of second order.

Sources: Becker & Rannacher, Acta Numerica 10 (2001) 1, and Oden & Prudhomme, J. Comput. Phys. 182 (2002) 496 (errors of
models by residuals weighted with the adjoint).
"""

import dataclasses
import itertools
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens import plotting
from lgsens._validate import as_count
from lgsens.accuracy._programs import Evaluated, Program, Study, in_turns
from lgsens.accuracy._setting import Build, Function, Setting
from lgsens.criteria import Criterion
from lgsens.integrate import AbstractIntegrator, GeneralizedAlpha
from lgsens.linear import tuned
from lgsens.model import AbstractReduction, Model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Option = tuple[AbstractReduction, ...]
_FOLLOWS = 100.0  # over the step: the rate of what is held
_MOST = 16  # options of which all combinations are looked at


@dataclasses.dataclass(frozen=True)
class Reduced:
    """What some reductions do, predicted or measured.

    Attributes:
        options: the reductions.
        value, gradient: Ψ(lean) − Ψ(rich) over |Ψ|, signed; and max |Δ dΨ/dp_i s_i| over max |dΨ/dp_i s_i|.
        first: as `value`, from one reverse run of the rich scene alone; NaN where a coordinate is held.
        unknowns: coordinates and constraints of the lean scene.
        time: of a run, over that of the rich scene: estimated by unknowns, or measured.
    """

    options: tuple[Option, ...]
    value: float
    gradient: float
    first: float
    unknowns: int
    time: float

    @property
    def error(self) -> float:
        """The larger of both changes."""
        return max(abs(self.value), self.gradient)

    @property
    def reductions(self) -> Option:
        """All of them in turn, for `model.reduced(*…)`."""
        return tuple(itertools.chain.from_iterable(self.options))

    def __str__(self) -> str:
        named = ", ".join(" + ".join(_label(each) for each in option) for option in self.options) or "the rich scene"
        numbers = (
            f"{self.value:+.1e}",
            f"{self.gradient:.1e}",
            f"{self.first:+.1e}",
            str(self.unknowns),
            f"{self.time:.2f}",
        )
        return f"{named[:58]:58}" + "".join(f"{number:>10}" for number in numbers)

    __repr__ = __str__


def _label(reduction: AbstractReduction) -> str:
    fields = (getattr(reduction, field.name) for field in dataclasses.fields(reduction))
    words = (" ".join(of) if isinstance(of, tuple) else str(of) for of in fields if of not in (None, True, ()))
    return f"{type(reduction).__name__}({', '.join(words)})"


class _Runs(NamedTuple):
    """The rich scene, what is asked of it, and its steps."""

    study: Study
    setting: Setting

    def program(self, options: Sequence[Option]) -> Program:
        """Ψ and dΨ/dp of the scene with these options, compiled."""
        return Program(self.study._replace(build=_Lean(self.study.build, tuple(options))), self.setting)


class _Lean(NamedTuple):
    """A builder of lean scenes; equal, for one compilation, where these are."""

    build: Build
    options: tuple[Option, ...]

    def __call__(self, p) -> Model:
        return self.build(p).reduced(*itertools.chain.from_iterable(self.options))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fidelity:
    """What each option changes, the largest gain of time for its error first; printed, a table.

    Attributes:
        rows: of each option.
        value: Ψ of the rich scene. unknowns: its coordinates and constraints.
        seconds: what the one reverse run took [s].
    """

    rows: tuple[Reduced, ...]
    value: float
    unknowns: int
    seconds: float
    runs: _Runs
    rich: Evaluated

    def combined(self, rows: Sequence[Reduced]) -> Reduced:
        """What several options do together: errors that do not compensate each other, unknowns that add up."""
        total = lambda name: float(sum(abs(getattr(row, name)) for row in rows))
        unknowns = self.unknowns - sum(self.unknowns - row.unknowns for row in rows)
        options = tuple(option for row in rows for option in row.options)
        return Reduced(
            options, total("value"), total("gradient"), total("first"), unknowns, _time(unknowns, self.unknowns)
        )

    def recommended(self, tolerance: float) -> Reduced:
        """The options that together save the most time and change Ψ and dΨ/dp by no more than a tolerance.

        Arguments:
            tolerance: relative, of both.

        Of all combinations of up to 16 options. Raises `ValueError` for a tolerance that is not positive.
        """
        if not tolerance > 0.0:
            raise ValueError(f"`tolerance` must be positive, got {tolerance!r}; 1e-3 for example.")
        useful = [row for row in self.rows if row.error <= tolerance][:_MOST]
        subsets = (subset for n in range(len(useful) + 1) for subset in itertools.combinations(useful, n))
        found = (self.combined(subset) for subset in subsets)
        return min((each for each in found if each.error <= tolerance), key=lambda each: (each.unknowns, each.error))

    def verified(self, reduced: Reduced | None = None) -> Reduced:
        """What some options do in fact: the lean scene is compiled and run, and the rich one beside it.

        Arguments:
            reduced: a row, or what `recommended` or `combined` returned; None: the rich scene.

        Raises `ValueError` where the lean scene fails (equations that are redundant now, a body that nothing holds).
        """
        return self._measured([() if reduced is None else reduced.options])[0]

    def fastest(self, tolerance: float) -> Reduced:
        """The fastest in fact within a tolerance, of what is `recommended`, and of that without its options of the
        largest error, one after the other, down to the rich scene.

        Arguments:
            tolerance: as in `recommended`.

        All of them are compiled and run in turns: a scene of fewer unknowns may take longer, as a first rod brings a
        kind of joint of its own. Raises `ValueError` as `recommended` and `verified`.
        """
        rows = {row.options: row for row in self.rows}
        best = sorted(self.recommended(tolerance).options, key=lambda option: rows[(option,)].error)
        found = self._measured([tuple(best[:n]) for n in range(len(best), -1, -1)])
        return min((each for each in found if each.error <= tolerance), key=lambda each: each.time)

    def _measured(self, several: Sequence[tuple[Option, ...]]) -> list[Reduced]:
        programs = {options: self.runs.program(options) for options in {(): None} | dict.fromkeys(several)}
        found = {options: program.evaluate()[0] for options, program in programs.items()}
        for options, each in found.items():
            if each.failure:
                raise ValueError(f"The scene with {options!r} fails: {each.failure}")
        seconds = {options: of for options, (of, _) in in_turns(programs, 9).items()}

        def reduced(options: tuple[Option, ...]) -> Reduced:
            unknowns = _unknowns(_Lean(self.runs.study.build, options), self.runs.study.p)
            return Reduced(
                options, *_changes(found[options], self.rich), np.nan, unknowns, seconds[options] / seconds[()]
            )

        return [reduced(options) for options in several]

    def plot(self) -> "Figure":
        """Error against the share of time, an entry for each option and for what is recommended at 1e-4 … 1e-1.

        Raises `ImportError` without matplotlib.
        """
        best = [self.recommended(10.0**power) for power in (-4, -3, -2, -1)]
        series = {"one option": self.rows, "recommended": best}
        panel = {
            name: plotting.WorkPrecision(
                [row.time for row in rows if row.error > 0.0], [row.error for row in rows if row.error > 0.0]
            )
            for name, rows in series.items()
        }
        return plotting.work_precision_panels({"Ψ and dΨ/dp": panel}, {}, cost="time of a run over the rich scene's")

    def __str__(self) -> str:
        heads = ("of Ψ", "of dΨ/dp", "one run", "unknowns", "time")
        lines = [f"{'change by':58}" + "".join(f"{head:>10}" for head in heads), *map(str, self.rows)]
        return "\n".join([*lines, f"the rich scene: Ψ = {self.value:.6g}, {self.unknowns} unknowns"])

    __repr__ = __str__


def _time(unknowns: int, of: int) -> float:
    return (unknowns + tuned.RUN_UNKNOWNS) / (of + tuned.RUN_UNKNOWNS)


def _changes(found: Evaluated, rich: Evaluated) -> tuple[float, float]:
    value, gradient = found.relative(rich)
    return float(np.copysign(value, found.value - rich.value)), gradient


def _unknowns(build: Build, p: Any) -> int:
    system = eqx.filter_eval_shape(lambda p: build(p).system(), p)
    return system.group.dim + len(system.constraint_names)


class _Path(NamedTuple):
    """The builder of scenes on their way."""

    build: Build
    options: tuple[Option, ...]
    rate: float

    def __call__(self, both) -> Model:
        return self.build(both["p"]).toward(self.options, both["s"], self.rate)


class _OfBoth(NamedTuple):
    """A criterion of the design parameters as one of theirs and of s."""

    function: Any

    def __call__(self, at, both):
        return self.function(at, both["p"])


def fidelity(
    criterion: Function,
    build: Build,
    p: Any,
    options: Sequence[AbstractReduction | Sequence[AbstractReduction]],
    *,
    t0=0.0,
    t1,
    num_steps: int,
    integrator: AbstractIntegrator = GeneralizedAlpha(),
    scale: Any = None,
) -> Fidelity:
    """How much reductions of a scene would change a criterion and its gradient, and what they would save.

    ```python
    from lgsens.model import Joint, Rod, Without
    found = lg.accuracy.fidelity(criterion, build, p, [Rod("trailing_arm"), Joint("bush"), Without("stop")],
                                 t1=1.0, num_steps=400)
    print(found, found.recommended(1e-3))
    lean = build(p).reduced(*found.recommended(1e-3).reductions)
    ```

    Arguments:
        criterion: a function of a trajectory, or a `Criterion`.
        build: p ↦ the rich `Model`; `lambda model: model` for every number of a model.
        p: the parameters, a pytree of floats.
        options: reductions of `lgsens.model`, or sequences of them of which each needs the ones before.
        t0, t1, num_steps, integrator: as in `simulate`.
        scale: the size of a large change of each parameter, as in `work_precision`.

    One program is compiled, that of the rich scene with a number for each reduction; no lean scene is.
    Predictions are those of small changes: `Fidelity.verified` compiles the lean scene that is chosen and compares.

    Raises `ValueError` for bad arguments, reductions that the scene does not have, and where the rich scene fails.
    """
    num_steps = as_count(num_steps, "num_steps", " (it is static)")
    paths = [option if isinstance(option, Sequence) else (option,) for option in options]
    if not paths or not all(paths) or not all(isinstance(r, AbstractReduction) for path in paths for r in path):
        raise ValueError(f"`options` must be reductions such as Rod('link'), or sequences of them, got {options!r}.")
    study, setting = Study.of(criterion, build, p, scale, t0, t1), Setting(num_steps, integrator)
    if not isinstance(of := eqx.filter_eval_shape(build, study.p), Model):
        raise ValueError(f"`build` must return a Model, got {type(of).__name__}.")
    # a reduction by itself is one path, and one of several needs those before it
    parts = tuple(dict.fromkeys(tuple(path[: i + 1]) for path in paths for i in range(len(path))))
    unknowns = _unknowns(build, study.p)
    left = [_unknowns(_Lean(build, (tuple(path),)), study.p) for path in paths]
    rate = float(_FOLLOWS * num_steps / (study.t1 - study.t0))
    fn = criterion
    if isinstance(criterion, Criterion):
        given = {name: getattr(criterion, name) for name in ("integrand", "terminal")}
        fn = Criterion(**{name: None if of is None else _OfBoth(of) for name, of in given.items()})
    program = Program(_on_the_way(study, fn, parts, rate, np.zeros(len(parts))), setting)
    at = lambda s: _on_the_way(study, fn, parts, rate, s)

    def run(s: np.ndarray) -> tuple[Evaluated, np.ndarray]:
        program.study = at(s)
        both = program.evaluate()[0]
        if both.failure:
            raise ValueError(f"`fidelity`: the scene on its way to {parts[int(np.argmax(s))]!r} fails: {both.failure}")
        size = study.scale.size
        return Evaluated(both.value, both.gradient[:size]), both.gradient[size:]

    started = time.perf_counter()
    rich, slopes = run(np.zeros(len(parts)))
    seconds = time.perf_counter() - started
    size, largest = abs(rich.value) or 1.0, float(np.abs(rich.gradient).max(initial=0.0)) or 1.0
    changes = {}
    for i, part in enumerate(parts):
        held = part[-1].holds
        there, slope = run(np.eye(len(parts))[i] * (1.0 if held else 0.5))
        value, factor = (there.value - rich.value, 1.0) if held else (slope[i], 2.0)
        first = np.nan if held else slopes[i] / size
        changes[part] = value / size, factor * (there.gradient - rich.gradient) / largest, first
    rows = []
    for path, count in zip(paths, left):
        whole = [changes[tuple(path[: i + 1])] for i in range(len(path))]
        value, gradient, first = (sum(of) for of in zip(*whole))
        numbers = float(value), float(np.abs(gradient).max()), float(first)
        rows.append(Reduced((tuple(path),), *numbers, count, _time(count, unknowns)))
    rows.sort(key=lambda row: row.error / max(1.0 - row.time, 1e-3))
    return Fidelity(tuple(rows), rich.value, unknowns, seconds, _Runs(study, setting), rich)


def _on_the_way(study: Study, fn, parts, rate: float, s: np.ndarray) -> Study:
    both = {"p": study.p, "s": jnp.asarray(s, jax.tree.leaves(study.p)[0].dtype)}
    scale = np.concatenate([study.scale, np.ones(len(parts))])
    return Study(fn, _Path(study.build, parts, rate), both, scale, study.t0, study.t1)
