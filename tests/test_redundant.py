"""Redundant constraints: motion, multipliers of least norm, gradients; against mechanisms without them and NumPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says, some_quick

import lgsens as lg
from lgsens.examples import PROBLEMS, four_bar
from lgsens.integrate import singular_steps

PENDULUM = PROBLEMS["simple_pendulum_A01"]
Z = np.array([0.0, 0.0, 1.0])
EXACT = lg.GeneralizedAlpha(0.8, tolerance=1e-13)


def door(p, hinges=2, redundant="minimum_norm"):
    """A door 2 m high that swings about a leaning axis, on two hinges as far from the middle, or on one there."""
    mass, width, lean, spread = p["mass"], p["width"], p["lean"], p["spread"]
    axis = jnp.stack([jnp.sin(lean), 0.0 * lean, jnp.cos(lean)])
    across = jnp.stack([0.0 * lean, 1.0 + 0.0 * lean, 0.0 * lean])
    third = jnp.cross(axis, across)
    turn = jnp.stack([across, third, axis], axis=1)  # columns: the axes of the door
    inertia = mass / 12.0 * jnp.stack([0.0 * width + 4.0, width**2 + 4.0, width**2])
    body = lg.RigidBody(
        mass, inertia, width / 2.0 * across, turn, angular_velocity=1.5 * Z, velocity=0.75 * width * third
    )
    at = {"lower": -spread * axis, "upper": spread * axis} if hinges == 2 else {"only": jnp.zeros(3)}
    joints = {name: lg.RevoluteJoint(None, "door", at=point, axis=axis) for name, point in at.items()}
    return lg.Model(
        {"door": body},
        joints,
        {"gravity": lg.Gravity((0.0, 0.0, -9.81))},
        redundant=redundant if hinges == 2 else "refuse",
    )


DOOR = {name: jnp.asarray(number) for name, number in {"mass": 20.0, "width": 0.9, "lean": 0.3, "spread": 0.6}.items()}


def planar(redundant, **numbers):
    """The four-bar in its own form of 17 equations, or of four revolute joints: 20 equations of rank 17."""
    model = four_bar(**numbers)
    if not redundant:
        return model
    joints = dict(model.joints)
    for name, a, b in (("B", "crank", "coupler"), ("C", "coupler", "rocker")):
        pin = joints[name]
        assert isinstance(pin, lg.SphericalJoint | lg.UniversalJoint)
        joints[name] = lg.RevoluteJoint(a, b, at=pin.at, axis=jnp.asarray(Z))
    return lg.Model(model.bodies, joints, model.forces, redundant="minimum_norm")


CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, -1, 0), (1, -1, 1), (0, -1, 1), (0, 0, 1)], float)


def bricard(mass=1.0, size=1.0, relaxed=None, redundant="minimum_norm"):
    """The Bricard mechanism of the IFToMM benchmarks: five rods on edges of a cube and the ground, six revolute joints.

    The rods are a tenth as thick as long.

    Each of the axes is orthogonal to both rods; `relaxed`: the joint that is cylindrical instead.
    """
    corners = size * jnp.asarray(CORNERS)
    rods = jnp.roll(corners, -1, axis=0) - corners
    bodies, joints = {}, {}
    names = [*(f"rod {i}" for i in range(5)), None]
    for i, name in enumerate(names):
        along = rods[i] / size
        kind = lg.CylindricalJoint if i == relaxed else lg.RevoluteJoint
        joints[f"hinge {i}"] = kind(names[i - 1], name, at=corners[i], axis=jnp.cross(rods[i - 1], rods[i]))
        if name is not None:
            inertia = mass * size**2 / 12.0 * (1.01 * jnp.eye(3) - 0.99 * jnp.outer(along, along))
            bodies[name] = lg.RigidBody(mass, inertia, (corners[i] + corners[(i + 1) % 6]) / 2.0)
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, -9.81, 0.0))}, redundant=redundant)


MOTION = ("position", "velocity", "acceleration", "angular_velocity", "angular_acceleration")


def same_motion(one, other, tolerance):
    for body in one.system.body_names:
        for what in MOTION:
            a, b = getattr(one.body(body), what), getattr(other.body(body), what)
            np.testing.assert_allclose(
                a, b, rtol=0, atol=tolerance * (1.0 + jnp.abs(b).max()), err_msg=f"{body} {what}"
            )


def least_norm(trajectory, n):
    """λ at step n by NumPy's pseudo-inverse, with moments divided by the radius of gyration."""
    system = trajectory.system
    q = jax.tree.map(lambda leaf: leaf[n], trajectory.states.q)
    jacobian = np.asarray(system.constraint_jacobian(q, 0.0))
    gyration = np.sqrt(np.mean(np.trace(system.inertia, axis1=1, axis2=2)) / 3.0 / np.mean(system.mass))
    # rows of points move with translations, rows of axes do not
    columns = system.index[:, :3].ravel()
    arm = np.where(np.abs(jacobian[:, columns]).max(axis=1) > 0.0, 1.0, gyration)
    return arm * (np.linalg.pinv((jacobian * arm[:, None]).T, rcond=1e-9) @ (trajectory.states.lam[n] @ jacobian))


def multipliers(trajectory):
    """All of `Trajectory.multiplier`, in the order of λ."""
    system = trajectory.system
    lam = np.zeros(trajectory.states.lam.shape)
    for name in set(system.constraint_names):
        lam[:, system.multiplier_rows(name)] = trajectory.multiplier(name)
    return lam


@pytest.fixture(scope="module")
def two_hinges():
    return lg.simulate(door(DOOR, 2), t1=0.5, num_steps=100, integrator=EXACT)


@pytest.mark.slow
def test_a_door_on_two_hinges_moves_like_one_on_one(two_hinges):
    one = lg.simulate(door(DOOR, 1), t1=0.5, num_steps=100, integrator=EXACT)
    # joints give way by 1e-7 of what the scheme is off in a step
    same_motion(two_hinges, one, 1e-7)
    both = two_hinges.multiplier("upper")[:, :3] + two_hinges.multiplier("lower")[:, :3]
    single = one.multiplier("only")[:, :3]
    assert jnp.abs(single).max() > 150.0  # nearly the weight
    np.testing.assert_allclose(both, single, rtol=0, atol=1e-5)


def test_two_hinges_carry_a_door_in_the_least_shares(two_hinges):
    two = two_hinges
    upper, lower = two.multiplier("upper"), two.multiplier("lower")
    # Newton's law of the door, of 200 N: the scheme's own equation, but for what joints give way by, as above
    weight = np.array([0.0, 0.0, -9.81])
    accelerated = float(DOOR["mass"]) * (np.asarray(two.body("door").acceleration) - weight)
    np.testing.assert_allclose(-(upper + lower)[:, :3], accelerated, rtol=0, atol=1e-5)
    # the load along the axis and the moments in equal shares
    axis = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    np.testing.assert_allclose(upper[:, :3] @ axis, lower[:, :3] @ axis, rtol=0, atol=1e-7)
    np.testing.assert_allclose(upper[:, 3:], lower[:, 3:], rtol=0, atol=1e-7)
    lam = multipliers(two)
    for n in (0, 50, 100):
        # the round-off of λ that the projection leaves, and that of the pseudo-inverse
        np.testing.assert_allclose(lam[n], least_norm(two, n), rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("route", [lg.IndexReducedODE(), lg.Richardson(EXACT)])
def test_other_integrators_take_redundant_constraints(route):
    two, one = (lg.simulate(door(DOOR, hinges), t1=0.1, num_steps=20, integrator=route) for hinges in (2, 1))
    same_motion(two, one, 1e-6)  # the index-reduced route: 1e-10


def criteria(scene, p, method, where):
    run = lg.simulate(scene(p), t1=p["t1"], num_steps=16, integrator=EXACT, sensitivity=method)
    body, joint = where
    force = run.multiplier(joint)
    motion = run.body(body)
    return jnp.stack(
        [
            lg.time_integral(run.t, motion.position[:, 0] ** 2),
            lg.time_integral(run.t, motion.acceleration[:, 1] ** 2),
            jnp.sum(force[-1, :3]) + force[-1, -1],
        ]
    )


def fourth_order_difference(function, p, name, step):
    at = lambda s: function(p | {name: p[name] * (1.0 + s * step)})
    return (8.0 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12.0 * step * p[name])


def with_jacobian(scene, where, method, mode):
    def value(p):
        found = criteria(scene, p, method, where)
        return found, found

    return jax.jit(mode(value, has_aux=True))


def check_gradients(scene, p, where, tolerance, *, both_modes):
    """The derivative in reverse mode and, with `both_modes`, that in forward mode against differences."""
    reverse = with_jacobian(scene, where, lg.AdjointVariable(), jax.jacrev)
    found = {"reverse": reverse(p)[0]}
    if both_modes:
        found["forward"] = with_jacobian(scene, where, lg.DirectDifferentiation(), jax.jacfwd)(p)[0]
    for name in p:
        difference = fourth_order_difference(lambda p: reverse(p)[1], p, name, 1e-3)
        scale = 1.0 + np.abs(difference)
        for mode, gradient in found.items():
            error = (gradient[name] - difference) / scale
            np.testing.assert_allclose(error, 0.0, rtol=0, atol=tolerance, err_msg=f"{mode} {name}")
    return found["reverse"]


@pytest.mark.slow
@pytest.mark.parametrize("both_modes", [False, True])
def test_gradients_of_the_door(both_modes):
    # round-off of λ, 1e-9 of 200 N, over a relative step of 1e-3
    check_gradients(door, DOOR | {"t1": jnp.asarray(0.2)}, ("door", "upper"), 1e-6, both_modes=both_modes)


@pytest.mark.slow
def test_a_four_bar_of_revolute_joints_is_the_planar_one():
    p = {name: jnp.asarray(number) for name, number in {"a": 0.3, "m3": 2.0, "th0": 1.2, "w0": 5.0, "t1": 0.1}.items()}
    build = lambda redundant: lambda p: planar(redundant, **{name: p[name] for name in p if name != "t1"})
    one, other = (lg.simulate(build(redundant)(p), t1=0.1, num_steps=50) for redundant in (True, False))
    same_motion(one, other, 1e-6)
    where = ("coupler", "A")
    found = check_gradients(build(True), p, where, 1e-6, both_modes=True)
    plain = jax.jacfwd(lambda p: criteria(build(False), p, lg.DirectDifferentiation(), where))(p)
    for name in p:  # of the motion; multipliers are those of other joints
        np.testing.assert_allclose(found[name][:2], plain[name][:2], rtol=1e-5, atol=1e-5, err_msg=name)


@pytest.mark.slow
def test_rank_of_bricard_and_door():
    found = lg.constraint_rank(bricard())
    assert (found.coordinates, found.equations, found.rank, found.reference_rank) == (30, 30, 29, 29)
    assert (found.redundant, found.degrees_of_freedom, found.singular) == (1, 1, False)
    assert found.joints == tuple(f"hinge {i}" for i in range(6))
    assert "Degrees of freedom          1" in str(found) and "hinge 0, hinge 1" in str(found)
    assert lg.constraint_rank(door(DOOR, redundant="refuse")).joints == ("lower", "upper")
    assert lg.constraint_rank(door(DOOR, hinges=1)).redundant == 0
    with pytest.raises(ValueError, match=says("`constraint_rank`", "must be known numbers, got traced ones", "`jit`")):
        jax.jit(lambda t0: lg.constraint_rank(door(DOOR), t0=t0).rank)(0.0)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [lg.DenseLU(), lg.BlockSparse()])
def test_bricard_moves_like_its_variant_with_a_cylindrical_joint(solver):
    model = dataclasses.replace(bricard(), linear_solver=solver)
    one = lg.simulate(model, t1=1.0, num_steps=500)
    other = lg.simulate(bricard(relaxed=2, redundant="refuse"), t1=1.0, num_steps=500)
    assert jnp.abs(one.body("rod 2").position[-1] - one.body("rod 2").position[0]).max() > 0.6
    same_motion(one, other, 1e-7)  # accelerations carry round-off/(βh²) = 2e-10, amplified by the mechanism
    lam = multipliers(one)
    for n in (0, 250, 500):
        np.testing.assert_allclose(lam[n], least_norm(one, n), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_gradients_of_bricard():
    p = {"mass": jnp.asarray(1.2), "size": jnp.asarray(0.9), "t1": jnp.asarray(0.4)}
    check_gradients(lambda p: bricard(p["mass"], p["size"]), p, ("rod 2", "hinge 3"), 1e-6, both_modes=True)


@pytest.mark.slow  # `test_what_fails_for_redundant_constraints_says_so` is in the quick run
def test_what_cannot_take_redundant_constraints_says_so():
    with pytest.raises(ValueError, match=says("`redundant` must be one of", "'maybe'")):
        door(DOOR, redundant="maybe")
    with pytest.raises(ValueError, match=says("ContinuousDirect needs independent constraints", "AdjointVariable()")):
        lg.simulate(door(DOOR), t1=0.1, num_steps=4, sensitivity=lg.ContinuousDirect())
    with pytest.raises(ValueError, match=says("velocity level", "needs independent constraints", "free='x y rz'")):
        lg.simulate(door(DOOR), t1=0.1, num_steps=4, integrator=lg.GeneralizedAlpha(stabilized=True))
    with pytest.raises(ValueError, match=says("redundant='minimum_norm'")):
        lg.simulate(door(DOOR, redundant="refuse"), t1=0.1, num_steps=4)


def test_what_fails_for_redundant_constraints_says_so():
    """Their matrices are singular, which looks like bodies that nothing holds or positions out of reach."""
    twice = door(DOOR, redundant="refuse")
    with pytest.raises(ValueError, match=says("RadauIIA: the joints have 10 equations for 6", "redundant='remove'")):
        lg.simulate(twice, t1=0.1, num_steps=4, integrator=lg.RadauIIA())
    with pytest.raises(ValueError, match=says("10 equations for 6 coordinates", "redundant='remove'")):
        lg.linearize(twice)
    spring = lg.TorsionSpringDamper(None, "door", axis=twice.joints["upper"].axis, stiffness=5.0)
    push = lg.AppliedForce("door", fixed_moment=Z)
    held = lg.Model(twice.bodies, twice.joints, {"spring": spring, "push": push})
    with pytest.raises(ValueError, match=says("constrain the same motion twice", "['lower', 'upper']")):
        lg.statics(held, loads={"push": [0.0, 1.0]})
    bar = lambda x: lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=(x, 0.0, 0.0), free="x y rz")
    pin = lambda kind, a, b, x, **axis: kind(a, b, at=(x, 0.0, 0.0), **axis)
    joints = {"hinge": pin(lg.RevoluteJoint, None, "a", 0.0, axis=Z), "ball": pin(lg.SphericalJoint, None, "a", 0.0)}
    square = lg.Model({"a": bar(0.5), "b": bar(1.5)}, joints | {"elbow": pin(lg.SphericalJoint, "a", "b", 1.0)})
    assert len(square.system().constraint_names) == square.system().group.dim
    with pytest.raises(ValueError, match=says("constrain the same motion twice", "['ball', 'hinge']")):
        lg.kinematics(square, t=[0.0, 0.1])


@pytest.mark.slow  # equal steps of the same mechanism are in the quick run
def test_redundant_equations_are_no_singular_configuration_for_adaptive_steps():
    """Their margins come from a matrix of their own."""
    adaptive = lg.AdaptiveSteps(tolerance=1e-5)
    found = lg.simulate(bricard(), t1=0.5, num_steps=200, integrator=adaptive).body("rod 2").position[-1]
    expected = lg.simulate(bricard(), t1=0.5, num_steps=200).body("rod 2").position[-1]
    np.testing.assert_allclose(found, expected, atol=1e-3)  # what the tolerance leaves after tens of steps


def linkage(angle, coupler=0.9, rocker=0.3):
    """A planar four-bar, crank of 0.3 m, pins 0.9 m apart; a parallelogram is flat, and singular, at the angle π."""
    turned = lambda x: np.array([-x[1], x[0], 0.0])
    pin_b, pin_d = 0.3 * np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.9, 0.0, 0.0])
    span = np.linalg.norm(pin_d - pin_b)
    along = (coupler**2 - rocker**2 + span**2) / (2.0 * span)
    unit = (pin_d - pin_b) / span
    pin_c = pin_b + along * unit + np.sqrt(max(coupler**2 - along**2, 0.0)) * turned(unit)
    velocity = 5.0 * turned(pin_b)

    def rod(start, end, share, rate):
        moments = (0.1, 0.1, float(np.sum((end - start) ** 2)) / 12.0)
        middle, spin = (start + end) / 2.0, np.array([0.0, 0.0, rate])
        return lg.RigidBody(1.0, moments, middle, velocity=share * velocity, angular_velocity=spin, free="x y rz")

    zero = np.zeros(3)
    bodies = {
        "crank": rod(zero, pin_b, 0.5, 5.0),
        "coupler": rod(pin_b, pin_c, 1.0, 0.0),
        "rocker": rod(pin_d, pin_c, 0.5, 5.0),
    }
    pins = {"A": (None, "crank", zero), "B": ("crank", "coupler", pin_b), "C": ("coupler", "rocker", pin_c)}
    pins["D"] = (None, "rocker", pin_d)
    joints = {
        name: lg.RevoluteJoint(a, b, at=jnp.asarray(at), axis=jnp.asarray(Z)) for name, (a, b, at) in pins.items()
    }
    return lg.Model(bodies, joints)


@pytest.mark.slow  # small version: test_a_reference_that_lies_flat_is_singular
@pytest.mark.parametrize("factor_every", some_quick([20, 0]))
def test_a_parallelogram_through_its_dead_centre_is_said_to_be_singular(factor_every):
    scheme = lg.GeneralizedAlpha(0.8, factor_every=factor_every)
    with pytest.raises(lg.SimulationError, match=says("passes a singular configuration", "of 100, t = 0.0")):
        lg.simulate(linkage(2.8), t1=0.1, num_steps=100, integrator=scheme)
    found = lg.simulate(linkage(2.8), t1=0.1, num_steps=100, integrator=scheme, throw=False)
    assert found.result == lg.RESULTS.singular_configuration
    # at 5 rad/s it is flat after (π − 2.8)/5 = 0.0683 s, in step 69
    assert int(jnp.argmax(singular_steps(found.stats.margin))) in (67, 68)
    assert jnp.all(jnp.isfinite(found.body("coupler").position))
    # before it nothing is wrong; nor with lengths that leave b + c longer than the 1.2 m to the pin by 2 mm
    assert lg.simulate(linkage(2.8), t1=0.06, num_steps=100, integrator=scheme).result == 0
    near = lg.simulate(linkage(2.8, 0.88, 0.322), t1=0.1, num_steps=100, integrator=scheme)
    known = near.stats.margin[jnp.isfinite(near.stats.margin)]
    assert jnp.min(known) < 0.5 * jnp.max(known)


OTHERS = {
    "adaptive": lg.AdaptiveSteps(lg.GeneralizedAlpha(0.8), tolerance=1e-5),
    "given": lg.GivenSteps(1.0 + 0.3 * np.sin(np.arange(100.0) / 8.0), lg.GeneralizedAlpha(0.8)),
    "given, full Newton": lg.GivenSteps(np.ones(100), lg.GeneralizedAlpha(0.8, factor_every=0)),
    "stabilized": lg.GeneralizedAlpha(0.8, stabilized=True),
}


@pytest.mark.slow  # a program each; equal steps are above
@pytest.mark.parametrize("name", OTHERS)
def test_other_steps_are_watched_too(name):
    run = lambda model, t1: lg.simulate(model, t1=t1, num_steps=100, integrator=OTHERS[name], throw=False)
    found = run(linkage(2.8), 0.1)
    assert found.result == lg.RESULTS.singular_configuration
    near = found.t[int(jnp.argmax(singular_steps(found.stats.margin)))]
    assert abs(near - (np.pi - 2.8) / 5.0) < 0.005  # two steps, of 2 ms at most
    assert run(linkage(2.8), 0.06).result == 0
    assert run(linkage(2.8, 0.88, 0.322), 0.1).result == 0


@pytest.mark.parametrize("factor_every", [1, 0])
def test_without_joints_nothing_is_singular(factor_every):
    scheme = lg.GeneralizedAlpha(factor_every=factor_every)
    stone = lg.Model({"stone": lg.RigidBody(1.0, (1.0, 1.0, 1.0), free="z")}, {}, {"g": lg.Gravity((0.0, 0.0, -9.81))})
    assert lg.simulate(stone, t1=0.1, num_steps=10, integrator=scheme).result == 0


def test_friction_that_sticks_is_no_singular_configuration():
    """Where a driven slider turns round, the slope of its friction adds γ h μN/w₀ = 25 kg to the 0.1 kg of the matrix.

    Its constraints are the same all the time, and so is the margin, up to the weights of their singular values.
    """
    rail = lg.PrismaticJoint(None, "block", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0))
    driver = lg.TranslationDriver(
        None, "block", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), value=lg.Harmonic(amplitude=0.1, frequency=2.0)
    )
    friction = lg.JointFriction("rail", coefficient=0.3, slip_speed=1e-3, preload=300.0, own_forces=False)
    block = lg.RigidBody(0.1, (1.0, 1.0, 1.0))
    model = lg.Model({"block": block}, {"rail": rail, "driver": driver}, {"friction": friction})
    full_newton = lg.GeneralizedAlpha(factor_every=0)
    found = lg.simulate(model, t1=0.2, num_steps=40, integrator=full_newton, throw=False)
    assert found.result == lg.RESULTS.successful
    known = found.stats.margin
    assert jnp.min(known) > 0.1 * jnp.max(known)


def test_a_pendulum_in_steps_too_long_fails_in_newton():
    """Its rod never loses rank; multipliers jump between solutions, and so do the margins."""
    run = lambda num_steps: lg.simulate(PENDULUM.build(PENDULUM.parameters), t1=10.0, num_steps=num_steps)
    with pytest.raises(lg.SimulationError, match=says("Newton", "It failed at step", "of 128")):
        run(128)


def test_what_is_a_sign_of_a_singular_configuration():
    falling = [1.0, 0.8, 0.4, 0.09, 0.02, 0.1]
    signs = lambda margins: jnp.flatnonzero(singular_steps(jnp.asarray(margins))).tolist()
    assert signs(falling) == [3, 4]  # 0.4 is half of what was before, but not small
    assert signs([1.0, 0.02, 0.6, 0.04]) == [1]  # one that went up before is none
    assert signs([1.0, jnp.inf, 0.05, 0.02]) == [3]  # what is not known is none


def test_a_reference_that_lies_flat_is_singular():
    found = lg.constraint_rank(linkage(np.pi))
    assert found.singular and found.rank == found.reference_rank + 1 and not found.joints
    assert "singular" in str(found)


def scissor_lift(roller):
    """A platform of 100 kg on two crossed bars, which a rod between their feet holds; rollers of so many kg."""
    c, s, y, x = 0.6 * np.cos(0.5), 0.6 * np.sin(0.5), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
    bar = lambda: lg.RigidBody(5.0, (0.1, 0.6, 0.6), position=(c, 0.0, s))
    light = lambda z: lg.RigidBody(roller, (roller / 100.0,) * 3, position=(2 * c, 0.0, z))
    bodies = {"left": bar(), "right": bar(), "foot": light(0.0), "head": light(2 * s)}
    bodies["platform"] = lg.RigidBody(100.0, (5.0, 5.0, 5.0), position=(c, 0.0, 2 * s))
    pin = lambda a, b, *at: lg.RevoluteJoint(a, b, at=at, axis=y)
    joints = {
        "pivot": pin(None, "left", 0.0, 0.0, 0.0),
        "cross": pin("left", "right", c, 0.0, s),
        "edge": pin("right", "platform", 0.0, 0.0, 2 * s),
        "lower": pin("right", "foot", 2 * c, 0.0, 0.0),
        "upper": pin("left", "head", 2 * c, 0.0, 2 * s),
        "ground": lg.PrismaticJoint(None, "foot", at=(2 * c, 0.0, 0.0), axis=x),
        "rail": lg.PrismaticJoint("platform", "head", at=(2 * c, 0.0, 2 * s), axis=x),
        "rod": lg.DistanceJoint(None, "foot", at_a=(0.0, 0.0, 0.0), at_b=(2 * c, 0.0, 0.0)),
    }
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))}, redundant="minimum_norm")


@pytest.mark.slow
@pytest.mark.parametrize("roller", [1e-3, 1.0, 1e-5])
def test_light_bodies_between_redundant_joints(roller):
    """At rest; by virtual work the rod pulls with g (m_p + m_b + m_r) cot(0.5), all of them twice as high or half."""
    run = lg.simulate(scissor_lift(roller), t1=0.1, num_steps=2, integrator=lg.IndexReducedODE())
    tension = 9.81 * (100.0 + 5.0 + roller) / np.tan(0.5)
    # A body lighter by δ has multipliers that iterations tell to ε/δ; with three of them 4e-4 was left at 1e-3 kg.
    np.testing.assert_allclose(run.multiplier("rod")[:, 0], tension, rtol=1e-9)
    assert float(jnp.max(jnp.abs(run.states.vdot))) < 1e-7
