"""`kinematics`: the motion that joints and prescribed coordinates alone determine."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, Int

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
from lgsens.dynamics import RESULTS, State, forces_of_motion, names_of_all, positions
from lgsens.linear import lost
from lgsens.model import Model, MultibodySystem
from lgsens.simulation import AbstractRun, throw_if_failed


class Kinematics(AbstractRun):
    """The positions of a driven mechanism, with what `Trajectory` answers: `body`, `joint`, `force`, ….

    Attributes:
        values: the driven values by joint, shape (n,) each: [m], of a `RotationDriver` [rad].
        t: the times at which forces and signals are taken [s], shape (n,).
        states: q; v and v̇ with respect to the rates; λ of that motion. Stacked along a leading axis n.
        result: a value of `RESULTS`, shape (), int32; 0 is success.
        system: the equations of motion, the driven values those of the reference.
    """

    values: dict[str, Float[Array, " n"]]
    t: Float[Array, " n"]
    states: State
    result: Int[Array, ""]
    system: MultibodySystem

    def _kinematics(self):
        return self.states, self.t


def kinematics(
    model: Model,
    driven: Mapping[str, Any] | None = None,
    *,
    rates: Mapping[str, Any] | None = None,
    t=None,
    t0=0.0,
    throw: bool = True,
) -> Kinematics:
    """The positions of a mechanism whose joints and driven coordinates leave it no freedom, velocities, forces.

        Φ(q, s, t) = 0,     B v + Φ_s ṡ + Φ_t = 0,     B v̇ = −Γ,     Bᵀλ = −r(q, v, v̇, 0, t)

    for each set of driven values s, ṡ constant, and the time of drivers with a signal: a test rig of a suspension, the
    coupler curve of a linkage, inverse dynamics. Accelerations are those at constant ṡ; the multiplier of a driver is
    what it takes to drive.

    Arguments:
        model: the scene. `RigidBody(free=…)` and joints leave as many degrees of freedom as are driven. Joints may
            repeat each other with `redundant="minimum_norm"`, which says what their multipliers are then, or "remove".
        driven: values by name of a `TranslationDriver` (displacement [m]), a `RotationDriver` (angle [rad]) or a
            `DistanceJoint` (length [m]), in place of its own number or signal, shape (n,) each. The first position is
            found from the reference configuration, each other one from that before: where they are far apart, or near
            a dead centre, in parts, so that no other way to assemble the mechanism is met. A dead centre itself, as
            that of a parallelogram that lies flat, is passed straight on. None or {}: signals drive it.
        rates: rates of the driven values [m/s], [rad/s], shape () or (n,), by name; those left out are 0. None: 1 for
            all of them. With the one rate 1, velocities are derivatives by the driven value (a motion ratio); with 0,
            forces are those at rest. Beside `t` they must be given: what their rates by time are, values do not tell.
        t: times [s], shape (n,): signals run, and velocities and accelerations are the derivatives of the motion by
            time. None: signals are held at t0.
        t0: the time at which signals and time-dependent forces are taken where `t` is None [s], shape ().
        throw: raise if there is no such position, or an angle of a spring, a gear or a coupling passes half a turn,
            which positions do not tell. With False `result` says so; numbers of a position that is none are NaN, and
            those of the positions after it.

    Differentiable by every number of the model and by the driven values, by the implicit function theorem: one
    factorization per position for all of them. Raises `ValueError` for names that are not drivers, values of different
    lengths, joints that only constrain velocities, a mechanism with other degrees of freedom than the driven ones, and
    positions that do not exist, or that are singular, so that the driven values do not determine the motion; inside
    `jit` the states are NaN and `result` says why. Source: Haug (1989), chapter 3.
    """
    if not isinstance(model, Model):
        raise ValueError(f"`model` must be a Model, got {type(model).__name__}.")
    driven, start = dict(driven or {}), as_float(t0, (), "`t0`")
    where = drivers(with_numbers(model, start).system())
    if not driven and t is None:
        raise ValueError(
            f"`driven` is empty; give values for drivers of the model, some of {sorted(where)}, or the times `t` at "
            "which their signals are taken."
        )
    values = columns("driven", driven, where, "the drivers and distance joints of the model")
    require_distances(model.joints, values)
    columns("rates", rates or {}, where, "the drivers and distance joints of the model")
    names, times = list(values), {} if t is None else {"t": as_float(t, None, "`t`")}
    shape = of_one_length(times | values, ", and `t` be one")
    if driven and t is not None and rates is None:
        raise ValueError(
            f"`rates`: with `t` velocities are those by time, and those of the driven values {sorted(driven)} are not "
            "known: give them, rates={} for values that are held; or give the drivers a signal (Polynomial, Sampled)."
        )
    given, speed = (table(rows, shape, start.dtype) for rows in (values.values(), speeds(names, rates, shape)))
    system = with_numbers(model, start, names).system()
    refuse_history(system)
    unknowns, equations = system.group.dim, len(system.constraint_names)
    if unknowns > equations or (unknowns < equations and model.redundant != "minimum_norm"):
        raise ValueError(
            f"`driven`: the mechanism has {unknowns} coordinates and {equations} equations, those of the drivers "
            f"{names or sorted(where)} included; kinematics needs as many. "
            + (
                "Drive more coordinates, hold bodies by `free`, or lock joints."
                if unknowns > equations
                else "Drive fewer coordinates; or joints say the same twice, as hinges of a planar mechanism do: give "
                "its bodies free='x y rz', leave out a joint that the `free` coordinates of its bodies satisfy anyway, "
                "or take Model(…, redundant='remove')."
            )
        )
    where = drivers(system)
    drive = Drive(system, tuple(where[name] for name in names))
    time = jnp.broadcast_to(start, shape) if t is None else times["t"]
    clock = jnp.zeros_like(time) if t is None else jnp.ones_like(time)
    (states, result), details = _kinematics_jit(*alike((drive, (given, time), (speed, clock))))
    if throw:
        known, cause, of = not isinstance(result, Tracer), result, details
        if known and int(result) != RESULTS.successful and int(details["position"]) == 0:
            cause, of = cause_of_failure(system, start, result, details)
        states = throw_if_failed(
            states,
            cause,
            of | {"names": names, "left_out": system.repeated_names} if known else of,
            names_of_all(system),
        )
    return Kinematics(values=values, t=time, states=states, result=result, system=system)


@eqx.filter_jit
def _kinematics_jit(drive: Drive, driven, rates):
    found = positions(drive, *driven)
    states = lost(~found.found, jax.vmap(lambda *args: forces_of_motion(drive, *args))(found.q, driven, rates))
    sound = found.found & jnp.all(jnp.isfinite(jnp.hstack([states.v, states.vdot, states.lam])), axis=1)
    first = jnp.argmin(sound)  # the first that was not found or has no rates, 0 if all have
    failed = jnp.where(found.singular[first], RESULTS.singular_configuration, RESULTS.position_failed)
    failed = jnp.where(found.found[first], RESULTS.invalid_numbers, failed)
    result = jnp.where(jnp.all(sound), RESULTS.successful, failed)
    first, result = unless_jumped(drive.system, found.q, first, result)
    details = {"violation": found.violation[first], "values": driven[0][first], "time": driven[1][first]}
    details["position"] = first
    return (states, result.astype(jnp.int32)), jax.lax.stop_gradient(details)
