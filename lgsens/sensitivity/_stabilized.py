"""L of the stabilized scheme (`integrate/_stabilized.py`), and both sweeps with it.

The unknowns of a step are those of `_linearization.py` and ν', kept as the second half of λ'. What is new: with
y = N ν = M⁻¹ B(q_n)ᵀ ν

    M y' = B_nᵀ ν' + G w_n + g_p p',   G w = D(Bᵀν)·(q w̃) at q_n,   g_p p' = (Bᵀν)_p p' − (M_p p') y
    x'   = h v'_n + h² ((½ − β) a'_n + β (a'_{n+1} + y')) + x_h h',      x_h = v_n + 2h ((½ − β) a_n + β (u + y))
    (B v) (B v'_{n+1} + V w_{n+1} + V_p p')/(γh)                                              = b.nu

with V w = D(B v)·(q w̃) and V_p p' = (B v)_p p'; all other rows are as there.

Forward substitution, from (w, v', v̇')_0 at u' = ν' = 0, with S₂ the exact matrix at the converged state:

    S₂ [u'; λ'; ν'] = [ b.a − r_p p' − (M v̇'_0 + C_t v'_0 + K_t w_0);
                        b.lam − (Φ_p p' + B w_0)/(βh²);
                        b.nu − (V_p p' + B v'_0 + V w_0)/(γh) ],          w = w_0 + βh² T (u' + N ν').

Back substitution. With the columns of a step as in `_adjoint.py`, and μ.nu the multiplier of the new row,

    μ.w + K_tᵀ μ.a + Bᵀ μ.lam/(βh²) + Vᵀ μ.nu/(γh) = c.w
    μ.v + C_tᵀ μ.a + Bᵀ μ.nu/(γh)                  = c.v
    −βh² Nᵀ Tᵀ μ.w                                 = c.nu

and the rest as there. Elimination of μ.w, μ.v, μ.vdot leaves

    S₂ᵀ [μ.a; μ.lam; μ.nu] = [ c.a + βh² Tᵀ c.w + γh c.v + c c.vdot;  c.lam;  c.nu + βh² Nᵀ Tᵀ c.w ].

The columns of step n receive besides, with μ_y = βh² M⁻¹ Tᵀ μ.w,

    c_n.w += Gᵀ μ_y,      p̄ += −V_pᵀ μ.nu/(γh) + g_pᵀ μ_y.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, constraint_velocity
from lgsens.integrate import (
    Constants,
    GeneralizedAlpha,
    StabilizedFactors,
    StabilizedStep,
    StabilizedTangents,
    by_configuration,
    halves,
)
from lgsens.sensitivity._blocks import Blocks, padded, sweep_blocks
from lgsens.sensitivity._linearization import Parameters, Rates, Step, Variation, kinematics, step_increment, steps


class Linearized(NamedTuple):
    """What the equations of one step need of its converged state, whatever their right-hand side."""

    x: Float[Array, " k"]
    rates: Rates
    y: Float[Array, " k"]
    tangents: StabilizedTangents
    normal: Float[Array, "k m"]  # N
    curvature: Float[Array, "k k"]  # G
    factors: StabilizedFactors


def _corrected_increment(scheme: GeneralizedAlpha, step: Step, h, y) -> tuple[Float[Array, " k"], Rates]:
    """x and the rates of x and v with h."""
    x, rates = step_increment(scheme, step, h)
    return x + (scheme.beta * h**2) * y, Rates(rates.x + (2.0 * scheme.beta * h) * y, rates.v)


def _linearized(scheme, parameters: Parameters, constants: Constants, step: Step) -> Linearized:
    system, h = parameters.system, parameters.h
    state, q = step.state, step.previous.q
    equations = StabilizedStep.of(scheme, system, constants.mass, constants.inverse_mass, step.previous, h, step.t)
    y, nu = equations.correction(state.lam), halves(state.lam)[1]
    x, rates = _corrected_increment(scheme, step, h, y)
    at_state = equations.tangents(state.q, state.v, state.vdot, state.lam, step.t)
    return Linearized(
        x=x,
        rates=rates,
        y=y,
        tangents=at_state,
        normal=equations.normal,
        curvature=by_configuration(system, lambda q: nu @ system.constraint_jacobian(q, step.t), q),
        factors=equations.factorized(at_state, x),
    )


def _load_function(step: Step, y):
    """p ↦ (r, Φ, B v, Bᵀν − M y) at the fixed converged step."""

    def loads(system: AbstractSystem, t):
        state, (lam, nu) = step.state, halves(step.state.lam)
        return (
            system.residual(state.q, state.v, state.vdot, lam, t),
            system.constraint(state.q, t),
            constraint_velocity(system, state.q, state.v, t),
            nu @ system.constraint_jacobian(step.previous.q, t) - system.mass_matrix() @ y,
        )

    return loads


def _loads(step: Step, y, parameters: Parameters, d: Parameters):
    """The derivative of these along p', with t' = t0' + (n+1) h'."""
    n = (step.t - parameters.t0) / parameters.h
    return jax.jvp(_load_function(step, y), (parameters.system, step.t), (d.system, d.t0 + n * d.h))[1]


def stabilized_direct_sweep(scheme, states: State, parameters: Parameters, b: Variation, d: Parameters):
    """Solve L (δ, p') = (b, d) forwards in time; returns δ stacked, and p' = d."""
    system, h = parameters.system, parameters.h
    group, constants = system.group, Constants.of(system, stabilized=True)
    position, velocity = scheme.beta * h**2, scheme.gamma * h
    num_steps, size = states.v.shape[0] - 1, states.v.shape[1] + states.lam.shape[1]
    blocks = Blocks.of(num_steps, size**2)

    def one(previous: Variation, inputs):
        step, (r_p, phi_p, v_p, g_p), row = inputs
        k_t, c_t, jacobian, velocity_stiffness = step.tangents
        w, v, vdot = kinematics(scheme, group, step.x, step.rates, h, previous, jnp.zeros_like(previous.a), d.h)
        dy = constants.inverse_mass @ (step.curvature @ previous.w + g_p)
        w, v, vdot = w + group.tangent_mv(step.x, position * dy) + row.w, v + row.v, vdot + row.vdot
        violations = ((phi_p + jacobian @ w) / position, (v_p + jacobian @ v + velocity_stiffness @ w) / velocity)
        u, lam = step.factors.solve(
            row.a - r_p - (constants.mass @ vdot + c_t @ v + k_t @ w), row.lam - jnp.concatenate(violations)
        )
        current = Variation(
            w=w + group.tangent_mv(step.x, position * (u + step.normal @ halves(lam)[1])),
            v=v + velocity * u,
            vdot=vdot + scheme.inertia_factor * u,
            lam=lam,
            a=u,
        )
        return current, current

    def block(previous: Variation, inputs):
        step, rows = inputs
        prepared = jax.vmap(partial(_linearized, scheme, parameters, constants))(step)
        loads = jax.vmap(lambda step, y: _loads(step, y, parameters, d))(step, prepared.y)
        return lax.scan(one, previous, (prepared, loads, rows))

    first = jax.tree.map(lambda leaf: leaf[0], b)
    rows = jax.tree.map(lambda leaf: leaf[1:], b)
    inputs = padded((steps(states, parameters), rows), blocks.padding, repeat=True)
    _, later = sweep_blocks(blocks, block, first, inputs)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest[:num_steps]]), first, later), d


def stabilized_adjoint_sweep(scheme, states: State, parameters: Parameters, c: Variation, c_p: Parameters):
    """Solve Lᵀ (μ, p̄) = (c, c_p) backwards in time; returns μ stacked (row 0: the cotangent of δ_0), and p̄."""
    system, h = parameters.system, parameters.h
    group, constants = system.group, Constants.of(system, stabilized=True)
    position, velocity = scheme.beta * h**2, scheme.gamma * h
    alpha_m, alpha_f = scheme.alpha_m, scheme.alpha_f
    num_steps, size = states.v.shape[0] - 1, states.v.shape[1] + states.lam.shape[1]
    blocks = Blocks.of(num_steps, size**2)

    def one(c: Variation, inputs):
        step, earlier = inputs
        k_t, c_t, jacobian, velocity_stiffness = step.tangents
        turned = position * group.tangent_rmv(step.x, c.w)
        c_lam, c_nu = halves(c.lam)
        mu_a, mu_lam = step.factors.solve(
            c.a + turned + velocity * c.v + scheme.inertia_factor * c.vdot,
            jnp.concatenate([c_lam, c_nu + turned @ step.normal]),
            transposed=True,
        )
        phi, rate = halves(mu_lam)
        phi, rate = phi / position, rate / velocity
        mu_w = c.w - mu_a @ k_t - phi @ jacobian - rate @ velocity_stiffness
        mu_v = c.v - mu_a @ c_t - rate @ jacobian
        mu_vdot = c.vdot - mu_a @ constants.mass
        mu_x = group.tangent_rmv(step.x, mu_w)
        mu_y = position * (constants.inverse_mass @ mu_x)
        previous = Variation(
            w=earlier.w + group.Ad_inv_rmv(group.exp(step.x), mu_w) + mu_y @ step.curvature,
            v=earlier.v + h * mu_x + mu_v,
            vdot=earlier.vdot - (alpha_f / (1.0 - alpha_f)) * mu_vdot,
            lam=earlier.lam,
            a=earlier.a
            + (h**2 * (0.5 - scheme.beta)) * mu_x
            + (h * (1.0 - scheme.gamma)) * mu_v
            + (alpha_m / (1.0 - alpha_f)) * mu_vdot,
        )
        of_loads = (-mu_a, -phi, -rate, mu_y)
        of_h = jnp.dot(step.rates.x, mu_x) + jnp.dot(step.rates.v, mu_v)
        return previous, (Variation(mu_w, mu_v, mu_vdot, mu_lam, mu_a), of_loads, of_h)

    def block(carry, inputs):
        c, bar = carry
        step, earlier = inputs
        prepared = jax.vmap(partial(_linearized, scheme, parameters, constants))(step)
        c, (mu, of_loads, of_h) = lax.scan(one, c, (prepared, earlier), reverse=True)

        def loads(system, t):
            return jax.vmap(lambda step, y, t: _load_function(step, y)(system, t))(step, prepared.y, t)

        _, pull_back = jax.vjp(loads, system, step.t)
        bar_system, bar_t = pull_back(of_loads)
        n = (step.t - parameters.t0) / h
        bar = Parameters(
            system=jax.tree.map(jnp.add, bar.system, bar_system),
            t0=bar.t0 + jnp.sum(bar_t),
            h=bar.h + jnp.dot(n, bar_t) + jnp.sum(of_h),
        )
        return (c, bar), mu

    # The steps that fill the last block come first, with zero cotangents, and leave them zero.
    c = padded(c, blocks.padding, repeat=False)
    last = jax.tree.map(lambda leaf: leaf[-1], c)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], c)
    inputs = (padded(steps(states, parameters), blocks.padding, repeat=True), earlier)
    (first, bar), later = sweep_blocks(blocks, block, (last, c_p), inputs, reverse=True)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest[:num_steps]]), first, later), bar


def stabilized_matvec(scheme, states: State, parameters: Parameters, delta: Variation, d: Parameters):
    """L (δ, p'), all steps at once: the equations above, written out. What JAX differentiates a second time."""
    system, h = parameters.system, parameters.h
    group, constants = system.group, Constants.of(system, stabilized=True)

    def rows(step: Step, previous: Variation, current: Variation) -> Variation:
        state, (lam, nu), (d_lam, d_nu) = step.state, halves(step.state.lam), halves(current.lam)
        before, t_dot = step.previous.q, d.t0 + (step.t - parameters.t0) / h * d.h
        y = constants.inverse_mass @ (nu @ system.constraint_jacobian(before, step.t))
        at = lambda q, w: group.to_ambient(q, w)

        def correction(system, q, nu, t):
            return nu @ system.constraint_jacobian(q, t) - system.mass_matrix() @ y

        _, load = jax.jvp(correction, (system, before, nu, step.t), (d.system, at(before, previous.w), d_nu, t_dot))
        dy = constants.inverse_mass @ load

        def equations(system, q, v, vdot, lam, t):
            rate = constraint_velocity(system, q, v, t)
            return system.residual(q, v, vdot, lam, t), system.constraint(q, t), rate

        _, (r, phi, rate) = jax.jvp(
            equations,
            (system, state.q, state.v, state.vdot, lam, step.t),
            (d.system, at(state.q, current.w), current.v, current.vdot, d_lam, t_dot),
        )
        x, rates = _corrected_increment(scheme, step, h, y)
        w, v, vdot = kinematics(scheme, group, x, rates, h, previous, current.a, d.h)
        return Variation(
            w=current.w - w - group.tangent_mv(x, (scheme.beta * h**2) * dy),
            v=current.v - v,
            vdot=current.vdot - vdot,
            lam=jnp.concatenate([phi / (scheme.beta * h**2), rate / (scheme.gamma * h)]),
            a=r,
        )

    previous = jax.tree.map(lambda leaf: leaf[:-1], delta)
    current = jax.tree.map(lambda leaf: leaf[1:], delta)
    later = jax.vmap(rows)(steps(states, parameters), previous, current)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[:1], rest]), delta, later), d
