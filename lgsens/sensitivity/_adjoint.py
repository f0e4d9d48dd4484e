"""The discrete adjoint variable method: back substitution with Lᵀ.

Given cotangents c_n of the states and c_p of the parameters, solve Lᵀ (μ, p̄) = (c, c_p). The columns of L that belong
to (w, v', v̇', λ', a')_{n+1}, with c already holding what later steps contribute, give for the multipliers μ of the
equations of step n → n+1 (named like their rows: μ.a of r, μ.lam of Φ/(βh²))

    μ.w    + K_tᵀ μ.a + Bᵀ μ.lam/(βh²) = c.w
    μ.v    + C_tᵀ μ.a                  = c.v
    μ.vdot + Mᵀ μ.a                    = c.vdot
    B μ.a                              = c.lam
    −βh² Tᵀ μ.w − γh μ.v − c μ.vdot    = c.a

Elimination of the first three leaves the transpose of the iteration matrix, which the continuous method of §7 does
not have (its remark after eq. 40):

    Sᵀ [μ.a; μ.lam] = [ c.a + βh² Tᵀ c.w + γh c.v + c c.vdot;  c.lam ]

The columns of step n then receive, from the same equations,

    c_n.w += Dᵀ μ.w,    c_n.v += h Tᵀ μ.w + μ.v,    c_n.a += h² (½ − β) Tᵀ μ.w + h (1 − γ) μ.v + α_m/(1 − α_f) μ.vdot,
    c_n.vdot += −α_f/(1 − α_f) μ.vdot,    p̄ += −r_pᵀ μ.a − Φ_pᵀ μ.lam/(βh²),    h̄ += x_hᵀ Tᵀ μ.w + v_hᵀ μ.v,

and p̄ of t0 and h through t_{n+1} = t0 + (n+1) h. With steps of different sizes c_n.a is so that of a_n*, say c*, and
what a_n, v̇_n and r_n receive of it is r_n c*, (1 − r_n) c* and (a_n − v̇_n)ᵀ c*; an empty step has μ = c_{n+1}, and adds
that to c_n. What is kept is the states; nothing of the paper's Ḃ, Ḟ_λ or
d²F_M/dt² is needed, because accelerations and multipliers are unknowns here like the others.
"""

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State, factor_size, mass_matrix, softness
from lgsens.integrate import GeneralizedAlpha
from lgsens.sensitivity._blocks import Blocks, padded, sweep_blocks
from lgsens.sensitivity._linearization import (
    Grid,
    Parameters,
    SingleStep,
    Variation,
    grid_cotangent,
    linearized,
    own,
    pseudo_load_function,
    steps,
)


def adjoint_sweep(scheme: GeneralizedAlpha, states: State, parameters: Parameters, c: Variation, c_p: Parameters):
    """Solve Lᵀ (μ, p̄) = (c, c_p) backwards in time; returns μ stacked (row 0: the cotangent of δ_0), and p̄."""
    system = parameters.system
    group, mass = system.group, mass_matrix(system)
    alpha_m, alpha_f = scheme.alpha_m, scheme.alpha_f
    num_steps = states.v.shape[0] - 1
    blocks = Blocks.of(num_steps, factor_size(system))

    def one(c: Variation, inputs):
        (x, _, (k_t, c_t, jacobian), factors), earlier, single = inputs
        h = parameters.h if single is None else single.grid.h
        mu_a, mu_lam = factors.solve(
            c.a
            + (scheme.beta * h**2) * group.tangent_rmv(x, c.w)
            + (scheme.gamma * h) * c.v
            + scheme.inertia_factor * c.vdot,
            c.lam,
            transposed=True,
        )
        mu_w = c.w - mu_a @ k_t - (mu_lam / (scheme.beta * h**2)) @ jacobian
        mu_v = c.v - mu_a @ c_t
        mu_vdot = c.vdot - mu_a @ mass
        mu_x = group.tangent_rmv(x, mu_w)
        previous = Variation(
            w=earlier.w + group.Ad_inv_rmv(group.exp(x), mu_w),
            v=earlier.v + h * mu_x + mu_v,
            vdot=earlier.vdot - (alpha_f / (1.0 - alpha_f)) * mu_vdot,
            lam=earlier.lam,
            a=earlier.a
            + (h**2 * (0.5 - scheme.beta)) * mu_x
            + (h * (1.0 - scheme.gamma)) * mu_v
            + (alpha_m / (1.0 - alpha_f)) * mu_vdot,
        )
        mu = Variation(mu_w, mu_v, mu_vdot, mu_lam, mu_a)
        if single is None:
            return previous, (mu, mu_x, None)
        previous, bar_ratio = single.begun_transposed(previous, earlier)
        previous = single.unless_empty(previous, jax.tree.map(jnp.add, earlier, c))
        return previous, (single.unless_empty(mu, c), mu_x, bar_ratio)

    def block(carry, inputs):
        c, bar = carry
        step, earlier, single = inputs
        prepared = jax.vmap(lambda step, grid: linearized(scheme, own(parameters, grid), mass, step))(
            step, single and single.grid
        )
        c, (mu, mu_x, bar_ratio) = lax.scan(one, c, (prepared, earlier, single), reverse=True)
        solved, h = mu, parameters.h
        if single is not None:  # an empty step has no equations of motion
            nothing = jax.tree.map(jnp.zeros_like, (mu, mu_x))
            mu, mu_x = jax.vmap(SingleStep.unless_empty)(single, (mu, mu_x), nothing)
            h = single.grid.h[:, None]

        loads = lambda system, t: jax.vmap(lambda state, t: pseudo_load_function(state)(system, t))(step.state, t)
        _, pull_back = jax.vjp(loads, system, step.t)
        bar_system, bar_t = pull_back((-mu.a, -mu.lam / (scheme.beta * h**2)))
        if bar_ratio is not None:
            rates = prepared.rates.x * mu_x + prepared.rates.v * mu.v
            bar = bar._replace(system=jax.tree.map(jnp.add, bar.system, bar_system))
            return (c, bar), (solved, Grid(bar_t, bar_t + jnp.sum(rates, axis=1), bar_ratio))
        n = (step.t - parameters.t0) / h
        if softness(system) is not None:
            violation = jax.vmap(system.constraint)(step.state.q, step.t)
            bar = bar._replace(h=bar.h + jnp.sum(mu.lam * violation) * 2.0 / (scheme.beta * h**3))
        bar = Parameters(
            system=jax.tree.map(jnp.add, bar.system, bar_system),
            t0=bar.t0 + jnp.sum(bar_t),
            h=bar.h + jnp.dot(n, bar_t) + jnp.sum(prepared.rates.x * mu_x) + jnp.sum(prepared.rates.v * mu.v),
        )
        return (c, bar), (mu, None)

    # The steps that fill the last block come first, with zero cotangents, and leave them zero.
    c = padded(c, blocks.padding, repeat=False)
    last = jax.tree.map(lambda leaf: leaf[-1], c)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], c)
    known = padded((steps(states, parameters), SingleStep.of(states, parameters)), blocks.padding, repeat=True)
    inputs = (known[0], earlier, known[1])
    (first, bar), (later, bar_grid) = sweep_blocks(blocks, block, (last, c_p), inputs, reverse=True)
    if bar_grid is not None:
        of_t0, of_h = grid_cotangent(parameters, jax.tree.map(lambda leaf: leaf[:num_steps], bar_grid))
        bar = Parameters(bar.system, bar.t0 + of_t0, bar.h + of_h)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest[:num_steps]]), first, later), bar
