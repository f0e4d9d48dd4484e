"""`kinematics`: the motion that joints and prescribed coordinates alone determine."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lgsens._validate import as_float, suggestion
from lgsens._xla import alike
from lgsens.dynamics import RESULTS, AbstractDrive, State, forces_of_motion, positions
from lgsens.model import AbstractJoint, AbstractSignal, Model, MultibodySystem
from lgsens.simulation import AbstractRun, throw_if_failed


class Kinematics(AbstractRun):
    """The positions of a driven mechanism, with what `Trajectory` answers: `body`, `joint`, `force`, ….

    Attributes:
        values: the driven values by joint, shape (n,) each: [m], of a `RotationDriver` [rad].
        t: the times at which forces and signals are taken [s], shape (n,).
        states: q; v and v̇ with respect to the rates; λ of that motion. Stacked along a leading axis n.
        result: a value of `RESULTS`, shape (), int32; 0 is success.
        system: the equations of motion, the driven values those of the reference.
        joints: the joints of the model by name.
    """

    values: dict[str, Float[Array, " n"]]
    t: Float[Array, " n"]
    states: State
    result: Int[Array, ""]
    system: MultibodySystem
    joints: dict[str, AbstractJoint] | None

    def _kinematics(self):
        return self.states, self.t


class _Drive(AbstractDrive):
    """A model's system, and where its driven numbers are: the stack of constraints and the element in it."""

    system: MultibodySystem
    where: tuple[tuple[int, int], ...] = eqx.field(static=True)

    def at(self, values):
        system = self.system
        for (stack, element), value in zip(self.where, values):
            leaf = lambda s, stack=stack: s.constraints[stack].elements.driven
            system = eqx.tree_at(leaf, system, leaf(system).at[element].set(value))
        return system


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
        model: the scene. `RigidBody(free=…)` and joints leave as many degrees of freedom as are driven.
        driven: values by name of a `TranslationDriver` (displacement [m]), a `RotationDriver` (angle [rad]) or a
            `DistanceJoint` (length [m]), in place of its own number or signal, shape (n,) each. The first position is
            found from the reference configuration, each other one from that before: begin near it, and take steps
            that cannot be mistaken for another way to assemble the mechanism. None or {}: signals drive it.
        rates: rates of the driven values [m/s], [rad/s], shape () or (n,), by name; those left out are 0. None: 1 for
            all of them. With the one rate 1, velocities are derivatives by the driven value (a motion ratio); with 0,
            forces are those at rest.
        t: times [s], shape (n,): signals run, and velocities and accelerations are the derivatives of the motion by
            time. None: signals are held at t0.
        t0: the time at which signals and time-dependent forces are taken where `t` is None [s], shape ().
        throw: raise if there is no such position. With False `result` says so, and its numbers are NaN.

    Differentiable by every number of the model and by the driven values, by the implicit function theorem: one
    factorization per position for all of them. Raises `ValueError` for names that are not drivers, values of different
    lengths, joints that only constrain velocities, a mechanism with other degrees of freedom than the driven ones, and
    positions that do not exist; inside `jit` the states are NaN and `result` says why. Source: Haug (1989), chapter 3.
    """
    if not isinstance(model, Model):
        raise ValueError(f"`model` must be a Model, got {type(model).__name__}.")
    driven, start = dict(driven or {}), as_float(t0, (), "`t0`")
    where = _drivers(_with_numbers(model, start).system())
    if not driven and t is None:
        raise ValueError(
            f"`driven` is empty; give values for drivers of the model, some of {sorted(where)}, or the times `t` at "
            "which their signals are taken."
        )
    for name in (*driven, *(rates or ())):
        if name not in where:
            raise ValueError(f"`driven`: {suggestion(name, where)}, the drivers and distance joints of the model.")
    names = sorted(driven)
    columns = [as_float(driven[name], None, f"`driven[{name!r}]`") for name in names]
    times = [] if t is None else [as_float(t, None, "`t`")]
    (shape, *_), given = [of.shape for of in (*times, *columns)], zip((*names, "t"), (*columns, *times))
    if len(shape) != 1 or not shape[0] or any(of.shape != shape for of in (*times, *columns)):
        shapes = {name: of.shape for name, of in given}
        raise ValueError(f"`driven` must hold vectors of one length ≥ 1, and `t` be one, got shapes {shapes}.")
    given = dict.fromkeys(names, 1.0) if rates is None else {name: rates.get(name, 0.0) for name in names}
    speeds = [as_float(given[name], None, f"`rates[{name!r}]`") for name in names]
    if any(speed.shape not in ((), shape) for speed in speeds):
        raise ValueError(f"`rates` must have shape () or {shape}, got {[speed.shape for speed in speeds]}.")
    if set(rates or ()) - set(names):
        raise ValueError(f"`rates`: {sorted(set(rates or ()) - set(names))} are not among the driven joints {names}.")
    system = _with_numbers(model, start, names).system()
    if system.num_velocity_rows:
        rolling = sorted(set(system.constraint_names[-system.num_velocity_rows :]))
        raise ValueError(
            f"`model`: {rolling} constrain velocities, so the positions depend on the way to them and not on driven "
            "values alone; use `simulate`."
        )
    if system.num_states:
        raise ValueError(
            f"`model`: the force elements {sorted(system.places_of_states())} have states, whose values depend on the "
            "motion before; use `simulate`, or leave them out."
        )
    unknowns, equations = system.group.dim, len(system.constraint_names)
    if unknowns != equations:
        raise ValueError(
            f"`driven`: the mechanism has {unknowns} coordinates and {equations} equations, those of the drivers "
            f"{names or sorted(where)} included; kinematics needs as many. "
            + (
                "Drive more coordinates, hold bodies by `free`, or lock joints."
                if unknowns > equations
                else "Drive fewer coordinates, or remove joints that repeat each other."
            )
        )
    where = _drivers(system)
    drive = _Drive(system, tuple(where[name] for name in names))
    table = lambda rows: jnp.stack([jnp.zeros(shape, start.dtype), *rows], axis=1)[:, 1:]
    values, speed = table(columns), table([jnp.broadcast_to(speed, shape) for speed in speeds])
    time = jnp.broadcast_to(start, shape) if t is None else times[0]
    clock = jnp.zeros_like(time) if t is None else jnp.ones_like(time)
    (states, result), details = _kinematics_jit(*alike((drive, (values, time), (speed, clock))))
    if throw:
        states = throw_if_failed(states, result, details, system.constraint_names)
    values = dict(zip(names, columns))
    return Kinematics(values=values, t=time, states=states, result=result, system=system, joints=model.joints)


@eqx.filter_jit
def _kinematics_jit(drive: _Drive, driven, rates):
    found = positions(drive, *driven)
    states = jax.vmap(lambda *args: forces_of_motion(drive, *args))(found.q, driven, rates)
    first = jnp.argmin(found.found)  # the first that was not found, 0 if all were
    result = jnp.where(jnp.all(found.found), RESULTS.successful, RESULTS.position_failed).astype(jnp.int32)
    details = {"violation": found.violation[first], "values": driven[0][first], "time": driven[1][first]}
    details["position"] = first
    return (states, result), jax.lax.stop_gradient(details)


def _with_numbers(model: Model, t, names: Sequence[str] | None = None) -> Model:
    """The model with numbers in place of the signals of time of these joints; None: of all."""
    is_signal = lambda leaf: isinstance(leaf, AbstractSignal)
    number = lambda leaf: leaf(t) if is_signal(leaf) else leaf

    def numbers(joint: AbstractJoint) -> AbstractJoint:
        leaves = lambda name: jax.tree.leaves(getattr(joint, name), is_leaf=is_signal)
        over_time = [field.name for field in dataclasses.fields(joint) if field.metadata.get("over", "time") == "time"]
        fields = [name for name in over_time if any(map(is_signal, leaves(name)))]
        some = lambda joint: [getattr(joint, name) for name in fields]
        return eqx.tree_at(some, joint, jax.tree.map(number, some(joint), is_leaf=is_signal)) if fields else joint

    joints = {name: numbers(joint) if names is None or name in names else joint for name, joint in model.joints.items()}
    return eqx.tree_at(lambda model: model.joints, model, joints)


def _drivers(system: MultibodySystem) -> dict[str, tuple[int, int]]:
    """By the name of each driver the stack of constraints and the element in it with its number."""
    stacks = [(k, stack) for k, stack in enumerate(system.constraints) if stack.elements.driven is not None]
    return {owner: (k, i) for k, stack in stacks for i, owner in enumerate(stack.owners)}
