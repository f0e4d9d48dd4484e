"""The direct differentiation method of the time integrator (§6.2): forward substitution with L.

At each step, with the equations of `_linearization.py`, everything but u' = a'_{n+1} and λ'_{n+1} is known. Let
(w, v', v̇')_0 be eqs. (24), (28), (29) at u' = 0 plus their right-hand sides. Then, with ∂w/∂u' = βh² T(x),
∂v'/∂u' = γh, ∂v̇'/∂u' = c,

    S [u'; λ'] = [ b.a − r_p p' − (M v̇'_0 + C_t v'_0 + K_t w_0);
                   b.lam − (Φ_p p' + B w_0)/(βh²) ]

with S the iteration matrix of eq. (30) at the converged state: one factorization per step, whatever the number of
parameters (under `vmap` over right-hand sides S stays unbatched). The steps after the last, which fill its block, are
computed and dropped.
"""

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State, factor_size, mass_matrix
from lgsens.integrate import GeneralizedAlpha
from lgsens.sensitivity._blocks import Blocks, padded, sweep_blocks
from lgsens.sensitivity._linearization import (
    Linearized,
    Parameters,
    SingleStep,
    Variation,
    grid_tangent,
    kinematics,
    linearized,
    own,
    pseudo_loads,
    steps,
)


def direct_step(
    scheme: GeneralizedAlpha,
    parameters: Parameters,
    mass,
    step: Linearized,
    loads,
    previous: Variation,
    row: Variation,
    dh,
) -> Variation:
    """δ_{n+1} from δ_n, the right-hand side of its equations, its pseudo-loads (r_p p', Φ_p p') and h'."""
    h, group = parameters.h, parameters.system.group
    x, rates, (k_t, c_t, jacobian), factors = step
    r_p, phi_p = loads

    w, v, vdot = kinematics(scheme, group, x, rates, h, previous, jnp.zeros_like(previous.a), dh)
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
    mass = mass_matrix(parameters.system)
    blocks = Blocks.of(states.v.shape[0] - 1, factor_size(parameters.system))

    def one(previous: Variation, inputs):
        step, loads, row, single, d_grid = inputs
        if single is None:
            current = direct_step(scheme, parameters, mass, step, loads, previous, row, d.h)
            return current, current
        begun, one_step = single.begun(previous, d_grid), own(parameters, single.grid)
        current = direct_step(scheme, one_step, mass, step, loads, begun, row, d_grid.h)
        current = single.unless_empty(current, jax.tree.map(jnp.add, previous, row))
        return current, current

    def prepare(step, single, d_grid):
        one_step = own(parameters, single and single.grid)
        return linearized(scheme, one_step, mass, step), pseudo_loads(step, one_step, own(d, d_grid))

    def block(previous: Variation, inputs):
        step, rows, *grid = inputs
        return lax.scan(one, previous, (*jax.vmap(prepare)(step, *grid), rows, *grid))

    first = jax.tree.map(lambda leaf: leaf[0], b)
    rows = jax.tree.map(lambda leaf: leaf[1:], b)
    grid = SingleStep.of(states, parameters), grid_tangent(parameters, d)
    inputs = padded((steps(states, parameters), rows, *grid), blocks.padding, repeat=True)
    _, later = sweep_blocks(blocks, block, first, inputs)
    num_steps = states.v.shape[0] - 1
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest[:num_steps]]), first, later), d
