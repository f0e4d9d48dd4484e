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

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State
from lgsens.integrate import GeneralizedAlpha, factorize_iteration_matrix
from lgsens.sensitivity._linearization import (
    Parameters,
    Variation,
    pseudo_load_function,
    step_increment,
    step_tangents,
    steps,
)


def adjoint_sweep(scheme: GeneralizedAlpha, states: State, parameters: Parameters, c: Variation, c_p: Parameters):
    """Solve Lᵀ (μ, p̄) = (c, c_p) backwards in time; returns μ stacked (row 0: the cotangent of δ_0), and p̄."""
    system, h = parameters.system, parameters.h
    group, mass = system.group, parameters.system.mass_matrix()
    alpha_m, alpha_f = scheme.alpha_m, scheme.alpha_f

    def sweep(carry, inputs):
        c, bar = carry
        step, earlier = inputs
        x, rates = step_increment(scheme, step, h)
        tangents = step_tangents(system, step)
        factors = factorize_iteration_matrix(scheme, system, tangents, mass, x, h)
        k_t, c_t, jacobian = tangents

        mu_a, mu_lam = factors.solve(
            c.a
            + (scheme.beta * h**2) * group.tangent_rmv(x, c.w)
            + (scheme.gamma * h) * c.v
            + scheme.inertia_factor * c.vdot,
            c.lam,
            transposed=True,
        )
        of_constraint = mu_lam / (scheme.beta * h**2)
        mu_w = c.w - mu_a @ k_t - of_constraint @ jacobian
        mu_v = c.v - mu_a @ c_t
        mu_vdot = c.vdot - mu_a @ mass
        mu_x = group.tangent_rmv(x, mu_w)

        _, pull_back = jax.vjp(pseudo_load_function(step.state), system, step.t)
        bar_system, bar_t = pull_back((-mu_a, -of_constraint))
        n = (step.t - parameters.t0) / h
        bar = Parameters(
            system=jax.tree.map(jnp.add, bar.system, bar_system),
            t0=bar.t0 + bar_t,
            h=bar.h + n * bar_t + jnp.dot(rates.x, mu_x) + jnp.dot(rates.v, mu_v),
        )
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
        return (previous, bar), Variation(mu_w, mu_v, mu_vdot, mu_lam, mu_a)

    last = jax.tree.map(lambda leaf: leaf[-1], c)
    earlier = jax.tree.map(lambda leaf: leaf[:-1], c)
    (first, bar), later = lax.scan(sweep, (last, c_p), (steps(states, parameters), earlier), reverse=True)
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), first, later), bar
