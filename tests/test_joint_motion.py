"""`Trajectory.joint` and `Trajectory.point`: against Newton and Euler by hand, SciPy's rotations, closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, GRAVITY, central_difference, random_body, random_point, random_rotation, says, some_quick
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.criteria._criterion_use import Use
from lgsens.model import Frame, relative_motion

ORIGIN, X, Y, Z = np.zeros(3), np.eye(3)[0], np.eye(3)[1], np.eye(3)[2]
G = np.asarray(GRAVITY)


def each_joint(seed=3):
    """One body for each type of joint, on the ground, which is a or b."""
    rng = np.random.default_rng(seed)
    at, axis = lambda: rng.uniform(-1, 1, 3), lambda: rng.normal(size=3)
    joints = {
        "ball": lg.SphericalJoint(None, "ball", at=at()),
        "hinge": lg.RevoluteJoint(None, "hinge", at=at(), axis=axis()),
        "cardan": lg.UniversalJoint("cardan", None, at=at(), axis_a=axis(), axis_b=axis()),
        "slider": lg.PrismaticJoint("slider", None, at=at(), axis=axis()),
        "sleeve": lg.CylindricalJoint(None, "sleeve", at=at(), axis=axis()),
        "weld": lg.FixedJoint(None, "weld", at=at()),
        "rod": lg.DistanceJoint(None, "rod", at_a=at(), at_b=at()),
        "shift": lg.TranslationDriver(None, "shift", at=at(), axis=axis(), value=lg.Polynomial((0.0, 1.0, 3.0))),
        "turn": lg.RotationDriver(None, "turn", axis=axis()),
        "wheel": lg.Rolling("wheel", at=at(), axis=(0.2, 1.0, 0.3), radius=0.4, normal=(0.1, 0.2, 1.0)),
    }
    spin = lambda: {"velocity": rng.normal(size=3), "angular_velocity": rng.normal(size=3)}
    bodies = {name: random_body(rng, **spin()) for name in joints}
    bodies["turn"] = lg.RigidBody(2.0, (0.3, 0.4, 0.5), position=at(), velocity=axis())  # it only falls and turns not
    return lg.Model(bodies, joints, {"gravity": lg.Gravity(G)})


def newton_euler(body, motion, gravity=G):
    """Force, and moment about the centre of mass, that a motion needs besides its weight, inertial frame, (n + 1, 3).

    Compared from the second time on: at the first the scheme moves v by O(h²), and not v̇ and λ.
    """
    x, orientation, _, spin, acceleration, change = map(np.asarray, motion)
    inertia = np.asarray(body.inertia if body.inertia.ndim == 2 else np.diag(body.inertia))
    moment = change @ inertia + np.cross(spin, spin @ inertia)
    return float(body.mass) * (acceleration - gravity), np.einsum("nij,nj->ni", orientation, moment), x


@pytest.mark.slow  # a joint of each type; others look at single ones
def test_force_and_moment_are_what_the_motion_needs():
    """m ẍ = m g + F, J Ω̇ + Ω × J Ω = Rᵀ(M + (p − x) × F) for each type of joint."""
    model = each_joint()
    trajectory = lg.simulate(model, t1=0.1, num_steps=20, integrator=lg.GeneralizedAlpha(0.5))
    for name, joint in model.joints.items():
        found = trajectory.joint(name)
        force, moment, x = newton_euler(model.bodies[name], trajectory.body(name))
        sign = 1.0 if joint.b == name else -1.0  # of what a joint does to its a
        point = np.asarray(found.point)
        # Newton's iteration ends at 1e-10 of a large change of each coordinate, over βh² = 6e-6 s² [measured: 2e-9]
        scale = 1.0 + max(np.abs(force).max(), np.abs(moment).max())
        np.testing.assert_allclose(sign * found.force, force, rtol=0, atol=1e-7 * scale, err_msg=name)
        about_centre = sign * (found.moment + np.cross(point - x, found.force))
        np.testing.assert_allclose(about_centre[1:], moment[1:], rtol=0, atol=1e-7 * scale, err_msg=name)
        turned = np.asarray(trajectory.body(name).orientation) if joint.a == name else np.eye(3)[None]
        if joint.a == name:
            turned = turned @ np.asarray(model.bodies[name].orientation).T
        axes = turned @ np.asarray(joint.frames[0].orientation)
        for local, whole in ((found.local_force, found.force), (found.local_moment, found.moment)):
            np.testing.assert_allclose(np.einsum("nij,nj->ni", axes, local), whole, rtol=0, atol=1e-13 * scale)
    hinge, slider = trajectory.joint("hinge"), trajectory.joint("slider")
    assert np.abs(hinge.moment).max() > 0.1 and np.abs(slider.moment).max() > 0.1
    # nothing about the axis of a hinge, nor along that of a slider
    size = np.abs(hinge.moment).max(), np.abs(slider.force).max()
    assert np.abs(hinge.local_moment[:, 0]).max() < 1e-13 * size[0]
    assert np.abs(slider.local_force[:, 0]).max() < 1e-13 * size[1]
    ball = trajectory.joint("ball")  # its multiplier is the force of b on a
    np.testing.assert_allclose(ball.force, -trajectory.multiplier("ball"), rtol=0, atol=0)
    assert np.abs(ball.moment).max() < 1e-14 * np.abs(ball.force).max() * 10.0
    rod = trajectory.joint("rod")
    towards = np.asarray(rod.point) - np.asarray(model.joints["rod"].at_a)
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    tension = np.asarray(trajectory.multiplier("rod"))
    np.testing.assert_allclose(rod.force, -tension * towards, rtol=0, atol=1e-13 * np.abs(tension).max())

    # coordinates: SciPy's rotations of b seen from a, in the axes of the joint
    for name, joint in model.joints.items():
        found, body = trajectory.joint(name), trajectory.body(name)
        turned = np.asarray(body.orientation) @ np.asarray(model.bodies[name].orientation).T
        axes = np.asarray(joint.frames[0].orientation)
        turned = axes.T @ (turned if joint.b == name else turned.swapaxes(1, 2)) @ axes
        rotation, own = Rotation.from_matrix(turned), found.coordinates
        close = lambda actual, expected: np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9)
        match name:
            case "ball":
                close(np.stack([own[f"rotation_{i}"] for i in "xyz"], axis=1), rotation.as_rotvec())
            case "hinge" | "sleeve" | "turn":  # the joint holds to the tolerance of Newton's iteration
                close(own["angle"], rotation.as_rotvec()[:, 0])
            case "cardan":
                close(np.stack([own["angle_a"], own["angle_b"]], axis=1), rotation.as_euler("XYZ")[:, :2])
            case "weld":
                assert own == {}
                close(found.orientation, np.broadcast_to(np.eye(3), (21, 3, 3)))
        if name == "shift":
            t = np.asarray(trajectory.t)
            close(found.displacement, t + 3.0 * t**2)
            assert abs(found.rate[-1] - 1.0 - 6.0 * t[-1]) < 10 * 0.005**2  # velocities keep joints to c h²
        if name == "rod":
            close(found.coordinates["length"], np.linalg.norm(joint.at_b - joint.at_a))
    start, axis = (np.asarray(x) for x in (model.bodies["slider"].position, model.joints["slider"].axis))
    slid = (np.asarray(trajectory.body("slider").position) - start) @ axis / np.linalg.norm(axis)
    np.testing.assert_allclose(trajectory.joint("slider").displacement, -slid, rtol=0, atol=1e-9)  # of the ground


@pytest.mark.parametrize("name", ["ball", "hinge", "cardan", "sleeve", "rod", "wheel"])
def test_rates_and_accelerations_are_derivatives_by_time(name):
    """Two bodies at x(t) = x + ẋ t + ẍ t²/2, R(t) = R exp(ũ t) exp(w̃ t): Ω = u + w, Ω̇ = u × w at t = 0."""
    rng = np.random.default_rng(5)
    joint = each_joint().joints[name]
    references = [Frame(rng.uniform(-1, 1, 3), random_rotation(rng)) for _ in "ab"]
    given = [(rng.uniform(-1, 1, 3), random_rotation(rng), *rng.normal(size=(4, 3))) for _ in "ab"]

    def at(t):
        motions = []
        for x, orientation, velocity, acceleration, u, w in given:
            later = orientation @ (Rotation.from_rotvec(u * t) * Rotation.from_rotvec(w * t)).as_matrix()
            place = x + velocity * t + acceleration * t**2 / 2
            motions.append((place, later, velocity, u + w, acceleration, np.cross(u, w)))
        leading = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], tuple(motions))
        return relative_motion(joint.coordinates, joint.frames, references, leading)

    step = 1e-3  # differences of fourth order: step⁴ = 1e-12 of the motion's, round-off EPS/step² = 2e-10
    found, values = at(0.0), [np.asarray(at(k * step).values[0]) for k in (-2, -1, 0, 1, 2)]
    rate = np.array([1, -8, 0, 8, -1]) / (12 * step) @ values
    acceleration = np.array([-1, 16, -30, 16, -1]) / (12 * step**2) @ values
    np.testing.assert_allclose(found.rates[0], rate, rtol=0, atol=1e-9 * (1 + np.abs(rate).max()))
    bound = 1e-8 * (1 + np.abs(acceleration).max())
    np.testing.assert_allclose(found.accelerations[0], acceleration, rtol=0, atol=bound)
    assert len(joint.coordinates) == len(values[2]) > 0


@pytest.mark.slow
@pytest.mark.parametrize("rate", [7.0, -100.0])
def test_angle_over_many_turns(rate):
    """ω t, also where a step is more than half a turn (5 rad)."""
    rotor = lg.RigidBody(2.0, (0.3, 0.3, 0.5), position=(0.1, 0.2, 0.0), angular_velocity=(0.0, 0.0, rate))
    model = lg.Model({"rotor": rotor}, {"hinge": lg.RevoluteJoint(None, "rotor", at=(0.1, 0.2, 1.0), axis=2 * Z)})
    trajectory = lg.simulate(model, t1=5.0, num_steps=100)
    found = trajectory.joint("hinge")
    assert abs(found.angle[-1]) > 2 * np.pi * 5
    # each step adds a rotation to round-off
    np.testing.assert_allclose(found.angle, rate * np.asarray(trajectory.t), rtol=0, atol=100 * 10 * EPS * abs(rate))
    np.testing.assert_allclose(found.rate, np.full(101, rate), rtol=1e-13)


def two_parts(**options):
    """An arm on a hinge with a mass welded to it, in the xz-plane."""
    spin = {"angular_velocity": (0.0, 2.0, 0.0)}
    bodies = {
        "arm": lg.RigidBody(2.0, (0.02, 0.3, 0.3), position=(0.5, 0.0, 0.0), velocity=(0.0, 0.0, -1.0), **spin),
        "mass": lg.RigidBody(1.0, (0.05, 0.04, 0.03), position=(1.1, 0.0, 0.2), velocity=(0.4, 0.0, -2.2), **spin),
    }
    joints = {
        "hinge": lg.RevoluteJoint(None, "arm", at=ORIGIN, axis=Y),
        "weld": lg.FixedJoint("mass", "arm", at=(1.0, 0.0, 0.0)),
    }
    if free := options.pop("free", None):
        bodies = {
            name: lg.RigidBody(b.mass, b.inertia, b.position, b.orientation, b.velocity, b.angular_velocity, free=free)
            for name, b in bodies.items()
        }
    return lg.Model(bodies, joints, {"gravity": lg.Gravity(G)}, **options)


PLANAR = {"free": "x z ry"}
SLOW = [pytest.param(options, marks=pytest.mark.slow) for options in ({"merge_fixed": True}, PLANAR)]


@pytest.mark.slow
@pytest.mark.parametrize("options", [*SLOW, PLANAR | {"merge_fixed": True}])
def test_of_merged_and_freed_bodies(options):
    model = two_parts(**options)
    trajectory = lg.simulate(model, t1=0.2, num_steps=40)
    arm, mass = (newton_euler(model.bodies[name], trajectory.body(name)) for name in ("arm", "mass"))
    weld, hinge = trajectory.joint("weld"), trajectory.joint("hinge")
    scale = np.abs(hinge.force).max()
    close = lambda a, b: np.testing.assert_allclose(a[1:], b[1:], rtol=0, atol=1e-8 * scale)
    close(-weld.force, mass[0])  # "mass" is its a
    close(-weld.moment - np.cross(np.asarray(weld.point) - mass[2], weld.force), mass[1])
    close(hinge.force + weld.force, arm[0])
    both = hinge.moment + weld.moment + np.cross(np.asarray(weld.point) - hinge.point, weld.force)
    close(both - np.cross(arm[2] - hinge.point, arm[0]), arm[1])
    angle = np.arctan2(*(-np.asarray(trajectory.body("arm").position).T[[2, 0]] * [[1.0], [-1.0]]))
    close(hinge.angle, angle)


@pytest.mark.slow
def test_redundant_joints_share_what_the_motion_needs():
    """A door on two hinges: the sum of their forces, and least norm: alike for two alike at the same distance."""
    door = lg.RigidBody(3.0, (0.3, 0.2, 0.1), position=(0.5, 0.0, 0.0), velocity=(0.0, 0.5, 0.0), angular_velocity=Z)
    hinges = {
        name: lg.RevoluteJoint(None, "door", at=(0.0, 0.0, z), axis=Z) for name, z in (("low", -1.0), ("up", 1.0))
    }
    model = lg.Model({"door": door}, hinges, {"gravity": lg.Gravity(G)}, redundant="minimum_norm")
    trajectory = lg.simulate(model, t1=0.1, num_steps=10)
    low, up = trajectory.joint("low"), trajectory.joint("up")
    force, moment, x = newton_euler(door, trajectory.body("door"))
    scale = np.abs(force).max()
    np.testing.assert_allclose(low.force + up.force, force, rtol=0, atol=1e-8 * scale)
    about = sum(j.moment + np.cross(np.asarray(j.point) - x, j.force) for j in (low, up))
    np.testing.assert_allclose(about[1:], moment[1:], rtol=0, atol=1e-8 * scale)
    np.testing.assert_allclose(low.force[:, 2], up.force[:, 2], rtol=0, atol=1e-8 * scale)
    np.testing.assert_allclose(low.angle, up.angle, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_of_a_driven_mechanism():
    """Crank and slider over three turns: x = r cos φ + √(l² − r² sin²φ); the driving moment by virtual work."""
    r, length, weight = 0.3, 1.0, 4.0
    bodies = {
        "crank": lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=(0.0, 0.0, 0.0), free="rz"),
        "slider": lg.RigidBody(2.0, (0.1, 0.1, 0.1), position=(r + length, 0.0, 0.0)),
    }
    joints = {
        "motor": lg.RotationDriver(None, "crank", axis=Z),
        "guide": lg.PrismaticJoint(None, "slider", at=(r + length, 0.0, 0.0), axis=X),
        "rod": lg.DistanceJoint("crank", "slider", at_a=(r, 0.0, 0.0), at_b=(r + length, 0.0, 0.0)),
    }
    model = lg.Model(bodies, joints, {"load": lg.AppliedForce("slider", force=(-weight, 0.0, 0.0))})
    phi = np.linspace(0.0, 6 * np.pi, 121)
    found = lg.kinematics(model, {"motor": phi}, rates={"motor": 0.0})
    x = r * np.cos(phi) + np.sqrt(length**2 - (r * np.sin(phi)) ** 2)
    slope = -r * np.sin(phi) - r**2 * np.sin(phi) * np.cos(phi) / np.sqrt(length**2 - (r * np.sin(phi)) ** 2)
    np.testing.assert_allclose(found.joint("motor").angle, phi, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.joint("guide").displacement, x - r - length, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.joint("motor").moment[:, 2], weight * slope, rtol=0, atol=1e-8)
    moving = lg.kinematics(model, {"motor": phi})
    np.testing.assert_allclose(moving.joint("guide").rate, slope, rtol=0, atol=1e-9)


def test_coordinates_of_a_wheel():
    """On a circle about the normal, leaning: where its lowest point is, by hand."""
    radius, lean, about = 0.5, 0.3, 2.0
    heading, spin = np.linspace(0.0, 3.0, 7), np.linspace(0.0, -2.5, 7)
    wheel = lg.Rolling("wheel", at=(0.0, 0.0, radius), axis=Y, radius=radius)
    tilted = Rotation.from_rotvec(heading[:, None] * Z) * Rotation.from_rotvec(lean * X)
    turned = tilted * Rotation.from_rotvec(spin[:, None] * Y)
    contact = about * np.stack([np.sin(heading), 1 - np.cos(heading), 0 * heading], axis=1)
    still = jnp.zeros((7, 3))
    motion = jnp.asarray(contact + radius * tilted.apply(Z)), jnp.asarray(turned.as_matrix()), *[still] * 4
    ground = still, jnp.broadcast_to(jnp.eye(3), (7, 3, 3)), *[still] * 4
    references = Frame(still[0], jnp.eye(3)), Frame(wheel.at, jnp.eye(3))
    found = relative_motion(wheel.coordinates, wheel.frames, references, (ground, motion)).values
    expected = np.stack([contact[:, 0], contact[:, 1], heading, np.full(7, lean), spin], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def pendulum(p):
    """A body on a slanted hinge; p: the hinge's point and axis."""
    body = lg.RigidBody(1.5, (0.1, 0.2, 0.25), position=(0.4, 0.1, 0.0))
    hinge = lg.RevoluteJoint(None, "body", at=p["at"], axis=p["axis"])
    return lg.Model({"body": body}, {"hinge": hinge}, {"gravity": lg.Gravity(G)})


@pytest.mark.slow  # gradients of simulations in both modes
def test_derivatives_in_both_modes_are_those_of_differences():
    """By the hardpoint, the axis and the marker."""
    p = {"at": jnp.array([0.0, 0.05, 0.1]), "axis": jnp.array([0.1, 1.0, 0.2]), "marker": jnp.array([0.8, 0.2, 0.1])}

    def what(p):
        trajectory = lg.simulate(pendulum(p), t1=0.2, num_steps=20)
        joint, marker = trajectory.joint("hinge"), trajectory.point("body", p["marker"])
        own = [joint.angle[-1:], joint.rate[-1:], joint.acceleration[-1:], joint.force[-1], joint.local_moment[-1]]
        found = jnp.concatenate([*own, *(array[-1] for array in marker)])
        return found, found

    with_value = jax.jit(jax.jacrev(what, has_aux=True))
    forward, reverse = jax.jit(jax.jacfwd(lambda p: what(p)[0]))(p), with_value(p)[0]
    for name in p:
        scale = np.abs(forward[name]).max()
        np.testing.assert_allclose(reverse[name], forward[name], rtol=0, atol=1e-9 * scale)  # EPS/(βh²) = 1e-11
        for i in range(3):
            # of fourth order: 3e-14 of fifth derivatives; Newton's iteration leaves 1e-10 of forces, over 1e-3
            step = 1e-3 * np.eye(3)[i]
            at = lambda k, name=name, step=step: np.asarray(with_value(p | {name: p[name] + k * step})[1])
            difference = (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / 12e-3
            np.testing.assert_allclose(forward[name][:, i], difference, rtol=0, atol=1e-7 * scale)


def test_point_is_where_the_reference_configuration_has_it():
    """Also where the motion starts elsewhere; velocity and acceleration by hand."""
    p = {"at": np.zeros(3), "axis": Y}
    model, at = pendulum(p), np.array([0.7, -0.2, 0.3])
    first = lg.simulate(model, t1=0.5, num_steps=50)
    trajectory = lg.simulate(model, t0=0.5, t1=0.6, num_steps=50, state0=first.state(-1))
    x, orientation, velocity, spin, acceleration, change = map(np.asarray, trajectory.body("body"))
    found, local = trajectory.point("body", at), at - np.array([0.4, 0.1, 0.0])
    turned = lambda vectors: np.einsum("nij,nj->ni", orientation, np.broadcast_to(vectors, spin.shape))
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
    close(found.position, x + turned(local))
    close(found.velocity, velocity + turned(np.cross(spin, local)))
    close(found.acceleration, acceleration + turned(np.cross(change, local) + np.cross(spin, np.cross(spin, local))))
    assert np.abs(found.position[0] - at).max() > 0.1
    swung = np.arctan2(-orientation[:, 2, 0], orientation[:, 0, 0])  # about y
    close(trajectory.joint("hinge").angle, swung)  # counted from the reference configuration too
    instant = lg.Instant(t=trajectory.t[3], state=trajectory.state(3), system=trajectory.system)
    for one, every in zip(instant.point("body", at), found):
        np.testing.assert_allclose(one, every[3], rtol=0, atol=1e-14)
    path = jax.vmap(lambda at: trajectory.point("body", at).position)(jnp.stack([jnp.asarray(at), jnp.zeros(3)]))
    close(path[0], found.position)


def anywhere(model) -> lg.Trajectory:
    """Three states of a model, whatever its joints say."""
    rng, system = np.random.default_rng(1), model.system()
    states = [lg.State(q, v, vdot, lam, vdot) for q, v, vdot, lam, _ in (random_point(system, rng) for _ in range(3))]
    stacked, t = jax.tree.map(lambda *leaves: jnp.stack(leaves), *states), jnp.arange(3.0)
    return lg.Trajectory(t=t, states=stacked, result=jnp.asarray(0), stats=None, system=system)


def test_derivatives_by_a_hardpoint_of_one_motion():
    """Of angle, force and moment by the hinge's point and axis, the motion as it is: forward, reverse, differences."""
    run = anywhere(pendulum({"at": np.zeros(3), "axis": Y}))

    def what(p):
        found = eqx.tree_at(lambda run: run.system.given, run, pendulum(p).system().given).joint("hinge")
        one = [found.angle, found.rate, found.acceleration]
        return jnp.concatenate([*one, found.moment.ravel(), found.local_moment.ravel(), found.local_force.ravel()])

    p = {"at": jnp.array([0.0, 0.05, 0.1]), "axis": jnp.array([0.1, 1.0, 0.2])}
    forward, reverse = jax.jit(jax.jacfwd(what))(p), jax.jit(jax.jacrev(what))(p)
    value = jax.jit(what)
    for name in p:
        scale = np.abs(forward[name]).max()
        np.testing.assert_allclose(reverse[name], forward[name], rtol=0, atol=1e-13 * scale)
        columns = central_difference(lambda x, name=name: value(p | {name: p[name] + x}), 3)
        np.testing.assert_allclose(forward[name], columns, rtol=0, atol=1e-8 * scale)  # 4e-11 of third derivatives
    assert np.abs(forward["at"]).max() > 0.1 and np.abs(forward["axis"]).max() > 0.1


def test_messages():
    trajectory = anywhere(two_parts())
    with pytest.raises(ValueError, match=says("`joint`: 'hing' is not one of ['hinge', 'weld']")):
        trajectory.joint("hing")
    with pytest.raises(ValueError, match=says("`angle`", "relative coordinates of this joint are []", "`coordinates`")):
        _ = trajectory.joint("weld").angle
    with pytest.raises(ValueError, match=says("`rate`", "are []")):
        _ = trajectory.joint("weld").rate
    with pytest.raises(ValueError, match=says("`body`: 'arms' is not one of ['arm', 'mass']")):
        trajectory.point("arms", ORIGIN)
    with pytest.raises(ValueError, match=says("`at` must have shape (3,), got shape (2,)")):
        trajectory.point("arm", (0.0, 1.0))


def joint_criterion(s, p):
    """Of everything that a joint says, at an instant."""
    hinge = s.joint("hinge")
    return hinge.angle**2 + 1e-2 * hinge.rate * hinge.acceleration + 1e-4 * hinge.force @ hinge.local_moment


def of_scene(**options):
    """The pendulum with a part welded to it, p as there."""

    def build(p):
        scene = pendulum(p)
        part = lg.RigidBody(0.5, (0.01, 0.01, 0.01), position=(0.6, 0.0, 0.2))
        weld = lg.FixedJoint("body", "part", at=(0.5, 0.0, 0.1))
        return lg.Model(scene.bodies | {"part": part}, scene.joints | {"weld": weld}, scene.forces, **options)

    return build


@pytest.mark.slow  # three programs each; small version: test_joints_of_an_instant
@pytest.mark.parametrize("options", [{}, {"merge_fixed": True}, {"formulation": "SE3"}])
def test_a_criterion_of_joints(options):
    """An instant knows the joints of its scene: on the fly, backwards, and through a trajectory, whose `joint` is
    tested against differences above; by the hardpoint and the axis, on which its frames depend directly."""
    p, build = {"at": jnp.array([0.0, 0.05, 0.1]), "axis": jnp.array([0.1, 1.0, 0.2])}, of_scene(**options)
    # programs stop Newton's iteration at other increments: 1e-10 over h², of accelerations, would be seen
    settings = {"t1": 0.2, "num_steps": 20, "integrator": lg.GeneralizedAlpha(tolerance=1e-13)}
    criterion = lg.Criterion(integrand=joint_criterion, terminal=lambda s, p: s.joint("hinge").angle * p["at"][2])

    def through_trajectory(p):
        run = lg.simulate(build(p), **settings)
        hinge = run.joint("hinge")
        product = jnp.sum(hinge.force * hinge.local_moment, axis=1)
        rate = hinge.angle**2 + 1e-2 * hinge.rate * hinge.acceleration + 1e-4 * product
        return lg.time_integral(run.t, rate) + hinge.angle[-1] * p["at"][2]

    value, expected = jax.jit(jax.value_and_grad(through_trajectory))(p)
    for method in (lg.DirectDifferentiation(), lg.AdjointVariable()):
        found = lg.differentiate(criterion, build, p, method=method, **settings)
        np.testing.assert_allclose(found.value, value, rtol=1e-11)
        for name in p:
            scale = np.abs(expected[name]).max()
            np.testing.assert_allclose(found.gradient[name], expected[name], rtol=0, atol=1e-10 * scale)  # EPS/(βh²)
            assert scale > 1e-2


def test_joints_of_an_instant():
    """As those of the trajectory, and of `save`."""
    model, at = pendulum({"at": np.zeros(3), "axis": Y}), 7
    run = lg.simulate(model, t1=0.2, num_steps=20)
    instant = run.instant(at)
    assert float(instant.t) == float(run.t[at])
    for one, every in zip(jax.tree.leaves(instant.joint("hinge")), jax.tree.leaves(run.joint("hinge")), strict=True):
        np.testing.assert_allclose(one, every[at], rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(instant.joint("hinge").axial_moment, instant.joint("hinge").local_moment[0])
    np.testing.assert_array_equal(run.joint("hinge").axial_force, run.joint("hinge").force @ Y)  # about a fixed axis
    saved = lg.simulate(model, t1=0.2, num_steps=20, save=lambda s: s.joint("hinge").coordinates)
    np.testing.assert_allclose(saved.values["angle"], run.joint("hinge").angle, rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match=says("`joint`: 'hing' is not one of ['hinge']")):
        instant.joint("hing")
    with pytest.raises(IndexError, match=says("`index` must be from -21 to 20")):
        run.instant(21)
    with pytest.raises(IndexError, match=says("`index` must be a whole number", "1.5")):
        run.instant(1.5)


@pytest.mark.parametrize("bodies", some_quick([((None, "bob"),), (("bob", None),)]))
def test_the_force_along_a_rod_turns_with_it(bodies):
    """Of a swinging bob, −(m v²/l − m g z/l), whichever end is a, and as many N as there are in the force."""
    at = dict(zip(("at_a", "at_b"), [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)][:: 1 if bodies[0] is None else -1]))
    bob = lg.RigidBody(2.0, None, position=(1.0, 0.0, 0.0))
    model = lg.Model({"bob": bob}, {"rod": lg.DistanceJoint(*bodies, **at)}, {"g": lg.Gravity((0.0, 0.0, -9.81))})
    run = lg.simulate(model, t1=0.6, num_steps=60, integrator=lg.RadauIIA())
    position, velocity = run.body("bob").position, run.body("bob").velocity
    tension = 2.0 * (np.sum(velocity**2, axis=1) - 9.81 * position[:, 2])
    assert np.abs(position[-1, 0]) < 0.5  # it has turned by more than a radian
    np.testing.assert_allclose(run.joint("rod").axial_force, -tension, atol=1e-9)  # Radau's λ in 10 ms
    np.testing.assert_allclose(np.linalg.norm(run.joint("rod").force, axis=1), np.abs(tension), atol=1e-9)


def test_what_a_criterion_of_a_joint_depends_on():
    """An angle and a rate on no acceleration and no multiplier: the continuous adjoint method may have them."""
    p = {"at": np.zeros(3), "axis": Y}
    system = pendulum(p).system()
    questions = {
        (False, False): [lambda j: j.angle, lambda j: j.rate, lambda j: j.point[0]],
        (True, False): [lambda j: j.acceleration],
        (False, True): [lambda j: j.force[0], lambda j: j.axial_moment],
    }
    for expected, asked in questions.items():
        for of in asked:
            criterion = lg.Criterion(integrand=lambda s, p, of=of: of(s.joint("hinge")))
            assert Use.of(criterion, system, jnp.zeros(()), p).integrand == expected


@pytest.mark.slow
def test_joints_are_outputs_of_a_linearization():
    """The angle by the one coordinate of a pendulum, whose rate is that of the angle."""
    model = pendulum({"at": np.zeros(3), "axis": Y})
    outputs = {"angle": lambda s: s.joint("hinge").angle, "rate": lambda s: s.joint("hinge").rate}
    linear = lg.linearize(lg.Model(model.bodies, model.joints), outputs=outputs)
    c = np.asarray(linear.C)
    np.testing.assert_allclose(c[0, 0], c[1, 1], rtol=1e-12)
    assert c[0, 1] == c[1, 0] == 0.0 and abs(c[0, 0]) > 0.1


@pytest.mark.slow
def test_a_batch_is_asked_one_by_one():
    """Whatever is asked: a body, a point mass, a point, a joint, a force, multipliers, a state."""

    def run(length):
        bodies = {
            "arm": lg.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), position=(length, 0.0, 0.0)),
            "bob": lg.RigidBody(2.0, None, position=(2.0 * length, 0.0, 0.0)),
        }
        joints = {
            "hinge": lg.RevoluteJoint(None, "arm", at=ORIGIN, axis=(0.0, 1.0, 0.0)),
            "ball": lg.SphericalJoint("arm", "bob", at=(2.0 * length, 0.0, 0.0)),
        }
        spring = lg.SpringDamper(None, "bob", at_a=(0.0, 0.0, 1.0), at_b=(2.0 * length, 0.0, 0.0), stiffness=50.0)
        model = lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81)), "spring": spring})
        return lg.simulate(model, t1=0.1, num_steps=4)

    questions = {
        "body": lambda run: run.body("arm"),
        "mass": lambda run: run.body("bob"),
        "point": lambda run: run.point("bob", (0.1, 0.2, 0.3)),
        "joint": lambda run: run.joint("hinge"),
        "force": lambda run: run.force("spring"),
        "multiplier": lambda run: run.multiplier("ball"),
        "state": lambda run: run.state(-1),
        "instant": lambda run: (run.instant(2).t, run.instant(2).body("bob").velocity),
    }
    batch = jax.jit(jax.vmap(jax.vmap(run)))(jnp.array([[0.4, 0.5, 0.6], [0.7, 0.8, 0.9]]))
    one = jax.tree.map(lambda leaf: leaf[1, 2], batch)
    asked = jax.jit(lambda run: {name: ask(run) for name, ask in questions.items()})
    of_all, of_one = asked(batch), asked(one)
    for name in questions:
        for found, expected in zip(jax.tree.leaves(of_all[name]), jax.tree.leaves(of_one[name]), strict=True):
            assert found.shape == (2, 3, *expected.shape), name
            # round-off of a product in another order
            np.testing.assert_allclose(found[1, 2], expected, rtol=0, atol=1e-12, err_msg=name)
    with pytest.raises(IndexError, match=says("from -5 to 4, as there are 5 states")):
        batch.state(5)
    with pytest.raises(ValueError, match=says("batch of trajectories, of shape (2, 3)", "jax.vmap(GivenSteps.of)")):
        lg.GivenSteps.of(batch)
