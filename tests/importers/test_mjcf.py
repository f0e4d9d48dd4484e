"""Trees and a loop in MJCF, an arm in URDF: accelerations are those of MuJoCo's own forward dynamics."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.dynamics import fixed_velocity_rate

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")
DATA = Path(__file__).parent / "data"
# what our models do not have
ABSENT = sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")) for name in ("CONTACT", "LIMIT", "FRICTIONLOSS"))


def reference(source, qpos, qvel, ctrl):
    """The model, and the data of `mj_forward`."""
    text = source.read_text(encoding="utf-8") if isinstance(source, Path) else source
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= ABSENT
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
    mujoco.mj_forward(model, data)
    return model, data


def random_state(source, seed):
    model = reference(source, 0.0, 0.0, 0.0)[0]
    rng = np.random.default_rng(seed)
    qpos, qvel = model.qpos0.copy(), rng.normal(size=model.nv)
    mujoco.mj_integratePos(model, qpos, 0.4 * rng.normal(size=model.nv), 1.0)
    return qpos, qvel, rng.uniform(-0.9, 0.9, size=model.nu)


@eqx.filter_jit
def equations(system):
    """q, v, M, B, r and γ at the start, at rest and without multipliers."""
    (q, v), t = system.reference(), jnp.zeros(())
    force = system.residual(q, v, jnp.zeros_like(v), jnp.zeros(len(system.constraint_names)), t)
    jacobian = system.constraint_jacobian(q, t)
    return q, v, system.mass_matrix(), jacobian, force, fixed_velocity_rate(system, q, v, t), system.constraint(q, t)


def start(model):
    """System, q, v, v̇ at the start: M v̇ + r + Bᵀλ = 0, B v̇ + γ = 0; least squares where equations are redundant.

    The loops of bodies close, and their velocities are consistent, to the round-off of positions of 1 m and 1 m/s.
    """
    system = model.system()
    q, v, *numbers = equations(system)
    mass, jacobian, force, gamma, gaps = map(np.asarray, numbers)
    m = len(jacobian)
    assert np.abs(gaps).max(initial=0) < 1e-13 and np.abs(jacobian @ v).max(initial=0) < 1e-13
    matrix = np.block([[mass, jacobian.T], [jacobian, np.zeros((m, m))]])
    solution = np.linalg.lstsq(matrix, -np.concatenate([force, gamma]))[0]
    return system, q, v, jnp.asarray(solution[: len(mass)])


def compare(model, data, imported, tolerance=1e-9):
    """Of each body ẍ of its centre of mass and ω̇ against J q̈ + J̇ q̇, relative to the largest joint acceleration."""
    system, q, v, vdot = start(imported.model)
    worst, asked = 0.0, 0
    for i, name in enumerate(system.body_names):
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body < 0:
            continue  # a rotor
        centre, axes, *_, acceleration, change = system.motion(i, q, v, vdot)
        of_point, of_turn, rate, turn_rate = (np.zeros((3, model.nv)) for _ in range(4))
        mujoco.mj_jac(model, data, of_point, of_turn, np.asarray(centre), body)
        mujoco.mj_jacDot(model, data, rate, turn_rate, np.asarray(centre), body)
        expected = of_point @ data.qacc + rate @ data.qvel, of_turn @ data.qacc + turn_rate @ data.qvel
        worst = max(worst, np.abs(acceleration - expected[0]).max(), np.abs(axes @ change - expected[1]).max())
        asked += 1
    assert asked == len(imported.report.bodies)
    # round-off 1e-16 times the condition of M with rotors of 0.004 kg m² beside bodies of 1 kg, some 1e4
    assert worst < tolerance * (1.0 + np.abs(data.qacc).max())


SLOW = pytest.mark.slow  # ten seconds of processor each


@pytest.mark.slow  # `test_accelerations_of_an_arm_in_urdf` is in the quick run
@pytest.mark.parametrize("name", ["cart", pytest.param("arm", marks=SLOW), pytest.param("figure", marks=SLOW)])
def test_accelerations_of_trees(name):
    """Hinges, slides, balls and a free base; several joints on one body; springs, dampers, armature, motors, servos."""
    path = DATA / f"{name}.xml"
    for seed in range(3):
        qpos, qvel, ctrl = random_state(path, seed)
        imported = lg.importers.mjcf(path, qpos=qpos, qvel=qvel, ctrl=ctrl)
        compare(*reference(path, qpos, qvel, ctrl), imported)


def test_accelerations_of_an_arm_in_urdf():
    text = (DATA / "arm.urdf").read_text(encoding="utf-8").replace("MIMIC", "")
    qpos, qvel, _ = random_state(text, 0)
    imported = lg.importers.urdf(text, qpos=qpos, qvel=qvel)
    compare(*reference(text, qpos, qvel, 0.0), imported)
    assert set(imported.report.dropped) == {
        "limit of the joint: slew, reach",
        "limit of the forces of actuators on the joint: slew, reach",
        "dry friction of the joint: elbow",
    }


def by_hand(mass=2.5, drive=0.7):
    """The four-bar of the file in its plane, with bodies of three freedoms and hinges of our own."""
    end = np.array([0.6753277879007873, 0.0, 0.4842074344021209])
    axis = (0.0, -1.0, 0.0)
    coupler = np.array([[0.01, 0.0, -0.02], [0.0, 0.11, 0.0], [-0.02, 0.0, 0.1]])
    bodies = {
        "crank": lg.RigidBody(1.2, (0.01, 0.01, 0.0008), (0.0, 0.0, 0.15), free="x z ry"),
        "coupler": lg.RigidBody(mass, coupler, (0.33, 0.0, 0.37), free="x z ry"),
        "rocker": lg.RigidBody(1.9, (0.04, 0.04, 0.002), (0.74, 0.0, 0.24), free="x z ry"),
        "rotor": lg.RigidBody(1.0, (0.05, 0.05, 0.05), free="rx"),
    }
    joints = {
        "drive": lg.RevoluteJoint(None, "crank", at=np.zeros(3), axis=axis),
        "crank end": lg.RevoluteJoint("crank", "coupler", at=(0.0, 0.0, 0.3), axis=axis),
        "closure": lg.RevoluteJoint("coupler", "rocker", at=end, axis=axis),
        "pin": lg.RevoluteJoint(None, "rocker", at=(0.8, 0.0, 0.0), axis=axis),
    }
    turn = lg.RevoluteJoint(None, "rotor", at=np.zeros(3), axis=(1.0, 0.0, 0.0))
    joints["armature"] = lg.CoordinateCoupling(joints["drive"], turn)
    forces = {
        "weight": lg.Gravity((0.0, 0.0, -9.81)),
        "motor": lg.TorsionSpringDamper(None, "crank", axis=axis, damping=0.2, motor=2.0 * drive),
        "spring": lg.TorsionSpringDamper(None, "rocker", axis=axis, stiffness=4.0, damping=0.1),
    }
    return lg.Model(bodies, joints, forces)


def test_the_loop_of_a_four_bar():
    """A ball joint in a plane, closed where it is read."""
    imported = lg.importers.mjcf(DATA / "four_bar.xml", ctrl=[0.7])
    assert imported.report.loops == {"closure": "SphericalJoint"}
    assert any("repeat others" in note for note in imported.report.notes)
    system = imported.model.system()
    q, v = system.reference()
    violation, jacobian = jax.jit(lambda system: (system.constraint(q, 0.0), system.constraint_jacobian(q, 0.0)))(
        system
    )
    assert np.abs(violation).max() < 1e-13 and np.abs(jacobian @ v).max() < 1e-13
    rank = np.linalg.matrix_rank(jacobian, tol=1e-8)  # three bars and a rotor, one freedom
    assert len(v) - rank == 1 and rank < len(jacobian)


@pytest.mark.slow  # small versions: test_the_loop_of_a_four_bar, test_equalities_of_joints
def test_four_bar_is_that_by_hand():
    """Accelerations at rest, in the plane; of MuJoCo to what its soft loop allows."""
    imported = lg.importers.mjcf(DATA / "four_bar.xml", ctrl=[0.7])
    (ours, _, _, of_ours), (own, _, _, of_own) = start(imported.model), start(by_hand())
    ours_at, own_at = ours.twists(of_ours), own.twists(of_own)
    assert np.abs(ours_at).max() > 1.0
    for name in ("crank", "coupler", "rocker"):
        pair = ours_at[ours.body_names.index(name)], own_at[own.body_names.index(name)]
        # body axes: those of principal inertia in the file, of the ground by hand; both turn about y
        np.testing.assert_allclose(pair[0][:3], pair[1][:3], atol=1e-10)
        np.testing.assert_allclose(np.linalg.norm(pair[0][3:]), np.abs(pair[1][4]), atol=1e-10)


PENDULUM = """
<mujoco><worldbody><body name="bob" pos="0 0 1" euler="0 40 0">
  <joint name="pin" axis="0 1 0" damping="0.1" armature="0.05"/><geom size="0.1" pos="0 0 -0.5"/>
</body></worldbody><actuator><motor name="drive" joint="pin" gear="3"/></actuator></mujoco>
"""


def check_gradients(source, joint, leaves):
    """Of an angle after 50 ms by numbers of the model that was read, against differences."""
    imported = lg.importers.mjcf(source, ctrl=[0.7]).model

    def angle(model):
        return lg.simulate(model, t1=0.05, num_steps=5).joint(joint).coordinates["angle"][-1]

    value_and_gradient = eqx.filter_jit(eqx.filter_value_and_grad(angle))
    _, gradient = value_and_gradient(imported)
    for leaf in leaves:
        moved = [value_and_gradient(eqx.tree_at(leaf, imported, leaf(imported) * (1.0 + h)))[0] for h in (1e-4, -1e-4)]
        difference = (moved[0] - moved[1]) / 2e-4
        assert abs(difference) > 1e-7
        # differences of second order in steps of 1e-4: 1e-8 of the third derivative, and round-off 1e-14/1e-4
        np.testing.assert_allclose(jnp.sum(leaf(gradient) * leaf(imported)), difference, rtol=1e-6, atol=1e-9)


@pytest.mark.slow  # two programs; a loop's, with its notebook, is there too
def test_gradients_of_what_was_read():
    """By a mass, the inertia of a rotor, the place of a hinge, a torque."""
    leaves = (
        lambda model: model.bodies["bob"].mass,
        lambda model: model.bodies["pin rotor"].inertia,
        lambda model: model.joints["pin"].at,
        lambda model: model.forces["drive motor"].motor,
    )
    check_gradients(PENDULUM, "pin", leaves)


@pytest.mark.slow  # two minutes of processor: a loop with equations that repeat each other
def test_gradients_of_a_loop():
    leaves = (
        lambda model: model.bodies["coupler"].mass,
        lambda model: model.bodies["drive rotor"].inertia,
        lambda model: model.forces["motor motor"].motor,
    )
    check_gradients(DATA / "four_bar.xml", "drive", leaves)


EQUALITIES = """
<mujoco><worldbody>
  <body name="one"><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0.3 0 0"/></body>
  <body name="two" pos="1 0 0"><joint name="b" type="slide" axis="0 0 1"/><geom size="0.1"/><site name="s"/></body>
  <body name="three" pos="2 0 0"><joint name="c" axis="0 1 0"/><geom size="0.1"/></body>
</worldbody><equality>
  <joint name="cam" joint1="b" joint2="a" polycoef="0.1 0.5 0.2 0 0"/>
  <joint name="lock" joint1="c" polycoef="0.3 0 0 0 0"/>
  <weld name="off" body1="one" body2="two" active="false"/>
</equality><sensor><jointpos joint="a"/></sensor></mujoco>
"""


@pytest.mark.slow
def test_equalities_of_joints():
    """q_b − 0.1 = 0.5 q_a + 0.2 q_a² and q_c = 0.3, from a configuration that satisfies them."""
    qpos = np.array([0.4, 0.1 + 0.5 * 0.4 + 0.2 * 0.4**2, 0.3])
    imported = lg.importers.mjcf(EQUALITIES, qpos=qpos, qvel=[1.0, 0.5 + 0.4 * 0.4, 0.0])
    system, _, _, vdot = start(imported.model)
    assert imported.report.loops == {"cam": "CoordinateCoupling", "lock": "RotationDriver"}
    np.testing.assert_allclose(imported.model.joints["cam"].coefficients, [0.5 + 0.4 * 0.4, 0.2], rtol=1e-14)
    mass, arm, inertia = 1000.0 * 4 / 3 * np.pi * 1e-3, 0.3, 0.4 * 1e-2 * (4 / 3 * np.pi)
    # Lagrange: (J + m l² + m p'²) q̈ + m p' p'' q̇² = m g (l cos q − p'), with the rates of p there
    slope, curvature = 0.5 + 0.4 * 0.4, 0.4
    pull = mass * 9.81 * (arm * np.cos(0.4) - slope) - mass * slope * curvature
    expected = pull / (inertia + mass * (arm**2 + slope**2))
    twists = system.twists(vdot)
    np.testing.assert_allclose(np.linalg.norm(twists[system.body_names.index("one"), 3:]), abs(expected), rtol=1e-10)
    assert set(imported.report.dropped) == {"off: not active", "contacts of 3 geoms", "1 sensors"}
    with pytest.raises(ValueError, match="misses 'cam' by"):
        lg.importers.mjcf(EQUALITIES, qpos=np.array([0.4, 0.0, 0.3]))
    followed = lg.importers.mjcf(EQUALITIES).model  # the others follow from a = 0
    np.testing.assert_allclose(followed.bodies["two"].position, [1.0, 0.0, 0.1], atol=1e-15)


def test_mimic_joints_are_coupled():
    text = (DATA / "arm.urdf").read_text(encoding="utf-8")
    text = text.replace("</robot>", '<transmission name="t"/></robot>')
    imported = lg.importers.urdf(text.replace("MIMIC", '<mimic joint="elbow" multiplier="-0.5" offset="0.2"/>'))
    assert "1 elements <transmission>" in imported.report.dropped
    (coupling,) = imported.report.loops
    np.testing.assert_allclose(imported.model.joints[coupling].coefficients, [-0.5])


WRONG = {
    "no MJCF": (lambda: lg.importers.mjcf("<robot/>"), "it has no element <mujoco>"),
    "nothing": (lambda: lg.importers.mjcf(""), "`source` must be the path of a file, or its text, got ''"),
    "nothing moves": (lambda: lg.importers.mjcf("<mujoco/>"), "no body can move"),
    "not read": (lambda: lg.importers.mjcf("<mujoco><nothing/></mujoco>"), "MuJoCo cannot read it"),
    "qpos": (lambda: lg.importers.mjcf(EQUALITIES, qpos=[0.0]), "`qpos` must be 3 finite numbers"),
    "keyframe": (lambda: lg.importers.mjcf(EQUALITIES, keyframe="home"), "'home' is not one of"),
    "slides": (
        lambda: lg.importers.mjcf(
            '<mujoco><worldbody><body name="b"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="1 1 0"/>'
            '<geom size="1"/></body></worldbody></mujoco>'
        ),
        "its slides are not orthogonal; put a body with a mass between them",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_bad_input(name):
    make, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        make()


def test_the_report_says_what_there_is():
    """Every thing of the arm that acts, and what was not carried over."""
    report = lg.importers.mjcf(DATA / "arm.xml").report
    assert report.bodies == ("shoulder", "upper", "fore", "hand")
    assert report.joints["roll + bend + twist"] == "SerialJoint"
    assert report.forces["servo motor"] == report.forces["pitch spring"] == "CoordinateForce"
    assert report.notes == ("plate: without joints, parts of 'hand'",)
    assert report.dropped == (
        "limit of the joint: pitch",
        "dry friction of the joint: elbow",
        "limit of the actuator's control: turn",
    )
    assert "Not carried over (3):" in repr(report)
