"""Simulations with steps of different sizes: given ones, and those of error control."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lgsens._validate import as_float, is_concrete, require
from lgsens.dynamics import AbstractSystem, Initial, State, require_independent
from lgsens.integrate import AdaptiveSteps, FirstState, GeneralizedAlpha, Stats, integrate_controlled
from lgsens.sensitivity import AdjointVariable, DirectDifferentiation, Parameters, times
from lgsens.simulation._start import Begin, begin
from lgsens.simulation._trajectory import Trajectory


class GivenSteps(eqx.Module):
    """Generalized-α with steps of given sizes: an integrator of `simulate`.

        t_{n+1} = t_n + (t1 − t0) f_n,   f = fractions/Σ fractions

    Arguments:
        fractions: the sizes of the steps, relative to each other, shape (num_steps,), not negative, the first positive.
            A step of size 0 repeats the state.
        integrator: the scheme, a `GeneralizedAlpha`.

    `GivenSteps.of(trajectory)` has those of a trajectory: the grid that error control found for one design serves
    those nearby, and what is computed on it is as smooth in the parameters as on equal steps. The trajectory is of
    second order where sizes change smoothly; where they jump by a factor r, multipliers are off by O(r² − 1) h for some
    steps. Derivatives are exact, those by `fractions`, t0 and t1 too.

    Raises `ValueError` for fractions of another shape or sign.
    """

    fractions: Float[Array, " n"]
    integrator: GeneralizedAlpha = eqx.field(static=True, default=GeneralizedAlpha())

    def __init__(self, fractions, integrator: GeneralizedAlpha = GeneralizedAlpha()):
        self.fractions = as_float(fractions, None, "GivenSteps: `fractions`")
        self.integrator = integrator
        if self.fractions.ndim != 1 or not self.fractions.size:
            raise ValueError(f"GivenSteps: `fractions` must have shape (num_steps,), got {self.fractions.shape}.")
        if not isinstance(integrator, GeneralizedAlpha):
            raise ValueError(f"GivenSteps: `integrator` must be a GeneralizedAlpha, got {integrator!r}.")
        require(
            lambda sizes: np.all(np.isfinite(sizes)) and np.all(sizes >= 0.0) and sizes[0] > 0.0,
            "GivenSteps: `fractions` must be finite, not negative, and the first one positive.",
            self.fractions,
        )

    @classmethod
    def of(cls, trajectory: Trajectory, integrator: GeneralizedAlpha = GeneralizedAlpha()) -> "GivenSteps":
        """The steps of a trajectory; those of size 0 are left out, unless it is traced."""
        sizes = jax.lax.stop_gradient(jnp.diff(trajectory.t))
        if is_concrete(sizes):
            sizes = np.asarray(sizes)[np.asarray(sizes) > 0.0]
        return cls(sizes, integrator)

    @property
    def num_steps(self) -> int:
        return self.fractions.shape[0]


UnevenIntegrator = AdaptiveSteps | GivenSteps


def check_uneven(integrator: UnevenIntegrator, num_steps: int, sensitivity, save) -> None:
    """Raise `ValueError` for what does not go together with steps of different sizes."""
    name = type(integrator).__name__
    if isinstance(integrator, GivenSteps) and integrator.num_steps != num_steps:
        raise ValueError(
            f"`num_steps` = {num_steps}, but GivenSteps has {integrator.num_steps}; give `integrator.num_steps`."
        )
    if integrator.integrator.stabilized:
        raise ValueError(f"{name}: `integrator` must be of index 3; leave `stabilized` out, or take equal steps.")
    if not isinstance(sensitivity, DirectDifferentiation | AdjointVariable):
        raise ValueError(
            f"`sensitivity` = {sensitivity!r} needs equal steps; with {name} DirectDifferentiation() or "
            "AdjointVariable()."
        )
    if save is not None:
        raise ValueError(f"`save` needs equal steps: leave it out, {name} returns a trajectory.")


class UnevenRun(NamedTuple):
    """A run with steps of different sizes, and whether it came to the end."""

    start: Begin
    t: Float[Array, " n+1"]
    states: State
    newton: Stats
    stats: Any  # what the trajectory shows
    reached: Bool[Array, ""]


def run_uneven(
    integrator: UnevenIntegrator, system: AbstractSystem, state0: State | None, initial: Initial | None, t0, t1,
    num_steps: int, sensitivity,
) -> UnevenRun:  # fmt: skip
    """The states on the grid that is given, or that error control finds."""
    require_independent(system, type(integrator).__name__)
    scheme, mean = integrator.integrator, (t1 - t0) / num_steps
    if isinstance(integrator, GivenSteps):
        h = (t1 - t0) * (integrator.fractions / jnp.sum(integrator.fractions))
        start = begin(scheme, system, t0, h[0], state0, initial)
        parameters = Parameters(system, t0, h)
        states, stats = sensitivity.trajectory(scheme, num_steps, start.state, parameters)
        return UnevenRun(start, times(num_steps, parameters), states, stats, stats, jnp.ones((), bool))

    # As it depends on the size of the first step.
    start = begin(scheme, system, t0, jnp.ones_like(mean), state0, initial)
    first = _first_state(start, given=state0 is not None)
    # What error control decides has no derivative: its sizes, as parts of the interval, are constants of the run.
    frozen = jax.lax.stop_gradient((system, first, t0, mean))
    found = jax.lax.stop_gradient(integrate_controlled(integrator, num_steps, *frozen))
    parameters = Parameters(system, t0, found.h / frozen[3] * mean)
    known = (found.states, Stats(*found.stats[: len(Stats._fields)]))
    states, newton = sensitivity.trajectory(scheme, num_steps, first.at(parameters.h[0]), parameters, known)
    return UnevenRun(start, times(num_steps, parameters), states, newton, found.stats, found.finished)


def _first_state(start: Begin, *, given: bool) -> FirstState:
    """From the starting values for h = 1. The a of a state that is given belongs to the first step, of any size."""
    state = start.state
    if given:
        return FirstState(state, jnp.zeros_like(state.v), jnp.zeros_like(state.a))
    base = State(state.q, start.consistent_v, state.vdot, state.lam, state.vdot)
    return FirstState(base, state.v - start.consistent_v, state.a - state.vdot)
