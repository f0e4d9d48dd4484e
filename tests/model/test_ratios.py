"""Transmissions of variable ratio: racks and screws by a curve over the angle, racks, screws and gears by time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, moved, random_rotation, says, some_quick
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.model import Frame
from lgsens.testing import check_joint, check_sensitivities

X, Y, ORIGIN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)
AT, AT_B = (0.3, -0.7, 1.1), (0.9, 0.2, 0.4)
AXIS, AXIS_B = (1.0, 2.0, -0.5), (0.8, 1.0, -1.0)
RADIUS, SWELL = 0.01, 2e-4
TRAVEL = lg.Polynomial((0.0, RADIUS, 0.0, SWELL))  # f = r θ + ε θ³, of which πr is reached at 5.4 rad
RATIO = lg.Harmonic(amplitude=0.2, frequency=0.3, offset=-1.5)
GEARS = {"at_a": AT, "at_b": AT_B, "axis_a": AXIS, "axis_b": AXIS_B}
JOINTS = {
    "rack by a curve": lg.RackAndPinionJoint(
        "a", "b", at=AT, axis=AXIS, direction=AXIS_B, radius=0.4, travel=lg.Polynomial((0.0, 0.3, 0.05, 0.1))
    ),
    "rack by time": lg.RackAndPinionJoint(
        "a", "b", at=AT, axis=AXIS, direction=AXIS_B, radius=lg.Harmonic(amplitude=0.1, frequency=0.3, offset=0.4)
    ),
    "gears on one axis": lg.GearJoint(
        "a", "b", at_a=AT, at_b=AT, axis_a=AXIS, axis_b=AXIS, ratio=3.0, teeth=1, line=AXIS_B
    ),
    "gears by time": lg.GearJoint("a", "b", **GEARS, ratio=RATIO),
    "screw by a curve": lg.ScrewJoint(
        "a", "b", at=AT, axis=AXIS, pitch=2.5, travel=lg.Polynomial((0.0, 0.3, 0.05, 0.1))
    ),
    "screw by time": lg.ScrewJoint(
        "a", "b", at=AT, axis=AXIS, pitch=lg.Harmonic(amplitude=0.1, frequency=0.3, offset=2.5)
    ),
}


@pytest.mark.slow  # small version: test_tangents_of_a_rack
@pytest.mark.parametrize("name", JOINTS)
def test_joints_are_what_they_say(name):
    check_joint(JOINTS[name], t=0.7).raise_if_failed()


def test_tangents_of_a_rack():
    """B, Bᵀλ and K = ∂(Bᵀλ)/∂x in closed form, with the bend of its curve, against autodiff of Φ."""
    rng, t, lam, zero = np.random.default_rng(0), jnp.asarray(0.7), jnp.array([1.3]), jnp.zeros(12)
    ends = [Frame(jnp.asarray(rng.normal(size=3)), jnp.asarray(random_rotation(rng))) for _ in "ab"]
    (element,) = JOINTS["rack by a curve"].constraints(*ends)

    @jax.jit
    def closed_and_differentiated(a, b):
        displaced = lambda x, a=a, b=b: (moved(a, x[:6]), moved(b, x[6:]))
        jacobian = lambda a, b: jax.jacfwd(lambda x: element.value(*displaced(x, a, b), t))(zero)
        stiffness = jax.jacfwd(lambda x: lam @ jacobian(*displaced(x)))(zero)
        closed = element.jacobian(a, b, t), element.force(a, b, lam, t), element.geometric_stiffness(a, b, lam, t)
        return closed, (jacobian(a, b), lam @ jacobian(a, b), stiffness)

    for found, expected in zip(*closed_and_differentiated(*(moved(end, rng.normal(size=6)) for end in ends))):
        close(found, expected, 200)  # some ten products of matrices


def test_values_over_many_turns():
    """Φ = s − f(θ), s − r(t) θ and φ_b − ρ(t) φ_a at poses by hand."""
    ground, t, time = Frame(np.zeros(3), np.eye(3)), 0.7, jnp.asarray(0.7)
    about_y = lambda angle: jnp.asarray(Rotation.from_rotvec([0, angle, 0]).as_matrix())
    placed = lambda s, angle: Frame(jnp.array([s, 0.0, 0.0]), about_y(angle))
    rack = {"at": ORIGIN, "axis": Y, "direction": X}
    for angle in (-5.0, -0.4, 0.0, 2.0, 4.9):
        (element,) = lg.RackAndPinionJoint("a", "b", **rack, radius=RADIUS, travel=TRAVEL).constraints(ground, ground)
        s = RADIUS * angle + SWELL * angle**3 + 1e-3
        close(element.value(ground, placed(s, angle), time), [1e-3], 1e3, scale=0.1)
    radius = lg.Ramp(start=0.02, end=0.05, duration=2.0)
    x = t / 2.0
    exact = 0.02 + 0.03 * (10 * x**3 - 15 * x**4 + 6 * x**5)
    for angle in (-40.0, 0.3, 25.0):
        (element,) = lg.RackAndPinionJoint("a", "b", **rack, radius=radius).constraints(ground, ground)
        close(element.value(ground, placed(exact * angle + 1e-3, angle), time), [1e-3], 1e3, scale=2.0)
    along = lambda s, angle: Frame(jnp.array([0.0, s, 0.0]), about_y(angle))
    for angle in (-40.0, 0.3, 25.0):
        thread = lg.ScrewJoint("a", "b", at=ORIGIN, axis=Y, pitch=radius)
        *_, element = thread.constraints(ground, ground)
        close(element.value(ground, along(exact * angle / (2 * np.pi) + 1e-3, angle), time), [1e-3], 1e3, scale=2.0)
    for angle in (-5.0, 0.0, 4.9):
        thread = lg.ScrewJoint("a", "b", at=ORIGIN, axis=Y, pitch=2 * np.pi * RADIUS, travel=TRAVEL)
        *_, element = thread.constraints(ground, ground)
        close(
            element.value(ground, along(RADIUS * angle + SWELL * angle**3 + 1e-3, angle), time), [1e-3], 1e3, scale=0.1
        )
    (element,) = lg.GearJoint("a", "b", at_a=ORIGIN, at_b=X, axis_a=Y, axis_b=Y, ratio=RATIO).constraints(
        ground, placed(1.0, 0.0)
    )
    ratio = -1.5 + 0.2 * np.sin(2 * np.pi * 0.3 * t)
    phi = element.value(placed(0.0, 0.8), placed(1.0, ratio * 0.8 + 0.01), time)
    close(phi, [0.01], 1e3, scale=1.0)
    on_axis = {"at_a": ORIGIN, "at_b": ORIGIN, "axis_a": Y, "axis_b": Y, "ratio": 3.0, "line": X}
    (element,) = lg.GearJoint("a", "b", **on_axis).constraints(ground, ground)
    for angle in (-9.0, 0.5, 20.0):
        close(element.value(placed(0.0, angle), placed(0.0, 3.0 * angle + 0.01), time), [0.01], 1e3, scale=60.0)


def steering(travel):
    """A pinion that is driven, and its rack in a guide."""
    body = lambda at: lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=at)
    joints = {
        "hinge": lg.RevoluteJoint(None, "pinion", at=ORIGIN, axis=Y),
        "guide": lg.PrismaticJoint(None, "rack", at=(0.0, 0.0, -0.1), axis=X),
        "mesh": lg.RackAndPinionJoint("rack", "pinion", at=ORIGIN, axis=Y, direction=X, radius=RADIUS, travel=travel),
        "wheel": lg.RotationDriver(None, "pinion", axis=Y),
    }
    return lg.Model({"pinion": body(ORIGIN), "rack": body((0.0, 0.0, -0.1))}, joints)


@pytest.mark.slow
def test_rack_follows_its_curve():
    """Position, rate and moment of the wheel over two turns and more, against SciPy's spline through the samples."""
    angles = np.linspace(-7.0, 7.0, 29)
    turns = np.concatenate([np.linspace(0.0, 6.8, 9), np.linspace(6.0, -6.8, 15)])  # by less than half a turn each
    samples = RADIUS * angles + 2e-3 * np.sin(angles)
    curve = CubicSpline(angles, samples, bc_type="natural")

    @eqx.filter_jit
    def run(values):
        model = steering(lg.Sampled(angles, values, "cubic"))
        model = eqx.tree_at(lambda m: m.forces, model, {})
        model = lg.Model(model.bodies, model.joints, {"load": lg.AppliedForce("rack", force=(5.0, 0.0, 0.0))})
        motion = lg.kinematics(model, {"wheel": turns}, rates={"wheel": 3.0})
        return motion.body("rack").position[:, 0], motion.body("rack").velocity[:, 0], motion.multiplier("wheel")[:, 0]

    position, rate, moment = run(jnp.asarray(samples))
    close(position, -curve(turns), 1e4)
    close(rate, -3.0 * curve(turns, 1), 1e5)
    # power: M ω = −(F − m ẍ) ẋ, the multiplier is what drives, reversed
    push = 5.0 + curve(turns, 2) * 9.0
    close(moment, -push * curve(turns, 1), 1e6)


@pytest.mark.slow
def test_gradient_by_the_curve():
    """The place of the rack by the coefficients of its curve: −θ^i."""

    def place(coefficients):
        model = steering(lg.Polynomial(coefficients))
        return lg.kinematics(model, {"wheel": jnp.array([2.0])}).body("rack").position[-1, 0]

    found = jax.jit(jax.grad(place))(jnp.array([0.0, RADIUS, 0.0, SWELL]))
    close(found, [-1.0, -2.0, -4.0, -8.0], 1e4)


@pytest.mark.slow  # three programs, a minute of processor
def test_every_number():
    """DDM, AVM and differences of random sums of the states of a nut whose pitch changes, of a barrel cam that it does
    not touch, and of a shaft that rubs in a universal joint."""
    body = lambda at, **more: lg.RigidBody(1.3, (0.1, 0.12, 0.2), position=at, **more)
    axis = np.array([0.1, 1.0, 0.3])  # not along one of the frame, where the normals, along which λ is, change over
    turning = {"angular_velocity": 3.0 * axis}
    bodies = {
        "nut": body(ORIGIN, **turning),
        "cam": body((1.0, 0.0, 0.0), **turning),
        "shaft": body((2.0, 0.2, 0.0), angular_velocity=(0.4, -0.7, 0.0), velocity=(0.0, 0.0, 0.08)),
    }
    joints = {
        "thread": lg.ScrewJoint(
            None, "nut", at=ORIGIN, axis=axis, pitch=lg.Harmonic(amplitude=0.2, frequency=0.5, offset=1.0)
        ),
        "groove": lg.ScrewJoint(
            None, "cam", at=(1.0, 0.0, 0.0), axis=axis, pitch=2.0, travel=lg.Polynomial((0.0, 0.3, 0.0, 0.1))
        ),
        "cross": lg.UniversalJoint(None, "shaft", at=(2.0, 0.0, 0.0), axis_a=X, axis_b=Y),
    }
    forces = {
        "weight": lg.Gravity((0.0, -2.0, -9.81)),
        "rubs": lg.JointFriction("cross", coefficient=0.3, slip_speed=0.1, radius=0.2, arm=0.5, viscous=0.1),
    }

    def asked(model):
        states = lg.simulate(model, t1=0.1, num_steps=5).states
        end = jnp.concatenate([jnp.ravel(leaf[-1]) for leaf in (*states.q, states.v, states.lam)])
        return jnp.asarray(np.random.default_rng(0).standard_normal((3, end.size))) @ end

    check_sensitivities(asked, lg.Model(bodies, joints, forces)).raise_if_failed()


def test_bad_input():
    for more, message in (
        ({"radius": RADIUS, "travel": 0.3}, "RackAndPinionJoint: `travel` must be a signal of the angle, got 0.3"),
        ({}, "RackAndPinionJoint: `radius` is missing"),
    ):
        with pytest.raises(ValueError, match=says(message)):
            lg.RackAndPinionJoint("a", "b", at=AT, axis=AXIS, direction=X, **more)
    for more, message in (
        ({"pitch": 0.1, "travel": 0.3}, "ScrewJoint: `travel` must be a signal of the angle, got 0.3"),
        ({}, "ScrewJoint: `pitch` is missing"),
        ({"pitch": 0.0}, "ScrewJoint: `pitch` must not be zero"),
    ):
        with pytest.raises(ValueError, match=says(message)):
            lg.ScrewJoint("a", "b", at=AT, axis=AXIS, **more)
    with pytest.raises(ValueError, match=says("GearJoint: `ratio` is missing")):
        lg.GearJoint("a", "b", **GEARS)


@pytest.mark.slow
@pytest.mark.parametrize("mode", [jax.grad, jax.jacfwd])
def test_gears_without_teeth_by_their_ratio(mode):
    """A torque and a damper over twelve turns: values and the derivative by the ratio in closed form.

    (J_a + ρ² J_b) ω̇ + c ρ² ω = M from rest: ω = M/(c ρ²) (1 − exp(−c ρ² t/(J_a + ρ² J_b))).
    """
    axis, t1, (j_a, j_b, c, torque) = (0.0, 0.0, 1.0), 2.0, (0.01, 0.04, 0.02, 1.0)

    def speed(ratio):
        bodies = {
            "a": lg.RigidBody(1.0, (j_a,) * 3, free="rz"),
            "b": lg.RigidBody(1.0, (j_b,) * 3, position=(0.3, 0.0, 0.0), free="rz"),
        }
        ends = {"at_a": ORIGIN, "at_b": (0.3, 0.0, 0.0), "axis_a": axis, "axis_b": axis}
        joints = {"belt": lg.GearJoint("a", "b", **ends, ratio=ratio, teeth=None)}
        forces = {
            "motor": lg.AppliedForce("a", moment=(0.0, 0.0, torque)),
            "load": lg.TorsionSpringDamper(None, "b", axis=axis, damping=c),
        }
        run = lg.simulate(lg.Model(bodies, joints, forces), t1=t1, num_steps=200)
        speed = run.body("a").angular_velocity[-1, 2]
        return speed, speed

    closed = lambda rho: torque / (c * rho**2) * (1.0 - jnp.exp(-c * rho**2 * t1 / (j_a + rho**2 * j_b)))
    rho = jnp.asarray(-0.5137)  # no count of teeth serves it
    slope, found = jax.jit(mode(speed, has_aux=True))(rho)
    # second order: h²/12 times the third derivative, (c ρ²/(J_a + ρ² J_b))² = 0.06 of the first, h = 10 ms; thrice that
    np.testing.assert_allclose(found, closed(rho), rtol=1.5e-6)
    np.testing.assert_allclose(slope, jax.grad(closed)(rho), rtol=1.5e-6)


@pytest.mark.slow
def test_gears_without_teeth_as_seen_from_a_carrier():
    """A planet on a sun, on an arm that turns thrice: as with teeth; and a drive of variable ratio: its rates."""
    axis = (0.0, 0.0, 1.0)

    def run(teeth, ratio):
        bodies = {
            "arm": lg.RigidBody(1.0, (0.1, 0.1, 0.2), position=(0.2, 0.0, 0.0), angular_velocity=(0.0, 0.0, 9.5)),
            "planet": lg.RigidBody(0.5, (0.02, 0.02, 0.03), position=(0.4, 0.0, 0.0)),
        }
        joints = {
            "arm": lg.RevoluteJoint(None, "arm", at=ORIGIN, axis=axis),
            "planet": lg.RevoluteJoint("arm", "planet", at=(0.4, 0.0, 0.0), axis=axis),
            "sun": lg.GearJoint(
                None, "planet", at_a=ORIGIN, at_b=(0.4, 0.0, 0.0), axis_a=axis, axis_b=axis, ratio=ratio, teeth=teeth
            ),
        }
        forces = {"gravity": lg.Gravity((0.0, -9.81, 0.0))}
        return lg.simulate(lg.Model(bodies, joints, forces), t1=2.0, num_steps=200, integrator=lg.RadauIIA())

    meshed, rolled = run(2, -1.5), run(None, -1.5)
    for one, other in zip(meshed.body("planet"), rolled.body("planet"), strict=True):
        # 2.5e-3 of a turn and a half in a step: order 5 leaves 1e-9 in angles that nothing holds
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-7 * np.abs(other).max())
    np.testing.assert_allclose(meshed.multiplier("sun"), rolled.multiplier("sun"), rtol=0, atol=1e-6)
    varied = run(None, RATIO)
    arm, planet = (varied.body(name).angular_velocity[:, 2] for name in ("arm", "planet"))
    # as seen from the line of centres, which turns with the arm: φ̇_planet − ω_arm = ρ (0 − ω_arm)
    np.testing.assert_allclose(planet - arm, -jax.vmap(RATIO)(varied.t) * arm, rtol=1e-10)


def winch(coupling):
    drum = lg.RigidBody(3.0, (0.03, 0.03, 0.05))
    load = lg.RigidBody(2.0, (0.1, 0.1, 0.1), position=(0.1, 0.0, -1.0))
    hinge = lg.RevoluteJoint(None, "drum", at=ORIGIN, axis=Y)
    slide = lg.PrismaticJoint(None, "load", at=(0.1, 0.0, -1.0), axis=Y)
    drive = lg.RotationDriver(None, "drum", axis=Y, value=lg.Polynomial((0.0, 5.0)))
    joints = {"hinge": hinge, "slide": slide, "rope": coupling(hinge, slide), "drive": drive}
    return lg.Model({"drum": drum, "load": load}, joints)


def gear_pair(teeth, ratio=-2.0 / 3.0):
    body = lambda at: lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=at)
    other = (0.1, 0.0, 0.0)
    mesh = lg.GearJoint("a", "b", at_a=ORIGIN, at_b=other, axis_a=Y, axis_b=Y, ratio=ratio, teeth=teeth)
    joints = {
        "hinge": lg.RevoluteJoint(None, "a", at=ORIGIN, axis=Y),
        "other": lg.RevoluteJoint(None, "b", at=other, axis=Y),
        "mesh": mesh,
        "drive": lg.RotationDriver(None, "a", axis=Y, value=lg.Polynomial((0.0, 5.0))),
    }
    return lg.Model({"a": body(ORIGIN), "b": body(other)}, joints)


TIMES = np.linspace(0.0, 2.0, 41)
TURNING = {  # the model, the joint, what it does per rad of the drive
    "an angle by a displacement": (lambda: winch(lambda h, s: lg.CoordinateCoupling(h, s, (10.0,))), "slide", 0.1),
    "gears with teeth": (lambda: gear_pair(3), "other", -2.0 / 3.0),
}
JUMPING = {
    "a displacement by an angle": lambda: winch(lambda h, s: lg.CoordinateCoupling(s, h, (0.1,))),
    "gears whose teeth nobody counted": lambda: gear_pair(1),
    "gears by time": lambda: gear_pair(1, lg.Harmonic(amplitude=1e-3, frequency=0.3, offset=-2.0)),
}


@pytest.mark.parametrize("name", some_quick(TURNING))
def test_couplings_over_whole_turns(name):
    build, joint, ratio = TURNING[name]
    found = lg.kinematics(build(), t=TIMES).joint(joint)
    moved = found.displacement if joint == "slide" else found.angle
    close(moved, 5.0 * ratio * TIMES, 1e3, scale=10.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", JUMPING)
def test_couplings_that_poses_do_not_tell_have_failed_at_half_a_turn(name):
    """π/5 s, after position 12 of 0.05 s each: the load of a winch jumped by 2πr there."""
    model = JUMPING[name]()
    with pytest.raises(lg.SimulationError, match=says("passes half a turn", "`teeth`", "before position 13")):
        lg.kinematics(model, t=TIMES)
    assert lg.kinematics(model, t=TIMES[:13]).result == lg.RESULTS.successful


@pytest.mark.slow  # small version: that of positions, above
@pytest.mark.parametrize("name", JUMPING)
@pytest.mark.parametrize("integrator", [lg.GeneralizedAlpha(), lg.RadauIIA()], ids=["alpha", "radau"])
def test_motions_have_failed_there_too(name, integrator):
    run = lg.simulate(JUMPING[name](), t1=2.0, num_steps=400, integrator=integrator, throw=False)
    assert run.result == lg.RESULTS.angle_jumped
