"""What `simulate` takes as its integrator: a scheme and how its steps are laid, as a value."""

import abc
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool, Float

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._grid import AbstractGrid, EqualGrid

if TYPE_CHECKING:
    from lgsens.integrate._scheme import AbstractScheme, Start


class Laid(NamedTuple):
    """Where steps begin and end, and what is known of them already."""

    grid: AbstractGrid
    found: tuple[State, Any] | None = None  # the states and statistics of the run, where they had to be found
    stats: Any = None  # what the trajectory shows instead of these
    reached: Bool[Array, ""] | None = None  # whether the end was reached; None: it is


class AbstractIntegrator(eqx.Module):
    """A scheme, and how its steps are laid."""

    @property
    @abc.abstractmethod
    def scheme(self) -> "AbstractScheme":
        """The scheme."""

    @property
    def extrapolated(self) -> bool:
        """Whether two runs, the second in twice as many steps, are extrapolated."""
        return False

    def check(self, num_steps: int) -> None:
        """Raise `ValueError` for a number of steps that these are not."""
        return

    def lay(self, system: AbstractSystem, start: "Start", jerk: Float[Array, " k"], t0, t1, num_steps: int) -> Laid:
        """The grid of a run from t0 to t1: here equal steps."""
        return Laid(EqualGrid(t0, (t1 - t0) / num_steps, num_steps))
