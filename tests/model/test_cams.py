"""Curves over coordinates, over many turns: cams, gears that are not round, torques over the angle of a crank."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

import lgsens as lg
from lgsens.model._turns import unless_closed
from lgsens.testing import check_force, check_sensitivities

ORIGIN, X, Y, Z = np.zeros(3), *np.eye(3)
G = 9.81
TURN = 2.0 * np.pi
ANGLES = np.linspace(0.0, TURN, 13)
LIFTS = 0.01 * (1.0 - np.cos(ANGLES)) + 0.002 * np.sin(2.0 * ANGLES) ** 2
EXACT = CubicSpline(ANGLES, [*LIFTS[:-1], LIFTS[0]], bc_type="periodic")
INERTIA, MASS, MOMENT = 0.02, 1.5, 0.7


class Eccentric(lg.AbstractSignal):
    """e (1 − cos θ)."""

    radius: jax.Array

    def __call__(self, t):
        return self.radius * (1.0 - jnp.cos(t))


class Oval(lg.AbstractSignal):
    """θ + e sin 2θ, of a pair of gears that are not round."""

    swell: jax.Array

    def __call__(self, t):
        return t + self.swell * jnp.sin(2.0 * t)


def valve(curve, drive=None, axis=Y, along=Z, **options):
    """A cam and what it lifts."""
    cam = lg.RevoluteJoint(None, "cam", at=ORIGIN, axis=axis)
    guide = lg.PrismaticJoint(None, "follower", at=X, axis=along)
    bodies = {
        "cam": lg.RigidBody(1.0, (INERTIA,) * 3, angular_velocity=3.0 * axis),
        "follower": lg.RigidBody(MASS, (0.1, 0.1, 0.1), position=X),
    }
    joints = {"cam": cam, "guide": guide, "lift": lg.CoordinateCoupling(guide, cam, curve=curve)}
    if drive is not None:
        joints["drive"] = lg.RotationDriver(None, "cam", axis=Y, value=drive)
    forces = {"weight": lg.Gravity((0.0, 0.0, -G)), "motor": lg.CoordinateForce(cam, motor=MOMENT)}
    return lg.Model(bodies, joints, forces, **options)


def turned(motion, name="cam"):
    return np.asarray(motion.joint(name).angle)


def test_a_driven_cam_over_turns():
    """s = f(ωt), ṡ = f′ω, s̈ = f″ω²; the moment that drives is (s̈ + g) m f′ less that of the motor."""
    speed = 4.0
    t = np.linspace(0.0, 5.0, 41)
    model = valve(lg.Sampled(ANGLES, LIFTS, "cubic", periodic=True), drive=lg.Polynomial((0.0, speed)))
    motion = lg.kinematics(model, t=t)
    angle = speed * t
    follower = motion.joint("guide")
    rate, acceleration = (of["displacement"] for of in (follower.rates, follower.accelerations))
    # Newton's tolerance, relative to a scene of a metre
    np.testing.assert_allclose(follower.displacement, EXACT(angle), atol=1e-12)
    np.testing.assert_allclose(rate, EXACT(angle, 1) * speed, atol=1e-11)
    np.testing.assert_allclose(acceleration, EXACT(angle, 2) * speed**2, atol=1e-10)
    np.testing.assert_allclose(turned(motion), angle, atol=1e-11)
    pushes = (EXACT(angle, 2) * speed**2 + G) * MASS * EXACT(angle, 1) - MOMENT
    np.testing.assert_allclose(-motion.multiplier("drive")[:, 0], pushes, atol=1e-9)
    assert angle[-1] > 3 * TURN


@pytest.mark.slow  # small version: test_gears_that_are_not_round
@pytest.mark.parametrize("linear_solver", [None, lg.BlockSparse()])
@pytest.mark.parametrize("integrator", [lg.RadauIIA(), lg.GeneralizedAlpha(), lg.IndexReducedODE()])
def test_a_free_cam_over_turns(integrator, linear_solver):
    """(J + m f′²) θ̈ = M − m (f″ θ̇² + g) f′, against SciPy's DOP853."""

    def rate(_, y):
        slope, bend = 0.01 * np.sin(y[0]), 0.01 * np.cos(y[0])
        return y[1], (MOMENT - MASS * (bend * y[1] ** 2 + G) * slope) / (INERTIA + MASS * slope**2)

    t1 = 1.0
    exact = solve_ivp(rate, (0.0, t1), (0.0, 3.0), "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    assert exact[0] > 3 * TURN
    model = valve(Eccentric(jnp.asarray(0.01)), linear_solver=linear_solver)
    motion = lg.simulate(model, t1=t1, num_steps=200, integrator=integrator)
    # second order: h²/12 t |θ⃛| = 2e-6 · 1e3 rad/s³; of the others 1e-8
    tolerance = 2e-3 if integrator == lg.GeneralizedAlpha() else 1e-6
    np.testing.assert_allclose(turned(motion)[-1], exact[0], atol=tolerance)


def gears(curve, speed=30.0):
    """A wheel that turns on, and another one that follows it by a curve."""
    hinges = {name: lg.RevoluteJoint(None, name, at=at, axis=Z) for name, at in (("one", ORIGIN), ("two", X))}
    bodies = {
        "one": lg.RigidBody(1.0, (1.0, 1.0, 0.3), free="rz"),
        "two": lg.RigidBody(1.0, (1.0, 1.0, 0.8), X, free="rz", angular_velocity=(0.0, 0.0, speed)),
    }
    return lg.Model(bodies, {"mesh": lg.CoordinateCoupling(hinges["one"], hinges["two"], curve=curve)}), hinges


@pytest.mark.slow  # `test_a_driven_cam_over_turns` is in the quick run
def test_gears_that_are_not_round():
    """θ₁ = θ₂ + e sin 2θ₂ over turns, and ½ (J₂ + J₁ (1 + 2e cos 2θ₂)²) θ̇₂² is kept."""
    swell, steps = 0.2, 200
    model, _ = gears(Oval(jnp.asarray(swell)))
    run = lg.simulate(model, t1=1.0, num_steps=steps)
    first, second = (run.body(name) for name in ("one", "two"))
    one, two = (np.unwrap(np.arctan2(body.orientation[:, 1, 0], body.orientation[:, 0, 0])) for body in (first, second))
    np.testing.assert_allclose(one, two + swell * np.sin(2.0 * two), atol=1e-9)  # Newton's tolerance over scales
    assert two[-1] > 3 * TURN
    energy = 0.15 * first.angular_velocity[:, 2] ** 2 + 0.4 * second.angular_velocity[:, 2] ** 2
    # second order: (h ω)²/12 of the part that goes to and fro, 0.6, as the coupling's own frequency is 2ω
    np.testing.assert_allclose(energy, energy[0], rtol=0.6 * (2 * 30.0 / steps) ** 2)


@pytest.mark.slow  # `test_what_closes_after_a_turn` is in the quick run
def test_a_curve_that_does_not_close_has_failed_at_half_a_turn():
    model, _ = gears(lg.Polynomial((0.0, 1.0, 0.2)))
    with pytest.raises(lg.SimulationError, match="half a turn"):
        lg.simulate(model, t1=0.3, num_steps=60)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_what_closes_after_a_turn(dtype):
    """Curves whose value and slope are zero, but for round-off, where the turn closes; and curves that do not close."""
    angle = jnp.asarray(1.3, dtype)
    for phase in np.linspace(0.0, TURN, 7):
        shift = jnp.asarray(phase, dtype)
        for closed in (
            lambda t, shift=shift: 0.01 * (1.0 + jnp.cos(t - shift)),
            lambda t, shift=shift: 0.01 * jnp.cos((t - shift) / 2.0) ** 4,
            lambda t, shift=shift: 0.01 * jnp.maximum(jnp.cos(t - shift), 0.0) ** 3,
        ):
            assert unless_closed(closed, angle) == 0.0
    for kind in ("linear", "cubic", "monotone"):  # slopes jump at samples, every 30 degrees
        torques = [0.0, 3.0, 8.0, 5.0, 2.0, 0.0, -1.0, -2.0, -1.0, 0.0, 0.0, 1.0, 0.0]
        samples = lg.Sampled(np.linspace(-np.pi, np.pi, 13), torques, kind, periodic=True).prepared()
        assert unless_closed(jax.tree.map(lambda leaf: leaf.astype(dtype), samples), angle) == 0.0
    geared = lambda t: 3.0 * t + 0.2 * jnp.sin(t)
    assert unless_closed(geared, angle, turn=TURN) == 0.0
    pulse = lambda t: jnp.exp(-((jnp.mod(t, 2.0 * TURN) - 0.6) ** 2) / 0.1)  # of two turns, nothing where one closes
    for open_ in (geared, lambda t: 0.1 * t**2, lambda t: 1.0 + 1e-3 * jnp.sin(t / 2.0), pulse):
        assert unless_closed(open_, angle) == angle
    assert unless_closed(lambda t: 1.3 * t, angle, turn=TURN) == angle


@pytest.mark.slow  # `test_what_closes_after_a_turn` is in the quick run
@pytest.mark.parametrize("turns", [pytest.param(False, marks=pytest.mark.slow), True])
def test_torque_over_the_angle_of_a_crank(turns):
    """J θ̈ = F(θ) − c θ̇ of period 2π, and with counted turns of 4π as of a four-stroke engine, against SciPy."""
    period, inertia, damping, t1 = (2 * TURN if turns else TURN), 0.05, 0.01, 1.0
    angles = np.linspace(0.0, period, 17)
    torques = 0.6 + np.sin(TURN * angles / period) + 0.3 * np.cos(2 * TURN * angles / period)
    exact = CubicSpline(angles, [*torques[:-1], torques[0]], bc_type="periodic")
    hinge = lg.RevoluteJoint(None, "crank", at=ORIGIN, axis=Y)
    curve = lg.Sampled(angles, [*torques[:-1], torques[0]], "cubic", periodic=True)
    gas = lg.CoordinateForce(hinge, curve=curve, damping=damping, turns=turns)
    bodies = {"crank": lg.RigidBody(1.0, (inertia,) * 3, angular_velocity=20.0 * Y)}
    model = lg.Model(bodies, {"hinge": hinge}, {"gas": gas})
    run = lg.simulate(model, t1=t1, num_steps=400, integrator=lg.RadauIIA())
    rate = lambda _, y: (y[1], (exact(y[0]) - damping * y[1]) / inertia)
    end = solve_ivp(rate, (0.0, t1), (0.0, 20.0), "DOP853", rtol=1e-11, atol=1e-11, max_step=1e-3).y[:, -1]
    assert end[0] > 2.0 * period
    # third derivatives jump at the samples: h⁴ of a fourth one there, 0.05 rad per step
    np.testing.assert_allclose(run.joint("hinge").angle[-1], end[0], atol=1e-5)
    force = run.force("gas")
    np.testing.assert_allclose(force.force, exact(run.joint("hinge").angle) - damping * force.rate, atol=1e-9)


@pytest.mark.slow
def test_forces_with_a_curve():
    """Tangents, action and reaction, carrying on merged bodies."""
    hinge = lg.RevoluteJoint("a", "b", at=(0.3, -0.7, 1.1), axis=(1.0, 2.0, -0.5))
    curve = lg.Sampled(ANGLES, 100.0 * LIFTS, "cubic", periodic=True)
    check_force(lg.CoordinateForce(hinge, curve=curve, stiffness=0.3, damping=0.4)).raise_if_failed()


@pytest.mark.slow  # three programs, a minute of processor
def test_every_number():
    """DDM, AVM and differences of random sums of the states of a cam by its samples and times, too."""

    def asked(model):
        # whose multipliers are right to round-off; those of generalized-α to 1e-8 of the largest
        states = lg.simulate(model, t1=0.2, num_steps=5, integrator=lg.RadauIIA()).states
        end = jnp.concatenate([jnp.ravel(leaf[-1]) for leaf in (*states.q, states.v, states.lam)])
        return jnp.asarray(np.random.default_rng(0).standard_normal((3, end.size))) @ end

    # no sample at the start: the third derivative jumps there
    curve = lg.Sampled(ANGLES - 0.2, [*LIFTS[:-1], LIFTS[0]], "cubic", periodic=True)
    # not along axes of the frame, where the normals, along which λ is, change over
    tilted = {"axis": np.array([0.1, 1.0, 0.3]), "along": np.array([0.2, -0.3, 1.0])}
    check_sensitivities(asked, valve(curve, **tilted)).raise_if_failed()


HINGE, SLIDER = lg.RevoluteJoint("a", "b", at=ORIGIN, axis=Y), lg.PrismaticJoint("a", "b", at=ORIGIN, axis=Y)
BAD = {
    "two relations": (
        lambda: lg.CoordinateCoupling(SLIDER, HINGE, (1.0,), curve=Eccentric(jnp.ones(()))),
        "`coefficients` and `curve` are two relations",
    ),
    "no signal": (lambda: lg.CoordinateCoupling(SLIDER, HINGE, curve=np.sin), "`curve` must be a signal"),
    "straight lines": (
        lambda: lg.CoordinateCoupling(SLIDER, HINGE, curve=lg.Sampled(ANGLES, LIFTS)),
        "`curve` follows straight lines between samples",
    ),
    "no force curve": (lambda: lg.CoordinateForce(HINGE, curve=3.0), "`curve` must be a signal"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    make, message = BAD[name]
    with pytest.raises(ValueError, match=says(message)):
        make()
