"""An integrator of `simulate`: a scheme, and how its steps are laid."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array, Bool

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._grid import AbstractGrid, EqualGrid, Start


class Laid(NamedTuple):
    """Where steps begin and end, and what is known of them already."""

    grid: AbstractGrid
    found: tuple[State, Any] | None = None  # the states and statistics of the run, where they had to be found
    stats: Any = None  # what the trajectory shows instead of these
    reached: Bool[Array, ""] | None = None  # whether the end was reached; None: it is


class AbstractIntegrator(eqx.Module):
    """A scheme, and how its steps are laid.

    Attributes:
        any_number: whether there may be any number of steps, as data too (`Steps`), twice as many being their halves.
        by_motion: whether the motion decides where steps end.
    """

    any_number: ClassVar[bool] = True
    by_motion: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def scheme(self) -> Any:
        """The scheme, an `AbstractScheme`."""

    @property
    def extrapolated(self) -> bool:
        """Whether two runs, the second in twice as many steps, are extrapolated."""
        return False

    @property
    def equal_steps(self) -> bool:
        """Whether all steps of a run are equal."""
        return True

    @property
    def equal_pieces(self) -> bool:
        """Whether steps are equal between the breaks at which they end."""
        return self.equal_steps

    def check(self, num_steps: int) -> None:
        """Raise `ValueError` for a number of steps that these are not."""

    def lay(self, system: AbstractSystem, start: Start, t0, t1, num_steps) -> Laid:
        """The grid of a run from t0 to t1: here equal steps. `num_steps`: an int, or `Steps`."""
        return Laid(EqualGrid.between(t0, t1, num_steps, self.scheme.restarts(system)))

    def moves(self, system: AbstractSystem) -> bool:
        """Whether where steps end depends on numbers of the system, for derivatives too."""
        return False

    def as_data(self, dtype) -> "AbstractIntegrator":
        """With its numbers as arrays, so that one program serves all of them; here as it is."""
        return self

    def frozen(self, trajectory: Any) -> "AbstractIntegrator":
        """The steps of a trajectory, where they were chosen for it."""
        return self
