"""Energy of bodies on elements that store and lose it: what is missing is what the elements took, to the order h²."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgsens as lg

X, ORIGIN, Y = (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)
ENDS = {"at_a": (-1.0, 0.0, 0.0), "at_b": ORIGIN}
MASS, TIME = 2.0, 0.5
INERTIA = np.array([0.1, 0.2, 0.25])
K, C, K_R, C_R = (np.array(rates) for rates in ((9.0, 5.0, 7.0), (1.0, 2.0, 0.5), (3.0, 2.0, 1.0), (0.3, 0.1, 0.2)))
CURVE = lg.Polynomial((0.0, 20.0, 0.0, 80.0))
DRAG, DENSITY, TORSION, MOTOR, CREEP = 3.0, 1.2, 4.0, 1.5, 6.0


def elements():
    pulled = lambda: lg.RigidBody(MASS, None, position=ORIGIN, velocity=X)
    bodies = {name: pulled() for name in ("spring", "curve", "stop", "drag", "maxwell", "contact")}
    bodies["wheel"] = lg.RigidBody(MASS, INERTIA, angular_velocity=(0.0, 2.0, 0.0))
    bodies["rubber"] = lg.RigidBody(MASS, INERTIA, velocity=(1.0, -0.5, 0.3), angular_velocity=(1.0, 2.0, -1.5))
    forces = {
        "spring": lg.SpringDamper(None, "spring", **ENDS, stiffness=30.0, damping=2.0),
        "curve": lg.CurveSpringDamper(None, "curve", **ENDS, spring=CURVE, damper=lg.Polynomial((0.0, 2.0, 0.0, 3.0))),
        "stop": lg.BumpStop(None, "stop", **ENDS, gap=0.1, stiffness=90.0, rounding=0.1, progression=0.3, rebound=True),
        "drag": lg.Drag("drag", drag_area=DRAG, density=DENSITY),
        "maxwell": lg.MaxwellElement(None, "maxwell", **ENDS, stiffness=40.0, damping=CREEP),
        "contact": lg.PlaneContact(
            None, "contact", at=ORIGIN, axis=(-1.0, 0.0, 0.0), stiffness=80.0, rounding=0.02, damping=0.3
        ),
        "wheel": lg.TorsionSpringDamper(None, "wheel", axis=Y, stiffness=TORSION, damping=0.5, motor=MOTOR),
        "rubber": lg.Bushing(
            None, "rubber", at=ORIGIN, stiffness=K, damping=C, rotational_stiffness=K_R, rotational_damping=C_R
        ),
    }
    joints = {"hinge": lg.RevoluteJoint(None, "wheel", at=ORIGIN, axis=Y)}
    return lg.Model(bodies, joints, forces)


@eqx.filter_jit
def motion(scene, steps):
    trajectory = lg.simulate(scene, t1=TIME, num_steps=steps)
    measured = {name: trajectory.force(name) for name in scene.forces if name != "rubber"}
    return trajectory.t, {name: trajectory.body(name) for name in scene.bodies}, measured


def balance(scene, steps):
    """Of each element the energy that its body and it have gained less their work, and that work, by NumPy."""
    t, bodies, measured = jax.tree.map(np.asarray, motion(scene, steps))
    found = {}

    def account(name, stored, power):
        body = bodies[name]
        spin = np.sum(body.angular_velocity * INERTIA * body.angular_velocity, axis=1)
        energy = stored + MASS / 2 * np.sum(body.velocity**2, axis=1) + spin / 2 * (name in ("wheel", "rubber"))
        work = np.trapezoid(power, t)
        found[name] = energy[-1] - energy[0] - work, work

    line = measured["spring"]
    account("spring", 15.0 * (line.length - 1.0) ** 2, -2.0 * line.rate**2)
    x, rate = measured["curve"].length - 1.0, measured["curve"].rate
    account("curve", 10.0 * x**2 + 20.0 * x**4, -rate * (2.0 * rate + 3.0 * rate**3))
    y, w, p = np.maximum(measured["stop"].length - 1.1, 0.0) ** 2, 0.01, 0.09
    log = np.log1p(y / w)
    account("stop", 45.0 * (y - w * log + (y**2 / 2 - w * y + w**2 * log) / p), 0.0 * y)
    speed = bodies["drag"].velocity[:, 0]
    account("drag", 0.0 * speed, -DENSITY * DRAG / 2 * speed**3)
    tension = measured["maxwell"].tension
    account("maxwell", tension**2 / 80.0, -(tension**2) / CREEP)
    push = measured["contact"]
    account("contact", 0.0 * push, -push * bodies["contact"].velocity[:, 0])
    hinge = measured["wheel"]
    account("wheel", TORSION / 2 * hinge.angle**2, MOTOR * hinge.rate - 0.5 * hinge.rate**2)
    u, v = bodies["rubber"].position, bodies["rubber"].velocity
    phi, spin = Rotation.from_matrix(bodies["rubber"].orientation).as_rotvec(), bodies["rubber"].angular_velocity
    half = np.linalg.norm(phi, axis=1, keepdims=True) / 2
    bend = np.where(half > 1e-4, (1 - half / np.tan(np.maximum(half, 1e-4))) / np.maximum(4 * half**2, 1e-8), 1 / 12)
    rate = spin + np.cross(phi, spin) / 2 + bend * np.cross(phi, np.cross(phi, spin))
    account("rubber", (u**2 @ K + phi**2 @ K_R) / 2, -(v**2 @ C + rate**2 @ C_R))
    return found


@pytest.mark.slow  # a program for each number of steps
def test_energy_is_balanced():
    few, many = balance(elements(), 50), balance(elements(), 100)
    for name, (missing, work) in few.items():
        left, size = float(many[name][0]), max(abs(float(work)), 0.05)
        assert abs(missing) < 0.02 * size, name
        assert abs(left) < 1e-6 or 3.0 < missing / left < 5.0, (name, missing, left)
