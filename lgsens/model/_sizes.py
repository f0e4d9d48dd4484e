"""What lengths, forces and moments of a scene compare with."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._xla import one_program
from lgsens.liegroups import Pose, Poses
from lgsens.linear import added
from lgsens.model._frames import BODY_DIM, ROTATION
from lgsens.model._loads import of_states
from lgsens.model._stack import at_ends, constraint_jacobian, state_coordinates

System = Any  # a MultibodySystem, which asks these functions


def _gyration_square(system: System) -> Float[Array, ""]:
    """The square of the radius of gyration of the bodies in the mean [m²], 1 m² of point masses."""
    count = len(system.body_names)
    mass = jnp.mean(system.mass[:count])
    square = jnp.mean(jnp.trace(system.inertia[:count], axis1=1, axis2=2)) / (3.0 * mass)
    return jnp.where(square > 0, square, 1.0)


def compliance(system: System) -> Float[Array, " m"]:
    """1/m for what is measured in metres, 1/(m l²) for angles and cosines, with m the mean mass of the bodies and l
    the radius of gyration of all of them: a moment counts as a force at the arm l."""
    mass, square = jnp.mean(system.mass[: len(system.body_names)]), _gyration_square(system)
    angular, t = [], jnp.zeros((), mass.dtype)
    for stack, ends, rows in zip(system.constraints, at_ends(system.constraints, system.pose), system.topology.rows):
        translation = stack.map(constraint_jacobian, ends, (t,)).reshape(*rows.shape, -1, BODY_DIM)
        without = jnp.all(translation[..., : ROTATION.start] == 0.0, axis=(2, 3))
        angular.append((without.astype(mass.dtype), rows))
    angular = lax.stop_gradient(added(angular, system.topology.num_constraints, mass.dtype))
    return (1.0 + angular * (1.0 / square - 1.0)) / mass


def _length(system: System) -> Float[Array, ""]:
    """Of the scene: the extent of the centres of mass, or the largest arm of an attachment; of one on the ground, where
    that is less, the extent of it and the centres of mass, which knows no origin."""
    centres = system.pose.position[: len(system.body_names)]
    extents = [jnp.ptp(centres, axis=0)]
    for stack in (*system.constraints, *system.loads):
        for body, side in zip("ab", (stack.a, stack.b)):
            for points in stack.elements.fixed("point", body):
                arm = jnp.abs(points).max(axis=0)
                if side is None:
                    arm = jnp.minimum(arm, jnp.ptp(jnp.concatenate([centres, points]), axis=0))
                extents.append(arm)
    # a body whose contact is at the origin has none of these, or round-off
    length, size = jnp.max(jnp.stack(extents)), jnp.sqrt(lax.stop_gradient(_gyration_square(system)))
    return jnp.where(length > 1e-4 * size, length, size)


@one_program
def distance(system: System, q: Pose) -> Float[Array, ""]:
    """The largest coordinate of a centre of mass in lengths of the scene, at least 1."""
    return jnp.maximum(jnp.max(jnp.abs(system._placed(q).position[: len(system.body_names)])) / _length(system), 1.0)


@one_program
def coordinate_scale(system: System) -> Float[Array, " k"]:
    """The length of the scene for translations, 1 for rotations, what loads say for their states."""
    length = _length(system)
    scale = jnp.ones(BODY_DIM, length.dtype).at[: ROTATION.start].set(length)
    if not isinstance(system.group, Poses):
        return jnp.tile(scale, len(system.body_names))
    every = scale[np.concatenate([np.asarray(own, int) for own in system.free])]
    for stack in system.dynamic:
        size = lambda load, length: of_states(load, "size", load.size(length))
        of_each = jax.vmap(size, in_axes=(0, None), axis_size=len(stack.owners))  # an element may have no numbers
        sizes = of_each(stack.elements, scale[0])
        every = every.at[state_coordinates(stack, system.index)].set(sizes)
    return every
