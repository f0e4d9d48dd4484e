"""What a criterion contributes to the continuous adjoint equations (39)–(43), with the accelerations in it.

With F(q, v, v̇, λ, p), F_M = F_v̇, F_C = F_v + F_v̇ ad(v), F_K = F_q + F_v ad(v) + F_v̇ ad(v̇) (eq. 34), the right-hand
sides are −F̈_M + Ḟ_C − F_K and −F_λ. Where F depends on v̇, that asks for third and fourth derivatives of the motion,
which a time integrator does not compute. Of the three ways that §7.2 lists, two end in the second-order equations:

"state", the second of the paper: accelerations and multipliers are functions of the state, by eq. (41); then
    F̃(q, v, t, p) = F(q, v, v̇(q, v, t, p), λ(q, v, t, p), p) has F̃_M = 0 and F̃_λ = 0, and Ḟ̃_C is one derivative along
    the motion (q ṽ, v̇, 1). Terminal terms may use v̇ and λ, too.

"derivatives", the first of the paper: y = v̈ and z = v⃛ from additional differential equations, v̇' = y and y' = z, solved
    by the formulae (28)–(29) of generalized-α for y and z, started by finite differences; likewise for λ.

The third, "first_order", needs no derivative of F and is a sweep of its own (`_first_order_adjoint.py`).

Only "state" is second order throughout. v̇_n and λ_n of generalized-α carry O(h²) (−ρ)^n of the start, and the other two
differentiate them twice, "derivatives" in z, "first_order" through B μ = −F_λᵀ in ν: O(1) in the first steps, an O(h)
of the gradient. With ρ∞ near 1 the filters amplify this by n³ (`benchmarks/methods.py`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._xla import scan
from lgsens.dynamics import AbstractSystem, State, accelerations, constraint_acceleration, kkt_solve
from lgsens.integrate import GeneralizedAlpha, Variation
from lgsens.sensitivity._linearization import cotangent_to_algebra

Pointwise = Callable[[Any, AbstractSystem, State, Float[Array, ""]], Float[Array, " c"]]


class OfState(NamedTuple):
    """A function of (q, v, t, p): v̇ and λ in it are those of eq. (41)."""

    function: Pointwise

    def __call__(self, p, system: AbstractSystem, state: State, t) -> Float[Array, " c"]:
        vdot, lam = accelerations(system, state.q, state.v, t)
        return self.function(p, system, State(state.q, state.v, vdot, lam, vdot), t)


class Functional(NamedTuple):
    """c criteria of eq. (31): F and G as functions of (p, system, state, t), each of shape (c,)."""

    rate: Pointwise | OfState  # F
    final: Pointwise | OfState  # G


class PathPoint(NamedTuple):
    """One converged state, its time, and the further derivatives of v̇ and λ, where they are used."""

    state: State
    t: Float[Array, ""]
    vdot_rates: tuple[Array, Array]  # y, z
    lam_rates: tuple[Array, Array]  # λ̇, λ̈


class Terms(NamedTuple):
    """The terms of F in eqs. (39)–(43) at one point, one row for each criterion."""

    load: Float[Array, "c k"]  # −F̈_M + Ḟ_C − F_K
    level: Float[Array, "c m"]  # −F_λ
    f_m: Float[Array, "c k"]
    f_c: Float[Array, "c k"]
    df_m: Float[Array, "c k"]  # Ḟ_M
    df_lam: Float[Array, "c m"]  # Ḟ_λ


def gradients(function: Callable[[State], Float[Array, " c"]], group, state: State) -> Variation:
    """The derivatives of c functions of a state in Lie-algebra coordinates, one row for each."""
    values, pull_back = jax.vjp(function, state)
    (rows,) = jax.vmap(pull_back)(jnp.eye(values.shape[0], dtype=values.dtype))
    return jax.vmap(lambda row: cotangent_to_algebra(group, state, row))(rows)


def near(function: Pointwise | OfState, p, system: AbstractSystem, state: State, t) -> Pointwise:
    """What stands for a function in first derivatives at a state.

    For an F of v̇(q, v, t, p) and λ(q, v, t, p), with Γ = Φ̈ and [[M, Bᵀ], [B, 0]] [a; b] = [F_v̇ᵀ; F_λᵀ], that is

        F(q, v, v̇, λ, p) − aᵀ r(q, v, v̇, λ, t, p) − bᵀ Γ(q, v, v̇, t, p),      v̇, λ, a, b fixed:

    as r = 0 and Γ = 0 for every q, v and p, it has the value of F and its first derivatives. The solve of eq. (41)
    is not differentiated; a second derivative differentiates v̇, λ, a and b, which are computed here.
    """
    if not isinstance(function, OfState):
        return function
    of = function.function
    vdot, lam = accelerations(system, state.q, state.v, t)
    at = lambda vdot, lam: of(p, system, State(state.q, state.v, vdot, lam, vdot), t)
    f_vdot, f_lam = jax.jacrev(at, argnums=(0, 1))(vdot, lam)
    jacobian = system.constraint_jacobian(state.q, t)
    a, b = kkt_solve(system.mass_matrix(), jacobian, f_vdot.T, f_lam.T)

    def fixed(p, system, state, t):
        q, v = state.q, state.v
        hidden = constraint_acceleration(system, q, v, vdot, t)
        residual = system.residual(q, v, vdot, lam, t)
        return of(p, system, State(q, v, vdot, lam, vdot), t) - residual @ a - hidden @ b

    return fixed


def plain_terms(functional: Functional, p, system: AbstractSystem, point: PathPoint) -> Terms:
    """The terms of an F(q, v, t, p) that does not depend on v̇ and λ (any more)."""
    state, t, group = point.state, point.t, system.group

    def by_v(q, v, t):
        moved = lambda v: State(q, v, state.vdot, state.lam, state.a)
        rate = near(functional.rate, p, system, moved(v), t)
        return jax.jacrev(lambda v: rate(p, system, moved(v), t))(v)

    f_v, rate_of_f_v = jax.jvp(by_v, (state.q, state.v, t), (*_along(group, state), jnp.ones_like(t)))
    rate = near(functional.rate, p, system, state, t)
    of = gradients(lambda state: rate(p, system, state, t), group, state)
    none, level = jnp.zeros_like(f_v), jnp.zeros((f_v.shape[0], state.lam.shape[0]), f_v.dtype)
    return Terms(
        load=rate_of_f_v - of.w - f_v @ group.ad(state.v), level=level, f_m=none, f_c=f_v, df_m=none, df_lam=level
    )


def derivative_terms(functional: Functional, p, system: AbstractSystem, point: PathPoint) -> Terms:
    """The terms of F(q, v, v̇, λ, t, p), with y, z, λ̇ and λ̈ of the point."""
    state, t, group = point.state, point.t, system.group
    bracket, bracket_rate = group.ad(state.v), group.ad(state.vdot)
    one = jnp.ones_like(t)

    def partials(q, v, vdot, lam, t):
        """F_v, F_v̇ and F_λ."""
        return jax.jacrev(
            lambda v, vdot, lam: functional.rate(p, system, State(q, v, vdot, lam, vdot), t), argnums=(0, 1, 2)
        )(v, vdot, lam)

    def rates(q, v, vdot, lam, t, y, lam_rate):
        """Their first derivatives along the motion."""
        motion = (*_along(group, State(q, v, vdot, lam, vdot)), y, lam_rate, one)
        return jax.jvp(partials, (q, v, vdot, lam, t), motion)[1]

    (y, z), (lam_rate, lam_rate2) = point.vdot_rates, point.lam_rates
    f_v, f_m, f_lam = partials(state.q, state.v, state.vdot, state.lam, t)
    (df_v, df_m, df_lam), (_, ddf_m, _) = jax.jvp(
        rates,
        (state.q, state.v, state.vdot, state.lam, t, y, lam_rate),
        (*_along(group, state), y, lam_rate, one, z, lam_rate2),
    )
    f_q = gradients(lambda state: functional.rate(p, system, state, t), group, state).w
    df_c = df_v + df_m @ bracket + f_m @ bracket_rate
    f_k = f_q + f_v @ bracket + f_m @ bracket_rate
    return Terms(load=-ddf_m + df_c - f_k, level=-f_lam, f_m=f_m, f_c=f_v + f_m @ bracket, df_m=df_m, df_lam=df_lam)


def _along(group, state: State):
    """q̇ (in the arrays of q) and v̇."""
    return group.to_ambient(state.q, state.v), state.vdot


def differentiated(scheme: GeneralizedAlpha, values: Float[Array, "n d"], h) -> Float[Array, "n d"]:
    """The time derivative y of a sequence f, by the equation ḟ = y solved with generalized-α (§7.2, first way).

        f_{n+1} = f_n + h ((1 − γ) b_n + γ b_{n+1}),   (1 − α_m) b_{n+1} + α_m b_n = (1 − α_f) y_{n+1} + α_f y_n

    solved for b_{n+1}, y_{n+1}; second order, with y_0 and b_0 = y_0 + (α_m − α_f) h ẏ_0 from one-sided differences.
    """
    alpha_m, alpha_f, gamma = scheme.alpha_m, scheme.alpha_f, scheme.gamma
    f0, f1, f2, f3 = values[:4]
    first = (-11.0 * f0 + 18.0 * f1 - 9.0 * f2 + 2.0 * f3) / (6.0 * h)
    second = (2.0 * f0 - 5.0 * f1 + 4.0 * f2 - f3) / h**2

    def step(carry, pair):
        b, y = carry
        new_b = ((pair[1] - pair[0]) / h - (1.0 - gamma) * b) / gamma
        new_y = ((1.0 - alpha_m) * new_b + alpha_m * b - alpha_f * y) / (1.0 - alpha_f)
        return (new_b, new_y), new_y

    start = (first + (alpha_m - alpha_f) * h * second, first)
    _, rest = scan(step, start, jnp.stack([values[:-1], values[1:]], axis=1))
    return jnp.concatenate([first[None], rest])


def points(scheme: GeneralizedAlpha, states: State, t, h, *, derivatives: bool) -> PathPoint:
    """All points of a trajectory, stacked."""
    if not derivatives:
        none = jnp.zeros((t.shape[0], 0), t.dtype)
        return PathPoint(states, t, (none, none), (none, none))
    y, lam_rate = differentiated(scheme, states.vdot, h), differentiated(scheme, states.lam, h)
    return PathPoint(states, t, (y, differentiated(scheme, y, h)), (lam_rate, differentiated(scheme, lam_rate, h)))
