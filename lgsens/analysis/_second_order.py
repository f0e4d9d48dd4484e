"""The equations of small motions about a steady one, on independent coordinates.

At rest. Let δq = q w̃ be a small displacement, of inputs u as well. Where nothing moves, δv = ẇ and δv̇ = ẅ, and with
the tangents of the system (§3.1 of the paper; K_t holds D_q(Bᵀλ), the geometric stiffness of the forces in the joints)

    M ẅ + C_t ẇ + K_t w + r_u u + r_u̇ u̇ + Jᵀ δλ = 0,     J w + Φ_u u = 0.                                      (a)

The rows of J are solved by a basis Z of its null space and the response S of the place to the inputs,

    w = Z x + S u,     J Z = 0,   Zᵀ M Z = I,     J S = −Φ_u,   Zᵀ M S = 0,

orthonormal in the metric of kinetic energy, in which metres and radians compare. Zᵀ (a) has no δλ and no ü. That
constraints are curved is in K_t: a displacement along them is Z x + n(x) with a normal part n = O(x²), and the joint
forces do the work xᵀ Zᵀ D_q(Bᵀλ) Z x / 2 on that.

In steady motion. Let the coordinates of displacements and velocities be seen in axes that turn with the motion,
w = exp(Γ t) w_c, and such that all matrices are constant in them (`_steady`); w and δv without mark are those at one
instant of it, dots derivatives in the turning axes. From δ(q̇) = (δq)˙, eq. (6), and v̇ → (·)˙ + Γ(·),

    δv = ẇ + N w,     δv̇ = (δv)˙ + Γ δv = ẅ + (N + Γ) ẇ + Γ N w,     N = ad(v) + Γ.

J w + Φ_u u = 0 holds at all times with constant J, so w = Z x + S u as before, and with R_0 = r_u, R_1 = r_u̇

    ẍ + C_r ẋ + K_r x + F_0 u + F_1 u̇ = 0,
    C_r = Zᵀ (M (N + Γ) + C_t) Z,                        K_r = Zᵀ (M Γ N + C_t N + K_t) Z,
    F_0 = Zᵀ ((M Γ N + C_t N + K_t) S + R_0),            F_1 = Zᵀ ((M (N + Γ) + C_t) S + R_1).

States z of elements are velocities of coordinates that nothing depends on: of these x is left out, ẋ = δz.

Rolling. Let J = [B; A] with rows of velocities A v + b = 0 besides. Places keep w = Z x + S u, with B alone; rates do
not fill Z. From δ(A v + b) = A (ẇ + N w) + D_q(A v + b) w = 0, and B ẇ = −Φ_u u̇,

    ẇ = Y ν + P,     J Y = 0,   Yᵀ M Y = I,     J P = −[Φ_u u̇; (A N + D_q(A v + b)) w],   Yᵀ M P = 0,

and ẋ = Zᵀ M ẇ. ẅ = Y ν̇ + Ṗ, in which Ṗ has ẋ, u̇ and ü, and Yᵀ (a) has neither δλ nor Ṗ. Without rows of velocities
Y = Z, P = S u̇, ẋ = ν, and this is what stands above.

First order. ẏ of y = [x; ν] is A y + B_0 u + B_1 u̇. That of y − B_1 u, which is called [x; ν], has no derivative of an
input,

    ẏ = A y + (B_0 + A B_1) u,     without rolling A = [0, I; −K_r, −C_r],   B_1 = [0; −F_1],   B_0 = [0; −F_0],

and an output δf(q, v, v̇, λ, u) is C y + D u + D_1 u̇ + D_2 ü, as δv̇ has S ü in it: what a driver prescribes has an
acceleration. δλ solves Jᵀδλ = −(what is left of (a)).

Source: Negrut & Ortiz, J. Comput. Nonlinear Dynam. 1 (2006) 230 (linearization of constrained equations); Géradin &
Rixen, Mechanical Vibrations, §2 and §8 (gyroscopic systems); Neimark & Fufaev, Dynamics of Nonholonomic Systems (1972),
ch. 6 (small motions of what rolls).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, kkt_solve

Built = Callable[[Float[Array, "p 3"]], AbstractSystem]  # the system, given u, u̇ and ü of its p inputs
Outputs = Callable[[AbstractSystem, State], Float[Array, " o"]]


class StateSpace(NamedTuple):
    """ẏ = A y + B u, δf = C y + D u + D_1 u̇ + D_2 ü."""

    A: Float[Array, "n n"]
    B: Float[Array, "n p"]
    C: Float[Array, "o n"]
    D: Float[Array, "o p"]
    D1: Float[Array, "o p"]
    D2: Float[Array, "o p"]


class Bases(NamedTuple):
    """Of displacements, and of velocities, states of elements last."""

    position: Float[Array, "k f"]  # Z
    velocity: Float[Array, "k g"]  # Y

    @classmethod
    def of(cls, system: AbstractSystem, jacobian: Float[Array, "m k"]) -> "Bases":
        """`jacobian`: J there, rows of velocities last."""
        rows, velocity = system.num_velocity_rows, null_space(system, jacobian)
        places = null_space(system, jacobian[: jacobian.shape[0] - rows]) if rows else velocity
        return cls(places[:, : places.shape[1] - system.num_states], velocity)


def null_space(system: AbstractSystem, jacobian: Float[Array, "m k"]) -> Float[Array, "k f"]:
    """Z: J Z = 0, Zᵀ M Z = I; of states of elements unit vectors, last.

    With the columns of J in two parts, J_d w_d + J_i w_i = 0: w_i are independent, J_d that of the m columns which QR
    with column pivoting takes first. So Z = [−J_d⁻¹J_i; I] L⁻ᵀ with the Cholesky factor L of its mass matrix is a
    smooth function of the numbers of the system, and its derivative that of Z, as long as the pivots are the same.
    """
    m, k = jacobian.shape
    moving = k - system.num_states
    mass, rows = system.mass_matrix()[:moving, :moving], jacobian[:, :moving]
    raw = jnp.eye(moving, dtype=rows.dtype)
    if m:
        scaled = lax.stop_gradient(rows * system.coordinate_scale()[None, :moving])
        _, order = jsl.qr(scaled, mode="r", pivoting=True)
        dependent, free = order[:m], jnp.sort(order[m:])
        slope = -jnp.linalg.solve(rows[:, dependent], rows[:, free])
        raw = jnp.zeros((moving, moving - m), rows.dtype)
        raw = raw.at[dependent].set(slope).at[free, jnp.arange(moving - m)].set(1.0)
    factor = jnp.linalg.cholesky(raw.T @ mass @ raw)
    return jsl.block_diag(jsl.solve_triangular(factor, raw.T, lower=True).T, jnp.eye(k - moving, dtype=rows.dtype))


def state_space(
    built: Built, outputs: Outputs, num_inputs: int, state: State, t, turning: Float[Array, "k k"] | None, bases: Bases
) -> StateSpace:
    """The matrices at one state; `turning`: Γ, None at rest; `bases`: those there."""
    none = jnp.zeros((num_inputs, 3), state.v.dtype)
    system, p = built(none), num_inputs
    rolls = system.num_velocity_rows > 0
    k, f, g = *bases.position.shape, bases.velocity.shape[1]
    cuts = f, f + g, f + g + p, f + g + 2 * p  # of columns of x, ν, u, u̇, ü
    mass = system.mass_matrix()
    stiffness, damping, jacobian = system.tangents(state.q, state.v, state.vdot, state.lam, t)
    forces = jax.jacfwd(lambda u: built(u).residual(state.q, state.v, state.vdot, state.lam, t))(none)
    gaps = jax.jacfwd(lambda u: built(u).constraint(state.q, t))(none)[..., 0]
    holonomic = jacobian[: gaps.shape[0]]
    place, _ = kkt_solve(mass, holonomic, jnp.zeros((k, p), none.dtype), -gaps)  # S

    zero = lambda columns, rows=k: jnp.zeros((rows, columns), none.dtype)
    w = jnp.concatenate([bases.position, zero(g), place, zero(2 * p)], axis=1)
    drift = jnp.zeros_like(mass) if turning is None else system.group.ad(state.v) + turning
    if rolls:
        asked = jnp.concatenate([zero(f + g + p, len(gaps)), gaps, zero(p, len(gaps))], axis=1)
        asked = jnp.concatenate([asked, _slipping(system, state, t, jacobian[gaps.shape[0] :] @ drift) @ w])
        pushed, _ = kkt_solve(mass, jacobian, jnp.zeros_like(w), -asked)  # P
    else:
        pushed = jnp.concatenate([zero(f + g + p), place, zero(p)], axis=1)
    rate = pushed + jnp.concatenate([zero(f), bases.velocity, zero(3 * p)], axis=1)  # ẇ
    # ẋ; zeros of A are exact without rolling, of which a motion that nothing holds has pairs
    dx = bases.position.T @ (mass @ rate) if rolls else jnp.eye(f, w.shape[1], f, dtype=none.dtype)
    by_x, _, by_u, by_u1, _ = jnp.split(pushed, cuts, axis=1)
    bent = by_x @ dx + jnp.concatenate([zero(f + g + p), by_u, by_u1], axis=1)  # ẅ but for Y ν̇
    dv, dvdot = rate + drift @ w, bent
    if turning is not None:
        dvdot = bent + (drift + turning) @ rate + turning @ (drift @ w)
    applied = jnp.concatenate([zero(f + g), forces[..., 0], forces[..., 1], zero(p)], axis=1)
    left = stiffness @ w + damping @ dv + mass @ dvdot + applied
    bend = -bases.velocity.T @ left
    bend = bend.at[:, bend.shape[1] - p :].set(0.0)  # −Yᵀ M Ṗ
    dvdot = dvdot + bases.velocity @ bend
    none_of_rows = zero(w.shape[1], jacobian.shape[0])
    _, dlam = kkt_solve(mass, jacobian, -(left + mass @ (bases.velocity @ bend)), none_of_rows)

    def output(w, dv, dvdot, dlam, u):
        q = system.group.retract(state.q, w)
        moved = State(q=q, v=state.v + dv, vdot=state.vdot + dvdot, lam=state.lam + dlam, a=state.vdot + dvdot)
        return outputs(built(u), moved)

    inputs = jnp.concatenate([jnp.zeros((f + g, p, 3), none.dtype), _unit_inputs(p, none.dtype)])
    at = jnp.zeros(k, none.dtype), jnp.zeros(k, none.dtype), jnp.zeros(k, none.dtype), jnp.zeros_like(state.lam), none
    along = lambda *directions: jax.jvp(output, at, directions)[1]
    rows = jax.vmap(along, in_axes=(1, 1, 1, 1, 0), out_axes=1)(w, dv, dvdot, dlam, inputs)

    by_y, by_u, by_u1, _ = jnp.split(jnp.concatenate([dx, bend]), cuts[1:], axis=1)
    out_y, out_u, out_u1, out_u2 = jnp.split(rows, cuts[1:], axis=1)
    return StateSpace(A=by_y, B=by_u + by_y @ by_u1, C=out_y, D=out_u + out_y @ by_u1, D1=out_u1, D2=out_u2)


def _slipping(system: AbstractSystem, state: State, t, drifting: Float[Array, "r k"]) -> Float[Array, "r k"]:
    """A N + D_q(A v + b): what rows of velocities ask of ẇ where the place is another one; `drifting`: A N."""
    slip = lambda w: system.velocity_constraint(system.group.retract(state.q, w), state.v, t)
    return drifting + jax.jacfwd(slip)(jnp.zeros_like(state.v))


def _unit_inputs(p: int, dtype) -> Float[Array, "3p p 3"]:
    """Of u, then of u̇ and ü."""
    return jnp.moveaxis(jnp.eye(3 * p, dtype=dtype).reshape(3 * p, 3, p), 1, 2)
