"""Steps under error control.

With v̈ ≈ (a_{n+1} − a_n)/h, a_n that of this step, the increment of eq. (27) misses the true one by e = h³ c (see
`missed_increment`), at no cost. The error of a step is measured by the largest

    |e_i|/s_i,     s = 1 rad or the length of the scene,

and kept below the tolerance. It is that of a step and not of a unit of time: local errors add up to ∫ h² |c| dt, in
∫ dt/h steps, and for a given sum the steps are fewest where h³ |c| is the same in all. The size of the next one follows
from the errors of the last two, E = |e|/tolerance, by the filter

    ρ = (θ/E_n)^{1/(4·3)} (θ/E_{n−1})^{1/(4·3)} (h_n/h_{n−1})^{−1/4},      h_{n+1} = h_n (1 + κ arctan((ρ − 1)/κ)).

It does not answer to what alternates from step to step, as accelerations do after a change, with (−ρ∞)ⁿ.
Sizes so chosen change smoothly, which matters: in the constraint directions the velocity carries an error of O(h²) that
belongs to the step size (see `_start.py`), and where this changes by a factor r multipliers are off by O(r² − 1) h.

The derivative is that of the scheme on the grid found, so nothing here is differentiated.

Sources: Géradin & Cardona, Flexible Multibody Dynamics (2001), §11; Söderlind, ACM Transactions on Mathematical
Software 29 (2003), doi:10.1145/641876.641877 (filter H211b); Söderlind & Wang, Journal of Computational and Applied
Mathematics 185 (2006), doi:10.1016/j.cam.2005.03.008 (limiter).
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._lanes import in_any_lane
from lgsens.integrate._newton import Stats
from lgsens.integrate._scheme import GeneralizedAlpha, missed_increment
from lgsens.integrate._uneven import Attempt, Progress, UnevenSteps, chosen, moved

_AIM = 0.5  # θ: few steps are rejected
_LIMIT = 1.0  # κ: no step is more than 2.6 times as long as the one before
_ATTEMPTS = 20  # at one step
_LEAST = 1e-6  # errors below this fraction of the tolerance count as so large


class AdaptiveSteps(eqx.Module):
    """Generalized-α with steps under error control: an integrator of `simulate`.

        h³ |c_i| ≤ tolerance s_i,     c = (1/6 − β − Δ/2) v̈ + ad(v) v̇/12,  Δ = α_m − α_f

    with c the part of the increment (27) that the scheme misses, v̈ ≈ (a_{n+1} − a_n)/h, s = 1 rad or the length of the
    scene.

    Arguments:
        integrator: the scheme, a `GeneralizedAlpha`.
        tolerance: the error that a step may add to a configuration, relative to 1 rad or the length of the scene.
            Global errors fall as tolerance^(2/3): a thousandth of it, a hundredth of them, in ten times the steps.
        longest: the longest step, as a fraction of the interval t1 − t0. A system at rest does not see ahead: no longer
            than half the shortest event that comes then, the bump of a road.

    `num_steps` of `simulate` is the largest number of steps. The trajectory has so many rows; those after the last step
    repeat t1 and the state there, so that integrals and `state(-1)` are right, and its `stats` are `ControlledStats`.
    Their sweep costs the derivative as much as a step: leave little room, or give the grid found to `GivenSteps`.

    The derivative is that of the numerical solution on the grid found, exactly, in both modes; under `vmap` each lane
    has its own. The sizes themselves change a little with the parameters, which the derivative leaves out: finite
    differences agree with it on the same grid (`GivenSteps.of`). **Sensitivities**: their errors are not controlled,
    but the scheme is stable at any step size for the motion and so for its linearization: across a bump gradients by
    hardpoints converge as Ψ does (`benchmarks/variable_steps.py`). The criterion's trapezoidal rule sees the grid too.

    All static and hashable. Raises `ValueError` for settings out of range.
    """

    integrator: GeneralizedAlpha = eqx.field(static=True, default=GeneralizedAlpha())
    tolerance: float = eqx.field(static=True, default=1e-6, kw_only=True)
    longest: float = eqx.field(static=True, default=0.02, kw_only=True)

    def __check_init__(self):
        if not isinstance(self.integrator, GeneralizedAlpha):
            raise ValueError(f"AdaptiveSteps: `integrator` must be a GeneralizedAlpha, got {self.integrator!r}.")
        if not isinstance(self.tolerance, int | float) or not 0.0 < self.tolerance < math.inf:
            raise ValueError(f"AdaptiveSteps: `tolerance` must be positive, got {self.tolerance!r}; try 1e-6.")
        if not isinstance(self.longest, int | float) or not 0.0 < self.longest <= 1.0:
            raise ValueError(f"AdaptiveSteps: `longest` must be in (0, 1], got {self.longest!r}; 0.02 is the default.")


class FirstState(NamedTuple):
    """The initial state for a first step of any size: v + h² v_2, a + h a_1."""

    state: State
    v_2: Float[Array, " k"]
    a_1: Float[Array, " k"]

    def at(self, h) -> State:
        state = self.state
        return State(state.q, state.v + h**2 * self.v_2, state.vdot, state.lam, state.a + h * self.a_1)


class ControlledStats(NamedTuple):
    """What Newton and the error control did in each step.

    Attributes:
        iterations: Newton's iterations, those of rejected attempts included, shape (n,), int32; 0 after the last step.
        increment: the last increment of each step, relative as in `GeneralizedAlpha.tolerance`, shape (n,).
        residual: the largest entry of the residual r before that increment [N or N m], shape (n,).
        converged: whether each step converged, shape (n,), bool.
        margin: as in `Stats`, shape (n,).
        error: the estimated error of each step, relative as in `AdaptiveSteps.tolerance`, shape (n,).
        rejected: attempts with a longer step before each, shape (n,), int32.
        steps: the number of steps that t1 took, shape (), int32.
    """

    iterations: Int[Array, " n"]
    increment: Float[Array, " n"]
    residual: Float[Array, " n"]
    converged: Bool[Array, " n"]
    margin: Float[Array, " n"]
    error: Float[Array, " n"]
    rejected: Int[Array, " n"]
    steps: Int[Array, ""]


class Controlled(NamedTuple):
    """The steps found: sizes (n,), states (n+1), and whether they reach the end."""

    h: Float[Array, " n"]
    states: State
    stats: ControlledStats
    finished: Bool[Array, ""]


class _Trial(NamedTuple):
    h: Float[Array, ""]
    found: Attempt
    error: Float[Array, ""]
    iterations: Int[Array, ""]
    rejected: Int[Array, ""]
    trying: Bool[Array, ""]

    def chosen(self, which, other: "_Trial") -> "_Trial":
        """`self` where `which`, else `other`; but the matrix of `self` in any case."""
        less = lambda trial: trial._replace(found=trial.found._replace(shared=None))
        small = chosen(which, less(self), less(other))
        return small._replace(found=small.found._replace(shared=self.found.shared))


def integrate_controlled(
    settings: AdaptiveSteps, num_steps: int, system: AbstractSystem, first: FirstState, t0, h
) -> Controlled:
    """At most `num_steps` steps from t0 to t0 + num_steps h; those not needed have size 0 and repeat the last state."""
    scheme, total = settings.integrator, num_steps * h
    steps = UnevenSteps.of(scheme, system)
    scale = steps.constants.scale
    tolerance = max(settings.tolerance, 16 * float(jnp.finfo(h.dtype).eps))

    def relative(v, vdot, jerk, h):
        missed = missed_increment(scheme, system, v, vdot, jerk)
        return h**3 * jnp.max(jnp.abs(missed) / scale) / tolerance

    def fitted(h, remaining):
        """A whole number of such steps for what remains: none at the end that differs from those before."""
        least = remaining / (settings.longest * total)
        return remaining / jnp.ceil(jnp.maximum(remaining / h - 0.1, least * (1.0 - 1e-9)))

    def step(carry, n):
        progress, proposed, before, elapsed = carry
        active = progress.running & (elapsed < total)
        remaining = jnp.where(active, total - elapsed, h)
        wanted = fitted(proposed, remaining)

        def begins(trial: _Trial) -> Progress:
            """A first step begins with the state that belongs to its size."""
            return progress._replace(
                state=chosen(n == 0, first.at(trial.h), progress.state),
                h=jnp.where(n == 0, trial.h, progress.h),
                shared=trial.found.shared,
            )

        def attempt(trial: _Trial) -> _Trial:
            progress = begins(trial)
            start = moved(progress.state, trial.h / progress.h)
            found = steps.tried(progress, trial.h, trial.trying)
            error = relative(start.v, start.vdot, (found.state.a - start.a) / trial.h, trial.h)
            accepted = found.stats.converged & (error <= 1.0)
            shorter = jnp.where(found.stats.converged, jnp.clip(0.8 * error ** (-1.0 / 3.0), 0.1, 0.8), 0.25)
            rejected = trial.rejected + (~accepted).astype(jnp.int32)
            again = ~accepted & (rejected < _ATTEMPTS)
            iterations = trial.iterations + found.stats.iterations
            given_up = ~accepted & ~again
            found = found._replace(
                state=jax.tree.map(lambda leaf: jnp.where(given_up, jnp.nan, leaf), found.state),
                stats=found.stats._replace(converged=found.stats.converged & ~given_up),
            )
            new = _Trial(jnp.where(again, trial.h * shorter, trial.h), found, error, iterations, rejected, again)
            return new.chosen(trial.trying, trial)

        none = jnp.zeros((), jnp.int32)
        stats = Stats(none, h * 0.0, h * 0.0, progress.running, jnp.nan * h)
        nothing = Attempt(progress.state, progress.contraction, stats, progress.shared)
        trial = lax.while_loop(
            lambda trial: in_any_lane(trial.trying), attempt, _Trial(wanted, nothing, h * 0.0, none, none, active)
        )
        begun = begins(trial)
        progress = steps.after(begun, trial.found, trial.h).chosen(active, progress)
        error = jnp.maximum(trial.error, _LEAST)
        rho = (_AIM / error * _AIM / before) ** (1.0 / 12.0) * (begun.h / trial.h) ** 0.25
        grown = trial.h * (1.0 + _LIMIT * jnp.arctan((rho - 1.0) / _LIMIT))
        elapsed = jnp.where(active, jnp.where(trial.h >= remaining, total, elapsed + trial.h), elapsed)
        h_taken = jnp.where(active | ~progress.running, trial.h, 0.0)
        stats = trial.found.stats._replace(iterations=trial.iterations)
        carry = (progress, grown, error, elapsed)
        return carry, (h_taken, progress.state, stats, trial.error * tolerance, trial.rejected)

    jerk = first.a_1 / (scheme.alpha_m - scheme.alpha_f)
    expected = relative(first.state.v, first.state.vdot, jerk, h)
    guess = h * jnp.minimum(1.0, (_AIM / jnp.maximum(expected, _LEAST)) ** (1.0 / 3.0))
    begin = (steps.first(first.at(guess), t0, guess), guess, jnp.full((), _AIM, h.dtype), h * 0.0)
    (_, _, _, elapsed), (sizes, later, newton, errors, rejected) = lax.scan(step, begin, jnp.arange(num_steps))
    begun = first.at(sizes[0])
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), begun, later)
    taken = jnp.sum((sizes > 0.0) & newton.converged).astype(jnp.int32)
    stats = ControlledStats(*newton, errors, rejected, taken)
    return Controlled(sizes, states, stats, elapsed >= total)
