"""`kinematics`: the motion that joints and prescribed coordinates alone determine."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lgsens._validate import as_float, suggestion
from lgsens.dynamics import RESULTS, AbstractDrive, State, forces_of_motion, positions
from lgsens.model import Model, MultibodySystem
from lgsens.simulation import AbstractMotion, throw_if_failed


class Kinematics(AbstractMotion):
    """The positions of a driven mechanism, with what `Trajectory` answers: `body`, `multiplier`, `force`.

    Attributes:
        values: the driven values by joint, shape (n,) each: [m], of a `RotationDriver` [rad].
        t: the time at which time-dependent forces are taken [s], shape (n,).
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
    driven: Mapping[str, Any],
    *,
    rates: Mapping[str, Any] | None = None,
    t0=0.0,
    throw: bool = True,
) -> Kinematics:
    """The positions of a mechanism whose joints and driven coordinates leave it no freedom, velocities, forces.

        Φ(q, s) = 0,     B v + Φ_s ṡ = 0,     B v̇ = −Γ,     Bᵀλ = −r(q, v, v̇, 0, t0)

    for each set of driven values s, ṡ constant: a test rig of a suspension, the coupler curve of a linkage, inverse
    dynamics. Accelerations are those at constant rates; the multiplier of a driver is what it takes to drive.

    Arguments:
        model: the scene. `RigidBody(free=…)` and joints leave as many degrees of freedom as are driven.
        driven: values by name of a `TranslationDriver` (displacement [m]), a `RotationDriver` (angle [rad]) or a
            `DistanceJoint` (length [m]), shape (n,) each. The first position is found from the reference
            configuration, each other one from that before: begin near it, and take steps that cannot be mistaken for
            another way to assemble the mechanism.
        rates: rates of the driven values [m/s], [rad/s], shape () or (n,), by name; those left out are 0. None: 1 for
            all of them. With the one rate 1, velocities are derivatives by the driven value (a motion ratio); with 0,
            forces are those at rest.
        t0: the time at which time-dependent forces are taken [s], shape ().
        throw: raise if there is no such position. With False `result` says so, and its numbers are NaN.

    Differentiable by every number of the model and by the driven values, by the implicit function theorem: one
    factorization per position for all of them. Raises `ValueError` for names that are not drivers, values of different
    lengths, a mechanism with other degrees of freedom than the driven ones, and positions that do not exist; inside
    `jit`, JAX's runtime error with the same message. Source: Haug (1989), chapter 3.
    """
    if not isinstance(model, Model):
        raise ValueError(f"`model` must be a Model, got {type(model).__name__}.")
    system = model.system()
    where = _drivers(system)
    if not driven:
        raise ValueError(f"`driven` is empty; give values for drivers of the model, some of {sorted(where)}.")
    for name in (*driven, *(rates or ())):
        if name not in where:
            raise ValueError(f"`driven`: {suggestion(name, where)}, the drivers and distance joints of the model.")
    names = sorted(driven)
    columns = [as_float(driven[name], None, f"`driven[{name!r}]`") for name in names]
    if any(column.ndim != 1 or column.shape != columns[0].shape or column.size == 0 for column in columns):
        shapes = {name: column.shape for name, column in zip(names, columns)}
        raise ValueError(f"`driven` must hold vectors of one length ≥ 1, got shapes {shapes}.")
    given = dict.fromkeys(names, 1.0) if rates is None else {name: rates.get(name, 0.0) for name in names}
    speeds = [as_float(given[name], None, f"`rates[{name!r}]`") for name in names]
    if any(speed.shape not in ((), columns[0].shape) for speed in speeds):
        raise ValueError(f"`rates` must have shape () or {columns[0].shape}, got {[speed.shape for speed in speeds]}.")
    if set(rates or ()) - set(names):
        raise ValueError(f"`rates`: {sorted(set(rates or ()) - set(names))} are not among the driven joints {names}.")
    unknowns, equations = system.group.dim, len(system.constraint_names)
    if unknowns != equations:
        raise ValueError(
            f"`driven`: the mechanism has {unknowns} coordinates and {equations} equations, those of the drivers "
            f"{names} included; kinematics needs as many. "
            + (
                "Drive more coordinates, hold bodies by `free`, or lock joints."
                if unknowns > equations
                else "Drive fewer coordinates, or remove joints that repeat each other."
            )
        )
    drive = _Drive(system, tuple(where[name] for name in names))
    values = jnp.stack(columns, axis=1)
    speed = jnp.stack([jnp.broadcast_to(speed, columns[0].shape) for speed in speeds], axis=1)
    (t, states, result), details = _kinematics_jit(drive, values, speed, as_float(t0, (), "`t0`"))
    found = Kinematics(values=dict(zip(names, columns)), t=t, states=states, result=result, system=system)
    if throw:
        found = throw_if_failed(found, found.result, details, system.constraint_names)
    return found


@eqx.filter_jit
def _kinematics_jit(drive: _Drive, values, rates, t0):
    found = positions(drive, values)
    t = jnp.broadcast_to(t0, values.shape[:1])
    states = jax.vmap(lambda *args: forces_of_motion(drive, *args))(found.q, values, rates, t)
    first = jnp.argmin(found.found)  # the first that was not found, 0 if all were
    result = jnp.where(jnp.all(found.found), RESULTS.successful, RESULTS.position_failed).astype(jnp.int32)
    details = {"violation": found.violation[first], "values": values[first], "position": first}
    return (t, states, result), jax.lax.stop_gradient(details)


def _drivers(system: MultibodySystem) -> dict[str, tuple[int, int]]:
    """By the name of each driver the stack of constraints and the element in it with its number."""
    stacks = [(k, stack) for k, stack in enumerate(system.constraints) if stack.elements.driven is not None]
    return {owner: (k, i) for k, stack in stacks for i, owner in enumerate(stack.owners)}
