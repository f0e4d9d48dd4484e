"""Forces: what they say of their derivatives, against what follows from the force."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.model import (
    AbstractClosedFormLoad,
    AbstractDynamicLoad,
    AbstractForce,
    AbstractLoad,
    Frame,
    RigidBody,
    carried,
    load_tangents,
)
from lgsens.testing._differences import SAFETY
from lgsens.testing._poses import DIM, ScenePoses, displaced, same, slope, vanishes
from lgsens.testing._report import Check, Report, worst
from lgsens.testing._sensitivities import check_sensitivities

Potential = Callable[[Any, Frame, Frame, Any], Float[Array, ""]]


class _AtStates(AbstractLoad):
    """A load with states, of which these are given, as are the multipliers that it reads."""

    load: AbstractDynamicLoad
    states: Float[Array, " s"]

    def force(self, a, b, va, vb, t):
        return self.load.force(a, b, va, vb, t, self.states)


def check_force(
    force: AbstractForce | AbstractLoad | AbstractDynamicLoad,
    *,
    potential: Potential | None = None,
    balanced: bool = True,
    bodies: Mapping[str, RigidBody] | None = None,
    length: float = 1.0,
    poses: int = 3,
    seed: int = 0,
) -> Report:
    """Check a force element, or one load, whose generalized force is Q = [F_a, M_a, F_b, M_b].

    At random poses, velocities and times: ∂Q/∂q under the retraction R exp(θ̃) and ∂Q/∂v, by autodiff and by
    differences; of a load in closed form, `tangents` against autodiff, None standing for zero. That Q is zero where it
    does not say that it `acts_on`, and on a part of a merged body that in the frame of the part. Q by every number of
    it, as `check_sensitivities` does. States of its own have random values. Between two bodies, action and reaction:

        F_a + F_b = 0,     x_a × F_a + R_a M_a + x_b × F_b + R_b M_b = 0

    With a potential E, Q = −∂E/∂q at rest, and what velocities add takes energy out, (Q(v) − Q(0))·v ≤ 0.

    Arguments:
        force: an `AbstractForce`, an `AbstractLoad` or an `AbstractDynamicLoad`.
        potential: (load, frame of a, frame of b, time [s]) ↦ E [J], shape (), written from the definition of the
            element and not from its code; None: it has none.
        balanced: whether two bodies feel opposite forces; False for one that acts on each from outside.
        bodies: the bodies of the scene, in their reference configuration; None: those that the force names, at random
            poses.
        length: size of the scene [m], shape (): random poses, velocities and steps are in proportion.
        poses: how many random poses.
        seed: of poses and velocities.

    Returns a `Report`; a row holds the worst of all poses. Raises `ValueError` for a Q of other than 12 entries.
    """
    scene = ScenePoses(seed, length)
    (part,) = ScenePoses(seed + 1, length).frames(1)
    states = jnp.asarray(np.random.default_rng(seed).uniform(0.5, 1.5, 64))

    def at_states(load: Any) -> AbstractLoad:
        if not isinstance(load, AbstractDynamicLoad):
            return load
        return _AtStates(load, states[: len(load.states) + sum(load.reads)])

    if isinstance(force, AbstractLoad | AbstractDynamicLoad):
        scene_bodies = scene.bodies("ab")
        attached = [("", "a", "b")]
        load_of = lambda force, i: at_states(force)
    else:
        names = [name for name in dict.fromkeys(force.bodies) if name is not None] or ["body"]
        scene_bodies = scene.bodies(names) if bodies is None else dict(bodies)
        load_of = lambda force, i: at_states(force.loads(scene_bodies)[i].load)
        attached = [
            (f"{i + 1} {type(each.load).__name__}: ", each.a, each.b)
            for i, each in enumerate(force.loads(scene_bodies))
        ]
    checks: list[Check] = []
    for i, (label, end_a, end_b) in enumerate(attached):
        (a, b), free = scene.ends(end_a, end_b, scene_bodies)
        load = load_of(force, i)
        program = _program(load, potential, free, part)
        zeros = jnp.zeros_like(scene.points(free))
        for pose in range(poses):
            first, second = displaced(a, b, scene.displacement(free))
            v, t = scene.displacement(free), jnp.asarray(scene.rng.uniform(), scene.dtype)
            arguments = first, second, v[:6], v[6:], t
            shape = jax.eval_shape(load.force, *arguments).shape
            if shape != (DIM,):
                raise ValueError(f"{label or f'{type(load).__name__}: '}`force` must have shape ({DIM},), got {shape}.")
            by_position = scene.sampled(program(scene.points(free), zeros, first, second, v, t), free)
            by_velocity = scene.sampled(program(zeros, scene.points(free), first, second, v, t), free)
            closed_form = isinstance(load, AbstractClosedFormLoad)
            checks += _compared(label, closed_form, balanced and len(free) == DIM, by_position, by_velocity, length)
            if pose == 0 and jax.tree.leaves(force):
                numbers = lambda force, i=i, arguments=arguments: load_of(force, i).force(*arguments)
                found = check_sensitivities(numbers, force, seed=seed)
                checks += [check._replace(name=f"{label}{check.name}") for check in found.checks]
    return Report(f"{type(force).__name__}, {poses} poses", worst(checks))


def _program(load: AbstractLoad, potential: Potential | None, free, part):
    """What a load says, and what follows from its force, at displacements x and velocities v + u of two frames."""

    def quantities(x, u, a, b, v, t):
        a, b = displaced(a, b, x)
        v, zero = v + u, jnp.zeros_like(v)
        force = lambda y, v: load.force(*displaced(a, b, y), v[:6], v[6:], t)
        given = load_tangents(load, a, b, v[:6], v[6:], t)
        position, velocity = (jnp.zeros((DIM, DIM), v.dtype) if part is None else part for part in given)
        q, resting = force(zero, v), force(zero, zero)
        found = {
            "Q": q,
            "Q on a part": carried(load, part, part).force(a, b, v[:6], v[6:], t)
            - carried(load, part, part, by_frames=True).force(a, b, v[:6], v[6:], t),
            "Q elsewhere": q[np.setdiff1d(np.arange(DIM), load.acts_on)],
            "∂Q/∂q": position[:, free],
            "∂Q/∂v": velocity[:, free],
            "∂Q/∂q by autodiff": jax.jacfwd(force)(zero, v)[:, free],
            "∂Q/∂v by autodiff": jax.jacfwd(force, argnums=1)(zero, v)[:, free],
            "F_a + F_b": q[0:3] + q[6:9],
            "moment of both": _moment(a, q[:6]) + _moment(b, q[6:]),
            "at rest": resting[free],
            "power": (q - resting)[free] @ v[free],
        }
        if potential is not None:
            energy = partial(potential, load)
            found["−∂E/∂q"] = -jax.jacfwd(lambda y: energy(*displaced(a, b, y), t))(zero)[free]
        return found

    return jax.jit(jax.vmap(quantities, in_axes=(0, 0, None, None, None, None)))


def _moment(frame: Frame, q):
    """The moment about the inertial origin [N m]."""
    return jnp.cross(frame.position, q[:3]) + frame.axis(q[3:])


def _compared(label: str, closed_form: bool, balanced: bool, by_position, by_velocity, length) -> Iterator[Check]:
    for name, found in (("∂Q/∂q", by_position), ("∂Q/∂v", by_velocity)):
        if closed_form:
            yield same(label + name, found[name], found[f"{name} by autodiff"])
        yield slope(label + name, found[f"{name} by autodiff"], found["Q"])
    size = float(np.abs(by_position["Q"].value).max(initial=0.0))
    yield vanishes(f"{label}Q", "on a part, in its frame", by_position["Q on a part"], size)
    if by_position["Q elsewhere"].value.size:
        yield vanishes(f"{label}Q", "elsewhere, 0", by_position["Q elsewhere"], size)
    if balanced:
        yield vanishes(f"{label}F_a + F_b", "action, reaction", by_position["F_a + F_b"], size)
        yield vanishes(f"{label}moment of both", "action, reaction", by_position["moment of both"], size * length)
    if "−∂E/∂q" in by_position:
        yield same(f"{label}Q at rest", by_position["at rest"], by_position["−∂E/∂q"], "given, −∂E/∂q")
        power = by_position["power"]
        eps = float(np.finfo(power.value.dtype).eps)
        tolerance = SAFETY * (power.sigma + eps * size * length)
        yield Check(f"{label}power of velocities", "at most 0", max(float(power.value), 0.0), tolerance)
