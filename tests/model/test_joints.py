"""Joints: how many equations, which motions they allow and forbid, whatever the bodies' orientation."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
import pytest
from helpers import EPS, close, random_body, some_quick
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.liegroups import Pose

AT, AT_B = np.array([0.3, -0.7, 1.1]), np.array([0.9, 0.2, 0.4])
AXIS = np.array([1.0, 2.0, -0.5])
AXIS_B = np.array([0.3, -1.0, 2.0])  # neither parallel nor orthogonal to AXIS
UNIT = AXIS / np.linalg.norm(AXIS)
ARM_B = AXIS_B - UNIT * (UNIT @ AXIS_B)  # the part that a universal joint uses
ACROSS = np.cross(UNIT, ARM_B) / np.linalg.norm(ARM_B)
ROD = (AT_B - AT) / np.linalg.norm(AT_B - AT)
ROD_NORMALS = np.linalg.svd(ROD[None])[2][1:]
EYE = np.eye(3)
ACROSS_UNIT = (ARM_B / np.linalg.norm(ARM_B), ACROSS)
ADVANCE, RACK, BESIDE = 0.4, AXIS_B / np.linalg.norm(AXIS_B), AT + 0.9 * ACROSS_UNIT[0]


class Displacement(NamedTuple):
    """A rigid displacement X → at + R (X − at) + slide."""

    rotation: np.ndarray
    at: np.ndarray
    slide: np.ndarray

    def point(self, x):
        return self.at + self.rotation @ (x - self.at) + self.slide

    def then(self, second):
        return Displacement(second.rotation @ self.rotation, self.at, second.point(self.point(self.at)) - self.at)

    def inverse(self):
        return Displacement(self.rotation.T, self.at + self.slide, -self.slide)


def turn(vector, at=AT):
    return Displacement(Rotation.from_rotvec(vector).as_matrix(), at, np.zeros(3))


def slide(vector):
    return Displacement(np.eye(3), AT, np.asarray(vector))


class Case(NamedTuple):
    """A joint: its equations; the twists (ω about a point, u) of b relative to a that it allows; …"""

    make: Callable
    equations: int
    turns: tuple[tuple[np.ndarray, np.ndarray], ...]
    slides: tuple[np.ndarray, ...]
    allowed: Displacement
    forbidden: tuple[Displacement, ...]
    twists: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...] = ()  # more of them, which are neither: ω, point, u


def about(*axes, at=AT):
    return tuple((axis, at) for axis in axes)


CASES = {
    "spherical": Case(
        lambda a, b, axis=AXIS: lg.SphericalJoint(a, b, at=AT),
        3,
        about(*EYE),
        (),
        turn([0.9, -1.2, 0.4]),
        (slide([0.3, 0.0, 0.0]), slide([0.0, 0.3, 0.0]), slide([0.0, 0.0, 0.3])),
    ),
    "revolute": Case(
        lambda a, b, axis=AXIS: lg.RevoluteJoint(a, b, at=AT, axis=axis),
        5,
        about(UNIT),
        (),
        turn(1.3 * UNIT),
        (turn(0.3 * ARM_B), turn(0.3 * ACROSS), slide(0.3 * UNIT), slide(0.3 * ACROSS)),
    ),
    "universal": Case(
        lambda a, b, axis=AXIS: lg.UniversalJoint(a, b, at=AT, axis_a=axis, axis_b=AXIS_B),
        4,
        about(UNIT, ARM_B),
        (),
        turn(-0.7 * ARM_B).then(turn(1.1 * UNIT)),
        (turn(0.3 * ACROSS), slide(0.3 * UNIT), slide(0.3 * ARM_B)),
    ),
    "prismatic": Case(
        lambda a, b, axis=AXIS: lg.PrismaticJoint(a, b, at=AT, axis=axis),
        5,
        (),
        (UNIT,),
        slide(1.7 * UNIT),
        (turn(0.3 * UNIT), turn(0.3 * ACROSS), slide(0.3 * ARM_B), slide(0.3 * ACROSS)),
    ),
    "cylindrical": Case(
        lambda a, b, axis=AXIS: lg.CylindricalJoint(a, b, at=AT, axis=axis),
        4,
        about(UNIT),
        (UNIT,),
        turn(-2.1 * UNIT).then(slide(0.8 * UNIT)),
        (turn(0.3 * ARM_B), turn(0.3 * ACROSS), slide(0.3 * ARM_B), slide(0.3 * ACROSS)),
    ),
    "fixed": Case(
        lambda a, b, axis=AXIS: lg.FixedJoint(a, b, at=AT),
        6,
        (),
        (),
        slide(np.zeros(3)),
        tuple(turn(0.3 * e) for e in EYE) + tuple(slide(0.3 * e) for e in EYE),
    ),
    "distance": Case(
        lambda a, b, axis=AXIS: lg.DistanceJoint(a, b, at_a=AT, at_b=AT_B),
        1,
        about(*EYE, at=AT_B),
        tuple(ROD_NORMALS),
        turn([0.5, -0.8, 1.5], at=AT_B).then(turn([1.0, 0.3, -0.6], at=AT)),
        (slide(0.3 * ROD),),
    ),
    "planar": Case(
        lambda a, b, axis=AXIS: lg.PlanarJoint(a, b, at=AT, axis=axis),
        3,
        about(UNIT),
        ACROSS_UNIT,
        turn(-2.1 * UNIT).then(slide(0.8 * ACROSS)),
        (turn(0.3 * ARM_B), turn(0.3 * ACROSS), slide(0.3 * UNIT)),
    ),
    "point on plane": Case(
        lambda a, b, axis=AXIS: lg.PointOnPlaneJoint(a, b, at=AT, axis=axis),
        1,
        about(*EYE),
        ACROSS_UNIT,
        turn([0.9, -1.2, 0.4]).then(slide(0.8 * ACROSS)),
        (slide(0.3 * UNIT),),
    ),
    "point on line": Case(
        lambda a, b, axis=AXIS: lg.PointOnLineJoint(a, b, at=AT, axis=axis),
        2,
        about(*EYE),
        (UNIT,),
        turn([0.9, -1.2, 0.4]).then(slide(0.8 * UNIT)),
        tuple(slide(0.3 * across) for across in ACROSS_UNIT),
    ),
    "screw": Case(  # more than a turn
        lambda a, b, axis=AXIS: lg.ScrewJoint(a, b, at=AT, axis=axis, pitch=2 * np.pi * ADVANCE),
        5,
        (),
        (),
        turn(7.5 * UNIT).then(slide(7.5 * ADVANCE * UNIT)),
        (turn(0.3 * ARM_B), turn(0.3 * ACROSS), slide(0.3 * ACROSS), slide(0.3 * UNIT), turn(UNIT)),
        ((UNIT, AT, ADVANCE * UNIT),),
    ),
    "rack and pinion": Case(
        lambda a, b, axis=AXIS: lg.RackAndPinionJoint(a, b, at=AT, axis=axis, direction=AXIS_B, radius=ADVANCE),
        1,
        about(*ACROSS_UNIT),
        tuple(np.linalg.svd(RACK[None])[2][1:]),
        turn(-7.5 * UNIT).then(slide(-7.5 * ADVANCE * RACK + 0.4 * np.cross(RACK, UNIT))),
        (turn(UNIT), slide(0.3 * RACK)),
        ((UNIT, AT, ADVANCE * RACK),),
    ),
    "gears": Case(  # b rolls around a, which it touches at a third of the distance, and moves out of its plane
        lambda a, b, axis=AXIS: lg.GearJoint(a, b, at_a=AT, at_b=BESIDE, axis_a=axis, axis_b=axis, ratio=-0.5, teeth=2),
        1,
        ((UNIT, AT + (BESIDE - AT) / 3), *about(*ACROSS_UNIT, at=BESIDE)),
        (UNIT, ARM_B),
        turn(0.5 * 7.5 * UNIT, at=BESIDE).then(turn(7.5 * UNIT)).then(slide(0.4 * UNIT)),
        (turn(0.3 * UNIT, at=BESIDE), slide(0.3 * ACROSS)),
    ),
    "constant velocity": Case(
        lambda a, b, axis=AXIS: lg.ConstantVelocityJoint(a, b, at=AT, axis_a=axis),
        4,
        about(*ACROSS_UNIT),
        (),
        turn(0.6 * ACROSS + 0.5 * ARM_B),
        (turn(0.3 * UNIT), *(slide(0.3 * e) for e in EYE)),
    ),
}
SIDES = {"two bodies": ("a", "b"), "ground first": (None, "b"), "ground last": ("a", None)}


def scene(name, side, seed=0, axis=AXIS, **body):
    rng = np.random.default_rng(seed)
    ends = SIDES[side]
    bodies = {end: random_body(rng, **body) for end in ends if end is not None}
    return lg.Model(bodies, {"joint": CASES[name].make(*ends, axis)})


@eqx.filter_jit
def evaluate(model, q):
    system = model.system()
    return system.constraint(q, 0.0), system.constraint_jacobian(q, 0.0)


def placed(model, displacements) -> Pose:
    """The bodies after a displacement of each."""
    position, orientation = [], []
    for name in sorted(model.bodies):
        body, displacement = model.bodies[name], displacements[name]
        position.append(displacement.point(np.asarray(body.position)))
        orientation.append(displacement.rotation @ np.asarray(body.orientation))
    return Pose(np.stack(position), np.stack(orientation))


REST = slide(np.zeros(3))


def configuration(model, side, relative, common=REST) -> Pose:
    """b displaced relative to a; then both by `common`, where neither is the ground."""
    if side == "two bodies":
        return placed(model, {"a": common, "b": relative.then(common)})
    return placed(model, {"b": relative} if side == "ground first" else {"a": relative.inverse()})


def motions(model, name, side) -> np.ndarray:
    """The velocities [ẋ, Ω] that the joint allows at the reference, relative and together, in rows."""
    case = CASES[name]
    relative = [(axis, at, np.zeros(3)) for axis, at in case.turns] + [(np.zeros(3), AT, u) for u in case.slides]
    relative += case.twists
    if side == "ground last" and name == "distance":
        relative = [(axis, AT if at is AT_B else at, u) for axis, at, u in relative]  # a turns about its own end
    movers = {"two bodies": "b", "ground first": "b", "ground last": "a"}[side]
    together = [] if side != "two bodies" else [(e, AT, np.zeros(3)) for e in EYE] + [(0 * e, AT, e) for e in EYE]
    rows = []
    for (omega, at, u), moving in [(twist, movers) for twist in relative] + [(twist, "ab") for twist in together]:
        row = []
        for body in sorted(model.bodies):
            pose, moves = model.bodies[body], float(body in moving)
            velocity = np.cross(omega, np.asarray(pose.position) - at) + u
            row += [moves * velocity, moves * np.asarray(pose.orientation).T @ omega]
        rows.append(np.concatenate(row))
    return np.array(rows).reshape(-1, 6 * len(model.bodies))


every_joint = pytest.mark.parametrize("name", CASES)
every_side = pytest.mark.parametrize("side", some_quick(SIDES, 2))

# Points lie within 3 m and axes have unit length; Φ and B sum about ten such products.
ULPS = 100


@every_side
@every_joint
def test_reference_satisfies_the_joint_and_the_null_space_is_its_motions(name, side):
    for seed in range(3):  # other positions and orientations of the bodies
        model = scene(name, side, seed)
        system = model.system()
        value, jacobian = evaluate(model, system.pose)
        assert value.shape == (CASES[name].equations,)
        assert system.constraint_names == ("joint",) * CASES[name].equations
        close(value, np.zeros_like(value), ULPS, scale=1.0)
        # Rank: B has rows of unit size, and no joint's rows are closer than 0.05 to dependent.
        assert np.linalg.svd(jacobian, compute_uv=False).min() > 0.05
        allowed = motions(model, name, side)
        assert allowed.shape[0] == jacobian.shape[1] - CASES[name].equations
        if allowed.size:
            assert np.linalg.svd(allowed, compute_uv=False).min() > 0.05
            close(jacobian @ allowed.T, np.zeros((len(value), len(allowed))), ULPS, scale=np.abs(allowed).max())


@every_side
@every_joint
def test_allowed_displacements_satisfy_the_joint(name, side):
    model = scene(name, side, seed=3)
    common = turn([1.0, -2.0, 0.5]).then(slide([0.4, 2.0, -1.0]))
    value, jacobian = evaluate(model, configuration(model, side, CASES[name].allowed, common))
    close(value, np.zeros_like(value), ULPS, scale=1.0)
    # Away from the reference the joint loses no equation: no angle of `allowed` is near a singular 90°.
    assert np.linalg.svd(jacobian, compute_uv=False).min() > 0.05


@every_side
@every_joint
def test_forbidden_displacements_violate_the_joint(name, side):
    model = scene(name, side, seed=4)
    for displacement in CASES[name].forbidden:
        value, _ = evaluate(model, configuration(model, side, displacement))
        # 0.3 rad or 0.3 m; the smallest first-order effect is that of the shorter arm, more than a tenth.
        assert np.abs(value).max() > 0.03


@every_joint
def test_velocities_seen_from_space_do_not_depend_on_body_frames(name):
    """B_θ Rᵀ acts on angular velocities in the inertial frame: the same for every choice of body axes."""
    jacobians = []
    for frames in (None, np.eye(3)):
        model = scene(name, "two bodies", 5, **({} if frames is None else {"orientation": frames}))
        positions = scene(name, "two bodies", 5).bodies
        model = eqx.tree_at(
            lambda m: [m.bodies[n].position for n in "ab"], model, [positions[n].position for n in "ab"]
        )
        _, jacobian = evaluate(model, model.system().pose)
        jacobian = np.array(jacobian).reshape(-1, 2, 2, 3)
        for i, body in enumerate("ab"):
            jacobian[:, i, 1] = jacobian[:, i, 1] @ np.asarray(model.bodies[body].orientation).T
        jacobians.append(jacobian)
    close(jacobians[0], jacobians[1], ULPS)


AXES = {
    "generic": AXIS,
    "x": np.array([1.0, 0.0, 0.0]),
    "-y": np.array([0.0, -1.0, 0.0]),
    "diagonal": np.ones(3),
}


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("name", ["revolute", "universal", "prismatic", "cylindrical", "screw"])
def test_length_of_the_axis_is_irrelevant(name, axis):
    model, scaled = (scene(name, "two bodies", axis=factor * AXES[axis]) for factor in (1.0, 7.0))
    q = configuration(model, "two bodies", CASES[name].forbidden[0])
    value, jacobian = evaluate(model, q)
    jacobian_scaled = evaluate(scaled, q)[1]
    close(evaluate(scaled, q)[0], value, ULPS)
    close(jacobian_scaled, jacobian, ULPS)
    assert np.linalg.svd(jacobian, compute_uv=False).min() > 0.05


def test_only_the_orthogonal_part_of_the_second_arm_counts():
    ends = "a", "b"
    rng = np.random.default_rng(6)
    bodies = {end: random_body(rng) for end in ends}
    arms = AXIS_B, 5.0 * (AXIS_B - 3.0 * AXIS)
    models = [lg.Model(bodies, {"j": lg.UniversalJoint(*ends, at=AT, axis_a=AXIS, axis_b=arm)}) for arm in arms]
    q = configuration(models[0], "two bodies", turn(0.3 * ACROSS))
    expected, actual = (evaluate(model, q) for model in models)
    close(actual[0], expected[0], ULPS, scale=1.0)
    close(actual[1], expected[1], ULPS)


def test_length_of_a_rod():
    """Φ = (d·d/L − L)/2: a rod e = 0.2 m longer than the distance |d| = L − e is violated by −e + e²/(2L) there."""
    rng = np.random.default_rng(7)
    distance = np.linalg.norm(AT_B - AT)
    joint = lg.DistanceJoint(None, "b", at_a=AT, at_b=AT_B, length=distance + 0.2)
    model = lg.Model({"b": random_body(rng)}, {"rod": joint})
    assert not model.system().assembled
    value, _ = evaluate(model, model.system().pose)
    assert abs(float(value[0]) + 0.2 - 0.2**2 / (2.0 * (distance + 0.2))) < 100 * EPS
