"""The error of a run on any steps by any scheme, from a second run in twice as many.

On sizes h_n = ε θ(n ε), θ smooth, what a scheme of order p computes has the errors ε^p e(t) + O(ε^{p+1}), so that

    true ≈ ψ + (ψ' − ψ) 2^p/(2^p − 1),     in a Lie group: q exp(w̃),  w = log(q⁻¹ q') 2^p/(2^p − 1)

from the runs ψ with ε and ψ' with ε/2, which halves each step: what belongs to its size follows it (`resized`),
at the start as well.

Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.4 and §II.8.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from lgsens.integrate import AbstractScheme, UnevenGrid
from lgsens.sensitivity import DirectDifferentiation, Parameters
from lgsens.simulation import StateError, Trajectory


@eqx.filter_jit
def refined_error(scheme: AbstractScheme, trajectory: Trajectory) -> StateError:
    """What is missing from a trajectory by `scheme`, at its times; NaN from where the second run failed."""
    states, system, t = trajectory.states, trajectory.system, trajectory.t
    h = jnp.diff(t)
    sizes = jnp.repeat(0.5 * h, 2)
    first = jax.tree.map(lambda leaf: leaf[0], states)
    start = scheme.resized(system, scheme.resumed(system, first, t[0]), t[0]).at(system, 0.5)
    grid = UnevenGrid.first(t[0], sizes)
    finer, _ = DirectDifferentiation().trajectory(scheme, start, Parameters(system, grid))
    finer = jax.tree.map(lambda leaf: leaf[::2], scheme.physical(system, finer))
    assert scheme.convergence_order is not None
    group, power = system.group, 2.0**scheme.convergence_order
    between = lambda q, other: group.log(group.compose(group.inverse(q), other))
    missing = lambda name: getattr(finer, name) - getattr(states, name)
    found = StateError(jax.vmap(between)(states.q, finer.q), missing("v"), missing("vdot"), missing("lam"))
    return jax.tree.map(lambda leaf: power / (power - 1.0) * leaf, found)
