"""A reference for Ψ and dΨ/dp that converges by itself, and what it knows of its own error.

Two routes that share the equations of motion only. **A**: the index-reduced equations by Dormand & Prince's scheme of
order 8, the number of steps doubled. With ψ_k the values and d_k = |ψ_k − ψ_{k−1}| their changes, errors fall by the
ratio r = d_k/d_{k−1} from one to the next, so the error of the last is

    d_k (r + r² + …) = d_k r/(1 − r),

taken with r ≥ 1/8, since one ratio alone proves little; d_k itself where r > 1/2. **B**: generalized-α, which stiff
forces do not trouble. Its errors are c₂h² + c₃h³ + …, and the runs with h, h/2, h/4, … are extrapolated power by power,

    T_{k,0} = ψ_k,     T_{k,j} = T_{k,j−1} + (T_{k,j−1} − T_{k−1,j−1})/(2^{j+1} − 1),     error ≈ |T_{k,k} − T_{k,k−1}|.

The better one is the reference. It counts only if the other one agrees within both errors; else the difference of the
two is the error that is reported.

Sources: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.4, §II.5, §II.9.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from lgsens._brief import brief
from lgsens.accuracy._programs import Evaluated, Study, evaluate
from lgsens.accuracy._setting import Setting
from lgsens.integrate import GeneralizedAlpha, IndexReducedODE

TARGET = 1e-11  # an error at which a route need not go on
_TRUSTED = 1e-3  # an error above which a route is no reference
_LEAST_RATIO = 1 / 8
_ROUND_OFF = 1e-12  # no error is estimated below: what the round-off of some hundred steps may leave
_HOPELESS = 3  # runs without a finite number at the start, after which there is none to come
_DOUBLED, _HALVED = 5, 7  # runs of the two routes, at most
MOST_RUNS = _DOUBLED + _HALVED
_AGREEMENT = 3.0  # the difference of two routes that the sum of their estimated errors explains


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """Ψ and dΨ/dp as good as they could be had.

    Attributes:
        value: Ψ.
        gradient: dΨ/dp times the scale of p, flat.
        value_error, gradient_error: estimated, relative as those of the table.
        evidence: a sentence on each route.
        confirmed: whether two routes agree within their errors.
    """

    value: float
    gradient: np.ndarray
    value_error: float
    gradient_error: float
    evidence: tuple[str, ...] = ()
    confirmed: bool = False

    __repr__ = brief

    @property
    def error(self) -> float:
        """The larger of the two errors."""
        return max(self.value_error, self.gradient_error)

    @property
    def evaluated(self) -> Evaluated:
        return Evaluated(self.value, self.gradient)


class _Route(NamedTuple):
    name: str
    steps: tuple[int, ...]
    found: Evaluated
    error: tuple[float, float]

    @property
    def sentence(self) -> str:
        if not self.found.finite:
            return f"{self.name}: failed with {', '.join(map(str, self.steps))} steps: {self.found.failure}"
        errors = " and ".join(f"{error:.0e}" for error in self.error)
        return f"{self.name} with {', '.join(map(str, self.steps))} steps: estimated errors of Ψ and dΨ/dp {errors}"


def by_doubling(changes: list[float]) -> float:
    """The error of the last of several values whose changes are given."""
    if len(changes) < 2 or changes[-2] == 0.0:
        return changes[-1]
    ratio = max(changes[-1] / changes[-2], _LEAST_RATIO)
    return changes[-1] * (ratio / (1 - ratio) if ratio < 0.5 else 1.0)


def doubled(name: str, run: Callable[[int], Evaluated], start: int, levels: int) -> _Route:
    """A route of which only the last value counts: doubled until it is good enough, or no longer gets better."""
    values: list[Evaluated] = []
    changes: list[tuple[float, float]] = []
    steps, best = [], None
    for level in range(levels):
        steps.append(start * 2**level)
        values.append(run(steps[-1]))
        if level and not any(value.finite for value in values[-2:]):
            break  # beyond help: unstable, or not applicable
        if level == 0 or not (values[-1].finite and values[-2].finite):
            continue
        changes.append(values[-2].relative(values[-1]))
        error = by_doubling([pair[0] for pair in changes]), by_doubling([pair[1] for pair in changes])
        if best is None or max(error) < max(best.error):
            best = _Route(name, tuple(steps), values[-1], error)
        if max(error) <= TARGET or (len(changes) > 2 and max(changes[-1]) >= max(changes[-2])):
            break
    return best if best is not None else _Route(name, tuple(steps), _unusable(values), (np.inf, np.inf))


def _unusable(values: list[Evaluated]) -> Evaluated:
    last = values[-1]
    return last._replace(value=np.nan, failure=last.failure or "no two values in a row are finite")


def extrapolated(name: str, run: Callable[[int], Evaluated], start: int, levels: int, enough: float = TARGET) -> _Route:
    """A route of second order, extrapolated power by power."""
    row: list[Evaluated] = []
    steps, best = [], None
    for level in range(levels):
        steps.append(start * 2**level)
        current = [run(steps[-1])]
        if not current[0].finite:
            row = []  # too coarse: begin again
            best = best or _Route(name, tuple(steps), current[0], (np.inf, np.inf))
            if level + 1 == _HOPELESS:
                break
            continue
        for j, coarser in enumerate(row, 1):
            factor = 1.0 / (2 ** (j + 1) - 1)
            current.append(current[-1].combined(1.0 + factor, coarser, -factor))
        row = current
        if len(row) > 1:
            error = row[-2].relative(row[-1])
            if best is None or not max(error) > max(best.error):
                best = _Route(name, tuple(steps), row[-1], error)
            if len(row) > 2 and max(error) <= enough:
                break
    assert best is not None
    return best


def converge(study: Study, coarsest: int, progress: Callable[[], Any] = lambda: None) -> Reference:
    """The reference of a study. Raises `ValueError` where neither route gives one."""
    import diffrax  # takes its time to import

    def runs(integrator):
        cache: dict[int, Evaluated] = {}

        def run(num_steps: int) -> Evaluated:
            if num_steps not in cache:
                cache[num_steps] = evaluate(study, Setting(num_steps, integrator))
                progress()
            return cache[num_steps]

        return run

    scheme = runs(GeneralizedAlpha())
    of_scheme = lambda levels, enough=TARGET: extrapolated(
        "GeneralizedAlpha, extrapolated", scheme, 4 * coarsest, levels, enough
    )
    explicit = doubled("IndexReducedODE(Dopri8)", runs(IndexReducedODE(diffrax.Dopri8())), 2 * coarsest, _DOUBLED)
    if not max(explicit.error) <= _TRUSTED:
        implicit = of_scheme(_HALVED)
    else:
        for levels in (3, 4, 5):  # no better than it takes to see whether the two agree
            implicit = of_scheme(levels)
            if _agree(explicit, implicit):
                break
    return _better_of(explicit, implicit)


def _agree(one: _Route, other: _Route) -> bool:
    if not (one.found.finite and other.found.finite):
        return False
    gaps = one.found.relative(other.found)
    return all(gap <= _AGREEMENT * (a + b) for gap, a, b in zip(gaps, one.error, other.error))


def _better_of(one: _Route, other: _Route) -> Reference:
    best, second = sorted((one, other), key=lambda route: max(route.error))
    if not max(best.error) <= _TRUSTED:
        raise ValueError(
            "`work_precision` finds no reference: "
            + "; ".join(route.sentence for route in (best, second))
            + ". Give `reference`, or settings with more steps: the fewest of them is where it begins."
        )
    error, evidence, confirmed = best.error, [best.sentence], _agree(best, second)
    if second.found.finite:
        gaps = second.found.relative(best.found)
        evidence.append(f"{second.sentence}; it differs by {gaps[0]:.0e} and {gaps[1]:.0e}")
        if not confirmed and max(second.error) <= _TRUSTED:
            error = tuple(map(max, error, gaps))
    else:
        evidence.append(second.sentence)
    value_error, gradient_error = (max(one, _ROUND_OFF) for one in error)
    return Reference(best.found.value, best.found.gradient, value_error, gradient_error, tuple(evidence), confirmed)
