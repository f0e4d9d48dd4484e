"""What accuracy a result has, and how it was reached."""

from collections.abc import Callable
from typing import Any, NamedTuple

from lgsens.integrate import AbstractIntegrator
from lgsens.simulation._extrapolation import richardson


class Reached(NamedTuple):
    """The accuracy of a result; `print` it.

    Attributes:
        asked: the accuracy that was asked for.
        error: the estimated error, in the same measure.
        num_steps: the number of steps, of the finest run where several are extrapolated.
        runs: how many these are, in …, num_steps/2 and num_steps steps; 1: nothing is extrapolated.
        integrator: that of each run, in `AlignedSteps` where the scene has breaks that equal steps miss.
        tried: the numbers of steps of all runs and the distances of each from the one before.
    """

    asked: float
    error: float
    num_steps: int
    runs: int
    integrator: AbstractIntegrator
    tried: tuple[tuple[int, float], ...]

    @property
    def extrapolated(self) -> bool:
        """Whether several runs are extrapolated."""
        return self.runs > 1

    @property
    def numbers(self) -> tuple[int, ...]:
        """The numbers of steps of the runs."""
        return tuple(self.num_steps // 2**j for j in reversed(range(self.runs)))

    def again(self, fn: Callable[[int], Any]) -> Any:
        """What a function of the number of steps gives in this setting, extrapolated as here; in `jit` too.

        Arguments:
            fn: number of steps ↦ a pytree of floats, as `lambda n: lg.differentiate(criteria, build, p, t1=t1,
                num_steps=n, integrator=reached.integrator)[:2]`.
        """
        return richardson(fn, self.numbers[0], self.runs).value if self.extrapolated else fn(self.num_steps)

    @property
    def brief(self) -> str:
        """In a line."""
        steps = "steps" if self.integrator.equal_steps else "aligned steps"
        *coarser, finest = map(str, self.numbers)
        runs = f"{', '.join(coarser)} and {finest}" if coarser else finest
        how = ", extrapolated" if self.extrapolated else ""
        return f"error {self.error:.1e}, asked {self.asked:g}, in {runs} {steps}{how}"

    def __str__(self) -> str:
        runs = ", ".join(f"{n}: {distance:.1e}" if distance < float("inf") else f"{n}" for n, distance in self.tried)
        return f"{self.brief}; steps and change from the run before: {runs}"

    __repr__ = __str__
