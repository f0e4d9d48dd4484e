"""`statics`: equilibria of a mechanism while some of its coordinates and loads are moved slowly."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from lgsens._validate import as_float
from lgsens._xla import alike
from lgsens.analysis._driven import (
    Drive,
    columns,
    drivers,
    of_one_length,
    refuse_history,
    require_distances,
    speeds,
    table,
    unless_jumped,
    with_numbers,
)
from lgsens.analysis._rank import cause_of_failure
from lgsens.dynamics import RESULTS, State, require_independent, static_path
from lgsens.model import Model, MultibodySystem
from lgsens.simulation import AbstractRun, throw_if_failed


class Statics(AbstractRun):
    """Equilibria along a path, with what `Trajectory` answers: `body`, `joint`, `force`, `multiplier`, tables.

    Attributes:
        values: the driven values and load factors by name, shape (n,) each.
        t: the time at which signals are taken [s], shape (n,).
        states: q and λ, at rest, stacked along a leading axis n.
        responses: for each direction of `rates` dq/ds as v and dλ/ds as λ, along axes n and r; see `along`.
        stable: whether an equilibrium is stable, shape (n,): whether the potential energy of springs and weights has a
            minimum there, as far as joints let move. A perfect column above its critical load stays straight, and is
            not.
        snapped: whether there is a jump on the way to it from the point before, shape (n,): behind a limit point a
            mechanism snaps through. It is an equilibrium; dynamics may end at another one (`simulate`).
        result: a value of `RESULTS`, shape (), int32; 0 is success.
        system: the equations of motion, driven values and factors those of the reference.
    """

    values: dict[str, Float[Array, " n"]]
    t: Float[Array, " n"]
    states: State
    responses: State
    stable: Bool[Array, " n"]
    snapped: Bool[Array, " n"]
    result: Int[Array, ""]
    system: MultibodySystem

    def _kinematics(self):
        return self.states, self.t

    def _besides(self):
        driven = drivers(self.system)
        factors = {f"{name}.factor": of for name, of in self.values.items() if name not in driven}
        return factors | {"stable": self.stable, "snapped": self.snapped}

    def along(self, direction: int = 0) -> "Statics":
        """The same positions with derivatives along a direction: velocities are dx/ds, `multiplier` is dλ/ds, the rate
        of a spring dℓ/ds (its motion ratio). Forces of dampers and joints mean nothing here."""
        one = jax.tree.map(lambda leaf: leaf[:, direction], (self.responses.v, self.responses.lam))
        states = eqx.tree_at(lambda states: (states.v, states.lam), self.states, one)
        return eqx.tree_at(lambda statics: statics.states, self, states)


def statics(
    model: Model,
    driven: Mapping[str, Any] | None = None,
    *,
    loads: Mapping[str, Any] | None = None,
    rates: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    starts: Sequence[int] = (),
    t0=0.0,
    throw: bool = True,
) -> Statics:
    """Quasi-static equilibria of a mechanism whose joints are driven and whose loads are raised, point by point.

        r(q, 0, 0, λ; s, t0) = 0,     Φ(q; s, t0) = 0,     and dq/ds, dλ/ds along s′

    A suspension on bushings on its test rig, a cable that sags, a gripper that closes: springs and weights balance what
    drives, each equilibrium is found from the one before.

    Arguments:
        model: the scene. Springs, joints and `RigidBody(free=…)` hold every body: one that can move without any force
            against it has no equilibrium that statics determines.
        driven: values by name of a `TranslationDriver` (displacement [m]), a `RotationDriver` (angle [rad]) or a
            `DistanceJoint` (length [m]), in place of its own number or signal, shape (n,) each.
        loads: factors [–] by name of an `AppliedForce`, in place of its signal, shape (n,) each.
        rates: rates of change s′ of the driven values and factors along the path, shape () or (n,), by name; those left
            out are 0. None: 1 for all of them. Several directions: a sequence of such mappings.
        starts: indices of points that are found from the first point and not from the one before: where another
            branch begins, as from the design position upwards and then downwards.
        t0: the time at which signals and time-dependent forces are taken, shape ().
        throw: raise if there is no such equilibrium, or an angle of a spring, a gear or a coupling passes half a turn.
            With False `result` says so; numbers of a point that is none are NaN, and those of the points after it up to
            the next of `starts`.

    The first point is found from the reference configuration. Differentiable by every number of the model, by driven
    values, factors and rates, by the implicit function theorem: one factorization per point for all of them, responses
    included. Raises `ValueError` for names that are neither, values of different lengths, joints that only constrain
    velocities, force elements with states, and points where something moves freely, by its name; `SimulationError`
    where no equilibrium is found. Inside `jit` the states are NaN and `result` says why. Source: Haug, Choi & Komkov
    (1986), §1.2, for the derivatives.
    """
    if not isinstance(model, Model):
        raise ValueError(f"`model` must be a Model, got {type(model).__name__}.")
    start = as_float(t0, (), "`t0`")
    known = drivers(with_numbers(model, start).system())
    values = columns("driven", driven or {}, known, "the drivers and distance joints of the model")
    require_distances(model.joints, values)
    factored = {name: force.with_factor(jnp.zeros_like(start)) for name, force in model.forces.items()}
    factored = {name: force for name, force in factored.items() if force is not None}
    factors = columns("loads", loads or {}, factored, "the force elements of the model with a factor (AppliedForce)")
    if both := sorted(set(values) & set(factors)):
        raise ValueError(f"`loads`: {both} are names of driven joints, too; give them other names.")
    given = values | factors
    if not given:
        raise ValueError(
            f"`driven` and `loads` are empty; give values for drivers, some of {sorted(known)}, or factors of "
            f"{sorted(factored)}. One equilibrium is `lgsens.equilibrium(model)`."
        )
    shape, names = of_one_length(given, ", `loads` as well"), list(given)
    wrong = [at for at in starts if not (isinstance(at, int | np.integer) and 0 <= at < shape[0])]
    if wrong:
        raise ValueError(f"`starts` must be indices of the {shape[0]} points, got {wrong}.")
    directions = [rates] if rates is None or isinstance(rates, Mapping) else list(rates)
    slopes = jnp.stack([table(speeds(names, of, shape), shape, start.dtype) for of in directions], axis=1)
    forces = model.forces | {name: factored[name] for name in factors}
    model = eqx.tree_at(lambda model: model.forces, model, forces, is_leaf=lambda leaf: leaf is model.forces)
    system = with_numbers(model, start, values).system()
    refuse_history(system)
    require_independent(system, "statics")
    where = drivers(system) | drivers(system, "loads")
    drive = Drive(system, tuple(where[name] for name in names))
    path = table(given.values(), shape, start.dtype)
    drive, path, slopes, start = alike((drive, path, slopes, start))
    (states, responses, result), flags, details = _statics_jit(drive, path, slopes, start, tuple(starts))
    if throw:
        cause = result
        if not isinstance(result, Tracer):
            details = details | {"names": names}
            if int(result) in (RESULTS.not_held, RESULTS.statics_failed):
                cause, details = cause_of_failure(system, start, result, details)
            if int(result) == RESULTS.not_held == int(cause):
                details = details | {"free": _free_bodies(drive, details)}
        states, responses = throw_if_failed((states, responses), cause, details, system.constraint_names)
    time = jnp.broadcast_to(start, shape)
    found: dict[str, Any] = {"t": time, "states": states, "responses": responses, "result": result} | flags
    return Statics(values=given, **found, system=system)


@eqx.filter_jit
def _statics_jit(drive: Drive, values, rates, t, starts: tuple[int, ...]):
    found = static_path(drive, values, rates, t, starts)
    n, r, _ = rates.shape
    rest = jnp.zeros((n, drive.system.group.dim), values.dtype)
    states = State(q=found.q, v=rest, vdot=rest, lam=found.lam, a=rest)
    none = jnp.zeros_like(found.w)
    several = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[:, None], (n, r, *leaf.shape[1:])), found.q)
    responses = State(q=several, v=found.w, vdot=none, lam=found.lam_rate, a=none)
    first = jnp.argmin(found.found)  # the first that was not found, 0 if all were
    failed = jnp.where(found.free[first], RESULTS.not_held, RESULTS.statics_failed)
    result = jnp.where(jnp.all(found.found), RESULTS.successful, failed)
    first, result = unless_jumped(drive.system, found.q, first, result, starts)
    result = jnp.where(drive.system.is_valid(), result, RESULTS.invalid_numbers).astype(jnp.int32)
    before = jax.tree.map(lambda leaf: leaf[jnp.maximum(first - 1, 0)], (found.q, found.lam))
    details = {"values": values[first], "time": t, "position": first, "before": before}
    flags = {"stable": found.stable, "snapped": found.snapped}
    return (states, responses, result), flags, jax.lax.stop_gradient(details)


def _free_bodies(drive: Drive, details: dict[str, Any]) -> list[str]:
    """The bodies that move most where nothing resists, in the configuration before the point that failed, or in the
    reference: the null space of K."""
    system = drive.at(details["values"])
    q, lam = details["before"]
    q_ref, v = system.reference()
    if int(details["position"]) == 0:
        q, lam = q_ref, jnp.zeros_like(lam)
    zero, k = jnp.zeros_like(v), len(v)
    tangents = system.tangents(q, zero, zero, lam, details["time"])
    scale, jacobian = system.coordinate_scale(), tangents.constraint_jacobian
    stiffness = np.asarray(tangents.stiffness * scale[None, :] * scale[:, None])
    jacobian = np.asarray(jacobian * scale[None, :])
    size = np.abs(stiffness).max() or 1.0
    corner = np.zeros((len(jacobian),) * 2)
    _, _, modes = np.linalg.svd(np.block([[stiffness / size, jacobian.T], [jacobian, corner]]))
    weights = np.abs(modes[-1, :k])
    index = system.index[: len(system.body_names)]
    most = [weights[own[own >= 0]].max(initial=0.0) for own in index]
    return [name for name, weight in zip(system.body_names, most) if weight > 0.5 * max(most)]
