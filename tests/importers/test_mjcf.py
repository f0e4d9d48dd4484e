"""Trees and a loop in MJCF, an arm in URDF: accelerations are those of MuJoCo's own forward dynamics."""

from pathlib import Path

import equinox as eqx
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


@pytest.mark.parametrize("name", ["arm", "figure", "cart"])
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
