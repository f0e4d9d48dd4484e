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
from jaxtyping import Array, Bool, Float

from lgsens.dynamics import AbstractSystem, State, constraint_jacobian
from lgsens.integrate._guess import Guess
from lgsens.integrate._lanes import renewed_where
from lgsens.integrate._newton import Chord, Constants, Solver, Stats, Wear, no_solver, take_step
from lgsens.integrate._scheme import GeneralizedAlpha
from lgsens.integrate._singular import Watch, margin_by_mass

_SAME = 2.0  # the change of h up to which modified Newton keeps its matrix


class _Past(NamedTuple):
    """The two states before the last one: where the parabola of the next guess passes."""

    t: Float[Array, "2"]
    vdot: Float[Array, "2 k"]
    lam: Float[Array, "2 m"]


class _Shared(NamedTuple):
    """The matrix that modified Newton keeps."""

    solver: Solver
    h: Float[Array, ""]  # of the step that it was made for
    wear: Wear  # by attempts


class Progress(NamedTuple):
    """The last state, and what the next step needs of those before."""

    state: State
    t: Float[Array, ""]
    h: Float[Array, ""]  # of the step that the state's a belongs to
    past: _Past
    contraction: Float[Array, ""]
    shared: _Shared | None
    watch: Watch  # margins by time
    watched: Float[Array, ""]  # when
    running: Bool[Array, ""]

    def chosen(self, which, other: "Progress") -> "Progress":
        """`self` where `which`, else `other`; but the matrix of `self`, which is large, in any case."""
        return chosen(which, self._replace(shared=None), other._replace(shared=None))._replace(shared=self.shared)


class Attempt(NamedTuple):
    """Where a step of size h leads."""

    state: State
    contraction: Float[Array, ""]
    stats: Stats
    shared: _Shared | None


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

    def _margin(self, state: State, t) -> Float[Array, ""]:
        """A margin (`_singular`) that can be compared with those of other step sizes."""
        jacobian = constraint_jacobian(self.system, state.q, t)
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
            shared=self._not_yet(state0, t0, h) if self.scheme.factor_every else None,
            watch=Watch.first(h.dtype),
            watched=t0,
            running=jnp.all(jnp.isfinite(state0.a)),
        )

    def _not_yet(self, state0: State, t0, h) -> _Shared:
        zeros = no_solver(self.scheme, self.system, self.constants, state0, t0, h)
        return _Shared(zeros, h, Wear.unused())

    def _due(self, progress: Progress, shared: _Shared, h):
        """Whether a step of size h wants a new matrix."""
        wear = shared.wear
        unknowns = self.system.group.dim + len(self.system.constraint_names)
        old = (wear.steps == 0) | (wear.steps >= self.scheme.factor_every) | wear.out(unknowns)
        passed = progress.t + h - progress.watched
        singular = progress.watch.ends_within(passed + 2.0 * self.scheme.factor_every * h)
        return old | singular | (h > _SAME * shared.h) | (_SAME * h < shared.h)

    def tried(self, progress: Progress, h, active) -> Attempt:
        """The state that a step of size h reaches; NaN unless `active` and converged."""
        start = moved(progress.state, h / progress.h)
        guess = Guess.first(start)._replace(contraction=progress.contraction, start=self._predicted(progress, h))
        shared, t = progress.shared, progress.t + h
        chord = None if shared is None else Chord(shared.solver, self._due(progress, shared, h))
        state, guess, stats, chord = take_step(
            self.scheme, self.system, self.constants, start, guess, chord, active, t, h
        )
        if shared is None or chord is None:
            margin = self._margin(state, t)
        else:
            made = chord.due
            margin = renewed_where(made, lambda: self._margin(state, t), jnp.full_like(h, jnp.nan))
            shared = _Shared(chord.solver, jnp.where(made, h, shared.h), shared.wear.after(made, stats.iterations))
        return Attempt(state, guess.contraction, stats._replace(margin=margin), shared)

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
        state, past, t = progress.state, progress.past, progress.t + h
        margin = found.stats.margin
        known = ~jnp.isnan(margin)
        return progress._replace(
            state=found.state,
            t=t,
            h=h,
            past=_Past(earlier(progress.t, past.t), earlier(state.vdot, past.vdot), earlier(state.lam, past.lam)),
            contraction=found.contraction,
            shared=found.shared,
            watch=chosen(known, progress.watch.after(margin, t - progress.watched), progress.watch),
            watched=jnp.where(known, t, progress.watched),
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
        found = steps.tried(progress, safe, active)
        done = steps.after(progress, found, safe)
        failed = ~progress.running
        stats = found.stats._replace(
            increment=jnp.where(active | failed, found.stats.increment, 0.0),
            residual=jnp.where(active | failed, found.stats.residual, 0.0),
            converged=jnp.where(active, found.stats.converged, progress.running),
        )
        progress = done.chosen(active, progress)
        return progress, (progress.state, stats)

    _, (later, stats) = lax.scan(step, steps.first(state0, t0, h[0]), h)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state0, later), stats
