"""What accuracy a result has, and how it was reached."""

from typing import NamedTuple

from lgsens.integrate import AbstractIntegrator


class Reached(NamedTuple):
    """The accuracy of a result; `print` it.

    Attributes:
        asked: the accuracy that was asked for.
        error: the estimated error, in the same measure.
        num_steps: the number of steps, of the finer run where two are extrapolated.
        extrapolated: whether two runs are, of num_steps/2 and num_steps steps.
        integrator: that of each run, in `AlignedSteps` where the scene has breaks that equal steps miss.
        tried: the numbers of steps of all runs and the distances of each from the one before.
    """

    asked: float
    error: float
    num_steps: int
    extrapolated: bool
    integrator: AbstractIntegrator
    tried: tuple[tuple[int, float], ...]

    @property
    def brief(self) -> str:
        """In a line."""
        steps = "steps" if self.integrator.equal_steps else "aligned steps"
        runs = f"{self.num_steps // 2} and {self.num_steps}" if self.extrapolated else f"{self.num_steps}"
        how = ", extrapolated" if self.extrapolated else ""
        return f"error {self.error:.1e}, asked {self.asked:g}, in {runs} {steps}{how}"

    def __str__(self) -> str:
        runs = ", ".join(f"{n}: {distance:.1e}" if distance < float("inf") else f"{n}" for n, distance in self.tried)
        return f"{self.brief}; steps and change from the run before: {runs}"

    __repr__ = __str__
