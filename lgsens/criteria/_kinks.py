"""Kinks and jumps inside of steps, told from differences along a motion.

Where a force has a kink between two times, second differences of accelerations are larger by 1/h than before and after,
where it jumps first ones; where a motion is not resolved they are as large as the accelerations. The forces
themselves, as functions of the states and times of the motion, say which of them it is: those whose differences stand
out at the same place.

A kink is missed by the estimates of errors, and a step that ends there mends it. A jump at a time that depends on the
parameters is missed by the gradient: the velocity changes by −[v̇] δt for a shift δt of that time, whatever the steps.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lgsens._xla import one_program
from lgsens.dynamics import AbstractSystem, breaks_of
from lgsens.integrate import SHORTEST
from lgsens.model import element_forces, scene_of
from lgsens.simulation import Trajectory

_SPIKE = 8.0  # differences beside a smooth change differ by less
_INSIDE = 0.1
_VISIBLE = 1e-4  # of the largest value of a run: smaller kinks move a result by less than the scheme does
_ROUND_OFF = 1e5  # of a configuration of some turns, over h²
_SAME = 1e-9  # of the largest change of a break
_REACH = 5  # times before and behind one, of the differences below
_AS_LARGE = 0.5  # of the largest acceleration of a run: second differences that are not resolved


class Kink(NamedTuple):
    """A kink or a jump of an acceleration inside of a step.

    Attributes:
        t: the end of the step [s].
        body: its name.
        forces: the names of the force elements that have a kink or a jump there; none where it is of a driver, say.
        jump: whether it jumps.
    """

    t: float
    body: str
    forces: tuple[str, ...]
    jump: bool = False

    def __str__(self) -> str:
        by = f" ({', '.join(map(repr, self.forces))})" if self.forces else ""
        return f"{self.body!r} at t = {self.t:.6g} s{by}"


class Roughness(NamedTuple):
    """Whether there is a kink, or a jump, in the step that ends at each time, of each body and of each force element,
    the share of steps whose accelerations are not resolved, and by how much of their largest they change in the first.
    """

    bodies: Bool[Array, "2 n+1 bodies"]
    forces: Bool[Array, "2 n+1 forces"]
    unresolved: Float[Array, ""]
    begin: Float[Array, ""]


def _accelerations(trajectory: Trajectory) -> Float[Array, "n+1 items parts"]:
    """Of each body, in rad and lengths of the scene."""
    bodies, scale = scene_of(trajectory.system), trajectory.system.coordinate_scale()
    if bodies is None:
        return (trajectory.states.vdot / scale[None])[:, :, None]
    motions, length = [trajectory.body(name) for name in bodies.body_names], jnp.max(scale)
    return jnp.stack([jnp.concatenate([m.acceleration / length, m.angular_acceleration], axis=1) for m in motions], 1)


def roughness(trajectory: Trajectory, told: Float[Array, " n"] | None = None) -> Roughness:
    """Of a motion in equal steps, or in such from each step on that is `told`, beside which nothing is looked for."""
    system, a, forces = trajectory.system, _accelerations(trajectory), []
    if scene_of(system) is not None:
        length = jnp.max(system.coordinate_scale())
        system, states, t = trajectory.of_bodies()
        found = element_forces(system, states.q, states.v, states.lam, t, length)
        forces = [_rough(force, jnp.max(jnp.abs(force), axis=(0, 2))) for _, force in found]
    size = jnp.max(jnp.abs(a), axis=(0, 2))
    h = (trajectory.t[-1] - trajectory.t[0]) / (trajectory.t.shape[0] - 1)
    seen = jnp.maximum(size, _ROUND_OFF * jnp.finfo(size.dtype).eps / h**2)  # a uniform motion has none but that
    begin = jnp.max(jnp.abs(a[1] - a[0]) / seen[:, None])
    turns = jnp.any(jnp.max(jnp.abs(jnp.diff(a, 2, axis=0)), axis=2) > _AS_LARGE * seen[None], axis=1)
    none = jnp.zeros((2, a.shape[0], 0), bool)
    others = _beside_none(told, a.shape[0])
    seen_of = lambda rough: rough & others[None, :, None]
    forces = seen_of(jnp.concatenate([none, *forces], axis=2))
    return Roughness(seen_of(_rough(a, size)), forces, jnp.mean(turns), begin)


def jumps_of(values: Float[Array, " n+1"], told: Float[Array, " n"] | None = None) -> Bool[Array, " n+1"]:
    """Whether a function of time jumps in the step that ends at each time, as far as that stands out; `told`: as in
    `roughness`."""
    jumps = _jumps(values[:, None, None], jnp.max(jnp.abs(values))[None])[:, 0]
    return jumps & _beside_none(told, values.shape[0])


def breaks_apart(trajectory: Trajectory, change: AbstractSystem) -> tuple[Float[Array, " k"], Bool[Array, " k"]]:
    """The times of breaks, ascending, and whether each is at the next one, moves otherwise than that by a `change` of
    the system, and accelerations jump there. A step that ends at both moves with each by half."""
    t, a = trajectory.t, _accelerations(trajectory)
    breaks, moving = jax.jvp(breaks_of, (trajectory.system,), (change,))
    order = jnp.argsort(breaks)
    breaks, moving = breaks[order], moving[order]
    inside = (breaks[:-1] > t[0]) & (breaks[1:] < t[-1])
    together = inside & (jnp.diff(breaks) <= SHORTEST * (t[-1] - t[0]))
    apart = jnp.abs(jnp.diff(moving)) > _SAME * jnp.max(jnp.abs(moving), initial=0.0)
    n = jnp.searchsorted(t, breaks[:-1])
    near = lambda k: a[jnp.clip(n + k, 0, t.size - 1)]
    changed = lambda first, last: jnp.max(jnp.abs(near(last) - near(first)), axis=(1, 2))
    across, around = changed(-2, 2), jnp.maximum(changed(-6, -2), changed(2, 6))
    jumps = (across > _SPIKE * around) & (across > _VISIBLE * jnp.max(jnp.abs(a)))
    return breaks[:-1], together & apart & jumps


def _beside_none(told: Float[Array, " n"] | None, times: int) -> Bool[Array, " n+1"]:
    """The times of which no difference above reaches over the begin of a step that is told."""
    if told is None:
        return jnp.ones(times, bool)
    near = jnp.convolve(jnp.append(told, 0.0), jnp.ones(2 * _REACH + 1, told.dtype), mode="same")
    return near < 0.5


def _rough(values: Float[Array, "n+1 items parts"], size: Float[Array, " items"]) -> Bool[Array, "2 n+1 items"]:
    """Kinks, and jumps."""
    jumps = _jumps(values, size)
    return jnp.stack([_spikes(values, size) & ~jumps, jumps])


@one_program
def _jumps(values: Float[Array, "n+1 items parts"], size: Float[Array, " items"]) -> Bool[Array, "n+1 items"]:
    """Where first differences stand out of those before and after.

    Over two steps, half of each, which do not see (−ρ∞)ⁿ. A jump inside of a step is in two of them, wherever it is.
    """
    first = jnp.max(jnp.abs(values[2:] - values[:-2]) / 2.0, axis=2)  # (n−1, items)
    at = lambda k: first[3 + k : first.shape[0] - 2 + k]
    pair = jnp.minimum(at(-1), at(0)), jnp.maximum(at(-1), at(0))
    around = jnp.maximum(jnp.maximum(at(-2), at(-3)), jnp.maximum(at(1), at(2)))
    jumps = (pair[0] > 0.5 * pair[1]) & (pair[0] > _SPIKE * around) & (pair[0] > _VISIBLE * size[None])
    return jnp.pad(jumps, ((4, 3), (0, 0)))  # the first one is of the step from the third to the fourth time


@one_program
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

    def at(n: int, i: int, jump: bool) -> Kink:
        acting = dict.fromkeys(owners[k] for k in np.flatnonzero(forces[int(jump), n - 1 : n + 2].any(axis=0)))
        return Kink(float(trajectory.t[n]), names[i], tuple(acting), jump)

    return tuple(at(n, i, bool(jump)) for n, i, jump in np.argwhere(np.moveaxis(bodies, 0, 2)))
