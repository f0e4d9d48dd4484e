"""What force elements measure along a motion."""

from collections.abc import Collection
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import suggestion
from lgsens.model._frames import BODY_DIM, ROTATION
from lgsens.model._loads import generalized_force
from lgsens.model._stack import at_ends
from lgsens.model._system import MultibodySystem


def measured(system: MultibodySystem, force: str, q, v, vdot, lam, t) -> Any:
    """The `measure` of the load of the force element `force`, along a leading axis of states and times."""
    whole, placed, twists, _ = system.of_parts(q, v, vdot)
    found = [
        (stack.only(i), read.rows[i : i + 1])
        for stack, read in zip(whole.loads, whole.topology.read)
        for i, owner in enumerate(stack.owners)
        if owner == force
    ]
    if not found:
        known = {owner for stack in whole.loads for owner in stack.owners}
        raise ValueError(f"`force`: {suggestion(force, known)}.")
    if len(found) > 1:
        raise ValueError(f"`force`: {force!r} acts on {len(found)} bodies and has no single value.")

    ((stack, read),) = found
    if read.size and whole is not system:
        (joint,) = stack.joints
        own = system.multiplier(joint, q, v, vdot, lam, t)
        none = jnp.zeros((*lam.shape[:-1], len(whole.constraint_names)), lam.dtype)
        lam = none.at[..., whole.multiplier_rows(joint)].set(own)

    def at_time(q, v, lam, t):
        twist = whole.twists(v)
        (ends,) = at_ends([stack], whole._placed(q), twist)
        return stack.map(lambda e, *args: e.measure(*args), ends, (t, *stack.inputs(twist, lam, read)))

    return jax.tree.map(lambda leaf: leaf[:, 0], jax.vmap(at_time)(placed, twists, lam, t))


def element_forces(
    system: MultibodySystem, q, v, lam, t, length
) -> list[tuple[tuple[str, ...], Float[Array, "n e w"]]]:
    """The generalized forces of all loads along a leading axis of states and times, moments as forces at the arm
    `length` [N]; after those of two bodies, 12, the rates of states. Of each stack, with the names of its elements."""

    def at_time(q, v, lam, t):
        acting = system._acting(system._placed(q), system.twists(v), lam, t, system.topology.forces)
        return [stack.map(generalized_force, ends, inputs) for stack, ends, inputs, _ in acting]

    def scaled(forces):
        w = np.arange(forces.shape[-1])
        moments = (w < 2 * BODY_DIM) & (w % BODY_DIM >= ROTATION.start)
        return jnp.where(moments, forces / length, forces)

    found = jax.vmap(at_time)(q, v, lam, t)
    return [(stack.owners, scaled(forces)) for stack, forces in zip(system.loads, found)]


def stresses(system: MultibodySystem, forces: Collection[str], q, v, lam, t) -> dict[str, Float[Array, " n"]]:
    """What these force elements measure as their `stress` [N/m²], along a leading axis of states and times, by name;
    without those that have none."""
    own = tuple(i for i, stack in enumerate(system.loads) if not {*stack.owners}.isdisjoint(forces))
    found = zip(own, _stresses(system, own, q, v, lam, t)) if own else ()
    known = [(system.loads[i].owners, values) for i, values in found if values is not None]
    return {owner: values[:, i] for owners, values in known for i, owner in enumerate(owners) if owner in forces}


@partial(jax.jit, static_argnums=1)
def _stresses(system: MultibodySystem, own: tuple[int, ...], q, v, lam, t) -> list[Float[Array, "n e"] | None]:
    def at_time(q, v, lam, t):
        acting = [*system._acting(system._placed(q), system.twists(v), lam, t, system.topology.forces)]
        measure = lambda e, *args: getattr(e.measure(*args), "stress", None)
        return [stack.map(measure, ends, inputs) for stack, ends, inputs, _ in (acting[i] for i in own)]

    return jax.vmap(at_time)(q, v, lam, t)
