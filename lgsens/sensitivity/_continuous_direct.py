"""The direct differentiation method of the equations of motion (§6.1).

Before any discretization, with ẇ = v' − ad(v) w and v̇' = ẅ + ad(v) ẇ + ad(v̇) w,

    M ẅ + (C_t + M ad(v)) ẇ + (K_t + C_t ad(v) + M ad(v̇)) w + Bᵀλ' = −r_p p'
    B w = −Φ_p p'

linear equations on a linear space, integrated by generalized-α with the numbers of the nominal scheme. The brackets
ad(v), ad(v̇) are what the Lie group adds. The solution is not the derivative of the numerical trajectory (that is §6.2,
`_sweeps.py`) but converges to the same limit, at second order.

Derivatives are those at a step, not at a time: t' = t_n', and between two steps dt stretches by σ = h'/h,

    v' = ẇ + ad(v) w − σ v,     v̇' = ẅ + ad(v) ẇ + ad(v̇) w − 2 σ v̇,

so that σ (C_t v + 2 M v̇) is added to the loads −r_p p' − r_t t'. v' and v̇' are continuous: where σ changes by Δσ, a
step begins with Δσ v more of ẇ, and 2 Δσ v̇ more of ẅ and a.

The derivative of the initial state gives w_0, v'_0, v̇'_0, λ'_0 and, through a'_0, ẅ at t0 + (α_m − α_f) h. v_0 has been
moved off B v = 0 by O(h²) for the nominal scheme (`GeneralizedAlpha.second_order_start`); ẇ_0 must solve its own hidden
constraint to better than that, so it is projected on d/dt (B w + Φ_p p') = 0 along the motion.
"""

from functools import partial

import jax
import jax.numpy as jnp

from lgsens._xla import scan
from lgsens.dynamics import State, consistent_velocity, full_jacobian, kkt_solve
from lgsens.integrate import GeneralizedAlpha, Variation, earlier, later, with_first
from lgsens.sensitivity._linear_alpha import LinearMotion, LinearNode, advance, started
from lgsens.sensitivity._linearization import Parameters, node_tangent


def continuous_direct_sweep(
    scheme: GeneralizedAlpha, states: State, parameters: Parameters, first: Variation, d: Parameters
) -> Variation:
    """The sensitivities (w, v', v̇', λ', a' = v̇') of all states, stacked, given those of the first."""
    system, grid = parameters
    group, mass = system.group, system.mass_matrix()
    places, d_places = jax.jvp(lambda grid: grid.places(), (grid,), (d.grid,))

    def stretch(place, d_place):
        """σ."""
        return node_tangent(grid, d.grid, place, d_place).h / grid.node(place).h

    def node(state: State, place, d_place) -> LinearNode:
        t, d_t = grid.node(place).t, node_tangent(grid, d.grid, place, d_place).t
        k_t, c_t, jacobian = system.tangents(state.q, state.v, state.vdot, state.lam, t)
        bracket = group.ad(state.v)
        residual = lambda system, t: system.residual(state.q, state.v, state.vdot, state.lam, t)
        loads = lambda system, t: (residual(system, t), system.constraint(state.q, t))
        r_p, phi_p = jax.jvp(loads, (system, t), (d.system, d_t))[1]
        stretched = stretch(place, d_place) * (c_t @ state.v + 2.0 * mass @ state.vdot)
        return LinearNode(
            damping=c_t + mass @ bracket,
            stiffness=k_t + c_t @ bracket + mass @ group.ad(state.vdot),
            constraint_jacobian=jacobian,
            load=(stretched - r_p)[:, None],
            level=-phi_p[:, None],
        )

    at_first = jax.jvp(lambda grid: grid.first_size, (grid,), (d.grid,))[1] / grid.first_size
    motion = _begin(scheme, system, jax.tree.map(lambda leaf: leaf[0], states), first, d, grid, at_first)

    def sweep(carry, inputs):
        (previous, before), (state, after, place, d_place) = carry, inputs
        h, ratio, sigma = grid.node(place).h, grid.ratio(place), stretch(place, d_place)
        begun = _restretched(previous, state, sigma - before)
        current = advance(scheme, mass, begun, node(after, place, d_place), h, ratio)
        current = grid.unless_empty(place, current, previous)
        return (current, sigma), (current, sigma)

    _, rest = scan(sweep, (motion, at_first), (earlier(states), later(states), places, d_places))
    motion, sigma = with_first((motion, at_first), rest)
    motion = jax.tree.map(lambda leaf: leaf[..., 0], motion)
    return jax.vmap(partial(_variation, group))(states, motion, sigma)


def _restretched(motion: LinearMotion, state: State, change) -> LinearMotion:
    """What a motion with the same v' and v̇' is where σ has another value."""
    along, twice = change * state.v[:, None], 2.0 * change * state.vdot[:, None]  # ad(v) v = 0
    return motion._replace(rate=motion.rate + along, acceleration=motion.acceleration + twice, a=motion.a + twice)


def _variation(group, state: State, motion: LinearMotion, sigma) -> Variation:
    bracket = group.ad(state.v)
    v = motion.rate + bracket @ motion.x - sigma * state.v
    vdot = motion.acceleration + bracket @ motion.rate + group.ad(state.vdot) @ motion.x - 2.0 * sigma * state.vdot
    return Variation(motion.x, v, vdot, motion.lam, vdot)


def _begin(scheme: GeneralizedAlpha, system, state: State, first: Variation, d: Parameters, grid, sigma):
    """w, ẇ, ẅ, λ' and the algorithmic acceleration of the linear scheme at t0."""
    ad, delta, t0, h = system.group.ad, scheme.alpha_m - scheme.alpha_f, grid.t0, grid.first_size
    bracket, of_vdot = ad(state.v), ad(state.vdot)
    w = first.w
    rate = first.v - bracket @ w + sigma * state.v
    rate = rate - _hidden_violation(system, state, w, rate, d, t0, sigma)
    acceleration = first.vdot - bracket @ rate - of_vdot @ w + 2.0 * sigma * state.vdot
    # a' stands for v̇' = ẅ + ad(v) ẇ + ad(v̇) w − 2 σ v̇ at t0 + Δ h, and a_0 for v̇ there
    change = (delta * h) * (bracket @ acceleration + 2.0 * of_vdot @ rate) + ad(state.a - state.vdot) @ w
    a = first.a - bracket @ rate - of_vdot @ w - change + 2.0 * sigma * state.a
    exact = LinearMotion(*(column[:, None] for column in (w, rate, acceleration, first.lam, a)))
    return started(scheme, system.mass_matrix(), full_jacobian(system, state.q, t0), exact, h)


def _hidden_violation(system, state: State, w, rate, d: Parameters, t0, sigma):
    """What d/dt (B w + Φ_p p' + Φ_t t') = 0 forbids of ẇ, as its M-orthogonal part."""
    q, group = state.q, system.group
    v = consistent_velocity(system, q, state.v, t0)

    def varied(q, w, t, d_t):
        tangents = d.system, group.to_ambient(q, w), d_t
        return jax.jvp(lambda system, q, t: system.constraint(q, t), (system, q, t), tangents)[1]

    motion = (group.to_ambient(q, v), rate, jnp.ones_like(t0), sigma)
    violation = jax.jvp(varied, (q, w, t0, d.grid.t0), motion)[1]
    mass, jacobian = system.mass_matrix(), full_jacobian(system, q, t0)
    return kkt_solve(mass, jacobian, jnp.zeros_like(rate), violation)[0]
