"""The Whipple bicycle, two wheels that roll, a frame and a fork: its linear equations as they are published.

Source: Meijaard, Papadopoulos, Ruina & Schwab, Proc. R. Soc. A 463 (2007) 1955, doi:10.1098/rspa.2007.1857, Table 1 and
the matrices M, C_1, K_0, K_2 of its benchmark; z is up here, down there.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import lgsens as lg

BASE, TRAIL, TILT, REAR, FRONT = 1.02, 0.08, np.pi / 10, 0.3, 0.35
G = 9.81
M = np.array([[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]])
K0 = np.array([[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]])
K2 = np.array([[0.0, 76.59734589573222], [0.0, 2.65431523794604]])
C1 = np.array([[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]])


def bicycle(speed, lean_rate):
    """Upright, with a rate of lean of all bodies about the line on the ground."""
    upwards = np.array([-np.sin(TILT), 0.0, np.cos(TILT)])
    turning = jnp.stack([lean_rate, 0.0 * lean_rate, 0.0 * lean_rate])

    def body(mass, moments, at, spin=0.0):
        xx, yy, zz, xz = moments
        inertia = np.array([[xx, 0.0, -xz], [0.0, yy, 0.0], [-xz, 0.0, zz]])
        velocity = jnp.array([speed, 0.0, 0.0]) + jnp.cross(turning, jnp.asarray(at))
        rates = turning + jnp.array([0.0, spin, 0.0])
        return lg.RigidBody(mass, inertia, position=at, velocity=velocity, angular_velocity=rates)

    wheels = {"rear": (0.0, 0.0, REAR), "front": (BASE, 0.0, FRONT)}
    y = (0.0, 1.0, 0.0)
    bodies = {
        "rear": body(2.0, (0.0603, 0.12, 0.0603, 0.0), wheels["rear"], speed / REAR),
        "frame": body(85.0, (9.2, 11.0, 2.8, 2.4), (0.3, 0.0, 0.9)),
        "fork": body(4.0, (0.05892, 0.06, 0.00708, -0.00756), (0.9, 0.0, 0.7)),
        "front": body(3.0, (0.1405, 0.28, 0.1405, 0.0), wheels["front"], speed / FRONT),
    }
    joints = {
        "rear hub": lg.RevoluteJoint("frame", "rear", at=wheels["rear"], axis=y),
        "head": lg.RevoluteJoint("frame", "fork", at=np.array([BASE + TRAIL, 0.0, 0.0]) + 0.8 * upwards, axis=-upwards),
        "front hub": lg.RevoluteJoint("fork", "front", at=wheels["front"], axis=y),
        "rear tyre": lg.Rolling("rear", at=wheels["rear"], axis=y, radius=REAR),
        "front tyre": lg.Rolling("front", at=wheels["front"], axis=y, radius=FRONT),
    }
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, 0.0, -G))})


def lean_and_steer(trajectory):
    turned = np.asarray(trajectory.body("frame").orientation)
    return np.stack([np.arctan2(turned[:, 2, 1], turned[:, 2, 2]), trajectory.joint("head").angle], axis=1)


@pytest.mark.parametrize(
    "integrator",
    [
        lg.GeneralizedAlpha(stabilized=True),
        lg.GeneralizedAlpha(0.5),
        lg.RadauIIA(),
    ],
    ids=["stabilized", "rho 0.5", "radau"],
)
@pytest.mark.slow
@pytest.mark.parametrize("speed", [4.6, 6.5])
def test_it_moves_as_the_benchmark_says(speed, integrator):
    """Weaving in the stable and leaning in the capsizing range of speeds."""
    trajectory = lg.simulate(bicycle(speed, 1e-3), t1=1.0, num_steps=200, integrator=integrator)
    found = lean_and_steer(trajectory)
    rates = np.array([trajectory.body("frame").angular_velocity[0, 0], trajectory.joint("head").rate[0]])
    unit = np.eye(2)
    flow = np.block(
        [
            [np.zeros((2, 2)), unit],
            [-np.linalg.solve(M, G * K0 + speed**2 * K2), -np.linalg.solve(M, speed * C1)],
        ]
    )
    start = np.concatenate([found[0], rates])
    expected = np.stack([(scipy.linalg.expm(flow * t) @ start)[:2] for t in np.asarray(trajectory.t)])
    # order two of steps of 5 ms where steering weaves at 12 1/s: (12 · 0.005)²/12 of it per radian, over ten radians
    np.testing.assert_allclose(found, expected, atol=3e-3 * np.abs(expected).max())


def test_the_scheme_that_may_be_unstable_warns():
    simulated = lambda integrator: jax.eval_shape(
        lambda speed: lg.simulate(bicycle(speed, 0.0 * speed), t1=1.0, num_steps=200, integrator=integrator), 5.0
    )
    with pytest.warns(UserWarning, match="several bodies may be unstable.*stabilized=True"):
        simulated(lg.GeneralizedAlpha())
    simulated(lg.GeneralizedAlpha(stabilized=True))  # warnings are errors here


@pytest.mark.slow
def test_small_motions_are_those_of_the_benchmark():
    """Its eigenvalues, and their derivatives by the speed; else λ = 0: place, heading and wheels, and the speed."""

    @jax.jit
    def found(speed):
        model = bicycle(speed, 0.0 * speed)
        return lg.linearize(model, lg.initial_state(model), throw=False).eigenvalues[6:]

    def expected(speed):
        unit, zero = np.eye(2), np.zeros((2, 2))
        stiffness, damping = np.linalg.solve(M, G * K0 + speed**2 * K2), np.linalg.solve(M, speed * C1)
        values = np.linalg.eigvals(np.block([[zero, unit], [-stiffness, -damping]]))
        return values[np.lexsort((-values.imag, np.abs(values).round(6)))]

    for speed in (5.0, 7.0):
        np.testing.assert_allclose(found(speed), expected(speed), rtol=1e-9)  # matrices of 14 digits
    change = (expected(5.0 + 1e-4) - expected(5.0 - 1e-4)) / 2e-4
    np.testing.assert_allclose(jax.jacfwd(found)(5.0), change, rtol=1e-6)  # those beside pairs of zeros: √ε, `repeated`


@pytest.mark.slow
def test_what_is_steered_leans():
    """To a driver at the head, with rates and accelerations of it, as the first row of the benchmark says."""
    speed, frequencies = 5.0, np.array([0.1, 0.5, 1.0, 3.0])
    model = bicycle(speed, 0.0)
    upwards = np.array([-np.sin(TILT), 0.0, np.cos(TILT)])
    driver = lg.RotationDriver("frame", "fork", axis=-upwards)
    model = lg.Model(model.bodies, model.joints | {"steering": driver}, model.forces)
    lean = lambda s: jnp.arctan2(s.body("frame").orientation[2, 1], s.body("frame").orientation[2, 2])
    moment = lambda s: s.joint("steering").axial_moment
    small = lg.linearize(
        model, lg.initial_state(model), inputs=["steering"], outputs={"lean": lean, "moment": moment}
    ).frequency_response(frequencies)
    s = 2j * np.pi * frequencies[:, None, None]
    dynamic = M * s**2 + speed * C1 * s + G * K0 + speed**2 * K2
    leans = -dynamic[:, 0, 1] / dynamic[:, 0, 0]
    np.testing.assert_allclose(small[:, 0, 0], leans, rtol=1e-9)
    steers = dynamic[:, 1, 0] * leans + dynamic[:, 1, 1]
    np.testing.assert_allclose(small[:, 1, 0], steers, rtol=1e-9)
