"""The error of one run, from the run itself: its defects, propagated by its own linearization.

A scheme that knows what its steps miss (`AbstractScheme.defects`) says b of L e = b, L the linearized trajectory of
`lgsens.sensitivity` and e = numerical − true up to higher powers of h. Forward substitution with L is the direct
differentiation method: one factorization and one solve per step, no iteration, as much as one more parameter in forward
mode. Other runs are estimated by `_refined_run.py`.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens._validate import is_concrete, require
from lgsens.criteria._refined_run import refined_error, require_order
from lgsens.dynamics import RESULTS, AbstractSystem, State
from lgsens.integrate import (
    AbstractGrid,
    AbstractIntegrator,
    AbstractScheme,
    EqualGrid,
    GeneralizedAlpha,
    Node,
    Variation,
    renewed,
)
from lgsens.sensitivity import LinearStep, Parameters, linearized_trajectory
from lgsens.simulation import StateError, Trajectory

_LEAST_STEPS = 3


def error_estimate(trajectory: Trajectory, integrator: AbstractIntegrator = GeneralizedAlpha()) -> StateError:
    """What is to be added to a trajectory to make it better by an order.

        true ≈ v + e.v,  v̇ + e.vdot,  λ + e.lam,  q exp(ẽ.w)

    Arguments:
        trajectory: a motion in three steps or more. One that has its own estimate (`Richardson`) is answered with that.
        integrator: the one that it is from; this is checked as far as a and v̇ tell.

    Of a scheme with `defects` (`GeneralizedAlpha` of index 3) in equal steps from this one run: −e solves L e = b, the
    defects its load, at the price of one more parameter in forward mode. Of every other integrator from a second run
    that divides each step in two, those that `AdaptiveSteps` chose too (`_refined_run.py`), and by the order that the
    scheme says it has.

    The estimate is the leading term of the error in the motion, h^p times a function of time, p the order of the
    scheme, right up to O(h^{p+1}), and of generalized-α in equal steps the transients (−ρ∞)ⁿ of v̇ and λ. It does not
    see round-off, Newton's tolerance, the trapezoidal rule of a criterion, forces that jump between two steps, or a
    step with which the scheme does not resolve the motion at all. Where sizes of steps are no smooth function of time,
    errors of v̇ and λ of index 3 are told in part only. The configuration and the velocity at t0 count as exact.

    Returns a `StateError` on the times of the trajectory; `corrected` adds it. Raises `ValueError` for a trajectory
    that has failed, is by another integrator, in unequal steps where the integrator has equal ones, or with too few
    steps, and for a scheme that does not say its `convergence_order`; under a trace the first three give NaN.
    `IndexReducedODE` with `rtol` has steps inside those of the trajectory, which are not known.
    """
    if trajectory.error is not None:
        return trajectory.error
    if trajectory.t.ndim != 1:
        raise ValueError("`error_estimate`: this is a batch of trajectories; jax.vmap it.")
    num_steps = trajectory.t.shape[0] - 1
    if not isinstance(integrator, AbstractIntegrator):
        raise ValueError(f"`integrator` must be a GeneralizedAlpha or another integrator, got {integrator!r}.")
    integrator.scheme.require_steps()
    require_order(integrator.scheme)
    if num_steps < _LEAST_STEPS:
        raise ValueError(f"`error_estimate` needs at least {_LEAST_STEPS} steps, got {num_steps}.")
    require(
        lambda result: result == RESULTS.successful,
        "`error_estimate`: the trajectory has failed (its `result` is not 0), and what it has is NaN from there on; "
        "`lg.raise_if_failed(trajectory)` says why.",
        trajectory.result,
    )
    valid = _is_by(integrator, trajectory)
    require(
        bool,
        f"`integrator`: the trajectory is not one of {integrator!r}"
        f"{' in equal steps' if integrator.equal_steps else ''}; give the one that it is from (`GivenSteps.of` has the "
        "steps of a trajectory).",
        valid,
    )
    found = _estimated(integrator, trajectory)
    return found if is_concrete(valid) else jax.tree.map(lambda leaf: jnp.where(valid, leaf, jnp.nan), found)


def _is_by(integrator: AbstractIntegrator, trajectory: Trajectory):
    """Whether steps are equal if they should be, and a belongs to v̇, up to round-off and what is NaN."""
    t, a, vdot = jax.lax.stop_gradient((trajectory.t, trajectory.states.a, trajectory.states.vdot))
    xp, restarts = jnp, integrator.scheme.restarts(trajectory.system)
    if is_concrete(t, a, vdot, restarts):  # inside `jit` operations of JAX are traced even so
        xp, (t, a, vdot) = np, map(np.asarray, (t, a, vdot))
    scheme, eps, h = integrator.scheme, float(jnp.finfo(vdot.dtype).eps), xp.diff(t)
    before = xp.concatenate([h[:1], h[:-1]])
    taken = (h > 0.0) & (before > 0.0)
    ratio = xp.where(taken, h / xp.where(taken, before, 1.0), 1.0)
    left = scheme.mismatch((vdot[:-1], a[:-1]), (vdot[1:], a[1:]), ratio[:, None])
    differ = xp.abs(0.0 * a[1:] if left is None else left) > 1e3 * eps * xp.nanmax(xp.abs(a), initial=0.0)
    if restarts is not None:
        anew = jax.vmap(partial(renewed, restarts))(Node(*map(jnp.asarray, (t[:-1], t[1:], h))), ratio)
        taken = taken & ~xp.asarray(anew)
    same = ~xp.any(taken[:, None] & differ)
    equal = xp.ptp(h) <= 1e-6 * h.mean() + 16 * eps * xp.abs(t).max()
    return xp.asarray(same & (equal | (not integrator.equal_steps)))


@eqx.filter_jit
def _estimated(integrator: AbstractIntegrator, trajectory: Trajectory) -> StateError:
    scheme, t = integrator.scheme, trajectory.t
    if not integrator.equal_steps:
        return refined_error(scheme, trajectory)
    grid = EqualGrid.between(t[0], t[-1], t.shape[0] - 1, scheme.restarts(trajectory.system))
    defects = smooth_defects(scheme, trajectory.system, grid, trajectory.states)
    if defects is None:
        return refined_error(scheme, trajectory)
    return error_by_defects(scheme, trajectory.states, Parameters(trajectory.system, grid), defects)


def smooth_defects(scheme: AbstractScheme, system: AbstractSystem, grid: AbstractGrid, states: State):
    """The `defects` of a run; None where they are not known, or not all: where steps begin with another state than the
    last ones ended with, that misses something as well."""
    return None if grid.resizes else scheme.defects(system, grid, states)


def error_by_defects(
    scheme: AbstractScheme,
    states: State,
    parameters: Parameters,
    defects: Variation,
    linear: LinearStep | None = None,
) -> StateError:
    """−e of L e = b, without a change of parameters; `linear`: as in `linearized_trajectory`."""
    e = linearized_trajectory(scheme, states, parameters, defects, None, linear=linear)
    return StateError(-e.w, -e.v, -e.vdot, -e.lam)


def corrected(trajectory: Trajectory, error: StateError) -> Trajectory:
    """The trajectory with an error of its states taken out, q exp(ẽ.w), v + e.v, v̇ + e.vdot, λ + e.lam.

    Ψ of this one minus Ψ of the trajectory estimates the error of a criterion, the quadrature included, if Ψ follows
    the `order` of the trajectory, as `Criterion` does. a is v̇. `error` is kept, as `Trajectory.error`.
    """
    states, group = trajectory.states, trajectory.system.group
    q = jax.vmap(group.retract)(states.q, error.w)
    vdot = states.vdot + error.vdot
    better = State(q, states.v + error.v, vdot, states.lam + error.lam, vdot)
    return dataclasses.replace(trajectory, states=better, error=error, order=4, stages=None)
