"""Newton's iteration in one step.

An iteration with the matrix of an earlier step (modified Newton) evaluates the residual only, and contracts by 1e-3 to
1e-2 on the quarter-car when the matrix is up to 20 steps old. Started from extrapolated accelerations and multipliers
it takes three or four to round-off, each a tenth of a full one. Motion and multipliers converge in turns, so a long
chain contracts by 0.3 and by 1e-4 alternately: what counts is κ² = d_i/d_{i−2}, with d_i the increments. The next
iteration would move by about κ² d_{i−1}: where that is the square of the tolerance, or a fraction of round-off (the
errors of a thousand steps add up), the last one was enough.

Round-off, the increments that remain however often one iterates, grows with the scene: 4 ε for the 48 coordinates of
the quarter-car, 230 ε for the 3072 of a chain of 512 links, about ε for each dozen. Increments near it bound κ from
above and do not measure it. An iteration is also the last where increments of at most one ε for each coordinate no
longer fall.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens.dynamics import AbstractSystem, State, mass_matrix, require_independent, softness
from lgsens.integrate._guess import Guess
from lgsens.integrate._lanes import in_any_lane, renewed_where
from lgsens.integrate._scheme import AbstractStep, GeneralizedAlpha, Index3Step, Motion
from lgsens.integrate._stabilized import StabilizedFactors, StabilizedStep
from lgsens.linear import LU, Factors, Inverse, Matrix

Solver = Factors | StabilizedFactors
_MODIFIED_LIMIT = 12  # iterations; more cost as much as a full one
_STALLED = 0.3  # that from which on two full iterations cost less
_FASTEST = 0.02  # contractions of earlier steps, when the matrix was newer, are no better than this
_ROUGH = 64  # ε: increments below measure no contraction, and are noise where they fall no longer


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

    def step(self, scheme: GeneralizedAlpha, system: AbstractSystem, previous: State, h, t) -> AbstractStep:
        """The equations of the step from `previous`."""
        if scheme.stabilized:
            return StabilizedStep.of(scheme, system, self.mass, self.inverse_mass, previous, h, t)
        return Index3Step(scheme, system, self.mass, self.scale, self.softness, previous, h)


class Chord(NamedTuple):
    """The matrix that iterations of modified Newton share, in factors."""

    solver: Solver
    due: Bool[Array, ""]  # whether the step begins with a new one; after a step, whether it made one


class Wear(NamedTuple):
    """What has been done with the matrix that steps share.

    A matrix that serves s steps of n_1, …, n_s iterations costs (R + Σ n_i)/s iterations per step if making it costs R.
    This is least where the next step would take more than that; it is taken to need as many as the last one. R is 6
    for the top (9 unknowns), 10 for 35, 20 for the quarter-car (94) and for chains in blocks, and flat: with half or
    twice of it times change by 3 %. (A new matrix wherever the contraction exceeds 0.1, the rule before, was made three
    times as often on the quarter-car, and cost 42 % more: 59 and 42 µs per step of 1 ms.)
    """

    steps: Int[Array, ""]
    iterations: Int[Array, ""]
    last: Int[Array, ""]  # of the last step

    @classmethod
    def unused(cls) -> "Wear":
        return cls(*(jnp.zeros((), jnp.int32) for _ in range(3)))

    def after(self, made, iterations) -> "Wear":
        """After a step of so many iterations, which made a new matrix or not."""
        return Wear(jnp.where(made, 0, self.steps) + 1, jnp.where(made, 0, self.iterations) + iterations, iterations)

    def out(self, unknowns: int):
        """Whether a new matrix pays."""
        renewal = min(20, 4 + unknowns // 5)
        return (self.steps > 1) & (self.last * self.steps > renewal + self.iterations)


class _Iterate(NamedTuple):
    u: Float[Array, " k"]
    lam: Float[Array, " m"]
    increment: Float[Array, ""]
    before: Float[Array, ""]  # the increment before it
    contraction: Float[Array, ""]  # of modified Newton
    residual: Float[Array, ""]
    iterations: Int[Array, ""]
    modified: Int[Array, ""]  # how many of them were modified Newton's
    settled: Bool[Array, ""]  # what modified Newton left before this iteration was small enough
    full: Bool[Array, ""]  # modified Newton has given up: each iteration has a matrix of its own
    due: Bool[Array, ""]  # the next iteration wants a new matrix
    going: Bool[Array, ""]
    margin: Float[Array, ""]  # of the last matrix made


def take_step(
    scheme: GeneralizedAlpha,
    system: AbstractSystem,
    constants: Constants,
    previous: State,
    guess: Guess,
    chord: Chord | None,
    running,
    t,
    h,
    kind: Any = Inverse,
) -> tuple[State, Guess, Stats, Chord | None]:
    """The state at t = t_n + h, the guess for the next step, and what Newton did; NaN unless `running` and converged.

    `chord` has the iteration matrix of an earlier step, for modified Newton, in factors of `kind`; it is returned with
    the last one made. None: full Newton only.

    Modified Newton, and the full Newton that takes over where it gives up, are rounds of one loop: a new matrix at the
    iterate where one is due, then iterations until the next is. What makes a matrix, nearly all that there is to
    compile, so is compiled once.
    """
    scale, equations = constants.scale, constants.step(scheme, system, previous, h, t)
    eps = float(jnp.finfo(scale.dtype).eps)
    tolerance = max(scheme.tolerance, 64 * eps)
    round_off = max(1.0, len(scale) / 12) * eps
    target = max(tolerance**2, 0.04 * round_off)
    noise = max(_ROUGH, len(scale)) * eps
    u, lam = guess.extrapolated(previous)

    def matrix(iterate: _Iterate, kind) -> tuple[Solver, Float[Array, ""]]:
        return equations.factors(equations.motion(iterate.u, iterate.lam), iterate.lam, t, kind)

    def corrected(solver: Solver | None, iterate: _Iterate) -> _Iterate:
        motion = equations.motion(iterate.u, iterate.lam)
        residual, violation = equations.defect(motion, iterate.lam, t)
        solver, margin = matrix(iterate, LU) if solver is None else (solver, iterate.margin)
        du, dlam = solver.solve(residual, violation)
        size, count = jnp.max(equations.change(du, dlam) * (scheme.beta * h**2) / scale), iterate.iterations + 1
        found = iterate._replace(
            u=iterate.u - du,
            lam=iterate.lam - dlam,
            increment=size,
            residual=jnp.max(jnp.abs(residual)),
            iterations=count,
            margin=margin,
        )
        if scheme.iterations is not None:
            return found
        # NaN compares false, and ends full Newton
        unfinished = (size > tolerance) & (count - iterate.modified < scheme.max_iterations)
        return found._replace(going=unfinished) if chord is None else watched(found, iterate.increment, unfinished)

    def watched(iterate: _Iterate, last, unfinished) -> _Iterate:
        """After an iteration, with the increment of the one before: is modified Newton done, or does it give up?"""
        size, before, count, full = iterate.increment, iterate.before, iterate.iterations, iterate.full
        measured = ~full & (count > 2) & (before > noise)
        ratio = jnp.sqrt(jnp.maximum(size, round_off) / jnp.where(measured, before, 1.0))
        bounds = (size <= noise) & (count > 3)  # the one before was measured in this step, too
        ratio = jnp.where(bounds, jnp.minimum(ratio, iterate.contraction), ratio)
        contraction = jnp.where(measured, ratio, iterate.contraction)
        contraction = jnp.where(jnp.isfinite(contraction), contraction, 1.0)
        rough = (size <= noise) & (size > 0.25 * before)
        settled = ~full & ((last * contraction**2 <= target) | rough)
        fast = (count < 4) | (contraction < _STALLED)  # by then the second pair is measured
        gives_up = ~full & ~settled & ~(fast & (count < _MODIFIED_LIMIT))
        astray = gives_up & (contraction >= 1.0)
        return iterate._replace(
            u=jnp.where(astray, u, iterate.u),
            lam=jnp.where(astray, lam, iterate.lam),
            before=last,
            contraction=contraction,
            modified=jnp.where(full, iterate.modified, count),
            settled=settled,
            full=full | gives_up,
            due=full | gives_up,
            going=jnp.where(full, unfinished, ~settled),
        )

    def repeated(corrected, iterate: _Iterate) -> _Iterate:
        if scheme.iterations is not None:
            return lax.fori_loop(0, scheme.iterations, lambda _, iterate: corrected(iterate), iterate)
        return lax.while_loop(lambda iterate: iterate.going & ~iterate.due, corrected, iterate)

    def round_of(carry: tuple[_Iterate, Solver]) -> tuple[_Iterate, Solver]:
        iterate, solver = carry
        due = in_any_lane(iterate.due & iterate.going)
        solver, margin = renewed_where(due, lambda: matrix(iterate, kind), (solver, iterate.margin))
        return repeated(partial(corrected, solver), iterate._replace(due=no, margin=margin)), solver

    infinite, none, no = jnp.full((), jnp.inf, scale.dtype), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    iterate = _Iterate(
        u=u,
        lam=lam,
        increment=infinite,
        before=infinite,
        contraction=guess.contraction,
        residual=infinite,
        iterations=none,
        modified=none,
        settled=no,
        full=no,
        due=no,
        going=running,
        margin=jnp.full((), jnp.nan, scale.dtype),
    )
    if chord is None:
        iterate = repeated(partial(corrected, None), iterate)
    else:
        due = in_any_lane(chord.due & running)  # where one lane of a batch makes a matrix, all have the time to
        carry = iterate._replace(due=due), chord.solver
        if scheme.iterations is None:
            iterate, solver = lax.while_loop(lambda carry: in_any_lane(carry[0].going), round_of, carry)
        else:
            iterate, solver = round_of(carry)
        chord = Chord(solver, running & (due | iterate.full))
    motion = equations.motion(iterate.u, iterate.lam)
    state = State(q=motion.q, v=motion.v, vdot=motion.vdot, lam=iterate.lam, a=iterate.u)
    finite = jnp.all(jnp.isfinite(iterate.u)) & jnp.all(jnp.isfinite(iterate.lam))
    converged = running & (iterate.settled | (iterate.increment <= tolerance)) & finite
    state = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), state)
    stats = Stats(
        iterations=jnp.where(running, iterate.iterations, 0),
        increment=jnp.where(iterate.settled, jnp.minimum(iterate.increment, tolerance), iterate.increment),
        residual=iterate.residual,
        converged=converged,
        margin=jnp.where(converged, iterate.margin, jnp.nan),
    )
    return state, guess.after(previous, jnp.maximum(iterate.contraction, _FASTEST)), stats, chord


def no_solver(scheme: GeneralizedAlpha, system: AbstractSystem, constants: Constants, state: State, t, h) -> Solver:
    """Zeros in the shapes of the inverse of an iteration matrix, to begin with."""
    at_state = Motion(state.v, state.q, state.v, state.vdot)
    inverse = lambda: constants.step(scheme, system, state, h, t).factors(at_state, state.lam, t, Inverse)[0]
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(inverse))
