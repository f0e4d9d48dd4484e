"""Kinks and jumps inside of steps, told from second differences along a motion.

Where a force has a kink or a jump between two times, second differences of accelerations are larger by 1/h or 1/h² than
before and after; where a motion is not resolved they are as large as the accelerations. The forces themselves, as
functions of the states and times of the motion, say which of them it is: those whose second differences stand out at
the same place.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lgsens.model import element_forces, scene_of
from lgsens.simulation import Trajectory

_SPIKE = 8.0  # second differences beside a smooth change differ by less
_INSIDE = 0.1
_VISIBLE = 1e-4  # of the largest value of a run: smaller kinks move a result by less than the scheme does
_AS_LARGE = 0.5  # of the largest acceleration of a run: second differences that are not resolved


class Kink(NamedTuple):
    """A kink or a jump of an acceleration inside of a step.

    Attributes:
        t: the end of the step [s].
        body: its name.
        forces: the names of the force elements that have a kink or a jump there; none where it is of a driver, say.
    """

    t: float
    body: str
    forces: tuple[str, ...]

    def __str__(self) -> str:
        by = f" ({', '.join(map(repr, self.forces))})" if self.forces else ""
        return f"{self.body!r} at t = {self.t:.6g} s{by}"


class Roughness(NamedTuple):
    """Whether there is a kink or a jump in the step that ends at each time, of each body and of each force element, and
    the share of steps whose accelerations are not resolved."""

    bodies: Bool[Array, "n+1 bodies"]
    forces: Bool[Array, "n+1 forces"]
    unresolved: Float[Array, ""]


def roughness(trajectory: Trajectory) -> Roughness:
    """Of a motion in equal steps."""
    system = trajectory.system
    scale = system.coordinate_scale()
    if scene_of(system) is not None:
        system, states, t = trajectory.of_bodies()
        length = jnp.max(scale)
        motions = [trajectory.body(name) for name in system.body_names]
        a = jnp.stack([jnp.concatenate([m.acceleration / length, m.angular_acceleration], axis=1) for m in motions], 1)
        found = element_forces(system, states.q, states.v, states.lam, t, length)
        forces = [_spikes(force, jnp.max(jnp.abs(force), axis=(0, 2))) for _, force in found]
    else:
        a, forces = (trajectory.states.vdot / scale[None])[:, :, None], []
    size = jnp.max(jnp.abs(a), axis=(0, 2))
    turns = jnp.any(jnp.max(jnp.abs(jnp.diff(a, 2, axis=0)), axis=2) > _AS_LARGE * size[None], axis=1)
    none = jnp.zeros((a.shape[0], 0), bool)
    return Roughness(_spikes(a, size), jnp.concatenate([none, *forces], axis=1), jnp.mean(turns))


def _spikes(values: Float[Array, "n+1 items parts"], size: Float[Array, " items"]) -> Bool[Array, "n+1 items"]:
    """Where second differences stand out of those before and after.

    Of means, which do not see the (−ρ∞)ⁿ that a kink leaves behind in accelerations. One at the part θ of a step
    changes three of these second differences by (1 − θ)/2, 1/2 and θ/2; on a time, where no step is the worse for it,
    two.
    """
    second = jnp.max(jnp.abs(jnp.diff((values[1:] + values[:-1]) / 2.0, 2, axis=0)), axis=2)  # (n−2, items)
    at = lambda k: second[3 + k : second.shape[0] - 3 + k]
    sides = jnp.minimum(at(-1), at(1)), jnp.maximum(at(-1), at(1))
    peak = (at(0) >= sides[1]) & (sides[0] > _INSIDE * at(0))
    spikes = peak & (at(0) > _SPIKE * jnp.maximum(at(-3), at(3))) & (at(0) > _VISIBLE * size[None])
    return jnp.pad(spikes, ((5, 4), (0, 0)))  # the first one is of the step from the fourth to the fifth time


def kinks(trajectory: Trajectory, found: Roughness) -> tuple[Kink, ...]:
    """What was found, by name."""
    system = scene_of(trajectory.system)
    bodies, forces = np.asarray(found.bodies), np.asarray(found.forces)
    names, owners = [f"coordinate {i}" for i in range(bodies.shape[1])], []
    if system is not None:
        names, owners = system.body_names, [owner for stack in system.loads for owner in stack.owners]

    def at(n: int, i: int) -> Kink:
        acting = dict.fromkeys(owners[k] for k in np.flatnonzero(forces[n - 1 : n + 2].any(axis=0)))
        return Kink(float(trajectory.t[n]), names[i], tuple(acting))

    return tuple(at(n, i) for n, i in np.argwhere(bodies))
