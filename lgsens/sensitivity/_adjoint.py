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

and p̄ of t0 and h through t_{n+1} = t0 + (n+1) h. What is kept is the states; nothing of the paper's Ḃ, Ḟ_λ or
d²F_M/dt² is needed, because accelerations and multipliers are unknowns here like the others.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State, factor_size, mass_matrix, softness
from lgsens.integrate import GeneralizedAlpha
from lgsens.sensitivity._blocks import Blocks, padded, sweep_blocks
from lgsens.sensitivity._linearization import (
    Parameters,
    Variation,
    linearized,
    pseudo_load_function,
    steps,
)


def adjoint_sweep(scheme: GeneralizedAlpha, states: State, parameters: Parameters, c: Variation, c_p: Parameters):
    """Solve Lᵀ (μ, p̄) = (c, c_p) backwards in time; returns μ stacked (row 0: the cotangent of δ_0), and p̄."""
    system, h = parameters.system, parameters.h
    group, mass = system.group, mass_matrix(system)
    alpha_m, alpha_f = scheme.alpha_m, scheme.alpha_f
    num_steps = states.v.shape[0] - 1
    blocks = Blocks.of(num_steps, factor_size(system))

    def one(c: Variation, inputs):
        (x, _, (k_t, c_t, jacobian), factors), earlier = inputs
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
        return previous, (Variation(mu_w, mu_v, mu_vdot, mu_lam, mu_a), mu_x)

    def block(carry, inputs):
        c, bar = carry
        step, earlier = inputs
        prepared = jax.vmap(partial(linearized, scheme, parameters, mass))(step)
        c, (mu, mu_x) = lax.scan(one, c, (prepared, earlier), reverse=True)

        loads = lambda system, t: jax.vmap(lambda state, t: pseudo_load_function(state)(system, t))(step.state, t)
        _, pull_back = jax.vjp(loads, system, step.t)
        bar_system, bar_t = pull_back((-mu.a, -mu.lam / (scheme.beta * h**2)))
        n = (step.t - parameters.t0) / h
        if softness(system) is not None:
            violation = jax.vmap(system.constraint)(step.state.q)
            bar = bar._replace(h=bar.h + jnp.sum(mu.lam * violation) * 2.0 / (scheme.beta * h**3))
        bar = Parameters(
            system=jax.tree.map(jnp.add, bar.system, bar_system),
            t0=bar.t0 + jnp.sum(bar_t),
            h=bar.h + jnp.dot(n, bar_t) + jnp.sum(prepared.rates.x * mu_x) + jnp.sum(prepared.rates.v * mu.v),
        )
        return (c, bar), mu

    # The steps that fill the last block come first, with zero cotangents, and leave them zero.
    c = padded(c, blocks.padding, repeat=False)
    last = jax.tree.map(lambda leaf: leaf[-1], c)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], c)
    inputs = (padded(steps(states, parameters), blocks.padding, repeat=True), earlier)
    (first, bar), later = sweep_blocks(blocks, block, (last, c_p), inputs, reverse=True)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest[:num_steps]]), first, later), bar
