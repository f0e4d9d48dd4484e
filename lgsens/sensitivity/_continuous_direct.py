"""The direct differentiation method of the equations of motion (§6.1).

Before any discretization, with ẇ = v' − ad(v) w and v̇' = ẅ + ad(v) ẇ + ad(v̇) w,

    M ẅ + (C_t + M ad(v)) ẇ + (K_t + C_t ad(v) + M ad(v̇)) w + Bᵀλ' = −r_p p'
    B w = −Φ_p p'

linear equations on a linear space, integrated by generalized-α with the numbers of the nominal scheme. The brackets
ad(v), ad(v̇) are what the Lie group adds. The solution is not the derivative of the numerical trajectory (that is §6.2,
`_sweeps.py`) but converges to the same limit, at second order.

The derivative of the initial state gives w_0, v'_0, v̇'_0, λ'_0 and, through a'_0, ẅ at t0 + (α_m − α_f) h. v_0 has been
moved off B v = 0 by O(h²) for the nominal scheme (`GeneralizedAlpha.second_order_start`); ẇ_0 must solve its own hidden
constraint to better than that, so it is projected on d/dt (B w + Φ_p p') = 0 along the motion.
"""

from functools import partial

import jax
import jax.numpy as jnp

from lgsens._xla import scan
from lgsens.dynamics import State, consistent_velocity, full_jacobian, kkt_solve
from lgsens.integrate import GeneralizedAlpha, Variation, later, with_first
from lgsens.sensitivity._linear_alpha import LinearMotion, LinearNode, advance, started
from lgsens.sensitivity._linearization import Parameters, node_tangent


def continuous_direct_sweep(
    scheme: GeneralizedAlpha, states: State, parameters: Parameters, first: Variation, d: Parameters
) -> Variation:
    """The sensitivities (w, v', v̇', λ', a' = v̇') of all states, stacked, given those of the first."""
    system, grid = parameters
    group, mass = system.group, system.mass_matrix()
    places, d_places = jax.jvp(lambda grid: grid.places(), (grid,), (d.grid,))

    def node(state: State, place, d_place) -> LinearNode:
        t, d_t = grid.node(place).t, node_tangent(grid, d.grid, place, d_place).t
        k_t, c_t, jacobian = system.tangents(state.q, state.v, state.vdot, state.lam, t)
        bracket = group.ad(state.v)
        residual = lambda system, t: system.residual(state.q, state.v, state.vdot, state.lam, t)
        loads = lambda system, t: (residual(system, t), system.constraint(state.q, t))
        r_p, phi_p = jax.jvp(loads, (system, t), (d.system, d_t))[1]
        return LinearNode(
            damping=c_t + mass @ bracket,
            stiffness=k_t + c_t @ bracket + mass @ group.ad(state.vdot),
            constraint_jacobian=jacobian,
            load=-r_p[:, None],
            level=-phi_p[:, None],
        )

    motion = _begin(scheme, system, jax.tree.map(lambda leaf: leaf[0], states), first, d, grid.t0, grid.first_size)

    def sweep(previous: LinearMotion, inputs):
        state, place, d_place = inputs
        h, ratio = grid.node(place).h, grid.ratio(place)
        current = advance(scheme, mass, previous, node(state, place, d_place), h, ratio)
        current = grid.unless_empty(place, current, previous)
        return current, current

    _, rest = scan(sweep, motion, (later(states), places, d_places))
    motion = jax.tree.map(lambda leaf: leaf[..., 0], with_first(motion, rest))
    return jax.vmap(partial(_variation, group))(states, motion)


def _variation(group, state: State, motion: LinearMotion) -> Variation:
    bracket = group.ad(state.v)
    v = motion.rate + bracket @ motion.x
    vdot = motion.acceleration + bracket @ motion.rate + group.ad(state.vdot) @ motion.x
    return Variation(motion.x, v, vdot, motion.lam, vdot)


def _begin(scheme: GeneralizedAlpha, system, state: State, first: Variation, d: Parameters, t0, h) -> LinearMotion:
    """w, ẇ, ẅ, λ' and the algorithmic acceleration of the linear scheme at t0."""
    ad, delta = system.group.ad, scheme.alpha_m - scheme.alpha_f
    bracket, of_vdot = ad(state.v), ad(state.vdot)
    w = first.w
    rate = first.v - bracket @ w
    rate = rate - _hidden_violation(system, state, w, rate, d, t0)
    acceleration = first.vdot - bracket @ rate - of_vdot @ w
    # a' stands for v̇' = ẅ + ad(v) ẇ + ad(v̇) w at t0 + Δ h, and a_0 for v̇ there
    change = (delta * h) * (bracket @ acceleration + 2.0 * of_vdot @ rate) + ad(state.a - state.vdot) @ w
    a = first.a - bracket @ rate - of_vdot @ w - change
    exact = LinearMotion(*(column[:, None] for column in (w, rate, acceleration, first.lam, a)))
    return started(scheme, system.mass_matrix(), full_jacobian(system, state.q, t0), exact, h)


def _hidden_violation(system, state: State, w, rate, d: Parameters, t0):
    """What d/dt (B w + Φ_p p') = 0 forbids of ẇ, as its M-orthogonal part."""
    q, group = state.q, system.group
    v = consistent_velocity(system, q, state.v, t0)

    def varied(q, w, t):
        tangents = d.system, group.to_ambient(q, w), d.grid.t0
        return jax.jvp(lambda system, q, t: system.constraint(q, t), (system, q, t), tangents)[1]

    violation = jax.jvp(varied, (q, w, t0), (group.to_ambient(q, v), rate, jnp.ones_like(t0)))[1]
    mass, jacobian = system.mass_matrix(), full_jacobian(system, q, t0)
    return kkt_solve(mass, jacobian, jnp.zeros_like(rate), violation)[0]
