"""MJCF and URDF, read by MuJoCo's own parser, as a `Model`.

The parser's compiled model has every default applied, every inertia computed and every frame resolved. At a
configuration qpos its kinematics say where bodies, anchors and axes are, which is the reference configuration here, so
that all of lgsens' elements follow from inertial points and axes.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lgsens._validate import optional
from lgsens.importers._mjcf_elements import actuators, between_bodies, loops
from lgsens.importers._mjcf_source import Source
from lgsens.importers._report import Imported, Report, built, made
from lgsens.model import Gravity, RigidBody


def mjcf(source: str | Path, *, qpos: Any = None, qvel: Any = None, ctrl: Any = None, keyframe: Any = None) -> Imported:
    """A model from an MJCF file, whose accelerations are those of MuJoCo without contacts and limits.

    Hinge, slide, ball and free joints, several on one body too, become joints or none; springs, dampers, motors and
    servos act on their coordinates; `armature` is a rotor that turns with the joint and has no other effect
    (`CoordinateCoupling`). Bodies without joints are parts of their parents. `connect`, `weld` and `joint` equalities
    close loops, exactly and not as springs.

    Arguments:
        source: the path of a file, or its text.
        qpos: the configuration that is the reference and the start, in MuJoCo's order, shape (nq,); None: that of the
            file, where coordinates that a `joint` equality gives follow from the others.
        qvel: the velocities there, shape (nv,); None: 0.
        ctrl: the controls, shape (nu,); None: 0. They are the constant `motor` of the forces, a leaf that may be
            replaced, by a signal too.
        keyframe: name or number of a keyframe of the file, in place of the three before.

    The gradient with respect to the model is that of lgsens' elements: by masses, inertias, the places `at` of joints.
    `report` says what was not carried over: contacts, limits, friction, tendons.

    Raises `ImportError` without MuJoCo (`pip install "lgsens[mujoco]"`), `ValueError` for what MuJoCo cannot read, a
    configuration of a wrong shape or that does not close the loops, and joints in a row that need a body between them.
    """
    return _imported(source, "MJCF", qpos, qvel, ctrl, keyframe)


def urdf(source: str | Path, *, qpos: Any = None, qvel: Any = None) -> Imported:
    """A model from a URDF file: links on fixed, revolute, continuous, prismatic and floating joints, as in `mjcf`.

    The root link is the ground; `mimic` joints are coupled. Meshes are not needed: the inertias are those of the file.

    Arguments:
        source: the path of a file, or its text.
        qpos, qvel: the start, as in `mjcf`.

    Raises as `mjcf` does.
    """
    return _imported(source, "URDF", qpos, qvel, None, None)


def _imported(source, kind: str, qpos, qvel, ctrl, keyframe) -> Imported:
    read = Source(optional("mujoco", f"importers.{kind.lower()}", "mujoco"), source, kind, qpos, qvel, ctrl, keyframe)
    groups = _groups(read)
    bodies = {read.body_name(root): _body(read, root, parts) for root, parts in groups.items()}
    if not bodies:
        raise ValueError(f"{read.name}: no body can move; give the file a joint.")
    read.notes += [
        f"{', '.join(read.body_name(part) for part in parts if part != root)}: without joints, parts of "
        f"{read.body_name(root)!r}"
        for root, parts in groups.items()
        if len(parts) > 1
    ]
    found = between_bodies(read, groups)
    closing = loops(read, found)
    forces = found.forces | actuators(read, found)
    gravity = read.model.opt.gravity
    if gravity.any() and not read.disabled("GRAVITY"):
        forces["gravity"] = made(Gravity, gravity)
    joints = found.joints | closing
    model, notes = built(bodies | found.rotors, joints, forces, check=bool(closing))
    read.notes += notes
    types = lambda of: {name: type(each).__name__ for name, each in of.items()}
    dropped = (*read.dropped, *_dropped(read))
    return Imported(
        model,
        Report(
            read.name, tuple(bodies), types(found.joints), types(closing), types(forces), tuple(read.notes), dropped
        ),
    )


def _groups(read: Source) -> dict[int, list[int]]:
    """The bodies that move as one, by the one that has the joints."""
    groups: dict[int, list[int]] = {}
    for body in range(1, read.model.nbody):
        if root := int(read.model.body_weldid[body]):
            groups.setdefault(root, []).append(body)
    return groups


def _body(read: Source, root: int, parts: list[int]) -> RigidBody:
    """m = Σ m_i, x = Σ m_i x_i / m, and J = Σ R_i J_i R_iᵀ + m_i (|d_i|² I − d_i d_iᵀ) about x."""
    model, data = read.model, read.data
    mass = model.body_mass[parts]
    total = mass.sum()
    if not total > 0:
        raise ValueError(f"{read.name}: body {read.body_name(root)!r} moves and has no mass; give it one.")
    centre = mass @ data.xipos[parts] / total
    axes = data.ximat[root].reshape(3, 3)
    if len(parts) == 1:
        inertia = model.body_inertia[root]
    else:
        inertia = np.zeros((3, 3))
        for part, m in zip(parts, mass):
            own, d = data.ximat[part].reshape(3, 3), data.xipos[part] - centre
            inertia += own * model.body_inertia[part] @ own.T + m * (d @ d * np.eye(3) - np.outer(d, d))
        inertia = axes.T @ inertia @ axes
        inertia = (inertia + inertia.T) / 2
    velocity, spin = read.velocity(root, centre)
    return RigidBody(total, inertia, centre, axes, velocity, axes.T @ spin)


class _Feature(NamedTuple):
    """Numbers of the compiled model that must be zero, and what it means if they are not; `of`: whose they are."""

    field: str
    meaning: str
    of: str = ""


_FEATURES = (
    _Feature("jnt_limited", "limit of the joint", "joint"),
    _Feature("jnt_stiffnesspoly", "stiffness polynomial of the joint", "joint"),
    _Feature("jnt_springyield", "yield of the joint's spring", "joint"),
    _Feature("jnt_actfrclimited", "limit of the forces of actuators on the joint", "joint"),
    _Feature("dof_frictionloss", "dry friction of the joint", "dof"),
    _Feature("dof_dampingpoly", "damping polynomial of the joint", "dof"),
    _Feature("actuator_forcelimited", "limit of the actuator's force", "actuator"),
    _Feature("actuator_ctrllimited", "limit of the actuator's control", "actuator"),
    _Feature("actuator_dampingpoly", "damping polynomial of the actuator", "actuator"),
    _Feature("actuator_plugin", "plugin of the actuator", "actuator"),
    _Feature("body_plugin", "plugin of the body", "body"),
)
_COUNTS = (
    ("npair", "explicit contact pairs"),
    ("ntendon", "tendons, with what acts on them"),
    ("nmocap", "mocap bodies, which stay where they are"),
    ("nflex", "flexible bodies"),
    ("nsensor", "sensors"),
)


def _dropped(read: Source) -> list[str]:
    """What the compiled model has and ours has not."""
    model, found = read.model, []
    touching = int(((model.geom_contype != 0) | (model.geom_conaffinity != 0)).sum()) if model.ngeom else 0
    if touching and not read.disabled("CONTACT"):
        found.append(f"contacts of {touching} geoms")
    for feature in _FEATURES:
        numbers = np.asarray(getattr(model, feature.field))
        absent = -1 if feature.field.endswith("plugin") else 0
        places = np.flatnonzero((numbers.reshape(len(numbers), -1) != absent).any(axis=1)) if len(numbers) else []
        if len(places):
            of = {"dof": lambda i: read.joint_name(int(model.dof_jntid[i]))}.get(
                feature.of, lambda i, kind=feature.of: read.named(kind, int(i))
            )
            found.append(f"{feature.meaning}: {', '.join(dict.fromkeys(of(i) for i in places))}")
    found += [f"{getattr(model, count)} {meaning}" for count, meaning in _COUNTS if getattr(model, count)]
    option = model.opt
    if option.density or option.viscosity:
        found.append(f"forces of the medium, density {option.density:g} kg/m³ and viscosity {option.viscosity:g} Pa s")
    return found
