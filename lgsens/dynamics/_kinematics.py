"""Kinematic analysis: the positions, velocities and accelerations that constraints alone determine, and their forces.

A driven mechanism has as many equations as coordinates, Φ(q, s, t; p) = 0 with the driven values s, the time t and the
numbers p of the system. Where A = B(q, t) is regular, it has one solution q(s, t; p) nearby (Haug 1989, §3.6). What is
said of s below includes t.

Position. Newton's iteration on the group, q ← q exp(−(A⁻¹Φ)~), from one s to the next. Its first step is that along
the tangent; what the others add, the curvature of the way, is a share of it where s changes by little. But near a dead
centre two ways to assemble the mechanism come close to each other, and the tangent of one leads to the other. There A
is singular in between. With A₀ at the start of a step and A₁ at its end no (1 − τ) A₀ + τ A₁ is, if no eigenvalue of

    C = A₁⁻¹ A₀,     S ← (c S + (c S)⁻¹)/2 from S = C,     c² = |S⁻¹|/|S|,

is real and negative. All have a positive real part where C + Cᵀ is positive definite, as it is but near dead centres,
or where the iteration (Newton's for the sign of a matrix) comes to S = I. (The sign of det C alone does not tell two
loops that change over at once.) So a step from s₀ to s₁ is taken in parts where it turns too far (`_FAR`), is bent
too much (`_BENT`), or is not sure of that. What is not at the shortest steps either (`_SHORT`) passes a singular
position itself, as a parallelogram that lies flat: the way that goes straight on is followed.

Derivatives of the position. Let δq = q w̃. By the chain rule, with DΦ·(q w̃) = A w,

    0 = δΦ = A w + Φ_s δs + Φ_p δp     ⟹     w = −A⁻¹ (Φ_s δs + Φ_p δp).

One factorization of A at the solution gives w for every δs and δp: in forward mode one right-hand side per
parameter, in reverse mode, by the transposed factors, μ = A⁻ᵀ q̄ and p̄ = −Φ_pᵀ μ, one per output. Φ_s δs + Φ_p δp is the
tangent of Φ at fixed q: nothing is differentiated along the iteration, nor by where it started.

Velocity and acceleration. With s moving at constant rates ṡ (of t 1, or 0 where signals are held), two derivatives of
Φ(q(s), s) = 0 along the motion (q ṽ, ṡ) are

    A v + Φ_s ṡ = 0,     A v̇ + Γ = 0,     Γ = d/dt (DΦ·(q ṽ) + Φ_s ṡ) at fixed v.

Forces. Inverse dynamics: r(q, v, v̇, λ, t) = r(q, v, v̇, 0, t) + Aᵀλ = 0 determines λ, as A is square.

Redundant constraints (`_redundant`) are more equations than coordinates, of which as many as there are coordinates are
independent: A has full column rank, and b on the right-hand sides above is in its range. A⁻¹b and A⁻ᵀf are x and λ of

    [[I, A], [Aᵀ, 0]] [λ; x] = [b; 0],     [[I, A], [Aᵀ, 0]] [λ; x] = [0; f],

least squares and least norm by the factors of one matrix. Where an iterate is not a solution the first is the
Gauss–Newton step, as fast, since Φ = 0 in the end; the norm of λ is the right one (`least_norm`) where it is read.

Singular positions. Where A loses rank (an arm at its full reach, a slider that drives its crank out of a dead centre)
s does not determine the motion: rates and forces are infinite. Newton's iteration still converges, each step half of
that before, to where its steps are √eps, and with them the smallest singular value of A; so rates come out as 10⁸,
accelerations as 10²⁴. With A by the scale of its columns and of the rows that this leaves, Â, and any vector g,

    Â z = g,     Âᵀ w = z/|z|,     1/|w| ≥ σ_min(Â)

is one inverse iteration, and near to σ_min where that is small beside the others.
"""

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.linalg import lu_factor, lu_solve
from jaxtyping import Array, Bool, Float, Int

from lgsens._xla import while_loop
from lgsens.dynamics._constraints import violation_of_all
from lgsens.dynamics._matrices import require_linear
from lgsens.dynamics._system import AbstractSystem, State
from lgsens.linear import sound

_MAX_ITERATIONS = 40
_AT_ONCE = 0.2  # rad, or of the scene: of an iteration that looks for the first position
_FAR = 1.0  # likewise: the first step of an iteration from one position to the next
_BENT = 1.25  # what the others add, of the first: as much on the way to a dead centre, where s is its square
_SLOW = 0.75  # a step of that iteration, of the one before; to a singular position it is half of that
_NEAR = 1e-3  # what they may add always, rad or of the scene
_LESS = 0.45  # a part of a step after one that failed; not a half, by which symmetric ones meet a dead centre
_LEAST = 2.0**-16  # the shortest part of a step
_TURNS = 20  # of the iteration for the sign of a matrix
_SHORT = 4000.0  # a multiple of √eps, rad or of the scene: steps that pass a singular position, long beside `_SINGULAR`
_SINGULAR = 8.0  # a multiple of √eps: so near to a singular position Newton's iteration ends, there or beside it


class AbstractDrive(eqx.Module):
    """A system some of whose constraints prescribe d numbers s, so that it has as many constraints as coordinates, or
    more where they may be redundant."""

    system: eqx.AbstractVar[AbstractSystem]

    @property
    @abc.abstractmethod
    def own(self) -> Float[Array, " d"]:
        """The values of s that the system has."""

    @abc.abstractmethod
    def at(self, values: Float[Array, " d"]) -> AbstractSystem:
        """The system with these values of s."""


class Positions(NamedTuple):
    """The configurations for n sets of values."""

    q: Any  # stacked along a leading axis n, `sound` where none was found
    found: Bool[Array, " n"]  # whether Newton's iteration converged to one that is not singular
    singular: Bool[Array, " n"]  # whether it did to one that is
    violation: Float[Array, "n m"]  # Φ there


def _square(matrix: Float[Array, "m k"]) -> Float[Array, "n n"]:
    """A, or the matrix whose solutions are those of A in least squares and of Aᵀ in least norm."""
    m, k = matrix.shape
    if m == k:
        return matrix
    # not a QR, whose derivative adds batched LAPACK calls that do not depend on each other (`lgsens._xla`)
    return jnp.block([[jnp.eye(m, dtype=matrix.dtype), matrix], [matrix.T, jnp.zeros((k, k), matrix.dtype)]])


def _solved_by(solve: Callable[[Array, bool], Array], shape: tuple[int, ...], rhs: Array, transposed: bool) -> Array:
    """A⁻¹ b, shape (k,), or A⁻ᵀ f, shape (m,), by what solves with `_square` of A or its transpose."""
    m, k = shape
    if m == k:
        return solve(rhs, transposed)
    none = jnp.zeros(m if transposed else k, rhs.dtype)
    found = solve(jnp.concatenate([none, rhs] if transposed else [rhs, none]), False)
    return found[:m] if transposed else found[m:]


def _solved(matrix: Float[Array, "m k"], rhs: Array, *, transposed: bool = False) -> Array:
    """A⁻¹ b, shape (k,), or A⁻ᵀ f, shape (m,)."""
    square = _square(matrix)
    solve = lambda rhs, transposed: jnp.linalg.solve(square.T if transposed else square, rhs)
    return _solved_by(solve, matrix.shape, rhs, transposed)


def _last_step(matrix: Float[Array, "m k"], violation: Float[Array, " m"], scale: Float[Array, " k"], before):
    """A⁻¹ Φ and 1/|w|, which is NaN or 0 where A is exactly singular, by one factorization, Â, and Â⁻¹ times that
    `before`; no derivatives."""
    scaled = matrix * scale[None, :]
    size = jnp.linalg.norm(scaled, axis=1)
    size = jnp.where(size > 0.0, size, 1.0)  # redundant rows may be zero
    scaled = scaled / size[:, None]
    factors = lu_factor(_square(scaled))
    solve = lambda rhs, transposed: lu_solve(factors, rhs, trans=int(transposed))
    solved = partial(_solved_by, solve, matrix.shape)
    z = solved(jnp.asarray(np.random.default_rng(0).normal(size=size.shape), scale.dtype), False)
    least = 1.0 / jnp.linalg.norm(solved(z / jnp.linalg.norm(z), True))
    change = jax.vmap(lambda column: solved(column, False), 1, 1)(before)
    return scale * solved(violation / size, False), least, scaled, change


def _positive(matrix: Float[Array, "k k"], asked) -> Bool[Array, ""]:
    """Whether all eigenvalues have a positive real part; if `asked`, else True may be missing."""
    norm, last = jnp.linalg.norm, len(matrix) - 0.5

    def turn(carry):
        sign, _, count = carry
        inverse = jnp.linalg.inv(sign)
        scale = jnp.sqrt(norm(inverse) / norm(sign))
        new = 0.5 * (scale * sign + inverse / scale)
        return new, norm(new - sign), count + 1

    definite = jnp.all(jnp.isfinite(lax.linalg.cholesky(matrix + matrix.T, symmetrize_input=False)))
    going = lambda carry: (carry[1] > 1e-3) & (carry[2] < _TURNS)  # quadratic: then all digits are there; NaN is not
    begin = jnp.where(asked & ~definite, jnp.inf, jnp.zeros((), matrix.dtype))
    sign, change, _ = while_loop(going, turn, (matrix, begin, jnp.zeros((), jnp.int32)))
    return definite | (asked & (change <= 1e-3) & (jnp.trace(sign) > last))


class _Position(NamedTuple):
    """What Newton's iteration comes to."""

    q: Any
    matrix: Float[Array, "m k"]  # Â
    sure: Bool[Array, ""]  # whether no matrix between that before and Â is singular
    first: Float[Array, ""]  # the size of its first step
    strays: Bool[Array, ""]  # whether it led too far to be the next position
    size: Float[Array, ""]  # that of the step before the last
    singular: Bool[Array, ""]

    @property
    def converged(self):
        return _small(self.size)


def _strays(first, more):
    """Whether an iteration from one position leads too far from it to be the next one; NaN does."""
    return ~((first <= _FAR) & (more <= jnp.maximum(_BENT * first, _NEAR)))


def _newton(drive: AbstractDrive, q, before: Float[Array, "m k"], values, t, near) -> _Position:
    """The configuration for some values and t, from another one with Â `before`; `near`: given up where it strays from
    that."""
    system = drive.at(values)
    scale = drive.system.coordinate_scale()

    def equations(q):
        return system.constraint_jacobian(q, t), system.constraint(q, t)

    largest = lambda x: jnp.max(jnp.abs(x) / scale)

    def body(carry):
        q, first, others, last, _, iteration = carry
        x = _solved(*equations(q))
        size = largest(x)
        # Far from the solution a full step may leave the branch.
        x = x * jnp.where(near, 1.0, jnp.minimum(1.0, _AT_ONCE / jnp.maximum(size, _AT_ONCE)))
        begins = iteration == 0
        first, others = jnp.where(begins, size, first), jnp.where(begins, others, others + x)
        slow = (size > _SLOW * last) & ~begins
        return system.group.retract(q, -x), first, others, size, slow, iteration + 1

    def unfinished(carry):
        _, first, others, size, slow, iteration = carry
        strays = near & (iteration > 0) & (slow | _strays(first, largest(others)))
        return ~_small(size) & ~strays & (iteration < _MAX_ITERATIONS)  # a NaN goes on, and costs nothing else

    none, infinite = jnp.zeros_like(scale), jnp.full((), jnp.inf, scale.dtype)
    start = q, infinite, none, infinite, jnp.zeros((), bool), jnp.zeros((), jnp.int32)
    q, first, others, size, *_ = while_loop(unfinished, body, start)
    # Newton is quadratic: one step from √eps is at round-off.
    x, least, matrix, change = _last_step(*equations(q), scale, before)
    strays = _strays(first, largest(others))
    sure = _positive(change, near & _small(size) & ~strays)
    regular = least > _SINGULAR * jnp.sqrt(jnp.finfo(scale.dtype).eps)  # NaN is not
    q = system.group.retract(q, -x)
    return _Position(q, matrix, sure, first, strays, size, _small(size) & ~regular)


def _small(size):
    return size <= jnp.sqrt(jnp.finfo(size.dtype).eps)


class _Way(NamedTuple):
    """How far the search for n configurations has come, from one to the next."""

    q: Any  # the last configuration, and
    matrix: Float[Array, "m k"]  # Â there
    row: Int[Array, ""]  # the one that it is on the way to
    reached: Float[Array, ""]  # as a part of that
    part: Float[Array, ""]  # the next part of it; −1: the way is lost, and the last try is whether it ends singular
    again: Bool[Array, ""]  # whether the last try was a success
    begun: Bool[Array, ""]  # whether there is a configuration to go on from
    found: tuple[Any, Float[Array, " n"], Bool[Array, " n"]]


@jax.custom_jvp
def _configurations(drive: AbstractDrive, values: Float[Array, "n d"], t: Float[Array, " n"]):
    """q(s, t) for each row of `values`, found one from the other, the first from that with the values that the system
    has, and that from the reference; Newton's step; and whether it is singular.

    Where the way ends it is lost, its step infinite: what follows may be assembled otherwise. All tries are turns of
    one loop: designs of a batch wait for the one with the most of them, and not at every position for the slowest.
    """
    group, n = drive.system.group, len(t) + 1
    rows = jax.tree.map(lambda own, others: jnp.concatenate([own[None], others]), (drive.own, t[0]), (values, t))
    one, zero, no = jnp.ones_like(t[0]), jnp.zeros_like(t[0]), jnp.zeros((), bool)

    def step(way: _Way) -> _Way:
        end, before = (jax.tree.map(lambda of, i=i: of[i], rows) for i in (way.row, way.row - 1))
        near, shortest = way.begun & (way.part > 0.0), way.part <= _LEAST
        to = jnp.where(near, jnp.minimum(way.reached + way.part, 1.0), 1.0)
        values, t = jax.tree.map(lambda end, before: end - (1.0 - to) * (end - before), end, before)
        new = _newton(drive, way.q, way.matrix, values, t, near)
        short = new.first <= _SHORT * jnp.sqrt(jnp.finfo(values.dtype).eps)
        follows = ~way.begun | (near & ~new.strays & (new.sure | short))
        taken = follows & new.converged & ~new.singular
        arrived, singular = taken & (to == 1.0), new.singular & (to == 1.0)
        over = ~taken & (~near | (follows & singular))
        new_row = arrived | over
        part = jnp.where(taken, jnp.where(way.again, 2.0, 1.0) * way.part, jnp.where(shortest, -1.0, _LESS * way.part))
        known = new.q, jnp.where(arrived | singular, new.size, jnp.inf), singular
        keep = lambda new, old: jnp.where(taken, new, old)
        q, matrix = jax.tree.map(keep, (new.q, new.matrix), (way.q, way.matrix))
        return _Way(
            q=q,
            matrix=matrix,
            row=jnp.where(over & way.begun, n, way.row + new_row.astype(jnp.int32)),
            reached=jnp.where(new_row, 0.0, keep(to, way.reached)),
            part=jnp.where(new_row, 1.0, part),
            again=taken & ~new_row,
            begun=way.begun | arrived,
            found=jax.tree.map(lambda every, new: every.at[way.row].set(new), way.found, known),
        )

    home = drive.system.reference()[0]
    every = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), home)
    none = jnp.zeros((len(drive.system.constraint_names), group.dim), t.dtype)
    found = every, jnp.full(n, jnp.inf, t.dtype), jnp.zeros(n, bool)
    start = _Way(home, none, jnp.zeros((), jnp.int32), zero, one, no, no, found)
    found = while_loop(lambda way: way.row < n, step, start).found
    return jax.tree.map(lambda leaf: leaf[1:], found)


@_configurations.defjvp
def _configurations_jvp(primals, tangents):
    drive, *given = primals
    q, size, singular = _configurations(drive, *given)

    def tangent(q, row, row_dot):
        violation = lambda drive, s, t: drive.at(s).constraint(q, t)
        _, violation_dot = jax.jvp(violation, (drive, *row), (tangents[0], *row_dot))
        w = -_solved(drive.at(row[0]).constraint_jacobian(q, row[1]), violation_dot)
        return drive.system.group.to_ambient(q, w)

    there = sound(singular | ~_small(size), q, lax.stop_gradient(drive.system.reference()[0]))
    q_dot = jax.vmap(tangent)(there, given, list(tangents[1:]))
    return (q, size, singular), (q_dot, jnp.zeros_like(size), np.zeros(singular.shape, jax.dtypes.float0))


def positions(drive: AbstractDrive, values: Float[Array, "n d"], t: Float[Array, " n"]) -> Positions:
    """The configurations for each row of driven values and times, differentiable by the rule above.

    Equations that were left out hold, too: without them there may be ways to assemble the mechanism at which they do
    not, to which a long step leads.
    """
    q, size, singular = _configurations(drive, values, t)
    at = lambda system, q, t: violation_of_all(system, q, t, system.constraint(q, t))
    violation = jax.vmap(lambda q, s, t: at(drive.at(s), q, t))(q, values, t)
    satisfied = jnp.max(jnp.abs(violation), axis=1) <= drive.system.constraint_round_off()  # NaN is not
    found = _small(size) & satisfied & ~singular
    q = sound(~found, q, lax.stop_gradient(drive.system.reference()[0]))
    return Positions(q, found, satisfied & singular, violation)


def forces_of_motion(
    drive: AbstractDrive, q, driven: tuple[Float[Array, " d"], Float[Array, ""]], rates: tuple[Array, Array]
) -> State:
    """v, v̇ and λ of the motion through q with constant rates of `driven`, values and time; a = v̇."""
    require_linear(drive.system, "`kinematics`")
    (values, t), group = driven, drive.system.group
    system = drive.at(values)
    jacobian = system.constraint_jacobian(q, t)
    at = lambda q, driven: drive.at(driven[0]).constraint(q, driven[1])
    _, along = jax.jvp(lambda driven: at(q, driven), (driven,), (rates,))
    v = -_solved(jacobian, along)

    def rate(q, driven):
        return jax.jvp(at, (q, driven), (group.to_ambient(q, v), rates))[1]

    _, change = jax.jvp(rate, (q, driven), (group.to_ambient(q, v), rates))
    vdot = -_solved(jacobian, change)
    none = jnp.zeros(jacobian.shape[0], v.dtype)
    lam = -_solved(jacobian, system.residual(q, v, vdot, none, t), transposed=True)
    return State(q=q, v=v, vdot=vdot, lam=lam, a=vdot)
