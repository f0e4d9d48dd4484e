"""The equations of motion of a scene, elements stacked by type."""

import dataclasses
from collections import Counter
from collections.abc import Hashable, Mapping
from typing import Any, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens._validate import array_of, is_concrete
from lgsens.liegroups import Pose
from lgsens.model._body import RigidBody
from lgsens.model._checks import outside_of_freedom
from lgsens.model._evaluate_by_kind import StackRow, evaluated, joined, stacked
from lgsens.model._forces import AbstractConnection, AbstractForce
from lgsens.model._frames import Frame, ground_frame
from lgsens.model._given_joints import given_joints, numbers_of
from lgsens.model._joints import AbstractJoint
from lgsens.model._loads import carriers, num_states
from lgsens.model._merge import Group, Placement, Placements, merged
from lgsens.model._merged_parts import Parts
from lgsens.model._on_merged_bodies import carried
from lgsens.model._stack import Placed, stack
from lgsens.model._system import MultibodySystem
from lgsens.model._violable_rows import in_plane, violable_rows

_MANY = 4  # fewer forces that are alike compile faster one by one: the yardstick's cars 7 % slower with 1


def assemble(
    bodies: Mapping[str, RigidBody],
    frames: Frame,
    joints: Mapping[str, AbstractJoint],
    forces: Mapping[str, AbstractForce],
) -> MultibodySystem:
    """The equations of bodies whose orientations are rotations; `frames`: theirs, by their names."""
    places: Placements = {None: Placement(None, None)} | {name: Placement(name, None) for name in bodies}
    return _assemble(bodies, bodies, frames, places, joints, forces)


def assemble_merged(
    bodies: Mapping[str, RigidBody],
    frames: Frame,
    joints: Mapping[str, AbstractJoint],
    forces: Mapping[str, AbstractForce],
    found: tuple[Group, ...],
) -> MultibodySystem:
    """The equations of what fixed joints make of the bodies."""
    moving, places = merged(bodies, found)
    parts, names = assemble(bodies, frames, joints, forces), sorted(moving)
    own = [places[name] for name in parts.body_names]
    states = range(len(names), len(names) + len(parts.free) - len(own))  # of states, the same ones in both systems
    here = ground_frame(parts.mass.dtype)
    offsets = [here if place.offset is None else place.offset for place in own] + [here for _ in states]
    fixed: dict[str | None, list[str]] = {}
    for name, joint in sorted(joints.items()):
        if places[joint.a].body == places[joint.b].body and name in parts.constraint_names:
            fixed.setdefault(places[joint.a].body, []).append(name)
    seen = Parts(
        system=parts,
        offset=Frame(*map(jnp.stack, zip(*offsets))),
        body=(*(None if place.body is None else names.index(place.body) for place in own), *states),
        free=parts.free,
        fixed=tuple(map(tuple, fixed.values())),
    )
    return _assemble(moving, bodies, frames, places, joints, forces, seen)


def _assemble(
    moving: Mapping[str, RigidBody],
    bodies: Mapping[str, RigidBody],
    frames: Frame,
    places: Placements,
    joints: Mapping[str, AbstractJoint],
    forces: Mapping[str, AbstractForce],
    parts: Parts[MultibodySystem] | None = None,
) -> MultibodySystem:
    """The equations of the `moving` bodies, to which joints and forces on the named `bodies` are attached.

    `frames`: those of `bodies`, by their names. Names are sorted here and nowhere else: a dict comes out of `jit`
    sorted, so its own order cannot be relied on.
    """
    names = tuple(sorted(moving))
    ordered = [moving[name] for name in names]
    number = {None: None} | {name: i for i, name in enumerate(names)}
    frame = {None: None} | {name: StackRow(frames, i) for i, name in enumerate(sorted(bodies))}

    ends_of = lambda joint: (joint.a, joint.b, *joint.others)
    bodies_of = lambda joint: [moving[body] for end in ends_of(joint) if (body := places[end].body) is not None]
    joints = {name: in_plane(joint, bodies_of(joint)) for name, joint in sorted(joints.items())}
    between = [(name, joint) for name, joint in joints.items() if places[joint.a].body != places[joint.b].body]
    members = [
        (joint, *map(frame.get, ends_of(joint)), *(places[end].offset for end in ends_of(joint)))
        for _, joint in between
    ]
    kinds = [(_kind(joint), *(end is None for end in ends)) for joint, *ends in members]
    constraints, given = [], []
    for (name, joint), found in zip(between, evaluated(_constraints, members, kinds)):
        row, numbers = (StackRow(of, found.index) for of in found.of)
        given.append(numbers)
        a, b, *others = (number[places[end].body] for end in ends_of(joint))
        if None in others or len({a, b, *others}) < 2 + len(others):
            raise ValueError(f"Joint {name!r} couples bodies that `merge_fixed` makes one, or ground; leave it out.")
        more = tuple(other for other in others if other is not None)
        single = [jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), of) for of in row.of]
        for i, (of, kept) in enumerate(zip(row.of, violable_rows(name, joint, single, bodies_of(joint)))):
            if any(kept):
                constraints.append(Placed(StackRow(of, row.index), a, b, name, kept, i, more))
    loads, free = [], [body.coordinates for body in ordered]
    acting = {name: force.on(joints) for name, force in sorted(forces.items())}
    members = {
        name: (force, frame[force.a], frame[force.b], places[force.a].offset, places[force.b].offset)
        for name, force in acting.items()
        if _is_connection(force)
    }
    kinds = {name: (_kind(force), *(end is None for end in ends)) for name, (force, *ends) in members.items()}
    counts = Counter(kinds.values())
    many = [name for name, kind in kinds.items() if counts[kind] >= _MANY]
    rows = dict(zip(many, evaluated(_load, [members[name] for name in many], [kinds[name] for name in many])))
    for name, force in acting.items():
        for element, *ends in _attached(name, force, moving if force.on_merged else bodies, rows, places):
            load = element.of if isinstance(element, StackRow) else element
            a, b = (places[end] for end in ends)
            own = carriers(num_states(load))
            if own and a.body is b.body is None:
                raise ValueError(
                    f"Force {name!r} has states and acts between bodies that fixed joints hold on the ground; leave it "
                    "out, or leave `merge_fixed` out."
                )
            if own or a.body != b.body or (a.body is not None and not load.balanced):
                here = tuple(range(len(free), len(free) + len(own)))
                loads.append(Placed(element, number[a.body], number[b.body], name, carriers=here, joint=force.reads))
                free.extend(own)
    kinds = [
        (jnp.shape(body.inertia) if body.inertia is not None else None, body.pivot is None, body.mass.dtype)
        for body in ordered
    ]
    inertia, centre = joined(evaluated(_inertia, [(body,) for body in ordered], kinds))
    if moving is not bodies:
        frames = joined([body.frame for body in ordered])
    mass = stacked([body.mass for body in ordered])
    pieces = [part for body in ordered for part in body.free_velocity]
    velocity = array_of(np.concatenate(pieces)) if is_concrete(pieces) else jnp.concatenate(pieces)
    outside = outside_of_freedom(bodies.values(), [(joint, bodies_of(joint)) for joint in joints.values()])
    velocity = velocity if outside is False else jnp.where(outside, jnp.nan, velocity)
    if more := len(free) - len(ordered):
        add = lambda of, value: jnp.concatenate([of, jnp.broadcast_to(value, (more, *of.shape[1:])).astype(of.dtype)])
        mass, inertia, centre = add(mass, 1.0), add(inertia, 0.0), add(centre, 0.0)
        frames = Frame(add(frames.position, 0.0), add(frames.orientation, np.eye(3)))
        velocity = jnp.concatenate([velocity, jnp.zeros(sum(map(len, free[len(ordered) :])), mass.dtype)])
    return MultibodySystem(
        mass=mass,
        inertia=inertia,
        pose=Pose(*frames),
        velocity=velocity,
        centre=centre if any(body.pivot is not None for body in ordered) else None,
        constraints=stack(constraints),
        loads=stack(loads),
        given=given_joints(between, given) if parts is None else (),
        parts=parts,
        body_names=names,
        free=tuple(free),
        assembled=all(joint.assembled for joint in joints.values()),
        linear_solver=None,
        minimum_norm=False,
    )


def _kind(member: AbstractJoint | AbstractConnection) -> Hashable:
    """What joints have in common whose constraints are made by the same operations, and forces whose loads are."""
    fields = [getattr(member, field.name) for field in dataclasses.fields(member) if field.name not in ("a", "b")]
    leaves, structure = jax.tree.flatten(fields, is_leaf=lambda x: x is None)
    return type(member), structure, tuple((leaf.shape, leaf.dtype) if eqx.is_array(leaf) else leaf for leaf in leaves)


def _constraints(joint: AbstractJoint, *frames_and_parts: Frame | None):
    """The constraints of a joint between its bodies, their frames, and the poses of merged parts there; its numbers."""
    frames, parts = frames_and_parts[: len(frames_and_parts) // 2], frames_and_parts[len(frames_and_parts) // 2 :]
    ends = list(_or_ground(frames))
    constraints = tuple(carried(element, *parts) for element in joint.constraints(*ends))
    return constraints, numbers_of(joint, ends[0].position.dtype)


def _load(force: AbstractConnection, a: Frame | None, b: Frame | None, *parts: Frame | None):
    """The load of a force between its bodies, likewise."""
    return carried(force.load(*_or_ground((a, b))), *parts)


def _or_ground(frames):
    ground = ground_frame(next(end.position.dtype for end in frames if end is not None))
    return (ground if end is None else end for end in frames)


def _is_connection(force: AbstractForce) -> TypeGuard[AbstractConnection]:
    """One of one's own may have other loads than its base class says."""
    return isinstance(force, AbstractConnection) and type(force).loads is AbstractConnection.loads


def _attached(
    name: str, force: AbstractForce, bodies: Mapping[str, RigidBody], rows: Mapping[str, StackRow], places: Placements
) -> list[tuple[Any, str | None, str | None]]:
    """The loads of a force, or their rows, each with the names of its bodies; `rows`: of connections."""
    if name in rows:
        return [(rows[name], force.bodies[0], force.bodies[1])]
    return [(carried(load, places[a].offset, places[b].offset), a, b) for load, a, b in force.loads(bodies)]


def _inertia(body: RigidBody):
    return body.frame_inertia, body.centre
