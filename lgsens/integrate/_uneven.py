"""Steps whose sizes error control finds.

A scheme says what a step adds to the error of a configuration, e = h^p c (`step_error`, `error_power`).
Generalized-α, p = 3: what the increment of eq. (27) misses of the true one, at no cost (`missed_increment`), with
v̈ ≈ (a_{n+1} − a_n)/h, a_n that of this step. Radau IIA, p = 4: the error of its polynomial within the step (`_radau`).
It is measured by the largest

    |e_i|/s_i,     s = 1 rad or the length of the scene,

and kept below the tolerance. It is that of a step and not of a unit of time: local errors add up to ∫ h^{p−1} |c| dt,
in ∫ dt/h steps, and for a given sum the steps are fewest where h^p |c| is the same in all. The size of the next one
follows from the errors of the last two, E = |e|/tolerance, by the filter

    ρ = (θ/E_n)^{1/(4p)} (θ/E_{n−1})^{1/(4p)} (h_n/h_{n−1})^{−1/4},      h_{n+1} = h_n (1 + κ arctan((ρ − 1)/κ)).

It does not answer to what alternates from step to step, as accelerations do after a change, with (−ρ∞)ⁿ. Sizes stay as
they are while this asks for 0.93 to 1.2 of them: a step of another size costs a factorization more in index 3, in the
sweeps too (`_grid`), and nothing is lost by fewer changes: 53 of 370 steps on the quarter-car's bump change their size
and not 342, with the same number of steps and error, 72 of 616 instead of 513 of 580 in a four-bar linkage. (Down to
0.85 as many, but three times as many steps are rejected; up to 1.3 steps are 4 % more.)

From π in a step on the samples of an unsteady body, and with them the estimate of the error, say nothing of its motion
(`dynamics._unseen`): no step turns one by more than half of it, whatever its error.

The derivative is that of the scheme on the grid found, so nothing here is differentiated.

Sources: Géradin & Cardona, Flexible Multibody Dynamics (2001), §11; Söderlind, ACM Transactions on Mathematical
Software 29 (2003), doi:10.1145/641876.641877 (filter H211b); Söderlind & Wang, Journal of Computational and Applied
Mathematics 185 (2006), doi:10.1016/j.cam.2005.03.008 (limiter).
"""

import math
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens._brief import brief
from lgsens._validate import require_setting
from lgsens._xla import alike, in_any_lane, scan, while_loop
from lgsens.dynamics import AbstractSystem, State, jerk, unsteady_rate
from lgsens.integrate._generalized_alpha import GeneralizedAlpha
from lgsens.integrate._given import AbstractUnevenSteps, GivenSteps
from lgsens.integrate._grid import Start, renewed
from lgsens.integrate._integrator import Laid
from lgsens.integrate._linearized import Node
from lgsens.integrate._loops import with_first
from lgsens.integrate._march import Progress, Walk, selected
from lgsens.integrate._pieces import PieceEnds, moved, piece_ends
from lgsens.integrate._scheme import AbstractScheme, Stats, scheme_of
from lgsens.integrate._uneven_grid import UnevenGrid, without_round_off

_AIM = 0.5  # θ: few steps are rejected
_LIMIT = 1.0  # κ: no step is more than 2.6 times as long as the one before
_ATTEMPTS = 20  # at one step
_TURN = math.pi / 2  # rad, what an unsteady body may turn by in a step
_KEPT = (0.93, 1.2)  # what is asked for, relative to a size that stays
_LEAST = 1e-6  # errors below this fraction of the tolerance count as so large


class AdaptiveSteps(AbstractUnevenSteps):
    """Steps under error control: an integrator of `simulate`.

        |e_i| ≤ tolerance s_i,     s = 1 rad or the length of the scene

    with e = h^p c as the scheme estimates it: of generalized-α, and of schemes that say nothing else, the part of the
    increment (27) that it misses, p = 3, c = (1/6 − β − Δ/2) v̈ + ad(v) v̇/12, Δ = α_m − α_f, v̈ ≈ (a_{n+1} − a_n)/h;
    of Radau IIA the largest error within the step, p = 4. Whatever it is, no step turns a body whose angular velocity
    changes by more than π/2.

    Arguments:
        integrator: the scheme, `GeneralizedAlpha` or another one.
        tolerance: the error that a step may add to a configuration, relative to 1 rad or the length of the scene.
            Global errors of generalized-α fall as tolerance^(2/3): a thousandth of it, a hundredth of them, in ten
            times the steps. Those of Radau IIA fall as its power 1 to 5/4, in stiff scenes 3/4.
        longest: the longest step, as a fraction of the interval t1 − t0; for Radau IIA, whose steps are few, 1.

    Steps end where a signal or a derivative of it jumps (`AbstractSignal.breaks`), of which there may be 256, and there
    are three at least between two such times. Of other events a system at rest does not see ahead: let `longest` be no
    more than half the shortest one that comes then.

    `num_steps` of `simulate` is the largest number of steps. The trajectory has so many rows; those after the last step
    repeat t1 and the state there, so that integrals and `state(-1)` are right, and its `stats` are `ControlledStats`.
    They take next to no time, but memory.

    The derivative is that of the numerical solution on the grid found, exactly, in both modes, breaks moving the steps
    that end at them; under `vmap` each lane has its own. The sizes themselves change a little with the parameters,
    which the derivative leaves out: finite differences agree with it on the same grid (`GivenSteps.of`).
    **Sensitivities**: their errors are not controlled, but the scheme is stable at any step size for the motion and so
    for its linearization: across a bump gradients by hardpoints converge as Ψ does (`benchmarks/variable_steps.py`).
    The criterion's trapezoidal rule sees the grid too.
    **Multipliers**, and with them forces in joints and drivers, converge as the motion does.

    All static and hashable. Raises `ValueError` for settings out of range.
    """

    any_number: ClassVar[bool] = False
    by_motion: ClassVar[bool] = True
    integrator: AbstractScheme = eqx.field(static=True, default=GeneralizedAlpha())
    tolerance: float = eqx.field(static=True, default=1e-6, kw_only=True)
    longest: float = eqx.field(static=True, default=0.02, kw_only=True)

    def __check_init__(self):
        scheme_of("AdaptiveSteps", self.integrator)
        valid = isinstance(self.tolerance, int | float) and 0.0 < self.tolerance < math.inf
        require_setting(self, "tolerance", valid, "positive", "; try 1e-6")
        valid = isinstance(self.longest, int | float) and 0.0 < self.longest <= 1.0
        require_setting(self, "longest", valid, "in (0, 1]", "; 0.02 is the default")

    def lay(self, system, start, t0, t1, num_steps):
        ends = piece_ends(system, t0, t1)
        # What error control decides has no derivative: its sizes, as parts of their pieces, are constants of the run.
        frozen = lax.stop_gradient((system, start, t0, (t1 - t0) / num_steps))
        found = lax.stop_gradient(_controlled_steps(self, num_steps, *frozen))
        sizes, states, stats, reached = found
        sizes, begins = moved(sizes, lax.stop_gradient(ends), ends)
        restarts = self.integrator.restarts(system)
        grid = UnevenGrid.first(t0, sizes, room=True, fixed=True, restarts=restarts, moving=begins)
        return Laid(grid, (states, Stats(*stats[: len(Stats._fields)])), stats, reached)

    def frozen(self, trajectory):
        return GivenSteps.of(trajectory, self.integrator)


class ControlledStats(NamedTuple):
    """What Newton and the error control did in each step.

    Attributes:
        iterations, increment, residual, converged, margin: as in `Stats`, shape (n,); iterations are those of rejected
            attempts too, and 0 after the last step.
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

    __repr__ = brief


class _Trial(NamedTuple):
    """A step of size h, tried, and where it leads."""

    h: Float[Array, ""]
    done: Progress
    stats: Stats
    error: Float[Array, ""]
    rejected: Int[Array, ""]
    trying: Bool[Array, ""]
    resized: Start  # the state that it begins with, for any size,
    known: Bool[Array, ""]  # if that was asked for


def _controlled_steps(
    settings: AdaptiveSteps, num_steps: int, system: AbstractSystem, first: Start, t0, h
) -> tuple[Float[Array, " n"], State, ControlledStats, Bool[Array, ""]]:
    """Sizes, states and statistics of at most `num_steps` steps from t0 on, and whether they reach t0 + num_steps h.

    Those not needed have size 0 and repeat the last state. The first size is taken from v̈ at t0 (`first_error`).
    """
    scheme, total = settings.integrator, num_steps * h
    walk, scale, power = Walk.of(scheme, system), system.coordinate_scale(), scheme.error_power
    tolerance = max(settings.tolerance, 16 * float(jnp.finfo(h.dtype).eps))
    pieces, restarts = PieceEnds.of(system, t0, total), scheme.restarts(system)

    def relative(c, h):
        return h**power * jnp.max(jnp.abs(c) / scale) / tolerance

    def fitted(h, remaining, longest):
        """A whole number of such steps for what remains: none at the end that differs from those before."""
        most = settings.longest * total
        least = remaining / (most if longest is None else jnp.minimum(most, longest))
        return remaining / jnp.ceil(jnp.maximum(remaining / h - 0.1, least * (1.0 - 1e-9)))

    def step(carry, n):
        progress, size, proposed, before, elapsed = carry
        active = progress.running & (elapsed < total)
        until, longest = pieces.after(elapsed)
        remaining = jnp.where(active, until - elapsed, h)
        wanted = fitted(proposed, remaining, longest)
        resize = lambda: scheme.resized(system, progress.state, t0 + elapsed)
        shapes = jax.eval_shape(resize)
        none_yet = alike(jax.tree.map(jnp.zeros_like, shapes), shapes)

        def begins(trial: _Trial) -> tuple[Progress, Float[Array, ""]]:
            """A first step begins with the state that belongs to its size, another with what earlier trials leave."""
            state = selected(n == 0, first.at(system, trial.h), progress.state)
            begin = progress._replace(state=state).with_matrix(trial.done.memory.matrix)
            return begin, jnp.where(n == 0, trial.h, size)

        def attempt(trial: _Trial) -> _Trial:
            start, size = begins(trial)
            state, h = start.state, trial.h
            ratio = without_round_off(h / size)
            changes = trial.trying & (ratio != 1.0)
            due = in_any_lane(changes & ~trial.known)
            resized = lax.cond(due, lambda: alike(resize(), shapes), lambda: trial.resized)
            node = Node(t0 + elapsed, t0 + (elapsed + h), h)
            begun = selected(changes, resized.at(system, ratio), state)
            if restarts is not None:
                anew = renewed(restarts, node, ratio)
                renew = lambda begun: alike(selected(anew, scheme.renewed(system, begun, node), begun), begun)
                begun = lax.cond(in_any_lane(trial.trying & anew), renew, lambda begun: begun, begun)
            done, stats = walk.take(start, begun, node, trial.trying)
            error = relative(scheme.step_error(system, begun, done.state, done.memory, node), h)
            turn = h * unsteady_rate(system, done.state.v, done.state.vdot)
            accepted = stats.converged & (error <= 1.0) & ~(turn > _TURN)
            allowed = jnp.minimum(error ** (-1.0 / power), _TURN / turn)
            shorter = jnp.where(stats.converged, jnp.clip(0.8 * allowed, 0.1, 0.8), 0.25)
            rejected = trial.rejected + (~accepted).astype(jnp.int32)
            again = ~accepted & (rejected < _ATTEMPTS)
            given_up = ~accepted & ~again
            done = Progress(
                state=jax.tree.map(lambda leaf: jnp.where(given_up, jnp.nan, leaf), done.state),
                memory=done.memory,
                running=stats.converged & ~given_up,
            )
            stats = stats._replace(iterations=trial.stats.iterations + stats.iterations, converged=done.running)
            h = jnp.where(again, h * shorter, h)
            new = _Trial(h, trial.done, stats, error, rejected, again, resized, trial.known)
            kept = selected(trial.trying, new, trial)
            return kept._replace(done=done.where(trial.trying, trial.done), known=trial.known | due)

        none = jnp.zeros((), jnp.int32)
        stats = Stats(none, h * 0.0, h * 0.0, progress.running, jnp.full_like(h, jnp.inf))
        trial = while_loop(
            lambda trial: in_any_lane(trial.trying),
            attempt,
            _Trial(wanted, progress, stats, h * 0.0, none, active, none_yet, jnp.zeros((), bool)),
        )
        _, size = begins(trial)
        progress = trial.done.where(active, progress)
        error = jnp.maximum(trial.error, _LEAST)
        rho = (_AIM / error * _AIM / before) ** (1.0 / (4 * power)) * (size / trial.h) ** 0.25
        grown = trial.h * (1.0 + _LIMIT * jnp.arctan((rho - 1.0) / _LIMIT))
        keeps = (grown > _KEPT[0] * trial.h) & (grown < _KEPT[1] * trial.h)
        longest = 0.8 * _TURN / unsteady_rate(system, progress.state.v, progress.state.vdot)
        proposed = jnp.minimum(jnp.where(keeps, trial.h, grown), longest)
        elapsed = jnp.where(active, jnp.where(trial.h >= remaining, until, elapsed + trial.h), elapsed)
        h_taken = jnp.where(active | ~progress.running, trial.h, 0.0)
        carry = (progress, jnp.where(active, trial.h, size), proposed, error, elapsed)
        return carry, (h_taken, progress.state, trial.stats, trial.error * tolerance, trial.rejected)

    v, vdot = first.state.v, first.state.vdot
    begun = jerk(system, first.state.q, v, vdot, first.state.lam, t0)
    expected = relative(scheme.first_error(system, v, vdot, begun), h)
    guess = h * jnp.minimum(1.0, (_AIM / jnp.maximum(expected, _LEAST)) ** (1.0 / power))
    begun = first.at(system, guess)
    memory = scheme.memory(walk.shared, begun, Node(t0, t0 + guess, guess), uneven=True)
    running = jnp.all(jnp.isfinite(begun.a))
    begin = (Progress(begun, memory, running), guess, guess, jnp.full((), _AIM, h.dtype), h * 0.0)
    (*_, elapsed), (sizes, later, newton, errors, rejected) = scan(step, begin, jnp.arange(num_steps))
    states = with_first(first.at(system, sizes[0]), later)
    taken = jnp.sum((sizes > 0.0) & newton.converged).astype(jnp.int32)
    stats = ControlledStats(*newton, errors, rejected, taken)
    return sizes, states, stats, elapsed >= total
