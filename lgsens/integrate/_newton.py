"""Newton's iteration in one step.

An iteration with the matrix of an earlier step (modified Newton) evaluates the residual only, and contracts by 1e-3 to
1e-2 on the quarter-car when the matrix is up to 20 steps old. Started from extrapolated accelerations and multipliers
it takes three or four to round-off, each a tenth of a full one. Motion and multipliers converge in turns, so a long
chain contracts by 0.3 and by 1e-4 alternately: what counts is κ² = d_i/d_{i−2}, with d_i the increments. The next
iteration would move by about κ² d_{i−1}: where that is the square of the tolerance, or a fraction of round-off (the
errors of a thousand steps add up), the last one was enough, if d_i²/d_{i−1} does not say otherwise: d_1 is mostly what
goes at once, and d_3/d_1 says little of the rest (a top on SE(3), a matrix 8 steps old: 1e-3, 1e-9, 1e-11).

Round-off, the increments that remain however often one iterates, grows with the scene: 4 ε for the 48 coordinates of
the quarter-car, 230 ε for the 3072 of a chain of 512 links, about ε for each dozen. Increments near it bound κ from
above and do not measure it. An iteration is also the last where increments of at most one ε for each coordinate no
longer fall.

Multipliers may lag behind. Where the joints of a body turn with it, as B = R B̄, its displacements do not see what is
missing from multipliers: the range of Bᵀ is that of the older B₀ᵀ, and Bᵀ ε in the residual is answered by δλ = R₀ᵀR ε
and no displacement. So ε contracts by |1 − R₀ᵀR|, the turn since the matrix was made, and grows for more than 1 rad (a
driven shaft with its centre of mass off the axis; a hinge on SE(3)). Hence an iteration is the last only if it changes
multipliers by little; where that does not fall any longer, and is no round-off, the step has a matrix of its own.
Round-off is ε m l/(βh²), of multipliers of m l per s² or more.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lgsens._xla import fori_loop, in_any_lane, renewed_where, while_loop
from lgsens.dynamics import State
from lgsens.integrate._alpha import AbstractStep, Matrix, at_least
from lgsens.integrate._guess import Guess
from lgsens.integrate._scheme import Stats
from lgsens.linear import LU, tuned

Solver = Any  # factors; None: each iteration makes its own
_FASTEST = 0.02  # contractions of earlier steps, when the matrix was newer, are no better than this
_ROUGH = 64  # ε: increments below measure no contraction, and are noise where they fall no longer
_LEFT = 0.01  # of the tolerance: what the last two increments let expect of the next one at most
_OF_FORCES = 1e-8  # of the largest multiplier: by how much the last iteration may change them
_FALLS = 0.7  # of the increment before


class _Iterate(NamedTuple):
    u: Float[Array, " k"]
    lam: Float[Array, " m"]
    increment: Float[Array, ""]
    before: Float[Array, ""]  # the increment before it
    of_forces: Float[Array, ""]  # the largest increment of a multiplier
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
    equations: AbstractStep, previous: State, guess: Guess, matrix: Matrix | None, due, running
) -> tuple[State, Guess, Stats, Matrix | None, Bool[Array, ""] | bool]:
    """The state at the end of the step, the guess for the next one, what Newton did, the matrix, and whether it is new.

    The state is NaN unless `running` and converged. `previous`, not resized: where the iteration starts. `matrix`: that
    of an earlier step, for modified Newton, or a new one where it is `due`. None: full Newton only.

    Modified Newton, and the full Newton that takes over where it gives up, are rounds of one loop: a new matrix at the
    iterate where one is due, then iterations until the next is. What makes a matrix, nearly all that there is to
    compile, so is compiled once.
    """
    scheme, scale, h = equations.shared.scheme, equations.shared.scale, equations.node.h
    eps = float(jnp.finfo(scale.dtype).eps)
    tolerance = at_least(scheme.tolerance, 64 * eps)
    round_off = max(1.0, len(scale) / 12) * eps
    target = at_least(tolerance**2, 0.04 * round_off)
    noise = max(_ROUGH, len(scale)) * eps
    weights = guess.weights(h, scheme.delta)
    u, lam = guess.extrapolated(previous, weights)
    kind = None if matrix is None else matrix.kind

    def factors(iterate: _Iterate, kind) -> tuple[Solver, Float[Array, ""]]:
        return equations.factors(equations.motion(iterate.u, iterate.lam), iterate.lam, kind)

    def corrected(solver: Solver, iterate: _Iterate) -> _Iterate:
        motion = equations.motion(iterate.u, iterate.lam)
        residual, violation = equations.defect(motion, iterate.lam)
        solver, margin = factors(iterate, LU) if solver is None else (solver, iterate.margin)
        du, dlam = solver.solve(residual, violation)
        size, count = jnp.max(equations.change(du, dlam) * (scheme.beta * h**2) / scale), iterate.iterations + 1
        found = iterate._replace(
            u=iterate.u - du,
            lam=iterate.lam - dlam,
            increment=size,
            of_forces=jnp.max(jnp.abs(dlam), initial=0.0),
            residual=jnp.max(jnp.abs(residual)),
            iterations=count,
            margin=margin,
        )
        if scheme.iterations is not None:
            return found
        # NaN compares false, and ends full Newton
        unfinished = (size > tolerance) & (count - iterate.modified < scheme.max_iterations)
        return found._replace(going=unfinished) if matrix is None else watched(found, iterate, unfinished)

    def watched(iterate: _Iterate, earlier: _Iterate, unfinished) -> _Iterate:
        """After an iteration, with the one before: is modified Newton done, or does it give up?"""
        last, largest = earlier.increment, jnp.max(jnp.abs(iterate.lam), initial=0.0)
        falls = iterate.of_forces <= _FALLS * earlier.of_forces
        allowed = jnp.where(falls, _OF_FORCES, at_least(_ROUGH * eps / (scheme.beta * h**2), _OF_FORCES))
        held = iterate.of_forces <= allowed * largest
        size, before, count, full = iterate.increment, iterate.before, iterate.iterations, iterate.full
        measured = ~full & (count > 2) & (before > noise)
        ratio = jnp.sqrt(jnp.maximum(size, round_off) / jnp.where(measured, before, 1.0))
        bounds = (size <= noise) & (count > 3)  # the one before was measured in this step, too
        ratio = jnp.where(bounds, jnp.minimum(ratio, iterate.contraction), ratio)
        contraction = jnp.where(measured, ratio, iterate.contraction)
        contraction = jnp.where(jnp.isfinite(contraction), contraction, 1.0)
        rough = (size <= noise) & (size > 0.25 * before)
        left = (size <= noise) | (size**2 <= _LEFT * tolerance * last)
        moves_no_more = ~full & ((last * contraction**2 <= target) & left | rough)
        settled = moves_no_more & held
        fast = (count < 4) | (contraction < tuned.CHORD_CONTRACTION)  # by then the second pair is measured
        stuck = moves_no_more & ~falls
        gives_up = ~full & ~settled & (stuck | ~(fast & (count < tuned.CHORD_ITERATIONS)))
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
            return fori_loop(0, scheme.iterations, lambda _, iterate: corrected(iterate), iterate)
        return while_loop(lambda iterate: iterate.going & ~iterate.due, corrected, iterate)

    def round_of(carry: tuple[_Iterate, Solver]) -> tuple[_Iterate, Solver]:
        iterate, solver = carry
        due = in_any_lane(iterate.due & iterate.going)
        solver, margin = renewed_where(due, lambda: factors(iterate, kind), (solver, iterate.margin))
        return repeated(partial(corrected, solver), iterate._replace(due=no, margin=margin)), solver

    infinite, none, no = jnp.full((), jnp.inf, scale.dtype), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    iterate = _Iterate(
        u=u,
        lam=lam,
        increment=infinite,
        before=infinite,
        of_forces=infinite,
        contraction=guess.contraction,
        residual=infinite,
        iterations=none,
        modified=none,
        settled=no,
        full=no,
        due=no,
        going=running,
        margin=jnp.full((), jnp.inf, scale.dtype),
    )
    made = True
    if matrix is None:
        iterate = repeated(partial(corrected, None), iterate)
    else:
        due = in_any_lane(due & running)  # where one lane of a batch makes a matrix, all have the time to
        carry = iterate._replace(due=due), matrix.solver
        if scheme.iterations is None:
            iterate, solver = while_loop(lambda carry: in_any_lane(carry[0].going), round_of, carry)
        else:
            iterate, solver = round_of(carry)
        made = running & (due | iterate.full)
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
        margin=jnp.where(converged, iterate.margin, jnp.inf),
    )
    guess = guess.after(previous, jnp.maximum(iterate.contraction, _FASTEST), weights, h)
    if matrix is not None:
        matrix = matrix.after(solver, made, stats.iterations, h)
    return state, guess, stats, matrix, made
