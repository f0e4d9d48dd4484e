"""Quasi-static equilibria along a path of driven values: r(q, 0, 0, λ; s, t) = 0, Φ(q; s, t) = 0.

The driven values s are d numbers of a system: what constraints prescribe, and by what given forces are multiplied. With
the numbers p of the system, y = (q, λ) and R = [r; Φ] at rest, a point of the path is R(y; s, p) = 0. Perturbed,
q w̃ and μ in place of δq and δλ,

    δR = K (w, μ) + R_s δs + R_p δp,     K = [[K_t, Bᵀ], [B, 0]],

square, and regular where the equilibrium holds every body: a wheel that turns freely on its hinge makes it singular.

Path. In one scan each point begins at the one before, moved along its tangent K⁻¹ R_s Δs, with the factors of K there:
modified Newton, factors renewed when an iteration leaves more than a fifth of the step. Once steps are below √ε, one
more with new factors ends at round-off, and its factors are those of the tangents: one or two factorizations per point.
Where that finds nothing, a quarter of the way is tried, from there more, along new tangents: a beam moved along its
tangent by an angle θ is stretched by θ²/2, and Newton's method is lost where forces of E A θ²/2 make K indefinite. So
it is where a path of stable equilibria, Zᵀ K_t Z positive definite with B Z = 0, comes to one that is not: that is on
another branch, unless the shortest stage finds it too and the path itself goes through a bifurcation. And so it is
where Newton's method moves a point by more than 2 % of the scene off the tangent, or the tangents before and behind say
what differs by 10 %: a smooth path leaves the square of a stage. (A share of what the tangent says, in place of these,
is as much as any jump before a limit point, where it has no bound.)

What even the shortest stage does not reach is behind a limit point, where the mechanism snaps through. From the last
point (and from the reference, where Newton's method finds no first point) it settles: Zᵀ K_t Z gets −1.5 times its
lowest eigenvalue on its diagonal as long as that is negative, implicit steps of a motion without inertia down the
potential energy, and Newton's at last. That is said (`snapped`). A path that is lost goes on at the next point that is
found from the first one.

Responses. To rates s′ along the path (a direction, of which there may be several) the equilibrium answers with

    z = (w, λ′) :     D(y, z; s, s′, p) = d/dε R(q exp(ε w̃), λ + ε λ′; s + ε s′, p) = K z + R_s s′ = 0.

Factors from a distance √ε away leave ε of the error after two iterations z ← z − K⁻¹ D.

Derivatives. By the implicit function theorem, first of the point, then of its response at the derivative of the point,

    K (x, μ) = −(R_s δs + R_p δp),     K δz = −δD  at fixed w and λ′ (Lie-algebra coordinates).

One factorization of K serves all right-hand sides: in forward mode one or two per parameter, in reverse mode, by the
transposed factors, as many per output. δD is a directional derivative of D, no third derivative is ever a matrix.
Nothing is differentiated along the iteration, nor by the point where it began (Haug, Choi & Komkov 1986, §1.2.2).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lgsens._xla import in_any_lane, scan, while_loop
from lgsens.dynamics._constraints import missing
from lgsens.dynamics._kinematics import AbstractDrive
from lgsens.linear import LU, Inverse, LinearEquations, linear_solve, lost

_MAX_ITERATIONS = 60
_SOFT = 1e-3  # of the largest stiffness, where there is none
_DAMPED = 1.5  # of a negative stiffness, added where a mechanism settles
_SHORTER, _LONGER, _LEAST = 0.25, 2.0, 1e-3  # stages of the way to a point after one that failed, or not; the least
_NEAR, _BENT = 0.02, 0.1  # how far Newton may move a point off the tangent, and the latter: rad, of the scene's size
_SLOW = 0.2  # what a chord iteration may leave of a step before factors are renewed


_times = jax.vmap(jnp.matmul)
_AT_EVERY_POINT = LinearEquations(  # of the constants K and K⁻ᵀ
    lambda of, x: _times(of[0], x),
    lambda of, b: _times(jnp.swapaxes(of[1], 1, 2), b),
    lambda of, c: _times(of[1], c),
)


class StaticPath(NamedTuple):
    """Equilibria at n points, and their responses to r directions; NaN where none was found."""

    q: Any  # stacked along a leading axis n
    lam: Float[Array, "n m"]
    w: Float[Array, "n r k"]
    lam_rate: Float[Array, "n r m"]
    found: Bool[Array, " n"]
    free: Bool[Array, " n"]  # K is singular, at an equilibrium or where none was to be found from the first point on
    stable: Bool[Array, " n"]
    snapped: Bool[Array, " n"]  # there is a jump on the way to it


class _Begin(NamedTuple):
    """A point of the path and its tangent to the next one, from which that is sought."""

    s: Float[Array, " d"]
    q: Any
    lam: Float[Array, " m"]
    w: Float[Array, " k"]
    lam_rate: Float[Array, " m"]
    stable: Bool[Array, ""]


class _Factors(NamedTuple):
    """K in factors, in units in which its unknowns are of order one: lengths of the scene, rad, and `force`."""

    lu: Any  # LU or Inverse
    coordinate: Float[Array, " k"]
    force: Float[Array, ""]  # J, the size of K_t in these units
    matrix: Any = None  # K, of points of a path
    pivot: Any = None  # its smallest over its largest, shape (): 0 where it is singular

    def residual(self, force, violation):
        return jnp.concatenate([force * self.coordinate / self.force, violation])

    @property
    def stable(self) -> Bool[Array, ""]:
        """Whether Zᵀ K_t Z is positive definite."""
        return jnp.all(
            jnp.isfinite(lax.linalg.cholesky(_free(self.matrix, len(self.coordinate)), symmetrize_input=False))
        )

    def parts(self, y) -> tuple[Array, Array]:
        k = self.coordinate.shape[0]
        return y[:k] * self.coordinate, y[k:] * self.force


def _where_due(due, new: Callable[[], Any], earlier: Any) -> Any:
    """`new()` where it is due; of a batch computed if it is due in any lane, where `cond` alone always computes it."""
    found = lax.cond(in_any_lane(due), new, lambda: earlier)
    return jax.tree.map(lambda new, old: jnp.where(due, new, old), found, earlier)


def _free(matrix, k: int):
    """Zᵀ K_t Z, symmetric, with columns of Z that B lets move."""
    stiffness, jacobian = matrix[:k, :k], matrix[k:, :k]
    if len(jacobian):
        z = jnp.linalg.qr(jacobian.T, mode="complete")[0][:, len(jacobian) :]
        stiffness = z.T @ stiffness @ z
    return (stiffness + stiffness.T) / 2.0


def _matrix(drive: AbstractDrive, values, q, lam, t):
    """K and its units."""
    system = drive.at(values)
    zero = jnp.zeros_like(system.reference()[1])
    tangents = system.tangents(q, zero, zero, lam, t)
    scale = lax.stop_gradient(drive.system.coordinate_scale())
    stiffness = tangents.stiffness * scale[None, :] * scale[:, None]
    size = lax.stop_gradient(jnp.max(jnp.abs(stiffness)))
    size = jnp.where(size > 0, size, 1.0)
    jacobian = tangents.constraint_jacobian * scale[None, :]
    corner = jnp.zeros((jacobian.shape[0],) * 2, jacobian.dtype)
    return jnp.block([[stiffness / size, jacobian.T], [jacobian, corner]]), (scale, size)


def _residual(drive: AbstractDrive, values, q, lam, t):
    """r and Φ at rest."""
    system = drive.at(values)
    zero = jnp.zeros_like(system.reference()[1])
    return system.residual(q, zero, zero, lam, t), system.constraint(q, t)


def _response(drive: AbstractDrive, values, rates, q, lam, w, lam_rate, t):
    """D."""
    along = (rates, drive.system.group.to_ambient(q, w), lam_rate)
    return jax.jvp(lambda s, q, lam: _residual(drive, s, q, lam, t), (values, q, lam), along)[1]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _path(starts: tuple[int, ...], drive: AbstractDrive, values, rates, t):
    """y and z at each point; the points `starts` are found from the first one, that one from the reference."""
    group, system, (home, v) = drive.system.group, drive.system, drive.system.reference()
    k, m, dtype = v.shape[0], len(system.constraint_names), v.dtype
    n, precise = values.shape[0], float(jnp.finfo(dtype).eps) ** 0.5
    begins = jnp.zeros(n, bool).at[jnp.asarray((0, *starts))].set(True)
    ahead = jnp.concatenate([values[1:] - values[:-1], jnp.zeros_like(values[:1])])
    ahead = jnp.where(jnp.roll(begins, -1)[:, None], 0.0, ahead)

    def factorize(s, q, lam, settles):
        matrix, units = _matrix(drive, s, q, lam, t)
        lu = LU.of(matrix)
        pivots = jnp.abs(jnp.diagonal(lu.lu))
        pivot = jnp.min(pivots) / jnp.max(pivots)
        # What weights alone hold, a pendulum, has a stiffness once the joints carry them, which they do after a step.
        soft = jnp.where(pivot > 1e3 * jnp.finfo(dtype).eps, jnp.zeros((), dtype), _SOFT)
        if k > m:
            lowest = lambda: jnp.linalg.eigvalsh(_free(matrix, k), symmetrize_input=False)[0]
            soft = _where_due(settles, lambda: jnp.maximum(soft, -_DAMPED * lowest()), soft)
        softened = lambda: matrix + soft * jnp.diag((jnp.arange(k + m) < k).astype(dtype))
        return _Factors(_where_due(soft > 0.0, lambda: LU.of(softened()), lu), *units, matrix, pivot)

    def move(q, lam, w, change):
        return group.retract(q, w), lam + change

    def newton(s, q, lam, factors, stale, settles):
        def body(carry):
            q, lam, factors, stale, moved, size, iteration, _ = carry
            factors = _where_due(stale, lambda: factorize(s, q, lam, settles), factors)
            step = -factors.lu.solve(factors.residual(*_residual(drive, s, q, lam, t)))
            left = jnp.max(jnp.abs(step))
            # Far from the solution a full step may leave the branch: at most 0.2 rad or a fifth of the scene at a time.
            step = step * jnp.minimum(1.0, 0.2 / jnp.maximum(jnp.max(jnp.abs(step[:k])), 0.2))
            q, lam = move(q, lam, *factors.parts(step))
            small = left <= precise
            renew = settles | small | (left > _SLOW * size)
            return q, lam, factors, renew, moved + step[:k], left, iteration + 1, small & stale

        def unfinished(carry):
            *_, left, iteration, done = carry
            return ~done & (iteration < _MAX_ITERATIONS) & ~jnp.isnan(left)

        still = jnp.zeros(k, dtype), jnp.full((), jnp.inf, dtype), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
        q, lam, factors, _, moved, *_, done = while_loop(unfinished, body, (q, lam, factors, stale, *still))
        return q, lam, factors, jnp.max(jnp.abs(moved)), done

    def respond(s, rates, q, lam, factors):
        def refine(z, _):
            response = partial(_response, drive, s)
            left = jax.vmap(lambda z, rate: response(rate, q, lam, *factors.parts(z), t=t))(z, rates)
            return z - factors.lu.solve(jax.vmap(factors.residual)(*left).T).T, None

        z = scan(refine, jnp.zeros((rates.shape[0], k + m), dtype), None, length=2)[0]
        return jax.vmap(factors.parts)(z)

    def follow(carry, row):
        home, before, factors, held = carry
        s, rates, ahead, begins, first = row
        near = jax.tree.map(lambda far, near: jnp.where(begins, far, near), home, before)
        way = s - near.s

        def stage(carry):
            near, factors, stale, reached, size, settles, snapped, *_ = carry
            to = jnp.minimum(reached + size, 1.0)
            at, share = s - (1.0 - to) * way, to - reached
            ahead_of = jnp.where(settles, 0.0, share)
            q, lam = move(near.q, near.lam, ahead_of * near.w, ahead_of * near.lam_rate)
            q, lam, factors, moved, done = newton(at, q, lam, factors, stale, settles)
            stable, shortest = factors.stable, first | (share * _SHORTER <= _LEAST)
            # The last two directions are that of the stage and that onward.
            along = jnp.concatenate([rates, way[None], jnp.where(to < 1.0, way, ahead)[None]])
            w, lam_rate = respond(at, along, q, lam, factors)
            bent = share * jnp.max(jnp.abs((w[-2] - near.w) / factors.coordinate))
            jumped = ~first & ((moved > _NEAR) | (bent > _BENT))
            through = first | stable | ~near.stable | shortest  # a bifurcation, if not before it
            done = done & jnp.where(settles, stable, through & ~jumped)
            keep = lambda new, old: jnp.where(done, new, old)
            near = jax.tree.map(keep, _Begin(at, q, lam, w[-1], lam_rate[-1], stable), near)
            snapped = snapped | (done & settles & ~first)
            lost, settles = settles & ~done, ~settles & ~done & shortest
            size = jnp.where(done, _LONGER, jnp.where(settles, 1.0, jnp.where(lost, 0.0, _SHORTER))) * share
            return near, factors, ~done, keep(to, reached), size, settles, snapped, w[:-2], lam_rate[:-2]

        def unfinished(carry):
            _, _, _, reached, size, *_ = carry
            return (reached < 1.0) & (size > 0.0) & (begins | held)

        none, one = jnp.zeros((), dtype), jnp.ones((), dtype)
        answers = jnp.zeros((len(rates), k), dtype), jnp.zeros((len(rates), m), dtype)
        no = jnp.zeros((), bool)
        stages = near, factors, begins | ~held, none, one, no, no, *answers
        near, factors, _, reached, _, _, snapped, w, lam_rate = while_loop(unfinished, stage, stages)
        done = reached == 1.0
        home = jax.tree.map(lambda new, old: jnp.where(first & done, new, old), near, home)
        home = home._replace(w=jnp.zeros_like(home.w), lam_rate=jnp.zeros_like(home.lam_rate))
        round_off = jnp.where(done, 1e2, 1e3) * jnp.finfo(dtype).eps
        free = (factors.pivot <= round_off) & (done | first)
        ended = (flag.astype(dtype) for flag in (done, free, near.stable, snapped))
        return (home, near, factors, done), (near.q, near.lam, w, lam_rate, *ended)

    whole = jnp.arange(k + m, dtype=jnp.int32)
    start = _Begin(values[0], home, jnp.zeros(m, dtype), jnp.zeros(k, dtype), jnp.zeros(m, dtype), jnp.zeros((), bool))
    none = LU(jnp.zeros((k + m, k + m), dtype), whole, whole)
    one = jnp.ones((), dtype)
    factors = _Factors(none, jnp.ones(k, dtype), one, none.lu, one)
    rows = values, rates, ahead, begins, jnp.arange(n) == 0
    return scan(follow, (start, start, factors, jnp.zeros((), bool)), rows)[1]


@_path.defjvp
def _path_jvp(starts, primals, tangents):
    drive, values, rates, t = primals
    drive_dot, values_dot, rates_dot, t_dot = tangents
    q, lam, w, lam_rate, *ended = _path(starts, *primals)
    group, rows = drive.system.group, (q, lam, values)
    every = lambda of, xs: scan(lambda _, row: (None, of(*row)), None, xs)[1]
    matrix, units = jax.vmap(lambda q, lam, s: _matrix(drive, s, q, lam, t))(*rows)
    factors = jax.vmap(lambda matrix, *units: _Factors(Inverse.of(matrix), *units))(lax.stop_gradient(matrix), *units)

    def solve(force, violation):
        """−K⁻¹ at every point: products, which are one operation for all directions."""
        rhs = jax.vmap(_Factors.residual)(factors, force, violation)
        solved = linear_solve(_AT_EVERY_POINT, (matrix, factors.lu.transpose), rhs)
        return jax.vmap(_Factors.parts)(factors, -solved)

    # One point after the other: what all directions need of one stays in the processor's cache.
    def first(q, lam, s, s_dot):
        of = lambda drive, s, t: _residual(drive, s, q, lam, t)
        return jax.jvp(of, (drive, s, t), (drive_dot, s_dot, t_dot))[1]

    x, mu = solve(*every(first, (*rows, values_dot)))
    q_dot = jax.vmap(group.to_ambient)(q, x)

    def second(q, lam, s, q_dot, mu, s_dot, *along):
        def change(w, lam_rate, rate, rate_dot):
            of = lambda drive, s, q, lam, t, rate: _response(drive, s, rate, q, lam, w, lam_rate, t)
            return jax.jvp(of, (drive, s, q, lam, t, rate), (drive_dot, s_dot, q_dot, mu, t_dot, rate_dot))[1]

        return jax.vmap(change)(*along)

    changes = every(second, (*rows, q_dot, mu, values_dot, w, lam_rate, rates, rates_dot))
    w_dot, lam_rate_dot = jax.vmap(solve, 1, 1)(*changes)
    return (q, lam, w, lam_rate, *ended), (q_dot, mu, w_dot, lam_rate_dot, *jax.tree.map(jnp.zeros_like, ended))


def static_path(
    drive: AbstractDrive, values: Float[Array, "n d"], rates: Float[Array, "n r d"], t, starts: tuple[int, ...] = ()
) -> StaticPath:
    """The equilibria at each row of driven values, and their responses to each direction of rates, differentiable by
    the rule above; NaN where none was found."""
    q, lam, w, lam_rate, *ended = _path(starts, drive, values, rates, t)
    done, free, stable, snapped = (flag > 0 for flag in ended)
    apart = jax.vmap(lambda q, s: jnp.any(missing(drive.at(s), q, t) != 0.0))(q, values)
    done = done & ~apart
    held = done & ~free
    q, lam, w, lam_rate = lost(~held, (q, lam, w, lam_rate))
    return StaticPath(q, lam, w, lam_rate, held, free, held & stable, held & snapped)
