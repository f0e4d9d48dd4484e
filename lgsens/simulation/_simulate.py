"""`simulate`: the model in, a trajectory out."""

import dataclasses
import warnings
from functools import partial
from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from lgsens._validate import as_count
from lgsens._xla import alike, tracing
from lgsens.dynamics import RESULTS, AbstractSystem, Faults, State, Unseen, names_of_all
from lgsens.integrate import (
    AbstractIntegrator,
    AbstractScheme,
    GeneralizedAlpha,
    Laid,
    Start,
    Stats,
    Steps,
    singular_steps,
)
from lgsens.model import Model
from lgsens.sensitivity import (
    AbstractSensitivity,
    AdjointVariable,
    DirectDifferentiation,
    Parameters,
    saved_run,
)
from lgsens.simulation._errors import primal_value, throw_if_failed
from lgsens.simulation._index_reduced_ode import integrate_ode
from lgsens.simulation._richardson import extrapolate_runs
from lgsens.simulation._save import Output, Save
from lgsens.simulation._settings import (
    by_diffrax,
    check_integrator,
    check_sensitivity,
    interval,
    warn_of_far_times,
    warn_of_single_precision,
)
from lgsens.simulation._start import Begin, as_system, begin, check_state0
from lgsens.simulation._to_accuracy import simulate_to
from lgsens.simulation._trajectory import Saved, Trajectory


@overload
def simulate(
    model: Model | AbstractSystem,
    *,
    t0: Any = ...,
    t1: Any,
    num_steps: int | None = ...,
    integrator: AbstractIntegrator = ...,
    sensitivity: AbstractSensitivity = ...,
    state0: State | Start | None = ...,
    save: None = ...,
    accuracy: float | None = ...,
    throw: bool = ...,
) -> Trajectory: ...


@overload
def simulate(
    model: Model | AbstractSystem,
    *,
    t0: Any = ...,
    t1: Any,
    num_steps: int,
    integrator: AbstractIntegrator = ...,
    sensitivity: AbstractSensitivity = ...,
    state0: State | Start | None = ...,
    save: Save,
    throw: bool = ...,
) -> Saved: ...


def simulate(
    model: Model | AbstractSystem,
    *,
    t0=0.0,
    t1,
    num_steps: int | None = None,
    integrator: AbstractIntegrator = GeneralizedAlpha(),
    sensitivity: AbstractSensitivity = DirectDifferentiation(),
    state0: State | Start | None = None,
    save: Save | None = None,
    accuracy: float | None = None,
    throw: bool = True,
):
    """Integrate the motion of a model from t0 to t1, by default with the Lie-group generalized-α scheme (paper §4).

    Arguments:
        model: the scene, or an `AbstractSystem`.
        t0, t1: initial and final time [s], shape (); t1 > t0.
        num_steps: number of steps of equal size h = (t1 − t0)/num_steps; a Python int. With `AdaptiveSteps` the
            largest number of steps.
        integrator: the scheme and its Newton settings, `GeneralizedAlpha`. `Richardson` extrapolates two such runs,
            of n and 2n steps, to nearly fourth order. `IndexReducedODE`: an explicit Runge–Kutta scheme of high order.
            `AdaptiveSteps`: generalized-α under error control; `GivenSteps`: with steps of given sizes;
            `AlignedSteps`: with steps that end at edges of roads and signals.
        sensitivity: how the trajectory is differentiated. `DirectDifferentiation` supports every JAX
            transformation; `AdjointVariable` is reverse mode, and forward over it (`jax.hessian`); `AssociativeScan`
            takes all steps at once, for accelerators.
        state0: the state at t0, used as it is: one of `equilibrium`, or what a run continues from. Off its joints
            by more than a thousandth of the scene, or with velocities that these forbid, it is refused, inside `jit` by
            the result `off_joints`; with orientations that are no rotations, too (`invalid_numbers`). None: the
            consistent initial state of the model, from which the scheme begins with its own corrections. A given state
            has none: with `initial_state(model)` accelerations and multipliers of the first steps are of first order.
            For second order leave it out and put initial velocities into the model. `Trajectory.state` continues a run
            in steps of the same size: in others of index 3, and so on grids that choose theirs, forces of joints ring
            at first, by the square of the ratio of sizes. `Trajectory.continued` is for steps of any size.
        save: what to return of each instant instead of the trajectory, a function s ↦ pytree of an `Instant`; the
            result is a `Saved`. Without derivatives no state is stored, so that a batch of
            designs takes the memory of what it asks for. Define it once: a new lambda in each call compiles anew.
            With `checkpoints` numbers that it depends on come through the model, or are constants.
        accuracy: take as many steps as the motion takes to have this error, outside of `jit`, and extrapolate two runs
            where that is less work: the largest error of a configuration, relative to 1 rad or the length of the scene,
            and of a velocity, relative to the largest, as far as runs in n, 2n, 4n, … steps tell. `Trajectory.reached`
            says what was reached and how. `num_steps` is then the first number of steps, 64 by default: enough of them
            to see the shortest event. Edges of roads and signals are seen, and steps end there (`AlignedSteps`).
            Derivatives go through the last run.
        throw: raise if the simulation fails; inside `jit` and `vmap`, where nothing can be raised, all data are NaN and
            `Trajectory.result` says why (`raise_if_failed`). With False it says so, and the data are finite up to the
            step that failed and NaN from there on, and so are derivatives in both modes (with `checkpoints` those in
            reverse mode are NaN); of `AdaptiveSteps` that ran out of steps they end before t1.

    The derivative of the trajectory with respect to every number of the model, the initial state and the
    times is that of the numerical solution, to round-off.

    Raises `ValueError` for bad arguments, a mechanism that cannot be assembled or has redundant constraints,
    and `SimulationError` for a step that does not converge, a singular configuration, or a body that turns by more
    than π in a step while its angular velocity changes.
    Source: Sonneville & Brüls (2014), §4 and §6.2.
    """
    system = as_system(model)
    warn_of_single_precision(jax.tree.leaves(system)[0].dtype)
    if accuracy is not None:
        if save is not None or not throw:
            raise ValueError(
                "`accuracy` compares trajectories and raises if it is not reached: leave `save`, `throw` out."
            )
        settings = {"t0": t0, "t1": t1, "integrator": integrator, "sensitivity": sensitivity, "state0": state0}
        return simulate_to(simulate, accuracy, model, num_steps, settings)
    num_steps = as_count(num_steps, "num_steps", " (it is static), unless `accuracy` is given")
    diffrax = by_diffrax(integrator)
    if not diffrax:
        check_integrator(integrator, num_steps)
    check_sensitivity(sensitivity)
    if diffrax and (sensitivity != DirectDifferentiation() or save is not None):
        raise ValueError(
            f"`sensitivity` = {sensitivity!r} and `save` need steps of the scheme. With `rtol` diffrax takes its own, "
            "and differentiates them in one direction only (`mode`): leave them out, or leave `rtol` out."
        )
    if save is not None and not callable(save):
        raise ValueError(f"`save` must be a function of an Instant, got {save!r}. Leave it out to have the trajectory.")
    if caution := integrator.scheme.caution(system):
        warnings.warn(caution, stacklevel=2)
    t0, t1 = interval(t0, t1)
    warn_of_far_times(t0, t1, num_steps)
    check_state0(system, state0, t0)
    with tracing():
        system, t0, t1, state0 = alike((system, t0, t1, state0))
        given = for_any_number(num_steps, integrator, sensitivity, save, (system, t0, t1 - t0, state0))
        output = None if save is None else Output.of(save, system, t0)
        found, details = _simulate_jit(system, t0, t1, *given, sensitivity, state0, output)
        found = cut(found, num_steps) if isinstance(given[0], Steps) else found
    if throw:
        fields = ("states", "error", "stages") if save is None else ("values", "final")  # the others say what happened
        motion = {name: getattr(found, name) for name in fields}
        motion = throw_if_failed(motion, found.result, details, names_of_all(system))
        found = dataclasses.replace(found, **motion)
    return found


def for_any_number(
    num_steps: int, integrator: AbstractIntegrator, sensitivity: AbstractSensitivity, save: Save | None, arrays: Any
) -> tuple[int | Steps, AbstractIntegrator]:
    """Steps and integrator with their numbers as data, where a program of its own serves them: outside of `jit`, where
    all `arrays` have values (and derivatives at most); else as they are."""
    if not integrator.any_number or integrator.extrapolated or by_diffrax(integrator):
        return num_steps, integrator
    leaves = jax.tree.leaves(arrays)
    traced = any(isinstance(primal_value(leaf), Tracer) for leaf in leaves)
    if traced or save is not None or sensitivity not in (DirectDifferentiation(), AdjointVariable()):
        return num_steps, integrator
    return Steps.of(num_steps, leaves[0].dtype), integrator.as_data(leaves[0].dtype)


def cut(found: Trajectory, num_steps: int) -> Trajectory:
    """A trajectory without the rows for which there was room."""
    motion, t, stats = _cut((found.states, found.stages), found.t, found.stats, num_steps)
    return dataclasses.replace(found, states=motion[0], stages=motion[1], t=t, stats=stats)


@jax.custom_jvp
def _tied(states: State) -> State:
    """The states as they are, with tangents that depend on all of them: whatever a criterion looks at, all have
    cotangents, and one program pulls these back."""
    return states


@_tied.defjvp
def _tied_rule(primals, tangents):
    nothing = 0.0 * sum(leaf.ravel()[0] for leaf in jax.tree.leaves(tangents) if leaf.size)
    return primals[0], jax.tree.map(lambda leaf: leaf + nothing, tangents[0])


@partial(jax.jit, static_argnums=3)
def _cut(motion: tuple[State, Any], t, stats: Any, num_steps: int) -> tuple[tuple[State, Any], Any, Any]:
    states, stages = motion
    room = t.shape[0] - 1
    rows = lambda tree, n: jax.tree.map(lambda leaf: leaf[:n], tree)
    of_steps = lambda tree: jax.tree.map(lambda leaf: leaf[: num_steps * (leaf.shape[0] // room)], tree)
    return (rows(_tied(states), num_steps + 1), of_steps(stages)), t[: num_steps + 1], of_steps(stats)


@eqx.filter_jit
def _simulate_jit(system, t0, t1, num_steps, integrator, sensitivity, state0, save):
    begun = begin(integrator.scheme, system, t0, state0)
    return run(system, begun, t0, t1, num_steps, integrator, sensitivity, save)


def outcome(scheme: AbstractScheme, begun: Begin, stats: Stats, faults: Faults, t, laid: Laid):
    """The result code of a simulation, and what its message needs."""
    failed = jnp.argmin(stats.converged)  # the first step that did not converge, 0 if all did
    newton = jnp.where(jnp.all(stats.converged), RESULTS.successful, scheme.failure)
    singular = singular_steps(stats.margin)
    newton = jnp.where(jnp.any(singular), RESULTS.singular_configuration, newton)
    failed = jnp.where(jnp.any(singular), jnp.argmax(singular), failed)
    for code, steps in ((RESULTS.angle_jumped, faults.jumped), (RESULTS.turn_not_resolved, faults.turned > jnp.pi)):
        # what diverges turns as it likes; behind a jump a motion may diverge, or look singular, a hundred steps later
        before = code == RESULTS.angle_jumped and jnp.argmax(steps) < failed
        found = jnp.any(steps) & ((newton != scheme.failure) | before)
        newton = jnp.where(found, code, newton)
        failed = jnp.where(found, jnp.argmax(steps), failed)
    newton = jnp.where((newton != RESULTS.successful) & faults.jumping[failed], RESULTS.angle_jumped, newton)
    if faults.missing.size:
        apart = jnp.any(faults.apart)  # before Newton's iteration fails, if it does
        newton = jnp.where(apart, RESULTS.joints_apart, newton)
        failed = jnp.where(apart, jnp.argmax(faults.apart), failed)
    result = jnp.where(begun.result == RESULTS.successful, newton, begun.result).astype(jnp.int32)
    time = t[failed + 1]
    if laid.reached is not None:
        stopped = ~laid.reached & (result == RESULTS.successful)
        result = jnp.where(stopped, RESULTS.steps_exhausted, result).astype(jnp.int32)
        time = jnp.where(stopped, t[-1], time)
    result = jnp.where(t[-1] > t[0], result, RESULTS.invalid_numbers).astype(jnp.int32)
    details = {
        "violation": begun.violation,
        "jacobian": begun.jacobian,
        "step": failed + 1,
        "num_steps": jnp.asarray(stats.converged.shape[0] if laid.grid.count is None else laid.grid.count),
        "time": time,
        "begin": t[failed],
        "iterations": stats.iterations[failed],
        "increment": stats.increment[failed],
        "residual": stats.residual[failed],
        "turn": faults.turned[failed],
        "missing": faults.missing[failed],
        "tolerance": jnp.asarray(scheme.tolerance),
    }
    return result, jax.lax.stop_gradient(details)


def run(
    system: AbstractSystem,
    begun: Begin,
    t0,
    t1,
    num_steps: int | Steps,
    integrator: AbstractIntegrator,
    sensitivity: AbstractSensitivity,
    save: Output | None = None,
) -> tuple[Any, dict[str, Any]]:
    """`simulate` without its checks: the trajectory or what is saved of it, and what the message of a failure needs."""
    one = lambda **halved: _single_run(system, begun, t0, t1, num_steps, integrator, sensitivity, save, **halved)
    if not integrator.extrapolated:
        return one()
    (coarse, of_coarse), (fine, of_fine) = one(), one(halved=True)
    failed = coarse.result != RESULTS.successful
    details = jax.tree.map(lambda first, second: jnp.where(failed, first, second), of_coarse, of_fine)
    return extrapolate_runs(system, coarse, fine), details | {"run": jnp.where(failed, 1, 2)}


def _single_run(
    system,
    begun: Begin,
    t0,
    t1,
    num_steps: int | Steps,
    integrator: AbstractIntegrator,
    sensitivity,
    save,
    halved=False,
):
    scheme: Any = integrator.scheme
    laid = integrator.lay(system, begun.start, t0, t1, num_steps)
    laid = Laid(laid.grid.halved()) if halved else laid
    grid: Any = laid.grid
    t = grid.times()
    state0, parameters = begun.start.at(system, grid.first_size), Parameters(system, grid)
    if save is None:
        if by_diffrax(scheme):
            states, newton = integrate_ode(scheme, system, grid, scheme.physical(system, state0))
        else:
            states, newton = sensitivity.trajectory(scheme, state0, parameters, laid.found)
        unseen = Unseen.along(system, states, t)
    else:
        (values, unseen), final, newton = saved_run(sensitivity, save, scheme, state0, parameters)
    result, details = outcome(scheme, begun, newton, Faults.between(t, unseen), t, laid)
    stats = scheme.statistics(newton) if laid.stats is None else laid.stats
    if save is None:
        stages = scheme.stages(system, grid, states)
        states = scheme.physical(system, states)
        found = Trajectory(
            t=t, states=states, result=result, stats=stats, system=system, order=scheme.order, stages=stages
        )
    else:
        found = Saved(t, values, scheme.physical(system, final), result, stats)
    return found, details | jax.lax.stop_gradient({"t1": t1})
