"""Joints that transmit rotations, and forces of hinges and vehicles: closed forms, proven tangents, derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, random_body, says, some_quick
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.model import Frame, load_tangents
from lgsens.testing import check_force, check_joint, check_sensitivities

AT, AT_B = (0.3, -0.7, 1.1), (0.9, 0.2, 0.4)
AXIS, AXIS_B = (1.0, 2.0, -0.5), (0.8, 1.0, -1.0)
X, Y, Z, ORIGIN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)

# Those of the others are sums of constraints that tests/model/test_constraints.py proves.
JOINTS = {
    "rack": lg.RackAndPinionJoint("a", "b", at=AT, axis=AXIS, direction=AXIS_B, radius=-0.3),
    "gears": lg.GearJoint("a", "b", at_a=AT, at_b=AT_B, axis_a=AXIS, axis_b=AXIS_B, ratio=-1.5, teeth=2),
    "constant velocity": lg.ConstantVelocityJoint("a", "b", at=AT, axis_a=AXIS, axis_b=AXIS_B),
}


@pytest.mark.slow  # small versions: test_accelerations_of_the_workshop, test_ratios.py::test_tangents_of_a_rack
@pytest.mark.parametrize("name", JOINTS)
def test_joints_are_what_they_say(name):
    check_joint(JOINTS[name]).raise_if_failed()


# Potentials, written from the definition of the elements.


def torsion_energy(load, a, b, t):
    first = a.orientation.T @ b.orientation @ load.first_b
    angle = jnp.arctan2(first @ load.second_a, first @ load.first_a) - load.free_angle
    angle = (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi  # within half a turn of where it is free
    return load.stiffness * angle**2 / 2 + (load.preload - load.motor) * angle


def bushing_energy(load, a, b, t):
    own, turned = load.parts
    u = a.local_point(b.point(own.point_b)) - own.point_a
    s = (a.orientation @ turned.triad_a).T @ b.orientation @ turned.triad_b
    angle = jnp.arccos((jnp.trace(s) - 1) / 2)
    phi = angle / (2 * jnp.sin(angle)) * jnp.stack([s[2, 1] - s[1, 2], s[0, 2] - s[2, 0], s[1, 0] - s[0, 1]])
    energy = own.preload @ u + u @ own.stiffness @ u / 2
    return energy + turned.preload @ phi + phi @ (turned.stiffness * phi) / 2


def stop_energy(load, a, b, t):
    """∫ x³/(x² + w²) (1 + x²/p²) dx, with y = x²: ½ ∫ (y/(y + w²)) (1 + y/p²) dy."""
    length = jnp.linalg.norm(b.point(load.point_b) - a.point(load.point_a))
    curve = load.spring
    y, w, p = (load.free_length - length - curve.gap) ** 2, curve.rounding**2, curve.progression**2
    log = jnp.log1p(y / w)
    return curve.stiffness / 2 * (y - w * log + (y**2 / 2 - w * y + w**2 * log) / p)


RATES = {"stiffness": (3.0, 1.0, 2.0), "damping": (0.5, 0.2, 0.1), "preload": (0.1, -0.4, 0.3)}
FORCES = {
    "torsion": (
        lg.TorsionSpringDamper("a", "b", axis=AXIS, stiffness=2.0, damping=0.3, free_angle=0.4, motor=0.7),
        {"potential": torsion_energy},
    ),
    "bushing": (
        lg.Bushing("a", "b", at=AT, **RATES, **{f"rotational_{name}": rates for name, rates in RATES.items()}),
        {"potential": bushing_energy},
    ),
    "stop": (
        lg.BumpStop("a", "b", at_a=AT, at_b=AT_B, gap=-8.0, stiffness=2.0, rounding=0.7, progression=2.0),
        {"potential": stop_energy},
    ),
    "following": (lg.AppliedForce("a", at=AT, force=AXIS, moment=AT_B, follows=True), {"balanced": False}),
    "drag": (lg.Drag("a", at=AT, drag_area=0.7, wind=AXIS_B), {"balanced": False}),
}


@pytest.mark.parametrize("name", some_quick(FORCES))  # of a bushing: the quick test of its tangents is below
def test_forces_are_what_they_say(name):
    force, options = FORCES[name]
    check_force(force, **options).raise_if_failed()


def load_of(force, bodies=None):
    rng = np.random.default_rng(0)
    bodies = {name: random_body(rng) for name in force.bodies if name is not None} if bodies is None else bodies
    (attached,) = force.loads(bodies)
    return attached.load, *(Frame(np.zeros(3), np.eye(3)) if n is None else bodies[n].frame for n in force.bodies)


REST = jnp.zeros(6)


def test_bushing_is_six_by_six():
    """At its place, −∂Q/∂q and −∂Q/∂v of a body on the ground are diagonal; a turn about one axis is met along it."""
    k, c, k_r, c_r = np.arange(1.0, 13.0).reshape(4, 3)
    rates = {"stiffness": k, "damping": c, "rotational_stiffness": k_r, "rotational_damping": c_r}
    bushing = lg.Bushing(None, "body", at=ORIGIN, **rates)
    body = lg.RigidBody(1.0, (1.0, 1.0, 1.0))
    load, ground, frame = load_of(bushing, {"body": body})
    tangents = load_tangents(load, ground, frame, REST, REST, 0.0)
    close(-tangents.position[6:, 6:], np.diag([*k, *k_r]), 10)
    close(-tangents.velocity[6:, 6:], np.diag([*c, *c_r]), 10)
    for i, e in enumerate(np.eye(3)):
        turned = Frame(jnp.asarray(0.1 * e), jnp.asarray(Rotation.from_rotvec(0.7 * e).as_matrix()))
        close(load.force(ground, turned, REST, REST, 0.0)[6:], np.concatenate([-0.1 * k[i] * e, -0.7 * k_r[i] * e]), 50)


def test_rates_of_a_bushing_that_are_not_given_add_nothing():
    plain, _, _ = load_of(lg.Bushing("a", "b", at=AT, stiffness=AT))
    assert isinstance(plain, lg.model.BushingLoad)


def test_stop_has_two_derivatives_where_it_is_met():
    """F, F′ and F″ tend to zero with the squeeze, F‴ = 6 k/w² not; both kinds of stop, before, and far behind."""
    k, gap, w, p = 5.0, 0.2, 0.05, 0.4
    for rebound, sign in ((False, -1.0), (True, 1.0)):
        stop = lg.BumpStop(
            None, "b", at_a=ORIGIN, at_b=X, gap=gap, stiffness=k, rounding=w, progression=p, rebound=rebound
        )
        tension = load_of(stop)[0].spring
        squeezed = lambda x, tension=tension, sign=sign: sign * tension(sign * (gap + x))
        derivatives = [squeezed]
        for _ in range(3):
            derivatives.append(jax.grad(derivatives[-1]))
        x = 1e-6
        found = [float(d(x)) for d in derivatives]
        expected = 6 * k / w**2 * np.array([x**3 / 6, x**2 / 2, x, 1.0])
        np.testing.assert_allclose(found, expected, rtol=1e-8)  # the next terms are (x/w)²; gap + x − gap has 2e-11
        assert [float(d(-x)) for d in derivatives] == [0.0] * 4
        np.testing.assert_allclose(squeezed(0.3), k * 0.027 / (0.09 + w**2) * (1 + 0.09 / p**2), rtol=1e-14)


def test_bar_and_following_force():
    """A bar of steel of 20 mm and 1 m has 1245.641 N m/rad; a force that follows is that of the body's frame."""
    bar = lg.AntiRollBar("a", "b", axis=Y, diameter=0.02, length=1.0)
    load, a, b = load_of(bar, {name: lg.RigidBody(1.0, (1.0, 1.0, 1.0)) for name in "ab"})
    turned = b._replace(orientation=jnp.asarray(Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()))
    measured = load.measure(a, turned, REST, REST, 0.0)
    np.testing.assert_allclose(
        [measured.angle, measured.moment], [0.1, -124.5641], rtol=1e-6
    )  # as many digits as given
    tube = lg.AntiRollBar("a", "b", axis=Y, diameter=0.02, bore=0.01, length=1.0)
    np.testing.assert_allclose(load_of(tube)[0].stiffness, 15 / 16 * load.stiffness, rtol=1e-14)

    rng = np.random.default_rng(1)
    body = random_body(rng)
    ((load, _, _),) = lg.AppliedForce("a", at=AT, force=AXIS, follows=True).loads({"a": body})
    rotation = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()  # of the body, about its centre of mass
    frame = Frame(body.frame.position, rotation @ np.asarray(body.frame.orientation))
    force = load.force(Frame(np.zeros(3), np.eye(3)), frame, REST, REST, jnp.zeros(()))[6:]
    close(force[:3], rotation @ AXIS, 20)
    arm = rotation @ (np.array(AT) - np.asarray(body.position))
    close(frame.orientation @ force[3:], np.cross(arm, rotation @ AXIS), 50)


# One scene of all: a screw, a rack and its pinion, a planet on a sun, bent shafts, slides, a bushing and a stop.

G, PITCH, RADIUS, RATIO, BEND = 9.81, 0.2, 0.1, -2.0, np.pi / 6
ADVANCE = PITCH / (2 * np.pi)
SHAFT_B = (float(np.cos(BEND)), 0.0, float(np.sin(BEND)))
SLOPE, PLANE = (0.0, 0.6, 0.8), (0.6, 0.0, 0.8)
C, C_R, M_0, SPIN = np.array([(1.0, 2.0, 3.0), (0.3, 0.2, 0.1), (0.5, -0.2, 0.1), (0.4, -0.5, 0.6)])


def workshop(solver=None):
    body = lambda mass, at=ORIGIN, inertia=(0.1, 0.2, 0.3), **more: lg.RigidBody(mass, inertia, position=at, **more)
    middle = tuple(np.array([0.5, 3.0, 0.0]) + 0.5 * np.array(SHAFT_B))
    bodies = {
        "nut": body(2.0, velocity=(0.0, 0.0, 30.0 * ADVANCE), angular_velocity=(0.0, 0.0, 30.0)),
        "pinion": body(1.0, (2.0, 0.0, 0.0)),
        "rack": body(3.0, (2.0, 0.0, -0.1)),
        "arm": body(1.5, (4.2, 0.0, 0.0)),
        "planet": body(0.7, (4.5, 0.0, 0.0)),
        "shaft_a": body(1.0, (0.0, 3.0, 0.0)),
        "shaft_b": body(1.0, middle, (0.4, 0.4, 0.4)),
        "arm_of_bar": body(1.0, (0.0, 4.0, 0.0)),
        "block": body(2.0, (0.0, 6.0, 0.0), velocity=X),
        "bead": lg.RigidBody(1.0, None, position=(0.0, 8.0, 0.0)),
        "rubbered": body(2.0, (0.0, 10.0, 0.0), velocity=X, angular_velocity=SPIN),
        "stopped": lg.RigidBody(0.5, None, position=(0.0, 12.0, 1.0)),
    }
    end = tuple(np.array([0.5, 3.0, 0.0]) + np.array(SHAFT_B))
    joints = {
        "screw": lg.ScrewJoint(None, "nut", at=ORIGIN, axis=Z, pitch=PITCH),
        "pinion hinge": lg.RevoluteJoint(None, "pinion", at=(2.0, 0.0, 0.0), axis=Y),
        "guide": lg.PrismaticJoint(None, "rack", at=(2.0, 0.0, -0.1), axis=X),
        "mesh": lg.RackAndPinionJoint("rack", "pinion", at=(2.0, 0.0, 0.0), axis=Y, direction=X, radius=RADIUS),
        "arm hinge": lg.RevoluteJoint(None, "arm", at=(4.0, 0.0, 0.0), axis=Z),
        "planet hinge": lg.RevoluteJoint("arm", "planet", at=(4.5, 0.0, 0.0), axis=Z),
        "sun": lg.GearJoint(
            None, "planet", at_a=(4.0, 0.0, 0.0), at_b=(4.5, 0.0, 0.0), axis_a=Z, axis_b=Z, ratio=RATIO
        ),
        "shaft hinge": lg.RevoluteJoint(None, "shaft_a", at=(0.0, 3.0, 0.0), axis=X),
        "homokinetic": lg.ConstantVelocityJoint("shaft_a", "shaft_b", at=(0.5, 3.0, 0.0), axis_a=X, axis_b=SHAFT_B),
        "line": lg.PointOnLineJoint(None, "shaft_b", at=end, axis=SHAFT_B),
        "bar hinge": lg.RevoluteJoint(None, "arm_of_bar", at=(0.0, 4.0, 0.0), axis=X),
        "slope": lg.PlanarJoint(None, "block", at=(0.0, 6.0, 0.0), axis=SLOPE),
        "plane": lg.PointOnPlaneJoint(None, "bead", at=(0.0, 8.0, 0.0), axis=PLANE),
    }
    rubber = {"stiffness": 50 * C, "damping": C, "rotational_stiffness": 20 * C_R, "rotational_damping": C_R}
    forces = {
        "weight": lg.Gravity((0.0, 0.0, -G)),
        "push": lg.AppliedForce("rack", force=(5.0, 0.0, 0.0), follows=True),
        "motor": lg.TorsionSpringDamper(None, "arm", axis=Z, stiffness=3.0, damping=0.2, free_angle=0.3, motor=0.6),
        "torque": lg.AppliedForce("shaft_a", moment=(0.8, 0.0, 0.0)),
        "bar": lg.AntiRollBar("shaft_a", "arm_of_bar", axis=X, diameter=0.005, length=0.8, damping=0.01),
        "drag": lg.Drag("block", drag_area=0.5, wind=(0.0, 0.0, 0.0)),
        "rubber": lg.Bushing(None, "rubbered", at=(0.0, 10.0, 0.0), rotational_preload=M_0, **rubber),
        "stop": lg.BumpStop(
            None, "stopped", at_a=(0.0, 12.0, 0.0), at_b=(0.0, 12.0, 1.0), gap=-0.02, stiffness=900.0, rounding=0.01
        ),
    }
    return lg.Model(bodies, joints, forces, linear_solver=solver)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [lg.DenseLU(), None, lg.BlockSparse()])
def test_accelerations_of_the_workshop(solver):
    model = workshop(solver)
    state = eqx.filter_jit(lg.initial_state)(model)
    system = model.system()
    ends = np.cumsum([len(free) for free in system.free])[:-1]
    rates = dict(zip(system.body_names, np.split(np.asarray(state.vdot), ends)))
    found, expected = [], []

    def compare(actual, wanted):
        found.extend(np.atleast_1d(actual))
        expected.extend(np.atleast_1d(wanted))

    fall = -G / (1 + 0.3 / (2.0 * ADVANCE**2))  # energy ½ (m + J/ρ²) ṡ²
    compare(rates["nut"][[2, 5]], [fall, fall / ADVANCE])
    slide = 5.0 / (3.0 + 0.2 / RADIUS**2)
    compare([rates["rack"][0], rates["pinion"][4]], [slide, -slide / RADIUS])
    turn = (0.6 + 3.0 * 0.3) / (0.3 + 1.5 * 0.2**2 + 0.7 * 0.5**2 + 0.3 * (1 - RATIO) ** 2)  # Willis: ω_p = (1 − ρ) ω
    compare([rates["arm"][5], rates["planet"][5]], [turn, (1 - RATIO) * turn])
    both = 0.8 / (0.1 + 0.4)
    compare([rates["shaft_a"][3], *rates["shaft_b"][3:]], [both, *(both * np.array(SHAFT_B))])
    down = lambda n: np.array([0.0, 0.0, -G]) + G * n[2] * np.array(n)
    compare(rates["block"][:3], down(SLOPE) - 0.5 * 1.225 * 0.5 / 2.0 * np.array(X))
    compare(rates["bead"][:3], down(PLANE))
    inertia = np.array([0.1, 0.2, 0.3])
    moment = -M_0 - C_R * SPIN - np.cross(SPIN, inertia * SPIN)
    compare(rates["rubbered"], [*(np.array([0.0, 0.0, -G]) - C * np.array(X) / 2.0), *(moment / inertia)])
    compare(rates["stopped"][2], 900.0 * 0.02**3 / (0.02**2 + 0.01**2) / 0.5 - G)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)  # condition of the scaled matrix: 1e5 round-offs


@pytest.mark.slow  # a program of twelve bodies
def test_shafts_turn_alike_and_gears_keep_their_ratio():
    """Travel of nut and pinion, angles of planet and arm, and with B v = 0 the angular velocities along both shafts."""
    integrator = lg.GeneralizedAlpha(stabilized=True)
    run = eqx.filter_jit(lambda model: lg.simulate(model, t1=0.5, num_steps=10, integrator=integrator))
    trajectory = run(workshop())
    body = trajectory.body
    spin = lambda name: body(name).angular_velocity[-1]
    angle = lambda name, i, j: np.arctan2(body(name).orientation[-1, j, i], body(name).orientation[-1, i, i])
    pairs = [
        (spin("shaft_b") @ np.array(SHAFT_B), spin("shaft_a")[0]),
        (spin("planet")[2], (1 - RATIO) * spin("arm")[2]),
    ]
    places = [
        (body("nut").position[-1, 2] % PITCH, ADVANCE * angle("nut", 0, 1) % PITCH),
        (2.0 - body("rack").position[-1, 0], RADIUS * angle("pinion", 2, 0)),
        (angle("planet", 0, 1), (1 - RATIO) * angle("arm", 0, 1)),
    ]
    np.testing.assert_allclose(*np.transpose(places + pairs), atol=1e-8)  # Newton's tolerance
    assert abs(body("nut").position[-1, 2]) > 2 * PITCH  # turns
    screw, slope, line = (trajectory.joint(name) for name in ("screw", "slope", "line"))
    np.testing.assert_allclose(screw.displacement, ADVANCE * screw.angle, atol=1e-8)  # over all of them
    travel = np.asarray(body("block").position) - (0.0, 6.0, 0.0)
    across = np.stack([slope.coordinates["displacement_y"], slope.coordinates["displacement_z"]], axis=1)
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), np.linalg.norm(travel, axis=1), atol=1e-8)
    assert set(line.coordinates) == {"displacement", "rotation_x", "rotation_y", "rotation_z"}


def on_the_ground():
    """What is new once, each between a body and the ground, so that its programs are small."""
    body = lambda at, **more: lg.RigidBody(2.0, (0.1, 0.2, 0.25), position=at, **more)
    bodies = {
        "nut": body(ORIGIN, velocity=(0.0, 0.0, 3.0 * ADVANCE), angular_velocity=(0.0, 0.0, 3.0)),
        "gear": body(AT_B, velocity=SLOPE),
        "shaft": body(AT),
        "block": body((0.0, 6.0, 0.0), velocity=X),
    }
    joints = {
        "screw": lg.ScrewJoint(None, "nut", at=ORIGIN, axis=Z, pitch=PITCH),
        "gears": lg.GearJoint(None, "gear", at_a=AT, at_b=AT_B, axis_a=AXIS, axis_b=AXIS_B, ratio=-1.5),
        "homokinetic": lg.ConstantVelocityJoint(None, "shaft", at=ORIGIN, axis_a=X, axis_b=SHAFT_B),
        "line": lg.PointOnLineJoint(None, "shaft", at=AT_B, axis=SHAFT_B),
        "slope": lg.PlanarJoint(None, "block", at=(0.0, 6.0, 0.0), axis=SLOPE),
    }
    rates = {f"rotational_{name}": values for name, values in RATES.items()}
    stop = {"gap": -0.02, "stiffness": 900.0, "rounding": 0.01, "progression": 0.1}
    forces = {
        "push": lg.AppliedForce("block", at=AT, force=AXIS, moment=X, follows=True),
        "motor": lg.TorsionSpringDamper(None, "nut", axis=Z, stiffness=3.0, damping=0.2, free_angle=0.3, motor=0.6),
        "bar": lg.AntiRollBar(None, "block", axis=SLOPE, diameter=0.005, length=0.8, bore=0.002, damping=0.01),
        "drag": lg.Drag("block", at=AT_B, drag_area=0.5, wind=AXIS_B),
        "rubber": lg.Bushing(None, "gear", at=AT_B, **RATES, **rates),
        "stop": lg.BumpStop(None, "gear", at_a=ORIGIN, at_b=AT_B, **stop),
    }
    return lg.Model(bodies, joints, forces)


def more_on_the_ground():
    """Curves, contacts, and ratios that vary."""
    body = lambda at, **more: lg.RigidBody(2.0, (0.1, 0.2, 0.25), position=at, **more)
    bodies = {"rubber": body(AT), "wheel": body(AT_B, velocity=X), "pinion": body(ORIGIN, angular_velocity=Y)}
    cubic = lg.Polynomial((0.0, 2.0, 0.0, 3.0))
    # no sample where the motion begins: there the second derivative jumps, and differences by its place see both sides
    sampled = lg.Sampled((-1.0, -0.3, 0.5, 1.0), (-2.0, -0.5, 1.5, 2.0), "monotone")
    curves = {"springs": (cubic, sampled, None), "rotational_dampers": (None, None, cubic)}
    soft = {"stiffness": 50.0, "rounding": 0.2}
    joints = {
        "mesh": lg.RackAndPinionJoint(
            None, "pinion", at=ORIGIN, axis=Y, direction=X, radius=0.3, travel=lg.Polynomial((0.0, 0.3, 0.05, 0.1))
        ),
        "gears": lg.GearJoint(
            None,
            "rubber",
            at_a=AT,
            at_b=AT,
            axis_a=AXIS,
            axis_b=AXIS,
            ratio=lg.Harmonic(amplitude=0.1, frequency=1.0),
            line=Z,
        ),
    }
    forces = {
        "rubber": lg.Bushing(None, "rubber", at=AT, **RATES, **curves),
        "tyre": lg.TyreSpring("wheel", at=AT_B, preload=3.0, **soft),
        "floor": lg.PlaneContact(
            None, "pinion", at=AT_B, axis=AXIS, gap=-0.1, damping=0.2, coefficient=0.3, slip_speed=0.4, **soft
        ),
        "turn": lg.AppliedForce("wheel", fixed_moment=AXIS),
    }
    return lg.Model(bodies, joints, forces)


@pytest.mark.slow  # three programs each, four minutes of processor
@pytest.mark.parametrize("scene", [on_the_ground, more_on_the_ground])
def test_every_number(scene):
    """DDM, AVM and differences of four random sums of the state: entries of their own that stay zero are round-off."""

    def asked(model):
        states = lg.simulate(model, t1=0.05, num_steps=5).states
        end = jnp.concatenate([jnp.ravel(leaf[-1]) for leaf in (*states.q, states.v)])
        return jnp.asarray(np.random.default_rng(0).standard_normal((4, end.size))) @ end

    check_sensitivities(asked, scene()).raise_if_failed()


BAD = {
    "pitch": (lambda: lg.ScrewJoint("a", "b", at=AT, axis=AXIS, pitch=0.0), "ScrewJoint: `pitch` must not be zero"),
    "radius": (
        lambda: lg.RackAndPinionJoint("a", "b", at=AT, axis=AXIS, direction=X, radius=0.0),
        "`radius` must not be zero",
    ),
    "gears on one axis": (
        lambda: lg.GearJoint("a", "b", at_a=ORIGIN, at_b=Z, axis_a=X, axis_b=Z, ratio=1.0),
        "is along `axis_b`",
    ),
    "teeth": (lambda: lg.GearJoint("a", "b", at_a=AT, at_b=AT_B, axis_a=X, axis_b=X, ratio=1.0, teeth=0), "`teeth`"),
    "opposed shafts": (
        lambda: lg.ConstantVelocityJoint("a", "b", at=AT, axis_a=X, axis_b=(-1.0, 0.1, 0.0)),
        "give both in the same sense",
    ),
    "twice free": (
        lambda: lg.TorsionSpringDamper("a", "b", axis=X, free_angle=0.0, preload=1.0),
        "`free_angle` or `preload`, not both",
    ),
    "turned": (
        lambda: lg.RotationalSpringDamper("a", "b", stiffness=1.0, turned=(0.0, 2.0, 3.0)),
        "`turned` must be within half a turn",
    ),
    "bore": (lambda: lg.AntiRollBar("a", "b", axis=X, diameter=0.02, bore=0.03, length=1.0), "`diameter` > `bore`"),
    "rounding": (
        lambda: lg.BumpStop("a", "b", at_a=AT, at_b=AT_B, gap=0.0, stiffness=1.0, rounding=0.0),
        "BumpStop: `rounding` must be positive",
    ),
    "stop without direction": (
        lambda: lg.BumpStop("a", "b", at_a=AT, at_b=AT, gap=0.0, stiffness=1.0, rounding=0.1),
        "has no direction; move one end",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    make, message = BAD[name]
    with pytest.raises(ValueError, match=says(message)):
        make()


@pytest.mark.parametrize(("free", "rows"), [("x y rz", 0), ("x y z rz", 1)])
def test_planar_joint_of_a_body_with_few_freedoms(free, rows):
    body = lg.RigidBody(1.0, (1.0, 1.0, 1.0), free=free.split())
    model = lg.Model({"b": body}, {"plane": lg.PlanarJoint(None, "b", at=ORIGIN, axis=Z)})
    assert model.system().constraint_names == ("plane",) * rows


def test_screw_of_a_body_with_few_freedoms():
    """A body that turns about the screw and moves along it keeps the equation of the pitch, and falls the same."""
    body = lg.RigidBody(2.0, (0.1, 0.2, 0.3), free=("z", "rz"))
    screw = lg.ScrewJoint(None, "nut", at=ORIGIN, axis=Z, pitch=PITCH)
    model = lg.Model({"nut": body}, {"screw": screw}, {"weight": lg.Gravity((0.0, 0.0, -G))})
    assert model.system().constraint_names == ("screw",)
    fall = -G / (1 + 0.3 / (2.0 * ADVANCE**2))
    np.testing.assert_allclose(eqx.filter_jit(lg.initial_state)(model).vdot[0], fall, rtol=1e-12)
