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

First order. With ν = ẋ + F_1 u no derivative of an input drives the state y = [x; ν],

    ẏ = [0, I; −K_r, −C_r] y + [−F_1; C_r F_1 − F_0] u = A y + B u,

and an output δf(q, v, v̇, λ, u) is C y + D u + D_1 u̇ + D_2 ü, as δv̇ has S ü in it: what a driver prescribes has an
acceleration. δλ solves Jᵀδλ = −(what is left of (a)).

Source: Negrut & Ortiz, J. Comput. Nonlinear Dynam. 1 (2006) 230 (linearization of constrained equations); Géradin &
Rixen, Mechanical Vibrations, §2 and §8 (gyroscopic systems).
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
    built: Built, outputs: Outputs, num_inputs: int, state: State, t, turning: Float[Array, "k k"] | None, basis
) -> StateSpace:
    """The matrices at one state; `turning`: Γ, None at rest; `basis`: Z there."""
    none = jnp.zeros((num_inputs, 3), state.v.dtype)
    system = built(none)
    k, n, p = state.v.shape[0], basis.shape[1], num_inputs
    mass = system.mass_matrix()
    stiffness, damping, jacobian = system.tangents(state.q, state.v, state.vdot, state.lam, t)
    forces = jax.jacfwd(lambda u: built(u).residual(state.q, state.v, state.vdot, state.lam, t))(none)
    gaps = jax.jacfwd(lambda u: built(u).constraint(state.q, t))(none)[..., 0]
    place, _ = kkt_solve(mass, jacobian, jnp.zeros((k, p), none.dtype), -gaps)  # S

    # Columns of all that follows: x, ẋ, u, u̇, ü.
    zero_n, zero_p = jnp.zeros((k, n), none.dtype), jnp.zeros((k, p), none.dtype)
    w = jnp.concatenate([basis, zero_n, place, zero_p, zero_p], axis=1)
    rate = jnp.concatenate([zero_n, basis, zero_p, place, zero_p], axis=1)  # ẇ
    bent = jnp.concatenate([zero_n, zero_n, zero_p, zero_p, place], axis=1)  # ẅ but for Z ẍ
    if turning is None:
        dv, dvdot = rate, bent
    else:
        drift = system.group.ad(state.v) + turning
        dv, dvdot = rate + drift @ w, bent + (drift + turning) @ rate + turning @ (drift @ w)
    applied = jnp.concatenate([zero_n, zero_n, forces[..., 0], forces[..., 1], zero_p], axis=1)
    left = stiffness @ w + damping @ dv + mass @ dvdot + applied
    bend = -basis.T @ left
    bend = bend.at[:, bend.shape[1] - p :].set(0.0)  # −Zᵀ M S
    dvdot = dvdot + basis @ bend
    _, dlam = kkt_solve(mass, jacobian, -(left + mass @ (basis @ bend)), jnp.zeros((jacobian.shape[0], 2 * n + 3 * p)))

    def output(w, dv, dvdot, dlam, u):
        q = system.group.retract(state.q, w)
        moved = State(q=q, v=state.v + dv, vdot=state.vdot + dvdot, lam=state.lam + dlam, a=state.vdot + dvdot)
        return outputs(built(u), moved)

    inputs = jnp.concatenate([jnp.zeros((2 * n, p, 3), none.dtype), _unit_inputs(p, none.dtype)])
    at = jnp.zeros(k, none.dtype), jnp.zeros(k, none.dtype), jnp.zeros(k, none.dtype), jnp.zeros_like(state.lam), none
    along = lambda *directions: jax.jvp(output, at, directions)[1]
    rows = jax.vmap(along, in_axes=(1, 1, 1, 1, 0), out_axes=1)(w, dv, dvdot, dlam, inputs)

    cuts = n, 2 * n, 2 * n + p, 2 * n + 2 * p
    by_x, by_rate, by_u, by_u1, _ = jnp.split(bend, cuts, axis=1)  # −K_r, −C_r, −F_0, −F_1
    out_x, out_rate, out_u, out_u1, out_u2 = jnp.split(rows, cuts, axis=1)
    f = n - system.num_states
    unit = jnp.eye(n, dtype=none.dtype)[:f]
    upper = jnp.concatenate([jnp.zeros((f, f), none.dtype), unit], axis=1)
    lower = jnp.concatenate([by_x[:, :f], by_rate], axis=1)
    return StateSpace(
        A=jnp.concatenate([upper, lower]),
        B=jnp.concatenate([unit @ by_u1, by_u + by_rate @ by_u1]),
        C=jnp.concatenate([out_x[:, :f], out_rate], axis=1),
        D=out_u + out_rate @ by_u1,
        D1=out_u1,
        D2=out_u2,
    )


def _unit_inputs(p: int, dtype) -> Float[Array, "3p p 3"]:
    """Of u, then of u̇ and ü."""
    return jnp.moveaxis(jnp.eye(3 * p, dtype=dtype).reshape(3 * p, 3, p), 1, 2)
