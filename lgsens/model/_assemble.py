"""The equations of motion of a scene, elements stacked by type."""

from collections.abc import Mapping

import jax.numpy as jnp

from lgsens.liegroups import Pose
from lgsens.model._body import RigidBody
from lgsens.model._carried import carried_constraint, carried_load
from lgsens.model._forces import AbstractForce, Gravity
from lgsens.model._frames import Frame, ground_frame
from lgsens.model._joints import AbstractJoint
from lgsens.model._loads import SpringDamperLoad
from lgsens.model._merge import Group, Place, Places, merged
from lgsens.model._needed import needed
from lgsens.model._parts import Parts
from lgsens.model._stack import Placed, stack, stacked
from lgsens.model._system import MultibodySystem


def assemble(
    bodies: Mapping[str, RigidBody], joints: Mapping[str, AbstractJoint], forces: Mapping[str, AbstractForce]
) -> MultibodySystem:
    """The equations of bodies whose orientations are rotations."""
    places: Places = {None: Place(None, None)} | {name: Place(name, None) for name in bodies}
    return _assemble(bodies, bodies, places, joints, forces)


def assemble_merged(
    bodies: Mapping[str, RigidBody],
    joints: Mapping[str, AbstractJoint],
    forces: Mapping[str, AbstractForce],
    found: tuple[Group, ...],
) -> MultibodySystem:
    """The equations of what fixed joints make of the bodies."""
    moving, places = merged(bodies, found)
    parts, names = assemble(bodies, joints, forces), sorted(moving)
    own = [places[name] for name in parts.body_names]
    here = ground_frame(parts.mass.dtype)
    offsets = [here if place.offset is None else place.offset for place in own]
    fixed: dict[str | None, list[str]] = {}
    for name, joint in sorted(joints.items()):
        if places[joint.a].body == places[joint.b].body and name in parts.constraint_names:
            fixed.setdefault(places[joint.a].body, []).append(name)
    seen = Parts(
        system=parts,
        offset=Frame(*map(jnp.stack, zip(*offsets))),
        body=tuple(None if place.body is None else names.index(place.body) for place in own),
        free=parts.free,
        fixed=tuple(map(tuple, fixed.values())),
    )
    return _assemble(moving, bodies, places, joints, forces, seen)


def _assemble(
    moving: Mapping[str, RigidBody],
    bodies: Mapping[str, RigidBody],
    places: Places,
    joints: Mapping[str, AbstractJoint],
    forces: Mapping[str, AbstractForce],
    parts: Parts[MultibodySystem] | None = None,
) -> MultibodySystem:
    """The equations of the `moving` bodies, to which joints and forces on the named `bodies` are attached.

    Names are sorted here and nowhere else: a dict comes out of `jit` sorted, so its own order cannot be relied on.
    """
    names = tuple(sorted(moving))
    ordered = [moving[name] for name in names]
    number = {None: None} | {name: i for i, name in enumerate(names)}
    ground = ground_frame(ordered[0].mass.dtype)
    frame = lambda name: ground if name is None else bodies[name].frame

    constraints = []
    for name, joint in sorted(joints.items()):
        a, b = places[joint.a], places[joint.b]
        if a.body == b.body:
            continue
        elements = joint.constraints(frame(joint.a), frame(joint.b))
        free = [() if end.body is None else moving[end.body].free for end in (a, b)]
        for i, (element, kept) in enumerate(zip(elements, needed(name, joint, elements, *free))):
            if any(kept):
                element = carried_constraint(element, a.offset, b.offset)
                constraints.append(Placed(element, number[a.body], number[b.body], name, kept, i))
    loads = []
    for name, force in sorted(forces.items()):
        # the weights of the parts of a body are a weight at its centre of mass
        for load, *ends in force.loads(moving if isinstance(force, Gravity) else bodies):
            a, b = (places[end] for end in ends)
            if a.body != b.body or (a.body is not None and not isinstance(load, SpringDamperLoad)):
                loads.append(Placed(carried_load(load, a.offset, b.offset), number[a.body], number[b.body], name))
    pivoted = any(body.pivot is not None for body in ordered)
    return MultibodySystem(
        mass=stacked([body.mass for body in ordered]),
        inertia=stacked([body.frame_inertia for body in ordered]),
        pose=Pose(
            stacked([body.frame.position for body in ordered]),
            stacked([body.orientation for body in ordered]),
        ),
        velocity=jnp.concatenate([part for body in ordered for part in body.free_velocity]),
        centre=stacked([body.centre for body in ordered]) if pivoted else None,
        constraints=stack(constraints),
        loads=stack(loads),
        parts=parts,
        body_names=names,
        free=tuple(body.coordinates for body in ordered),
        assembled=all(joint.assembled for joint in joints.values()),
        linear_solver=None,
        minimum_norm=False,
    )
