"""The direct differentiation method of the time integrator (§6.2): forward substitution with L.

At each step, with the equations of `_linearization.py`, everything but u' = a'_{n+1} and λ'_{n+1} is known. Let
(w, v', v̇')_0 be eqs. (24), (28), (29) at u' = 0 plus their right-hand sides. Then, with ∂w/∂u' = βh² T(x),
∂v'/∂u' = γh, ∂v̇'/∂u' = c,

    S [u'; λ'] = [ b.a − r_p p' − (M v̇'_0 + C_t v'_0 + K_t w_0);
                   b.lam − (Φ_p p' + B w_0)/(βh²) ]

with S the iteration matrix of eq. (30) at the converged state: one factorization per step, whatever the number of
parameters (under `vmap` over right-hand sides S stays unbatched).
"""

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State
from lgsens.integrate import GeneralizedAlpha, factorize_iteration_matrix
from lgsens.sensitivity._linearization import (
    Parameters,
    Step,
    Variation,
    kinematics,
    pseudo_loads,
    step_increment,
    step_tangents,
    steps,
)


def direct_step(
    scheme: GeneralizedAlpha,
    parameters: Parameters,
    mass,
    step: Step,
    previous: Variation,
    row: Variation,
    d: Parameters,
) -> Variation:
    """δ_{n+1} from δ_n, the right-hand side of its equations and p'. What does not depend on these three is shared
    by all of them under `vmap`: the tangents and one factorization."""
    system, h = parameters.system, parameters.h
    group = system.group
    x, rates = step_increment(scheme, step, h)
    tangents = step_tangents(system, step)
    factors = factorize_iteration_matrix(scheme, system, tangents, mass, x, h)
    r_p, phi_p = pseudo_loads(step, parameters, d)
    k_t, c_t, jacobian = tangents

    w, v, vdot = kinematics(scheme, group, x, rates, h, previous, jnp.zeros_like(previous.a), d.h)
    w, v, vdot = w + row.w, v + row.v, vdot + row.vdot
    u, lam = factors.solve(
        row.a - r_p - (mass @ vdot + c_t @ v + k_t @ w),
        row.lam - (phi_p + jacobian @ w) / (scheme.beta * h**2),
    )
    return Variation(
        w=w + group.tangent_mv(x, (scheme.beta * h**2) * u),
        v=v + (scheme.gamma * h) * u,
        vdot=vdot + scheme.inertia_factor * u,
        lam=lam,
        a=u,
    )


def direct_sweep(scheme: GeneralizedAlpha, states: State, parameters: Parameters, b: Variation, d: Parameters):
    """Solve L (δ, p') = (b, d) forwards in time; returns δ stacked, and p' = d."""
    mass = parameters.system.mass_matrix()

    def sweep(previous: Variation, inputs):
        current = direct_step(scheme, parameters, mass, inputs[0], previous, inputs[1], d)
        return current, current

    first = jax.tree.map(lambda leaf: leaf[0], b)
    rows = jax.tree.map(lambda leaf: leaf[1:], b)
    _, later = lax.scan(sweep, first, (steps(states, parameters), rows))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), first, later), d
