"""Steps of different sizes.

The algorithmic acceleration of a step of size h stands for the acceleration at t_n + Δ h, Δ = α_m − α_f (eq. 29 is of
second order for that alone), so it changes with the step size. Along the line through v̇_n at t_n and a_n at t_n + Δ h,

    a_n ← v̇_n + r (a_n − v̇_n),    r = h_{n+1}/h_n,

is the one that the step of size h_{n+1} begins with. Everything else in eqs. (24)–(29) belongs to one step only.

A step of size 0 leaves everything as it is. A grid that needs fewer steps than its arrays have places ends with such.

Sources: Brüls & Arnold, Journal of Computational and Nonlinear Dynamics 3 (2008), doi:10.1115/1.2960475; Jay & Negrut,
Journal of Computational and Nonlinear Dynamics 2 (2007), doi:10.1115/1.2389231.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens.dynamics import AbstractSystem, State, constraint_jacobian
from lgsens.integrate._integrate import (
    SLOW,
    Constants,
    Guess,
    Solver,
    Stats,
    inverse_at,
    no_inverse,
    renewed_where,
    take_step,
)
from lgsens.integrate._scheme import GeneralizedAlpha
from lgsens.integrate._singular import Watch, margin_by_mass

_SAME = 2.0  # the change of h up to which modified Newton keeps its matrix


class _Past(NamedTuple):
    """The two states before the last one: where the parabola of the next guess passes."""

    t: Float[Array, "2"]
    vdot: Float[Array, "2 k"]
    lam: Float[Array, "2 m"]


class Progress(NamedTuple):
    """The last state, and what the next step needs of those before."""

    state: State
    t: Float[Array, ""]
    h: Float[Array, ""]  # of the step that the state's a belongs to
    past: _Past
    contraction: Float[Array, ""]
    inverse: Solver | None
    inverse_h: Float[Array, ""]
    age: Int[Array, ""]  # steps with this inverse
    watch: Watch  # margins by time
    watched: Float[Array, ""]  # when
    margin: Float[Array, ""]  # of this step, NaN where that was not looked at
    running: Bool[Array, ""]


class Attempt(NamedTuple):
    """Where a step of size h leads."""

    state: State
    contraction: Float[Array, ""]
    stats: Stats


def moved(state: State, ratio) -> State:
    """The state with the algorithmic acceleration that a step `ratio` times as long begins with."""
    return State(state.q, state.v, state.vdot, state.lam, state.vdot + ratio * (state.a - state.vdot))


class UnevenSteps(eqx.Module):
    """Generalized-α one step at a time, each with a size of its own."""

    scheme: GeneralizedAlpha = eqx.field(static=True)
    system: AbstractSystem
    constants: Constants

    @classmethod
    def of(cls, scheme: GeneralizedAlpha, system: AbstractSystem) -> "UnevenSteps":
        return cls(scheme, system, Constants.of(system))

    def _inverse(self, state: State, t, h) -> tuple[Solver, Float[Array, ""]]:
        inverse, _ = inverse_at(self.scheme, self.system, self.constants, state, t, h)
        return inverse, self._margin(state)

    def _margin(self, state: State) -> Float[Array, ""]:
        """A margin (`_singular`) that can be compared with those of other step sizes."""
        jacobian = constraint_jacobian(self.system, state.q)
        return margin_by_mass(self.system, self.constants.mass, jacobian, self.constants.scale)

    def first(self, state0: State, t0, h) -> Progress:
        """Before the first step, to whose size h the a of `state0` belongs."""
        twice = lambda leaf: jnp.stack([leaf, leaf])
        return Progress(
            state=state0,
            t=t0,
            h=h,
            # times that differ: weights that add up to one give the same value at any
            past=_Past(t0 - h * jnp.asarray([1.0, 2.0], h.dtype), twice(state0.vdot), twice(state0.lam)),
            contraction=jnp.ones_like(h),
            inverse=no_inverse(self._inverse, state0, t0, h)[0] if self.scheme.factor_every else None,
            inverse_h=h,
            age=jnp.asarray(self.scheme.factor_every, jnp.int32),
            watch=Watch.first(h.dtype),
            watched=t0,
            margin=jnp.full_like(h, jnp.nan),
            running=jnp.all(jnp.isfinite(state0.a)),
        )

    def renewed(self, progress: Progress, h, active) -> Progress:
        """With an inverse that serves a step of size h, for modified Newton."""
        earlier = progress.inverse
        if earlier is None:
            return progress
        old = (progress.age >= self.scheme.factor_every) | ((progress.contraction >= SLOW) & (progress.age > 1))
        other = (h > _SAME * progress.inverse_h) | (_SAME * h < progress.inverse_h)
        passed = jnp.maximum(progress.t - progress.watched, h)
        due = active & (old | other | progress.watch.ends_within(passed + 2.0 * self.scheme.factor_every * h))
        start = lambda: self._inverse(moved(progress.state, h / progress.h), progress.t, h)
        inverse, margin = renewed_where(due, start, (earlier, progress.margin))
        return progress._replace(
            inverse=inverse,
            watch=chosen(due, progress.watch.after(margin, passed), progress.watch),
            watched=jnp.where(due, progress.t, progress.watched),
            margin=jnp.where(due, margin, jnp.nan),
            inverse_h=jnp.where(due, h, progress.inverse_h),
            age=jnp.where(due, 0, progress.age) + 1,
        )

    def tried(self, progress: Progress, h, active) -> Attempt:
        """The state that a step of size h reaches; NaN unless `active` and converged."""
        start = moved(progress.state, h / progress.h)
        guess = Guess((start.a, start.a), (start.lam, start.lam), progress.contraction, self._predicted(progress, h))
        t = progress.t + h
        found = take_step(self.scheme, self.system, self.constants, start, guess, progress.inverse, active, t, h)
        margin = self._margin(found[0]) if progress.inverse is None else progress.margin
        return Attempt(found[0], found[1].contraction, found[2]._replace(margin=margin))

    def _predicted(self, progress: Progress, h):
        """u and λ from the parabolas through the last three v̇ and λ; u by eq. (29), whatever sizes they had."""
        alpha_m, alpha_f = self.scheme.alpha_m, self.scheme.alpha_f
        start, past, t = moved(progress.state, h / progress.h), progress.past, progress.t
        n = jnp.concatenate([t[None], past.t])
        to = t + h - n
        weights = jnp.stack(
            [
                to[1] * to[2] / ((n[0] - n[1]) * (n[0] - n[2])),
                to[0] * to[2] / ((n[1] - n[0]) * (n[1] - n[2])),
                to[0] * to[1] / ((n[2] - n[0]) * (n[2] - n[1])),
            ]
        )
        vdot, lam = (
            weights[0] * last + weights[1:] @ before
            for last, before in ((start.vdot, past.vdot), (start.lam, past.lam))
        )
        return ((1.0 - alpha_f) * vdot + alpha_f * start.vdot - alpha_m * start.a) / (1.0 - alpha_m), lam

    def after(self, progress: Progress, found: Attempt, h) -> Progress:
        """With a step of size h done; it ends the simulation if it did not converge."""
        earlier = lambda last, before: jnp.stack([last, before[0]])
        state, past = progress.state, progress.past
        return progress._replace(
            state=found.state,
            t=progress.t + h,
            h=h,
            past=_Past(earlier(progress.t, past.t), earlier(state.vdot, past.vdot), earlier(state.lam, past.lam)),
            contraction=found.contraction,
            running=found.stats.converged,
        )


def chosen(which, one, other):
    """`one` where `which`, leaf by leaf, else `other`."""
    return jax.tree.map(lambda one, other: jnp.where(which, one, other), one, other)


def integrate_uneven(scheme: GeneralizedAlpha, system: AbstractSystem, state0: State, t0, h) -> tuple[State, Stats]:
    """The states at t0 + Σ h, stacked along a leading axis, for steps of sizes h, shape (n,); a of `state0` belongs to
    the first.

    A step that does not converge ends the simulation: it and those after it are NaN, and `Stats` says so. A step of
    size 0 repeats the state.
    """
    steps = UnevenSteps.of(scheme, system)

    def step(progress: Progress, h):
        active = progress.running & (h != 0.0)
        safe = jnp.where(active, h, progress.h)
        ready = steps.renewed(progress, safe, active)
        found = steps.tried(ready, safe, active)
        done = steps.after(ready, found, safe)
        failed = ~progress.running
        stats = found.stats._replace(
            increment=jnp.where(active | failed, found.stats.increment, 0.0),
            residual=jnp.where(active | failed, found.stats.residual, 0.0),
            converged=jnp.where(active, found.stats.converged, progress.running),
        )
        kept = ready._replace(inverse=None)
        progress = chosen(active, done._replace(inverse=None), kept)._replace(inverse=ready.inverse)
        return progress, (progress.state, stats)

    _, (later, stats) = lax.scan(step, steps.first(state0, t0, h[0]), h)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state0, later), stats
