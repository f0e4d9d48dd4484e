"""What is known of the worth of a value and its gradient, in numbers and in words."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from lgsens._validate import all_finite
from lgsens.criteria._kinks import Kink
from lgsens.dynamics import RESULTS

_DUALITY = 1e-6  # round-off of long runs is far below
_NEAR = 1e-3  # margins to singular configurations, relative to the largest
_UNRESOLVED = 0.1  # of the steps
_BEGIN = 0.9  # of the largest accelerations, in one step: by exp(−λh) = 1/10 of it what is fast goes on
_COARSE = 0.1  # relative errors of which estimates know the size, not the order that they fall with


def _some(kinks: Sequence[Kink]) -> str:
    more = f" and {len(kinks) - 4} more" if len(kinks) > 4 else ""
    return ", ".join(map(str, kinks[:4])) + more


def _times(times: Sequence[float]) -> str:
    return ", ".join(f"{t:.6g}" for t in times[:4]) + (" …" if len(times) > 4 else "")


class Certificate(NamedTuple):
    """What a value and its gradient are worth; `print` it.

    Attributes:
        value, gradient: Ψ, shape (), and dΨ/dp, like p: those of the numerical motion.
        value_error, gradient_error: estimates of true less computed, in the same shapes.
        tolerance: the relative error that was asked for, shape ().
        duality: by how much the two sensitivity methods differ, relative to the largest terms, shape ().
        newton: the change of Ψ that is left in Newton's iteration, shape (); NaN: not known of this scheme.
        growth: how much the motion changes for a relative change of p of 1, in rad or lengths of the scene, shape ().
        exponential: whether it grows exponentially, shape ().
        margin: the least margin to a singular configuration of those looked at, relative to the largest, shape ().
        kinks: where in time an acceleration has a kink or a jump inside of a step, of which body, by which forces, as
            far as it stands out: such as are small beside a smooth change are not seen, nor two within five steps.
        jumps: the ends of steps in which the integrand of a `Criterion` jumps [s], likewise: an angle that comes round.
        coincident: where two breaks coincide that depend on p in different ways, and accelerations jump [s].
        unresolved: the share of steps in which accelerations change as much as they are large, shape ().
        begin: by how much of their largest value they change in the first step, shape ().
        result: a value of `RESULTS`, shape (), int32.
    """

    value: Float[Array, ""]
    gradient: PyTree
    value_error: Float[Array, ""]
    gradient_error: PyTree
    tolerance: float
    duality: Float[Array, ""]
    newton: Float[Array, ""]
    growth: Float[Array, ""]
    exponential: Any
    margin: Float[Array, ""]
    kinks: tuple[Kink, ...]
    jumps: tuple[float, ...]
    coincident: tuple[float, ...]
    unresolved: Float[Array, ""]
    begin: Float[Array, ""]
    result: Int[Array, ""]

    @property
    def relative(self) -> tuple[float, float]:
        """The estimated errors of value and gradient, relative to them (of the gradient by its norm)."""
        norm = lambda tree: float(np.linalg.norm(np.asarray(ravel_pytree(tree)[0])))
        ratio = lambda error, of: error / of if of > 0.0 else (0.0 if error == 0.0 == of else np.inf)  # NaN: not known
        return ratio(norm(self.value_error), norm(self.value)), ratio(norm(self.gradient_error), norm(self.gradient))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes value or gradient worth less than the estimates say, or not worth anything, and what to do."""
        said = []
        if int(self.result) != RESULTS.successful:
            said.append(f"the simulation failed: {RESULTS(int(self.result)).message}")
        known = {"Ψ": (self.value, self.value_error), "dΨ/dp": (self.gradient, self.gradient_error)}
        for name, numbers in known.items():
            if not all_finite(numbers):
                said.append(f"{name} or its error is not finite: `differentiate` says where that comes from")
        single = np.asarray(self.value).dtype == np.float32
        lost = "round-off of single precision, which grows as 1/h²: take double, or fewer steps"
        if self.duality > (0.1 * self.tolerance if single else _DUALITY):
            why = "an element is not linear in its tangents, or its equations are nearly singular"
            said.append(
                f"direct and adjoint derivatives differ by {float(self.duality):.1e}"
                + (f": {lost}" if single else f", far above round-off: a rule of {why}")
            )
        if self.exponential:
            said.append(
                f"the motion is unstable or chaotic: a relative change of p of 1 moves it by {float(self.growth):.1e} "
                f"lengths; the gradient holds for changes below {1.0 / float(self.growth):.0e}. Shorten the run, or "
                "average over many"
            )
        if self.unresolved > _UNRESOLVED:
            said.append(
                f"in {100 * float(self.unresolved):.0f} % of the steps accelerations change as much as they are large: "
                "the steps do not resolve the motion, take many more of them, or model it without what is fast, a "
                "stiff spring as rigid, a short ramp as a longer one"
            )
        else:
            if self.begin > _BEGIN:
                said.append(
                    f"in the first step accelerations change by {100 * float(self.begin):.0f} % of their largest: what "
                    "is that fast, a stiff damper or clutch whose bodies begin apart in speed, a stiff spring apart in "
                    "place, is not resolved, and the motion may keep what one step made of it. Begin in agreement (an "
                    "`equilibrium`, velocities), or take many more steps (`accuracy=` of `differentiate` does)"
                )
            if kinks := [kink for kink in self.kinks if not kink.jump]:
                said.append(
                    f"accelerations have a kink inside of a step: {_some(kinks)}. Estimates do not see it; let a step "
                    "end there (`AlignedSteps` does at edges of a road), or make the force, or the curve of a joint, "
                    "smooth over several steps"
                )
            if jumps := [kink for kink in self.kinks if kink.jump]:
                said.append(
                    f"accelerations jump inside of a step: {_some(jumps)}. Where the time of a jump depends on p the "
                    "gradient lacks what its shift does, in any number of steps, and may have the wrong sign: make the "
                    "force continuous over several steps, or let a step end there that moves with it: `AlignedSteps` "
                    "where a signal tells the time in `breaks`, else another run (`t1` may depend on p)"
                )
        if self.jumps:
            said.append(
                f"the integrand jumps inside of a step, at t = {_times(self.jumps)} s, which estimates and gradient "
                "do not see: take a continuous one, of an angle that comes round its sine and cosine or, to count "
                "turns, what a TorsionSpringDamper(…, stiffness=0, turns=True) measures (`s.force(name).angle`)"
            )
        if self.coincident:
            said.append(
                f"breaks coincide at t = {_times(self.coincident)} s whose times depend on p in different ways, and "
                "accelerations jump there: derivatives by each time have half of both jumps, only their sum is right. "
                "Let one number be both times, or leave some time between them"
            )
        if self.margin < _NEAR:
            said.append(
                f"a singular configuration is near: the margin falls to {float(self.margin):.1e} of its largest"
            )
        if abs(float(self.newton)) > 0.1 * self.tolerance * abs(float(self.value)):
            advice = lost if single else "ask for a smaller `tolerance`"
            said.append(f"Newton's iteration leaves {float(self.newton):.1e} of Ψ: {advice}")
        return tuple(said)

    @property
    def good(self) -> bool:
        """Whether value and gradient have the tolerance by the estimates, and nothing speaks against these."""
        return not self.warnings and max(self.relative) <= self.tolerance

    def __str__(self) -> str:
        of_value, of_gradient = self.relative
        digits = lambda error: f"{max(0.0, -np.log10(max(error, 1e-16))):.1f} digits"
        lines = [
            f"Ψ = {float(self.value):.10g}, estimated error {float(self.value_error):+.1e}: {digits(of_value)}",
            f"dΨ/dp: estimated error {of_gradient:.1e} of its norm: {digits(of_gradient)}",
            *(f"But {warning}." for warning in self.warnings),
        ]
        asked = f"the tolerance of {self.tolerance:g}"
        if self.good:
            lines.append(f"Good to {asked}.")
        elif self.warnings:
            lines.append(f"Not good to {asked}: the estimates do not hold.")
        else:
            factor = np.ceil(np.sqrt(max(self.relative) / self.tolerance) * 10.0) / 10.0
            least = "at least " if max(self.relative) > _COARSE else ""
            lines.append(f"Not good to {asked}: take {least}{factor:g} times as many steps.")
        return "\n".join(lines)

    __repr__ = __str__
