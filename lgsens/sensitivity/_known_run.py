"""A run whose steps are linearized once for all sweeps over it.

A sweep linearizes each step where it comes to it, in blocks that stay in a cache, and forgets it; so what a derivative
needs beside the states is little, in a batch of many, too. But to linearize a step costs several times what a solution
with it does (of the quarter-car 24 of 33 ms for a run), and who sweeps several times over one run (`criteria.certify`)
keeps the factors: less work, and a shorter program.
"""

from typing import NamedTuple

from jax import lax

from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme, Stats, Variation
from lgsens.linear import tuned
from lgsens.sensitivity._failed import Sound
from lgsens.sensitivity._linearization import Parameters
from lgsens.sensitivity._linearized_steps import LinearStep
from lgsens.sensitivity._methods import AbstractSensitivity, DirectDifferentiation
from lgsens.sensitivity._rules import back, forth
from lgsens.sensitivity._sweeps import linearized_steps


class KnownRun(NamedTuple):
    """The states of a run, and its steps, linearized; not for a batch."""

    scheme: AbstractScheme
    parameters: Parameters
    states: State
    stats: Stats
    linear: LinearStep | None  # None: they are too many numbers, and each sweep makes its own

    @classmethod
    def of(cls, scheme: AbstractScheme, state0: State, parameters: Parameters) -> "KnownRun":
        states, stats = DirectDifferentiation().trajectory(scheme, state0, parameters)
        numbers = parameters.grid.num_steps * scheme.numbers(parameters.system)
        if numbers > tuned.KEPT_NUMBERS:
            return cls(scheme, parameters, states, stats, None)
        linear = linearized_steps(scheme, Sound.of(states, parameters.system).states, parameters)
        return cls(scheme, parameters, states, stats, lax.stop_gradient(linear))

    def forwards(self, d_state0: State, d: Parameters) -> State:
        """The direct differentiation method: the tangents of all states from those of the first and of parameters."""
        return forth(self.scheme, self.states, self.parameters, (d_state0, d), linear=self.linear)

    def backwards(self, cotangents: State) -> tuple[Variation, State, Parameters]:
        """The adjoint variable method: μ and the cotangents of state0 and parameters, from those of all states."""
        return back(self.scheme, self.states, self.parameters, cotangents, self.linear)


class Given(AbstractSensitivity):
    """No derivative of the trajectory: its states are these, and what depends on them is a function of them."""

    states: State
    stats: Stats

    def trajectory(self, scheme, state0, parameters, found=None):
        return self.states, self.stats
