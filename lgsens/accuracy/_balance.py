"""What a trajectory says of itself: how far joints are violated, how well energy is balanced.

The work of forces and drivers. With v·(eq. 25), v·ad(v)ᵀMv = (ad(v) v)·Mv = 0 and J v = −[Φ_t; b] (`_constraints` of
`dynamics`),

    d/dt T = v·M v̇ = P,     T = ½ v·M v,     P = −v·r(q, v, 0, 0, t) + λ·[Φ_t; b].

What is left of the balance at t_n,

    δ_n = T_n − T_0 − ∫ P dt,

is the drift of the energy where forces have a potential, and as telling where they have not. ∫ P dt is of fourth order
on the times of the trajectory (the integral of the cubic through four times around each interval), so that δ is
that of the motion and not of the quadrature; where a trajectory has stages, their own quadrature gives ∫ P dt to t1.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens.dynamics import AbstractSystem, State, prescribed_velocity
from lgsens.simulation import Trajectory

_CHUNK = 64  # states that are evaluated together: one compilation for all numbers of steps


class Quality(NamedTuple):
    """As in a `Row` of the table."""

    violation: float
    energy_drift: float | None
    iterations: float | None
    unfinished: int


@eqx.filter_jit
def _evaluated(system: AbstractSystem, states: State, t):
    def at(state: State, t):
        rest = system.residual(state.q, state.v, jnp.zeros_like(state.v), jnp.zeros_like(state.lam), t)
        driven = jnp.dot(state.lam, prescribed_velocity(system, state.q, t))
        kinetic = 0.5 * jnp.dot(state.v, system.mass_matrix() @ state.v)
        return jnp.max(jnp.abs(system.constraint(state.q, t)), initial=0.0), kinetic, driven - jnp.dot(state.v, rest)

    return jax.vmap(at)(states, t)


def _along(system: AbstractSystem, states: State, t) -> tuple[np.ndarray, ...]:
    """max |Φ|, T and P at all states."""
    n = len(t)
    index = np.minimum(np.arange(-(-n // _CHUNK) * _CHUNK), n - 1).reshape(-1, _CHUNK)
    part = lambda rows: jax.tree.map(lambda leaf: leaf[rows], (states, t))
    found = [_evaluated(system, *part(rows)) for rows in index]
    violation, kinetic, power = (np.concatenate([np.asarray(part) for part in parts])[:n] for parts in zip(*found))
    return violation, kinetic, power


def cumulative(t: np.ndarray, f: np.ndarray) -> np.ndarray:
    """∫ f dt from t_0 to each time, by the cubics through four neighbouring times; exact for cubics on any grid."""
    n = len(t)
    width = min(4, n)
    first = np.clip(np.arange(n - 1) - (width - 2) // 2, 0, n - width)
    at = first[:, None] + np.arange(width)
    h = np.diff(t)[:, None]
    x = (t[at] - t[:-1, None]) / h  # the interval is [0, 1]
    powers = np.arange(width)
    # weights w with Σ w x^k = 1/(k + 1)
    weights = np.linalg.solve(
        np.swapaxes(x[:, :, None] ** powers, 1, 2), np.tile(1 / (powers + 1.0), (n - 1, 1))[..., None]
    )
    return np.concatenate([[0.0], np.cumsum(h[:, 0] * np.sum(weights[..., 0] * f[at], axis=1))])


def quality(trajectory: Trajectory) -> Quality:
    """The quality of a finished motion."""
    system, t = trajectory.system, np.asarray(trajectory.t)
    violation, kinetic, power = _along(system, trajectory.states, trajectory.t)
    if trajectory.stages is None:
        work = cumulative(t, power)
        defect = kinetic - kinetic[0] - work
    else:
        stages = trajectory.stages
        work = np.asarray(stages.weights) @ _along(system, stages.states, stages.t)[2]
        defect = kinetic[-1] - kinetic[0] - work
    size = max(float(kinetic.max()), float(np.abs(work).max()))
    stats: Any = trajectory.stats
    iterations = getattr(stats, "iterations", getattr(stats, "steps", None))
    converged = getattr(stats, "converged", None)
    return Quality(
        violation=float(violation.max()),
        energy_drift=float(np.abs(defect).max()) / size if size > 0 else None,
        iterations=None if iterations is None else float(np.mean(iterations)),
        unfinished=0 if converged is None else int(np.sum(~np.asarray(converged))),
    )
