"""The first-order adjoint equations: ref. [16] of the paper (Bestle & Seybold 1992), on a Lie group.

§7.2 names it as the third way to treat accelerations in a criterion. The acceleration is an unknown of its own, with
adjoint variables η_q, η_v of the kinematic equations beside μ of r and ν of Φ:

    δΨ + ∫ η_qᵀ(δq̇ + ad(v) δq − δv) + η_vᵀ(d/dt δv − δv̇) + μᵀδr + νᵀδΦ dt

The terms of δv̇, δλ, δv and δq vanish if

    η_v = M μ + F_v̇ᵀ                              B μ = −F_λᵀ
    η̇_v = F_vᵀ − η_q + C_tᵀ μ
    η̇_q = ad(v)ᵀ η_q + F_qᵀ + K_tᵀ μ + Bᵀν

No time derivative of F or of C_t is left, but a first-order DAE of index 3. It is solved by BDF2, the literature's
choice for such adjoint systems (Cao, Li, Petzold & Serban, ref. [26]): in τ = t_f − t, with s = 2h/3,
b = (4 η_{n+1} − η_{n+2})/3 and s η_q = (M + s C_tᵀ) μ + F_v̇ᵀ + s F_vᵀ − b_v =: E μ + e,

    [[(I + s ad(v)ᵀ) E + s² K_tᵀ,  Bᵀ],   [μ; s²ν] = [s b_q − (I + s ad(v)ᵀ) e − s² F_qᵀ;  −F_λᵀ]
     [B,                           0 ]]

At t_f, as in `_continuous_adjoint.py` with η₁, η₂ for what the constraints leave of the boundary terms,

    M μ + Bᵀη₁ = −(F_v̇ + G_v)ᵀ, B μ = −F_λᵀ;     η_v = −G_vᵀ − Bᵀη₁,     η_q = −G_qᵀ − D_q(Φ̇)ᵀη₁ − Bᵀη₂

and η₂ follows from the derivative of B μ = −F_λᵀ, the one place where Ḟ_v̇ and Ḟ_λ are needed. The cotangents of the
initial state are −η_q and −η_v at t_0.
"""

from functools import partial

import jax
import jax.numpy as jnp

from lgsens._xla import scan
from lgsens.dynamics import AbstractSystem, State, accelerations, constraint_velocity, mass_scale
from lgsens.integrate import with_last
from lgsens.linear import Factors
from lgsens.sensitivity._continuous_adjoint import (
    Cotangents,
    accumulated,
    constrained_solve,
    final_cotangents,
    jacobian_rate,
)
from lgsens.sensitivity._criterion_terms import Functional, PathPoint, gradients
from lgsens.sensitivity._linearization import Parameters


def first_order_adjoint_sweep(path: PathPoint, parameters: Parameters, functional: Functional, p) -> Cotangents:
    """The cotangents of c criteria."""
    system, h = parameters.system, parameters.grid.h
    group, mass = system.group, system.mass_matrix()
    k = mass.shape[0]
    s = 2.0 * h / 3.0

    def equations(point: PathPoint):
        """K_tᵀ, C_tᵀ, B, ad(v)ᵀ and the gradients of F as columns."""
        state = point.state
        k_t, c_t, jacobian = system.tangents(state.q, state.v, state.vdot, state.lam, point.t)
        f = gradients(lambda state: functional.rate(p, system, state, point.t), group, state)
        return k_t.T, c_t.T, jacobian, group.ad(state.v).T, jax.tree.map(jnp.transpose, f)

    def advance(nearer, far, point: PathPoint):
        """η_q, η_v, μ, ν at a point from η at the two points after it."""
        k_tT, c_tT, jacobian, bracketT, f = equations(point)
        b_q, b_v = ((4.0 * n - f) / 3.0 for n, f in zip(nearer, far))
        turned = jnp.eye(k, dtype=mass.dtype) + s * bracketT
        matrix, offset = mass + s * c_tT, f.vdot + s * f.v - b_v
        factors = Factors.of(turned @ matrix + s**2 * k_tT, jacobian.T, jacobian, mass_scale(mass))
        mu, nu = factors.solve(s * b_q - turned @ offset - s**2 * f.w, -f.lam)
        return ((matrix @ mu + offset) / s, mass @ mu + f.vdot), mu, nu / s**2

    at = lambda n: jax.tree.map(lambda leaf: leaf[n], path)
    eta, mu, eta1, eta2 = _final_conditions(functional, p, system, at(-1), *equations(at(-1)))
    (near, far), (mu1, mu2), (nu1, nu2) = _start(mass, eta, equations(at(-2)), equations(at(-3)), h)

    def step(carry, point: PathPoint):
        near, far = carry
        eta, mu, nu = advance(far, near, point)
        return (far, eta), (mu, nu)

    before = jax.tree.map(lambda leaf: leaf[:-3], path)
    (_, (eta_q, eta_v)), multipliers = scan(step, (near, far), before, reverse=True)
    # ν_f by extrapolation: it belongs to one end point, whose weight is h/2
    for of_r_and_phi in ((mu2, nu2), (mu1, nu1), (mu, 2.0 * nu1 - nu2)):
        multipliers = with_last(multipliers, of_r_and_phi)
    bar = final_cotangents(functional, p, system, at(-1), eta1, eta2)
    bar = accumulated(bar, functional, p, system, path, *multipliers)
    return Cotangents(-eta_q.T, -eta_v.T, *bar)


def _final_conditions(functional: Functional, p, system: AbstractSystem, point: PathPoint, k_tT, c_tT, jacobian, _, f):
    """(η_q, η_v), μ, η₁ and η₂ at t_f."""
    state, t, group, mass = point.state, point.t, system.group, system.mass_matrix()
    g = jax.tree.map(jnp.transpose, gradients(lambda state: functional.final(p, system, state, t), group, state))
    mu, eta1 = constrained_solve(mass, jacobian, -(f.vdot + g.v), -f.lam)
    eta_v = -g.v - jacobian.T @ eta1

    def constraint_force(state):
        return eta1.T @ constraint_velocity(system, state.q, state.v, t)

    of_velocity = gradients(constraint_force, group, state).w.T  # D_q(Φ̇)ᵀη₁

    # d/dt (M μ + F_v̇) = F_v − η_q + C_tᵀμ and d/dt (B μ + F_λ) = 0 give μ̇ and η₂; the motion's own v̈ and λ̇
    # are those of eq. (41).
    direction = (group.to_ambient(state.q, state.v), state.vdot, jnp.ones_like(t))
    _, (vddot, lam_rate) = jax.jvp(partial(accelerations, system), (state.q, state.v, t), direction)

    def partials(q, v, vdot, lam, t):
        rate = lambda vdot, lam: functional.rate(p, system, State(q, v, vdot, lam, vdot), t)
        return jax.jacrev(rate, argnums=(0, 1))(vdot, lam)

    q_rate, v_rate, t_rate = direction
    at = (state.q, state.v, state.vdot, state.lam, t)
    df_m, df_lam = jax.jvp(partials, at, (q_rate, v_rate, vddot, lam_rate, t_rate))[1]
    force = f.v + g.w + of_velocity + c_tT @ mu - df_m.T
    _, minus_eta2 = constrained_solve(mass, jacobian, force, -jacobian_rate(system, state, t) @ mu - df_lam.T)
    eta2 = -minus_eta2
    return (-g.w - of_velocity - jacobian.T @ eta2, eta_v), mu, eta1, eta2


def _start(mass, eta, first, second, h):
    """η, μ, ν at the two points before t_f, by the parabola through all three.

    Its slopes there are (η_2 − η_0)/2h and (3 η_2 − 4 η_1 + η_0)/2h.
    """
    k, m = mass.shape[0], first[2].shape[0]
    scale = mass_scale(mass)
    zero, one = jnp.zeros((k, k), mass.dtype), jnp.eye(k, dtype=mass.dtype)
    none, empty = jnp.zeros((k, m), mass.dtype), jnp.zeros((m, m), mass.dtype)
    # unknowns (h η_q, μ, h² ν/σ)_1 and the same of point 2; slopes[i][j] weighs η_j in h × the slope at i
    slopes = ((-0.5, 0.0, 0.5), (0.5, -2.0, 1.5))
    rows, rhs = [], []
    for here, own, (k_tT, c_tT, jacobian, bracketT, f) in zip((1, 2), slopes, (first, second)):
        of_q, of_v, of_constraint = [], [], []
        for j in (1, 2):
            same = j == here
            # h η_q' + h (ad(v)ᵀη_q + F_q + K_tᵀμ + Bᵀν) = 0, times h
            of_q += [own[j] * one + (h * bracketT if same else zero)]
            of_q += [h**2 * k_tT if same else zero, scale * jacobian.T if same else none]
            # h η_v' + h (F_v − η_q + C_tᵀμ) = 0 with η_v = M μ + F_v̇
            of_v += [-one if same else zero, own[j] * mass + (h * c_tT if same else zero), none]
            of_constraint += [none.T, scale * jacobian if same else none.T, empty]
        rows += [of_q, of_v, of_constraint]
        of_vdot = own[1] * first[4].vdot + own[2] * second[4].vdot
        rhs += [-(h * own[0]) * eta[0] - h**2 * f.w, -own[0] * eta[1] - of_vdot - h * f.v, -scale * f.lam]
    solution = jnp.linalg.solve(jnp.block(rows), jnp.concatenate(rhs))
    found = []
    for part, (*_, f) in zip(jnp.split(solution, 2), (first, second)):
        h_eta_q, mu, nu = part[:k], part[k : 2 * k], part[2 * k :]
        found.append(((h_eta_q / h, mass @ mu + f.vdot), mu, scale * nu / h**2))
    (eta1, mu1, nu1), (eta2, mu2, nu2) = found
    return (eta1, eta2), (mu1, mu2), (nu1, nu2)
