"""Bodies on fixed joints as one body.

Parts of masses m_i, centres of mass x_i, orientations R_i and inertias J_i that do not move in each other are one body:

    m = Σ m_i,    x = Σ m_i x_i / m,    J = Σ C_i J_i C_iᵀ + m_i (|d_i|² I − d_i d_iᵀ)

with d_i = Rᵀ(x_i − x), C_i = Rᵀ R_i, R the orientation of one of them (Steiner's parallel axis theorem, the inertias
turned to common axes). The velocities given for the parts need not be those of one body. An impulse through the joints
makes them so and changes neither momentum nor angular momentum; with o the origin of the merged frame (x, or a point
about which it turns),

    m ẋ = Σ m_i ẋ_i,    J_o Ω = Σ C_i J_i Ω_i + Rᵀ(x_i − o) × m_i Rᵀ ẋ_i,

of which the merged body takes the components along its degrees of freedom. That is the projection of `initial_state` in
two steps: orthogonal in the metric of kinetic energy, first on the fixed joints, then on all joints.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.model._body import RigidBody, lumped, parallel_axis
from lgsens.model._frames import Frame, ground_frame
from lgsens.model._free import ALL_FREE, ROTATIONS, TRANSLATIONS, Free, single_rotation
from lgsens.model._joints import AbstractJoint


class Group(NamedTuple):
    """Bodies that move as one.

    Attributes:
        name: of the merged body; None: they are fixed to the ground.
        parts: the names of the bodies, sorted.
        free: the degrees of freedom of the merged body.
        lead: the part whose axes the merged body has.
        turns: whether it only turns, about the origin of the frame of `lead`.
    """

    name: str | None
    parts: tuple[str, ...]
    free: Free
    lead: str | None
    turns: bool


class Placement(NamedTuple):
    """The body that moves another one, None for the ground, and the frame of the other in its own; None: its own."""

    body: str | None
    offset: Frame | None


Placements = Mapping[str | None, Placement]


def groups(bodies: Mapping[str, RigidBody], joints: Mapping[str, AbstractJoint]) -> tuple[Group, ...]:
    """The bodies of a scene by what fixed joints make of them; a body without degrees of freedom is ground.

    Raises `ValueError` for joints that repeat what fixed joints do, and parts whose degrees of freedom leave no body
    that `RigidBody` can describe.
    """
    root: dict[str | None, str | None] = {None: None} | {name: name for name in bodies}

    def find(end: str | None) -> str | None:
        while root[end] != end:
            end = root[end]
        return end

    def join(a: str | None, b: str | None) -> None:
        first, second = find(a), find(b)
        root[second if first is None else first] = first if first is None else second

    held = {None} | {name for name, body in bodies.items() if not body.free}
    for name in held:
        join(None, name)
    fixed = sorted(name for name, joint in joints.items() if joint.rigid)
    for name in [*fixed, *sorted(set(joints) - set(fixed))]:
        joint = joints[name]
        if find(joint.a) != find(joint.b):
            if name in fixed:
                join(joint.a, joint.b)
        elif not (joint.assembled and {joint.a, joint.b} <= held):
            a, b = ("the ground" if end is None else repr(end) for end in (joint.a, joint.b))
            raise ValueError(
                f"Model: joint {name!r} connects {a} and {b}, which fixed joints make one body already; remove it, or "
                f"one of {[other for other in fixed if other != name]}."
            )
    members: dict[str | None, list[str]] = {}
    for name in sorted(bodies):
        members.setdefault(find(name), []).append(name)
    found = tuple(_group(own, bodies, on_ground=end is None) for end, own in members.items())
    for group in found:
        if group.name in bodies and len(group.parts) > 1:
            raise ValueError(f"Model: {group.name!r} is the name of a merged body; give body {group.name!r} another.")
    return found


def _group(parts: Sequence[str], bodies: Mapping[str, RigidBody], *, on_ground: bool) -> Group:
    name, parts = " + ".join(parts), tuple(parts)
    if on_ground:
        return Group(None, parts, (), None, False)
    if len(parts) == 1:
        return Group(name, parts, bodies[name].free, name, False)
    reduced = [part for part in parts if bodies[part].free != ALL_FREE]
    if not reduced:
        return Group(name, parts, ALL_FREE, parts[0], False)
    lead, free = reduced[0], bodies[reduced[0]].free
    # A turn of the parts about one of their points moves their centre of mass across the axis.
    axis, turns = single_rotation(free), not set(free) & set(TRANSLATIONS)
    across = {TRANSLATIONS[i] for i in range(3) if i != axis} if set(free) & set(ROTATIONS) else set()
    as_one = across <= set(free) and all(bodies[part].free == free for part in reduced)
    if not as_one and not (turns and len(reduced) == 1):
        given = {part: bodies[part].free for part in reduced}
        raise ValueError(
            f"Model: fixed joints merge the bodies {list(parts)}, of which {given} have some degrees of freedom; that "
            "is possible where they all translate alike, all move in one plane alike, or only one of them turns about "
            "a point. Leave `merge_fixed` out, or write them as one body."
        )
    return Group(name, parts, free, lead, turns)


def merged(bodies: Mapping[str, RigidBody], found: Sequence[Group]) -> tuple[dict[str, RigidBody], Placements]:
    """The bodies that move, by name; and the `Placement` of every body."""
    moving: dict[str, RigidBody] = {}
    where: dict[str | None, Placement] = {None: Placement(None, None)}
    for group in found:
        frame = None
        if group.name is not None:
            body = moving[group.name] = _as_one(group, bodies)
            where[group.name] = Placement(group.name, None)
            if len(group.parts) > 1:
                frame = body.frame
        else:
            frame = ground_frame(bodies[group.parts[0]].mass.dtype)
        if frame is not None:
            for part in group.parts:
                where[part] = Placement(group.name, _seen_from(frame, bodies[part].frame))
    return moving, where


def _seen_from(frame: Frame, other: Frame) -> Frame:
    """The pose of a frame in another one."""
    return Frame(frame.local_point(other.position), frame.orientation.T @ other.orientation)


def _as_one(group: Group, bodies: Mapping[str, RigidBody]) -> RigidBody:
    """The body of the formulas above."""
    if len(group.parts) == 1:
        return bodies[group.parts[0]]
    assert group.lead is not None  # it is not on the ground
    parts, lead = [bodies[part] for part in group.parts], bodies[group.lead]
    of_parts = lambda number: jnp.stack([number(part) for part in parts])
    masses, centres, own = (
        of_parts(lambda p: p.mass),
        of_parts(lambda p: p.position),
        of_parts(lambda p: p.inertia_matrix),
    )
    spins, momenta = of_parts(lambda p: p.angular_velocity), masses[:, None] * of_parts(_velocity)
    axes, turns = lead.orientation, lead.orientation.T[None] @ of_parts(lambda p: p.orientation)

    mass, position, shifted = lumped(masses, centres)
    arms = (centres - position[None]) @ axes
    inertia = jnp.einsum("pij,pjk,plk->il", turns, own, turns) + axes.T @ shifted @ axes

    pivot = lead.frame.position if group.turns else None
    to_centre = jnp.zeros_like(position) if pivot is None else (position - pivot) @ axes
    spin_momenta = jnp.einsum("pij,pjk,pk->i", turns, own, spins)
    momentum = spin_momenta + jnp.sum(jnp.cross(arms + to_centre[None], momenta @ axes), axis=0)
    spin = _spin(inertia + mass * parallel_axis(to_centre), momentum, group.free)
    moves = jnp.asarray([name in group.free for name in TRANSLATIONS])
    velocity = jnp.where(moves, jnp.sum(momenta, axis=0) / mass, 0.0)
    points = all(part.inertia is None for part in parts)  # they translate
    whole = None if points else inertia
    return RigidBody(mass, whole, position, axes, velocity, spin, free=group.free, pivot=pivot)


def _velocity(part: RigidBody) -> Float[Array, "3"]:
    """That of the centre of mass; with a pivot it follows from the rotation."""
    if part.pivot is None:
        return part.velocity
    return part.orientation @ jnp.cross(part.angular_velocity, part.centre)


def _spin(inertia, momentum, free: Free) -> Float[Array, "3"]:
    """Ω of a body with an angular momentum about a point at which it does not translate, or its centre of mass."""
    if set(ROTATIONS) <= set(free):
        return jnp.linalg.solve(inertia, momentum)
    axis = single_rotation(free)
    if axis is None:
        return jnp.zeros_like(momentum)
    return jnp.zeros_like(momentum).at[axis].set(momentum[axis] / inertia[axis, axis])
