"""The error of a run on any steps by any scheme, from a second run in twice as many.

On sizes h_n = ε θ(n ε), θ smooth, what a scheme of order p computes has the errors ε^p e(t) + O(ε^{p+1}), so that

    true ≈ ψ + (ψ' − ψ) 2^p/(2^p − 1),     in a Lie group: q exp(w̃),  w = log(q⁻¹ q') 2^p/(2^p − 1)

from the runs ψ with ε and ψ' with ε/2, which halves each step: what belongs to its size follows it (`resized`),
at the start as well. The same holds of a criterion, whose quadrature over the stages has the order of the scheme.

Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.4 and §II.8.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from lgsens.integrate import AbstractGrid, AbstractScheme, Start, UnevenGrid
from lgsens.sensitivity import DirectDifferentiation, Parameters
from lgsens.simulation import StateError, Trajectory


def require_order(scheme: AbstractScheme) -> None:
    if scheme.convergence_order is None:
        raise ValueError(
            f"`integrator`: {type(scheme).__name__} does not say its `convergence_order`, without which no error can "
            "be told from two runs; give the class that property."
        )


def _share(scheme: AbstractScheme) -> float:
    """2^p/(2^p − 1)."""
    assert scheme.convergence_order is not None  # asked before
    return 1.0 / (1.0 - 0.5**scheme.convergence_order)


def refined_run(scheme: AbstractScheme, trajectory: Trajectory, grid: AbstractGrid | None = None) -> Trajectory:
    """The run of a trajectory by `scheme` in half its steps, those of `grid`; NaN from where it failed."""
    states, system, t = trajectory.states, trajectory.system, trajectory.t
    first = jax.tree.map(lambda leaf: leaf[0], states)
    start = scheme.resized(system, scheme.resumed(system, Start(first), t[0]).state, t[0]).at(system, 0.5)
    known = UnevenGrid.first(t[0], jnp.diff(t), restarts=scheme.restarts(system)) if grid is None else grid
    grid = known.halved()
    finer, stats = DirectDifferentiation().trajectory(scheme, start, Parameters(system, grid))
    stages, finer = scheme.stages(system, grid, finer), scheme.physical(system, finer)
    stats = scheme.statistics(stats)
    return dataclasses.replace(trajectory, t=grid.times(), states=finer, stages=stages, stats=stats, error=None)


def extrapolated(scheme: AbstractScheme, coarse, fine):
    """The limit of what was computed with ε and with ε/2."""
    return coarse + _share(scheme) * (fine - coarse)


@eqx.filter_jit
def refined_error(scheme: AbstractScheme, trajectory: Trajectory) -> StateError:
    """What is missing from a trajectory by `scheme`, at its times; NaN from where the second run failed."""
    states, group = trajectory.states, trajectory.system.group
    finer = jax.tree.map(lambda leaf: leaf[::2], refined_run(scheme, trajectory).states)
    between = lambda q, other: group.log(group.compose(group.inverse(q), other))
    missing = lambda name: getattr(finer, name) - getattr(states, name)
    found = StateError(jax.vmap(between)(states.q, finer.q), missing("v"), missing("vdot"), missing("lam"))
    return jax.tree.map(lambda leaf: _share(scheme) * leaf, found)
