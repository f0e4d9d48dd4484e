"""Newton's iteration in one step, and all steps in one scan.

An iteration with the matrix of an earlier step (modified Newton) evaluates the residual only, and contracts by 1e-3 to
1e-2 on the quarter-car when the matrix is up to 20 steps old. Started from extrapolated accelerations and multipliers
it takes three or four to round-off, each a tenth of a full one. Motion and multipliers converge in turns, so a long
chain contracts by 0.3 and by 1e-4 alternately: what counts is κ² = d_i/d_{i−2}, with d_i the increments. The next
iteration leaves an error of about κ² d_i. Where that is the square of the tolerance, or a fraction of round-off
(the errors of a thousand steps add up), the next iteration is the last: to ask for smaller increments instead would be
to ask for what the round-off of the constraints does not allow. That round-off grows with the scene (to 500 ε in a
chain of 512 links), so an iteration is also the last where increments of that size no longer fall: of at most one ε for
each coordinate.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens.dynamics import AbstractSystem, State, mass_matrix, require_independent, softness
from lgsens.integrate._scheme import AbstractStep, GeneralizedAlpha, Index3Step, Motion, increment
from lgsens.integrate._singular import Watch
from lgsens.integrate._stabilized import StabilizedFactors, StabilizedStep
from lgsens.linear import Factors, Inverse, Matrix

Solver = Factors | StabilizedFactors
_MODIFIED_LIMIT = 12  # iterations; more cost as much as a full one
SLOW = 0.1  # the contraction from which on a new matrix pays, in the next step
_STALLED = 0.3  # that from which on two full iterations cost less
_FASTEST = 0.02  # contractions measured close to round-off are no better than this
_ROUGH = 64  # round-offs: increments below say nothing of the contraction, and are noise where they fall no longer


class Stats(NamedTuple):
    """What Newton did in each step (in `take_step`: in one).

    Attributes:
        iterations: iterations of each step, those of modified Newton included, shape (n,), int32; 0 after a failure.
        increment: the last increment of each step, relative as in `GeneralizedAlpha.tolerance`, shape (n,).
        residual: the largest entry of the residual r before that increment [N or N m], shape (n,).
        converged: whether each step converged, shape (n,), bool.
        margin: how far the step is from a singular configuration (`_singular`), NaN where that was not looked at,
            shape (n,).
    """

    iterations: Int[Array, " n"]
    increment: Float[Array, " n"]
    residual: Float[Array, " n"]
    converged: Bool[Array, " n"]
    margin: Float[Array, " n"]


class Constants(NamedTuple):
    """What all steps share."""

    mass: Matrix  # M, (k, k)
    scale: Float[Array, " k"]
    softness: Float[Array, " m"] | None  # c; None: no constraint may be redundant
    inverse_mass: Matrix = None  # M⁻¹, (k, k), where the scheme is stabilized; M is dense there

    @classmethod
    def of(cls, system: AbstractSystem, *, stabilized: bool = False) -> "Constants":
        scale = system.coordinate_scale()
        if stabilized:
            require_independent(system, "GeneralizedAlpha(stabilized=True)")
            mass = system.mass_matrix()
            return cls(mass, scale, None, jnp.linalg.inv(mass))
        return cls(mass_matrix(system), scale, softness(system))

    def step(self, scheme: GeneralizedAlpha, system: AbstractSystem, previous: State, h) -> AbstractStep:
        """The equations of the step from `previous`."""
        if scheme.stabilized:
            return StabilizedStep.of(scheme, system, self.mass, self.inverse_mass, previous, h)
        return Index3Step(scheme, system, self.mass, self.scale, self.softness, previous, h)


class Guess(NamedTuple):
    """Where the next step's iteration starts, the parabola through the last three accelerations and multipliers, and
    how fast modified Newton contracted in this one."""

    a: tuple[Float[Array, " k"], Float[Array, " k"]]  # a_n, a_{n-1}
    lam: tuple[Float[Array, " m"], Float[Array, " m"]]
    contraction: Float[Array, ""]
    start: tuple[Float[Array, " k"], Float[Array, " m"]] | None = None  # u and λ, where steps are not equal

    @classmethod
    def first(cls, state0: State) -> "Guess":
        return cls((state0.a, state0.a), (state0.lam, state0.lam), jnp.ones((), state0.a.dtype))

    def extrapolated(self, state: State):
        """u and λ: 3 x_n − 3 x_{n−1} + x_{n−2}."""
        if self.start is not None:
            return self.start
        return tuple(3.0 * (x - last) + before for x, (last, before) in ((state.a, self.a), (state.lam, self.lam)))

    def after(self, state: State, contraction) -> "Guess":
        return Guess((state.a, self.a[0]), (state.lam, self.lam[0]), contraction)


class _Iterate(NamedTuple):
    u: Float[Array, " k"]
    lam: Float[Array, " m"]
    increment: Float[Array, ""]
    before: Float[Array, ""]  # the increment before
    contraction: Float[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    settled: Bool[Array, ""]  # what modified Newton left before this iteration was small enough
    margin: Float[Array, ""]  # of full Newton


def take_step(
    scheme: GeneralizedAlpha,
    system: AbstractSystem,
    constants: Constants,
    previous: State,
    guess: Guess,
    earlier: Solver | None,
    running,
    t,
    h,
) -> tuple[State, Guess, Stats]:
    """The state at t = t_n + h, the guess for the next step, and what Newton did; NaN unless `running` and converged.

    `earlier` solves with the iteration matrix of an earlier step, for modified Newton; None: full Newton only.
    """
    scale, equations = constants.scale, constants.step(scheme, system, previous, h)
    eps = float(jnp.finfo(scale.dtype).eps)
    tolerance = max(scheme.tolerance, 64 * eps)
    target = max(tolerance**2, 0.04 * eps)
    noise = max(_ROUGH, len(scale)) * eps

    def corrected(factors: Solver | None, iterate: _Iterate) -> _Iterate:
        motion = equations.motion(iterate.u, iterate.lam)
        residual, violation = equations.defect(motion, iterate.lam, t)
        solver, margin = equations.factors(motion, iterate.lam, t) if factors is None else (factors, iterate.margin)
        du, dlam = solver.solve(residual, violation)
        size = jnp.max(equations.change(du, dlam) * (scheme.beta * h**2) / scale)
        measured = (iterate.iterations > 1) & (iterate.before > noise)
        ratio = jnp.sqrt(size / jnp.where(measured, iterate.before, 1.0))
        contraction = jnp.where(measured, jnp.maximum(ratio, _FASTEST), iterate.contraction)
        rough = (size <= noise) & (size > 0.25 * iterate.before)
        settled = (iterate.increment * iterate.contraction**2 <= target) | rough
        largest, count = jnp.max(jnp.abs(residual)), iterate.iterations + 1
        return _Iterate(
            iterate.u - du, iterate.lam - dlam, size, iterate.increment, contraction, largest, count, settled, margin
        )

    # NaN compares false, and ends the iterations

    def contracting(iterate: _Iterate):
        fast = (iterate.iterations < 4) | (iterate.contraction < _STALLED)  # by then the second pair is measured
        return running & ~iterate.settled & fast & (iterate.iterations < _MODIFIED_LIMIT)

    def unfinished(iterate: _Iterate):
        return running & (iterate.increment > tolerance) & (iterate.iterations < scheme.max_iterations)

    infinite, none, no = jnp.full((), jnp.inf, scale.dtype), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    unknown = jnp.full((), jnp.nan, scale.dtype)
    u, lam = guess.extrapolated(previous)
    iterate = _Iterate(u, lam, infinite, infinite, guess.contraction, infinite, none, no, unknown)
    contraction = guess.contraction
    before = none
    if scheme.iterations is not None:
        iterate = lax.fori_loop(0, scheme.iterations, lambda _, iterate: corrected(earlier, iterate), iterate)
        iterate = iterate._replace(iterations=jnp.where(running, iterate.iterations, 0))
    elif earlier is not None:
        iterate = lax.while_loop(contracting, partial(corrected, earlier), iterate)
        closer = iterate.contraction < 1.0
        contraction = jnp.where(jnp.isfinite(iterate.contraction), iterate.contraction, 1.0)
        before = iterate.iterations
        iterate = _Iterate(
            u=jnp.where(closer, iterate.u, u),
            lam=jnp.where(closer, iterate.lam, lam),
            # an increment that ends full Newton before its first iteration
            increment=jnp.where(iterate.settled, jnp.minimum(iterate.increment, tolerance), infinite),
            before=infinite,
            contraction=contraction,
            residual=iterate.residual,
            iterations=none,
            settled=no,
            margin=unknown,
        )
    if scheme.iterations is None:
        iterate = lax.while_loop(unfinished, partial(corrected, None), iterate)
    motion = equations.motion(iterate.u, iterate.lam)
    state = State(q=motion.q, v=motion.v, vdot=motion.vdot, lam=iterate.lam, a=iterate.u)
    finite = jnp.all(jnp.isfinite(iterate.u)) & jnp.all(jnp.isfinite(iterate.lam))
    converged = running & (iterate.increment <= tolerance) & finite
    state = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), state)
    stats = Stats(before + iterate.iterations, iterate.increment, iterate.residual, converged, iterate.margin)
    return state, guess.after(previous, contraction), stats


def inverse_at(
    scheme: GeneralizedAlpha, system: AbstractSystem, constants: Constants, state: State, t, h
) -> tuple[Solver, Float[Array, ""]]:
    """The inverse of the iteration matrix of a step of size h from here, for modified Newton; its margin."""
    at_state = Motion(increment(scheme, state, state.a, h), state.q, state.v, state.vdot)
    return constants.step(scheme, system, state, h).factors(at_state, state.lam, t, Inverse)


Found = TypeVar("Found")


def no_inverse(inverse: Callable[..., Found], *arguments) -> Found:
    """Zeros of the shapes that `inverse(*arguments)` has, to begin with."""
    shape = jax.eval_shape(inverse, *arguments)
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)


def renewed_where(due, inverse: Callable[[], Found], earlier: Found) -> Found:
    """`inverse()` where it is due. A loop of no or one turn, because `cond` would copy the inverse."""
    renewed = lambda carry: (jnp.zeros((), bool), inverse())
    return lax.while_loop(lambda carry: carry[0], renewed, (due, earlier))[1]


def integrate(
    scheme: GeneralizedAlpha, num_steps: int, system: AbstractSystem, state0: State, t0, h
) -> tuple[State, Stats]:
    """The states at t0 + n h, n = 0 … num_steps, stacked along a leading axis.

    A step that does not converge ends the simulation: it and the steps after it are NaN, and `Stats` says so.
    """
    states, _, stats = integrate_outputs(scheme, num_steps, system, state0, t0, h, lambda state, _: state)
    return states, stats


def integrate_outputs(
    scheme: GeneralizedAlpha,
    num_steps: int,
    system: AbstractSystem,
    state0: State,
    t0,
    h,
    output: Callable[[State, Any], Any],
) -> tuple[Any, State, Stats]:
    """`output(state, t)` stacked instead of the states, the final state, and what Newton did."""
    later, end, stats = integrate_onward(scheme, num_steps, system, Mark.first(state0), t0, h, output)
    first = jax.tree.map(jnp.asarray, output(state0, t0))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), first, later), end.state, stats


class Mark(NamedTuple):
    """Where a run can go on: the n-th state, and what the iteration of the next step knows of the steps before."""

    n: Float[Array, ""]
    state: State
    guess: Guess
    running: Bool[Array, ""]
    watch: Watch

    @classmethod
    def first(cls, state0: State) -> "Mark":
        dtype = state0.a.dtype
        return cls(jnp.zeros((), dtype), state0, Guess.first(state0), jnp.ones((), bool), Watch.first(dtype))


def integrate_onward(
    scheme: GeneralizedAlpha,
    num_steps: int,
    system: AbstractSystem,
    mark: Mark,
    t0,
    h,
    output: Callable[[State, Any], Any],
) -> tuple[Any, Mark, Stats]:
    """`num_steps` steps on from a mark: `output(state, t)` after each of them, stacked; the mark that they reach.

    The steps are those of one long run where n of the mark is a multiple of `factor_every`: the inverse of the
    iteration matrix is due there, and is not part of the mark.
    """
    constants = Constants.of(system, stabilized=scheme.stabilized)

    def inverse(state: State, n) -> tuple[Solver, Float[Array, ""]]:
        return inverse_at(scheme, system, constants, state, t0 + n * h, h)

    def step(carry, n):
        previous, guess, earlier, age, running, watch = carry
        margin = watch.margin
        if earlier is not None:
            # A matrix that contracts slowly is renewed, unless it was new: then full Newton takes over. In a batch
            # every lane pays for the slowest; for its full iterations it would pay more.
            steps = jnp.maximum(age, 1).astype(margin.dtype)
            due = (jnp.mod(n, scheme.factor_every) == 0) | watch.ends_within(steps + 2.0 * scheme.factor_every)
            if scheme.iterations is None:  # else by the clock, which is the same in all lanes
                due = due | ((guess.contraction >= SLOW) & (age > 1))
            age = jnp.where(due, 0, age) + 1
            earlier, margin = renewed_where(due, partial(inverse, previous, n), (earlier, margin))
            watch = jax.tree.map(partial(jnp.where, due), watch.after(margin, steps), watch)
            margin = jnp.where(due, margin, jnp.nan)
        t = t0 + (n + 1) * h
        state, guess, stats = take_step(scheme, system, constants, previous, guess, earlier, running, t, h)
        if earlier is not None:
            stats = stats._replace(margin=margin)
        return (state, guess, earlier, age, stats.converged, watch), (output(state, t), stats)

    count = mark.n + jnp.arange(num_steps, dtype=constants.scale.dtype)
    earlier = None
    if scheme.factor_every:
        earlier, _ = no_inverse(inverse, mark.state, count[0])
    start = (mark.state, mark.guess, earlier, jnp.zeros((), jnp.int32), mark.running, mark.watch)
    (state, guess, _, _, running, watch), (outputs, stats) = lax.scan(step, start, count)
    return outputs, Mark(mark.n + num_steps, state, guess, running, watch), stats
