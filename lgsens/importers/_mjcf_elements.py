"""The joints, equalities and actuators of a compiled MuJoCo model as elements of lgsens.

MuJoCo's generalized forces act on joint coordinates q: −k (q − q_s) of a spring, −c q̇ of a damper, −a q̈ of the
armature, and of an actuator with the length l = g q over a gear g the force g (u g₀ + b₀ + b₁ l + b₂ l̇). Here q is
s + q_r: the coordinate s of a joint is zero where q = q_r, in the reference configuration.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from lgsens.importers._mjcf_source import BALL, FREE, HINGE, SLIDE, Source
from lgsens.importers._report import made
from lgsens.importers._serial import ANGLES, Gimbal, SerialJoint, rotation
from lgsens.model import (
    AbstractForce,
    AbstractJoint,
    AppliedForce,
    CoordinateCoupling,
    CoordinateForce,
    FixedJoint,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    RotationalSpringDamper,
    RotationDriver,
    SphericalJoint,
    TranslationDriver,
)

_ALIGNED = 1e-9  # of unit axes, and of places relative to the scene: as one
_CLOSED = 1e-3  # m or rad by which a configuration may miss an equality


class Axis(NamedTuple):
    """The coordinate of a hinge or slide: that of a joint by its name, and q where it is zero."""

    joint: AbstractJoint
    name: str | None
    origin: float


@dataclasses.dataclass
class Found:
    """What the joints of a file became; `axes`: the coordinates of its hinges and slides by their number."""

    joints: dict[str, AbstractJoint] = dataclasses.field(default_factory=dict)
    rotors: dict[str, RigidBody] = dataclasses.field(default_factory=dict)
    forces: dict[str, AbstractForce] = dataclasses.field(default_factory=dict)
    axes: dict[int, Axis] = dataclasses.field(default_factory=dict)


def between_bodies(read: Source, groups: dict[int, list[int]]) -> Found:
    """The joints between bodies and their parents, with springs, dampers and rotors."""
    model, found = read.model, Found()
    for root, parts in groups.items():
        parent, child = read.mover(int(model.body_parentid[root])), read.body_name(root)
        first = int(model.body_jntadr[root])
        own = range(first, first + int(model.body_jntnum[root]))
        for joint in own:
            if read.kind(joint) == FREE:
                lost = [what for what in ("dof_armature", "dof_damping") if read.of_dofs(what, joint)]
                lost += ["jnt_stiffness"] if model.jnt_stiffness[joint] else []
                read.dropped += [f"{what.split('_')[1]} of the free joint of {child}" for what in lost]
            elif read.kind(joint) == BALL:
                _ball(read, found, joint, parent, child)
        hinges, slides = ([i for i in own if read.kind(i) == kind] for kind in (HINGE, SLIDE))
        if (hinges or slides) and len(hinges) + len(slides) < len(own):
            raise ValueError(
                f"{read.name}: body {child!r} has a ball joint and others; put a body with a mass between them."
            )
        if hinges or slides:
            _in_a_row(read, found, [*own], parent, child)
        weightless = [(part, model.body_gravcomp[part]) for part in parts if model.body_gravcomp[part]]
        for part, share in weightless if not read.disabled("GRAVITY") else ():
            lift = -share * model.body_mass[part] * model.opt.gravity
            name = f"{read.body_name(part)} gravity compensation"
            found.forces[name] = made(AppliedForce, child, at=read.data.xipos[part], force=lift)
    for joint, axis in found.axes.items():
        _spring(read, found, joint, axis)
        _rotor(read, found, joint, axis)
    return found


def _in_a_row(read: Source, found: Found, own: list[int], a: str | None, b: str) -> None:
    """Hinges and slides of one body."""
    data = read.data
    axis = {i: data.xaxis[i] / np.linalg.norm(data.xaxis[i]) for i in own}
    kinds = "".join(read.kind(i)[0] for i in own)
    hinges, slides = ([i for i in own if read.kind(i) == kind] for kind in (HINGE, SLIDE))
    at = _common_point(read, hinges, b) if hinges else data.xanchor[own[0]]
    for i in own:
        kind, (first, second) = read.kind(i), (a, b)
        if kind == SLIDE and kinds == "h" * len(hinges) + "s" * len(slides) and hinges:  # its axis turns with b
            joint = made(PrismaticJoint, b, a, at=at, axis=-axis[i])
        elif kind == SLIDE:
            joint = made(PrismaticJoint, first, second, at=at, axis=axis[i])
        else:
            joint = made(RevoluteJoint, first, second, at=at, axis=axis[i])
        found.axes[i] = Axis(joint, None, read.turned(i) + read.zero(i))
    if len(hinges) > 1:
        _angles(read, found, hinges, axis, at, a, b)
    name = " + ".join(map(read.joint_name, own))
    if len(own) == 1:
        found.joints[name] = found.axes[own[0]].joint
        return
    if any(abs(axis[i] @ axis[j]) > _ALIGNED for i in slides for j in slides if i < j):
        _refuse(read, b, "its slides are not orthogonal")
    directions = lambda some: np.array([axis[i] for i in some]).reshape(-1, 3)
    if kinds == "s" * len(slides) + "h" * len(hinges):
        serial = made(SerialJoint, a, b, at=at, slides=directions(slides), hinges=directions(hinges))
    elif kinds == "h" * len(hinges) + "s" * len(slides):
        serial = made(SerialJoint, b, a, at=at, slides=directions(slides), hinges=directions(hinges[::-1]))
    else:
        _refuse(read, b, "it has slides before and after hinges")
    if len(own) < 6:
        found.joints[name] = serial


def _refuse(read: Source, body: str, why: str):
    raise ValueError(f"{read.name}: body {body!r} has several joints, and {why}; put a body with a mass between them.")


def _common_point(read: Source, hinges: list[int], body: str) -> np.ndarray:
    """Where the axes of hinges meet: least Σ |(I − e eᵀ)(x − p)|², nearest to the first anchor."""
    anchors, axes = read.data.xanchor[hinges], read.data.xaxis[hinges]
    across = [np.eye(3) - np.outer(e, e) for e in axes]
    lhs, rhs = np.concatenate(across), np.concatenate([p @ (q - anchors[0]) for p, q in zip(across, anchors)])
    point = anchors[0] + np.linalg.lstsq(lhs, rhs, rcond=1e-9)[0]
    if max(np.linalg.norm(p @ (point - q)) for p, q in zip(across, anchors)) > _ALIGNED * max(
        read.model.stat.extent, 1
    ):
        _refuse(read, body, "the axes of its hinges do not meet in a point")
    return point


def _angles(read: Source, found: Found, hinges: list[int], axis, at, a, b: str) -> None:
    """The coordinates of two or three hinges by one rotation R_x(α) R_y(β) R_z(γ)."""
    turned = [read.turned(i) for i in hinges]
    x, y = axis[hinges[0]], axis[hinges[1]]
    if abs(x @ y) > _ALIGNED:
        _refuse(read, b, "the axes of two successive hinges are not orthogonal")
    y = rotation(x, -turned[0]) @ y
    axes_a = np.stack([x, y, np.cross(x, y)], axis=1)
    sign, seen = 1.0, rotation((1, 0, 0), turned[0]) @ rotation((0, 1, 0), turned[1])
    if len(hinges) == 3:
        sign = float(np.sign((axes_a @ seen)[:, 2] @ axis[hinges[2]]))
        if np.linalg.norm(axes_a @ seen[:, 2] * sign - axis[hinges[2]]) > _ALIGNED:
            _refuse(
                read, b, "the axes of its three hinges are not orthogonal to each other in the file's configuration"
            )
        seen = seen @ rotation((0, 0, 1), sign * turned[2])
    for i, coordinate, own in zip(hinges, ANGLES, (1.0, 1.0, sign)):
        if own > 0:
            joint = made(Gimbal, a, b, at=at, axes_a=axes_a, axes_b=axes_a @ seen)
        else:  # −γ about the opposite axis: the same rotation seen with x and z reversed
            joint = _reversed(a, b, at, axes_a, seen)
        found.axes[i] = Axis(joint, coordinate.name, read.zero(i))


def _reversed(a, b, at, axes_a, seen) -> Gimbal:
    """Turned by π about y: R_x(α) R_y(β) R_z(γ) becomes R_x(−α) R_y(β) R_z(−γ)."""
    flip = np.diag([-1.0, 1.0, -1.0])
    return made(Gimbal, a, b, at=at, axes_a=axes_a @ flip, axes_b=axes_a @ seen @ flip)


def _ball(read: Source, found: Found, joint: int, a: str | None, b: str) -> None:
    """A ball joint with its spring ½ k |φ|², φ the rotation vector from the springs' configuration."""
    model, name, at = read.model, read.joint_name(joint), read.data.xanchor[joint]
    found.joints[name] = ball = made(SphericalJoint, a, b, at=at)
    stiffness, damping = float(model.jnt_stiffness[joint]), read.of_dofs("dof_damping", joint)
    stiffness, damping = stiffness * (not read.disabled("SPRING")), damping * (not read.disabled("DAMPER"))
    if stiffness or damping:
        start, rest = (of[model.jnt_qposadr[joint] :][:4].copy() for of in (read.qpos, model.qpos_spring))
        phi, body = np.zeros(3), int(model.jnt_bodyid[joint])
        read.mujoco.mju_subQuat(phi, start, rest)  # in the axes of the body
        found.forces[f"{name} spring"] = made(
            RotationalSpringDamper,
            a,
            b,
            stiffness=stiffness,
            damping=damping,
            turned=read.data.xmat[body].reshape(3, 3) @ phi,
        )
    if armature := read.of_dofs("dof_armature", joint):
        rotor = f"{name} rotor"
        _, spin = read.velocity(model.jnt_bodyid[joint], at)
        _, base = read.velocity(model.body_parentid[model.jnt_bodyid[joint]], at)
        # R_c = R_aᵀR_b from the reference on, so that Ω_c is ω_b − ω_a in the axes of the ground
        found.rotors[rotor] = RigidBody(1.0, np.full(3, armature), at, angular_velocity=spin - base, free="rx ry rz")
        for axis in ball.coordinates:
            follows = CoordinateCoupling(ball, made(SphericalJoint, None, rotor, at=at), names=(axis.name, axis.name))
            found.joints[f"{name} armature {axis.name[-1]}"] = follows


def _spring(read: Source, found: Found, joint: int, axis: Axis) -> None:
    model, name = read.model, read.joint_name(joint)
    stiffness = 0.0 if read.disabled("SPRING") else float(model.jnt_stiffness[joint])
    damping = 0.0 if read.disabled("DAMPER") else read.of_dofs("dof_damping", joint)
    if stiffness or damping:
        free = float(model.qpos_spring[model.jnt_qposadr[joint]]) - axis.origin
        spring = made(CoordinateForce, axis.joint, axis.name, stiffness=stiffness, damping=damping, free=free)
        found.forces[f"{name} spring"] = spring


def _rotor(read: Source, found: Found, joint: int, axis: Axis) -> None:
    """A body of inertia a that turns by s about the x axis of the ground; a slide of 1 m turns it by 1 rad."""
    model, name = read.model, read.joint_name(joint)
    driving = np.flatnonzero((model.actuator_trnid[:, 0] == joint) & (model.actuator_trntype <= 1))
    armature = read.of_dofs("dof_armature", joint)
    armature += sum(float(model.actuator_armature[i]) * model.actuator_gear[i, 0] ** 2 for i in driving)
    if not armature:
        return
    rotor, along, at = f"{name} rotor", (1.0, 0.0, 0.0), read.data.xanchor[joint]
    rate = float(read.qvel[model.jnt_dofadr[joint]])
    start = joint_start(read, joint, axis)
    # its coordinate is zero where that of the joint is, which for the angles of a gimbal is not the reference
    found.rotors[rotor] = RigidBody(
        1.0,
        np.full(3, armature),
        at,
        rotation(along, start),
        angular_velocity=np.multiply(rate, along),
        free="rx",
    )
    turn = made(Gimbal, None, rotor, at=at, axes_a=np.eye(3), axes_b=rotation(along, start))
    found.joints[f"{name} armature"] = CoordinateCoupling(axis.joint, turn, names=(axis.name, ANGLES[0].name))


def joint_start(read: Source, joint: int, axis: Axis) -> float:
    """The coordinate s of a joint in the reference configuration."""
    return read.turned(joint) + read.zero(joint) - axis.origin


def loops(read: Source, found: Found) -> dict[str, AbstractJoint]:
    """The equalities."""
    model, closing = read.model, {}
    for i in range(model.neq):
        name, kind = read.named("equality", i), model.eq_type[i]
        if not model.eq_active0[i] or read.disabled("EQUALITY"):
            read.dropped.append(f"{name}: not active")
            continue
        if (missed := read.violation(i)) > _CLOSED:
            raise ValueError(
                f"{read.name}: the configuration misses {name!r} by {missed:.3g} m or rad; give `qpos` that closes it."
            )
        if missed > 1e-9:
            read.notes.append(f"{name}: holds bodies as they are in the configuration, which misses it by {missed:.1e}")
        if kind == read.code("mjEQ_JOINT"):
            closing[name] = _coupled(read, found, i)
        elif kind in (read.code("mjEQ_CONNECT"), read.code("mjEQ_WELD")):
            a, b, at = _ends(read, i)
            closing[name] = made(SphericalJoint if kind == read.code("mjEQ_CONNECT") else FixedJoint, a, b, at=at)
        else:
            kind = read.mujoco.mjtEq(kind).name.removeprefix("mjEQ_").lower()
            read.dropped.append(f"{name}: an equality of type {kind}")
    if closing:
        read.notes.append("equalities hold exactly, and not by MuJoCo's soft constraints (solref, solimp)")
    return closing


def _ends(read: Source, i: int):
    model, data = read.model, read.data
    first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
    if model.eq_objtype[i] == read.code("mjOBJ_SITE"):
        bodies = [int(model.site_bodyid[site]) for site in (first, second)]
        return *map(read.mover, bodies), data.site_xpos[first].copy()
    # a connect has its anchor in body 1 first, a weld that in body 2
    weld = model.eq_type[i] == read.code("mjEQ_WELD")
    body = second if weld else first
    at = data.xpos[body] + data.xmat[body].reshape(3, 3) @ model.eq_data[i, :3]
    return read.mover(first), read.mover(second), at


def _coupled(read: Source, found: Found, i: int) -> AbstractJoint:
    """q₁ − q₁⁰ = p(q₂ − q₂⁰) in the coordinates from the reference: p(x + x_r) − p(x_r)."""
    model = read.model
    first, second = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
    axis = found.axes[first]
    if second < 0:
        place = {"at": read.data.xanchor[first]} if read.kind(first) == SLIDE else {}
        driver = TranslationDriver if place else RotationDriver
        return made(driver, axis.joint.a, axis.joint.b, axis=read.data.xaxis[first], **place)
    shift = read.turned(second) - joint_start(read, second, found.axes[second])
    moved = np.polynomial.Polynomial(model.eq_data[i, :5])(np.polynomial.Polynomial([shift, 1.0])).coef
    last = max(np.flatnonzero(np.abs(moved) > 0), default=0)
    return CoordinateCoupling(
        axis.joint, found.axes[second].joint, moved[1 : max(last, 1) + 1], names=(axis.name, found.axes[second].name)
    )


def actuators(read: Source, found: Found) -> dict[str, AbstractForce]:
    """Motors and servos on hinges and slides, with the controls of the state."""
    model, motors = read.model, {}
    if read.disabled("ACTUATION"):
        read.dropped.append("actuators: disabled in the file")
        return motors
    for i in range(model.nactuator):
        name, joint = read.named("actuator", i), int(model.actuator_trnid[i, 0])
        on_joint = model.actuator_trntype[i] in (read.code("mjTRN_JOINT"), read.code("mjTRN_JOINTINPARENT"))
        bias = model.actuator_biastype[i]
        if not on_joint or joint not in found.axes:
            read.dropped.append(f"actuator {name}: acts on something other than a hinge or slide")
        elif (
            model.actuator_dyntype[i] != read.code("mjDYN_NONE")
            or model.actuator_gaintype[i] != read.code("mjGAIN_FIXED")
            or bias not in (read.code("mjBIAS_NONE"), read.code("mjBIAS_AFFINE"))
        ):
            read.dropped.append(f"actuator {name}: it has states of its own, or a gain or bias that is not affine")
        else:
            axis, gear = found.axes[joint], float(model.actuator_gear[i, 0])
            b0, b1, b2 = model.actuator_biasprm[i, :3] if bias == read.code("mjBIAS_AFFINE") else np.zeros(3)
            drag = 0.0 if read.disabled("DAMPER") else float(model.actuator_damping[i])
            push = gear * (float(model.actuator_gainprm[i, 0]) * _control(read, i) + b0)
            motors[f"{name} motor"] = made(
                CoordinateForce,
                axis.joint,
                axis.name,
                stiffness=-(gear**2) * b1,
                damping=gear**2 * (drag - b2),
                free=-axis.origin,
                motor=push,
            )
    return motors


def _control(read: Source, i: int) -> float:
    """The control, clipped to its range as MuJoCo does."""
    model = read.model
    value = float(read.data.ctrl[model.actuator_ctrladr[i]])
    if model.actuator_ctrllimited[i] and not read.disabled("CLAMPCTRL"):
        value = float(np.clip(value, *model.actuator_ctrlrange[i]))
    return value
