"""The error of a run on any steps by any scheme, from a second run in twice as many.

On sizes h_n = ε θ(n ε), θ smooth, what a scheme of order p computes has the errors ε^p e(t) + O(ε^{p+1}), so that

    true ≈ ψ + (ψ' − ψ) 2^p/(2^p − 1),     in a Lie group: q exp(w̃),  w = log(q⁻¹ q') 2^p/(2^p − 1)

from the runs ψ with ε and ψ' with ε/2. Those sizes at ε/2 are not the halves of h_n: accelerations and multipliers feel
every change of the size by their own O(r² − 1) h (`GivenSteps`), which halves would put between each two steps in full.
Each step is divided so that all sizes follow their trend,

    h_n = h' + h'',     h''/h' = s = √r,     ln r = (ln h_{n+1} − ln h_{n−1})/2;      halves where sizes are equal.

The second run starts from the first state of the first, less what belongs there to the size of the first step: a_0
stands for the acceleration at t0 + Δ h (`resized`), and of index 3 v_0 misses the constraint by h² (`start`), of which
the shorter step keeps (h'_0/h_0)².

Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.4 and §II.8.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from lgsens.dynamics import consistent_velocity
from lgsens.integrate import AbstractScheme, UnevenGrid
from lgsens.sensitivity import DirectDifferentiation, Parameters
from lgsens.simulation import StateError, Trajectory

_MOST = 1.0  # |ln r|: sizes that jump by more are no function of time


@eqx.filter_jit
def refined_error(scheme: AbstractScheme, trajectory: Trajectory) -> StateError:
    """What is missing from a trajectory by `scheme`, at its times; NaN from where the second run failed."""
    states, system, t = trajectory.states, trajectory.system, trajectory.t
    h = jnp.diff(t)
    filled = UnevenGrid.first(t[0], h).places().h  # the size before, where a step is empty
    trend = jnp.asarray(jnp.gradient(jnp.log(filled)))
    ratio = jnp.exp(0.5 * jnp.clip(trend, -_MOST, _MOST))
    sizes = (h[:, None] * jnp.stack([1.0 / (1.0 + ratio), ratio / (1.0 + ratio)], axis=1)).reshape(-1)
    first = jax.tree.map(lambda leaf: leaf[0], states)
    own = (sizes[0] / h[0]) ** 2
    v = own * first.v + (1.0 - own) * consistent_velocity(system, first.q, first.v, t[0])
    start = scheme.resumed(system, dataclasses.replace(first, v=v), t[0])
    grid = UnevenGrid(t[0], sizes, h[0])
    finer, _ = DirectDifferentiation().trajectory(scheme, start, Parameters(system, grid))
    finer = jax.tree.map(lambda leaf: leaf[::2], scheme.physical(system, finer))
    assert scheme.convergence_order is not None
    group, power = system.group, 2.0**scheme.convergence_order
    between = lambda q, other: group.log(group.compose(group.inverse(q), other))
    missing = lambda name: getattr(finer, name) - getattr(states, name)
    found = StateError(jax.vmap(between)(states.q, finer.q), missing("v"), missing("vdot"), missing("lam"))
    return jax.tree.map(lambda leaf: power / (power - 1.0) * leaf, found)
