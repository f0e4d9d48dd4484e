"""`Model(redundant="remove")`: what is left out, and that everything takes what is left; against mechanisms without
redundant equations, least norm, and differences."""

import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says, some_quick
from test_kinematics import hinged_four_bar
from test_redundant import DOOR, EXACT, bricard, door

import lgsens as lg

Z, G = (0.0, 0.0, 1.0), (0.0, -9.81, 0.0)


def sprung(length, *, planar, redundant="remove", **options):
    """A four-bar of four hinges with a spring and a damper, at rest or with the crank turning."""
    model = hinged_four_bar(length, planar=planar)
    joints = {name: joint for name, joint in model.joints.items() if name != "motor"}
    spring = lg.SpringDamper(
        None, "coupler", at_a=(0.9, 0.9, 0.0), at_b=(0.4, 0.4, 0.0), stiffness=400.0, damping=20.0, free_length=0.5
    )
    crank = dataclasses.replace(model.bodies["crank"], angular_velocity=jnp.asarray((0.0, 0.0, 2.0)))
    return lg.Model(
        model.bodies | {"crank": crank},
        joints,
        model.forces | {"spring": spring},
        redundant="refuse" if planar else redundant,
        **options,
    )


@functools.cache
def hinged():
    return sprung(0.0, planar=False)


@pytest.fixture(autouse=True)
def built():
    """Not when the tests are collected, nor first inside of a trace."""
    hinged()


def seen(trajectory):
    """What is unique of a motion."""
    rocker = trajectory.body("rocker")
    parts = rocker.position, rocker.orientation, rocker.velocity, rocker.acceleration
    return jnp.concatenate([part.ravel() for part in parts])


RADAU = lg.RadauIIA(tolerance=1e-12)
STABILIZED = lg.GeneralizedAlpha(0.8, tolerance=1e-13, stabilized=True)


def run(length, planar, integrator, **options):
    model = sprung(length, planar=planar, redundant=hinged().removed)
    return lg.simulate(model, t1=0.3, num_steps=30, integrator=integrator, **options)


def test_what_is_left_out_of_hinges():
    """Of the twelve equations out of the plane nine are independent, and those in it stay."""
    assert len(hinged().removed) == 3
    assert hinged().summary().degrees_of_freedom == lg.constraint_rank(hinged()).degrees_of_freedom == 1
    assert lg.constraint_rank(hinged()).redundant == 0
    constraints = {name: place for name, place, _ in hinged().removed}
    assert all(place > 0 for place in constraints.values())  # directions, not points
    # a door keeps one equation less than two pins have, and no direction
    kept = door(DOOR, redundant="remove").system().constraint_names
    assert sorted(kept) == ["lower"] * 3 + ["upper"] * 2


SUN, PLANET, RING = 24, 18, 60  # teeth


@functools.cache
def planetary():
    """Three planets between sun and ring; two of their six meshes repeat others."""
    arm, held = 1e-3 * (SUN + PLANET), {"mass": 1.0, "inertia": (1e-3, 1e-3, 1e-3)}
    bodies = {name: lg.RigidBody(**held, free="rz") for name in ("sun", "carrier")}
    joints = {"motor": lg.RotationDriver(None, "sun", axis=Z, value=lg.Polynomial((0.0, 1.0)))}
    for i, angle in enumerate(np.arange(3) * 2.0 * np.pi / 3.0):
        at = arm * np.array([np.cos(angle), np.sin(angle), 0.0])
        name, axes = f"planet {i}", {"at_a": np.zeros(3), "at_b": at, "axis_a": Z, "axis_b": Z, "teeth": PLANET}
        bodies[name] = lg.RigidBody(**held, position=at, free="x y rz")
        joints[f"pin {i}"] = lg.RevoluteJoint("carrier", name, at=at, axis=Z)
        joints[f"mesh {i}"] = lg.GearJoint("sun", name, ratio=-SUN / PLANET, **axes)
        joints[f"teeth {i}"] = lg.GearJoint(None, name, ratio=RING / PLANET, **axes)
    return lg.Model(bodies, joints, redundant="remove")


def test_teeth_are_left_out_before_a_component_of_a_pin():
    """A pin that holds in one direction only, with the teeth for the other one, lets go where the carrier turns on."""
    assert len(planetary().removed) == 2
    assert not any(name.startswith("pin") for name, *_ in planetary().removed)


SLOW = pytest.mark.slow  # programs of their own


@SLOW
def test_planets_turn_their_carrier():
    """By Willis's equation, over one turn of it."""
    found = lg.kinematics(planetary(), t=np.linspace(0.0, 2.0 * np.pi * (SUN + RING) / SUN, 29))
    rate = found.body("carrier").angular_velocity[:, 2]
    np.testing.assert_allclose(rate, SUN / (SUN + RING), rtol=1e-9)  # positions to 1e-12


@pytest.mark.slow
@pytest.mark.parametrize(
    "integrator",
    [EXACT, STABILIZED, RADAU],
    ids=["alpha", "stabilized", "radau"],
)
def test_the_motion_is_that_of_the_planar_mechanism(integrator):
    # round-off of 30 steps in accelerations of 30 m/s², Newton's tolerance over h²
    found, expected = jax.jit(lambda length: [seen(run(length, of, integrator)) for of in (False, True)])(0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


@SLOW
@pytest.mark.parametrize(
    ("method", "integrator"),
    [(of, by) for of in (lg.DirectDifferentiation(), lg.AdjointVariable()) for by in (STABILIZED, RADAU)],
)
def test_gradients_by_a_length_are_those_of_the_planar_mechanism(method, integrator):
    def end(length, planar):
        return run(length, planar, integrator, sensitivity=method).body("rocker").position[-1, 0]

    mode = jax.jacfwd if isinstance(method, lg.DirectDifferentiation) else jax.jacrev
    found, expected = (jax.jit(mode(lambda x, of=of: end(x, of)))(0.01) for of in (False, True))
    np.testing.assert_allclose(found, expected, rtol=1e-9)  # Newton's tolerance, times the 1e2 of 30 steps


@SLOW
def test_linearize_takes_it():
    found, expected = (lg.linearize(sprung(0.0, planar=planar)).eigenvalues for planar in (False, True))
    np.testing.assert_allclose(found, expected, rtol=1e-9)  # second derivatives at an equilibrium found to 1e-10


@SLOW
def test_statics_take_it():
    def held(planar):
        model = sprung(0.0, planar=planar)
        pull = lg.AppliedForce("rocker", at=(0.8, 0.3, 0.0), force=(1.0, 0.0, 0.0))
        model = lg.Model(model.bodies, model.joints, model.forces | {"pull": pull}, redundant=model.redundant)
        return lg.statics(model, loads={"pull": [0.0, 20.0]}).body("rocker").position

    np.testing.assert_allclose(held(False), held(True), atol=1e-9)


@SLOW
def test_of_a_mechanism_that_no_plane_explains():
    """Bricard's mechanism by Radau, against multipliers of least norm; its equation is left out where the others stay
    regular all the way: without other ones the run ends in a singular configuration at 1.245 s."""
    model = bricard(redundant="remove")
    assert len(model.removed) == 1
    found = lg.simulate(model, t1=1.5, num_steps=150, integrator=EXACT).body("rod 2").position
    np.testing.assert_allclose(
        found, lg.simulate(bricard(), t1=1.5, num_steps=150, integrator=EXACT).body("rod 2").position, atol=1e-7
    )  # joints of the latter give way by 1e-7 of what the scheme is off in a step


def scissors(planar, stages=6):
    """A lift of crossed bars, each pair pinned in the middle and at the ends to the next: loops one above the other."""
    free = "x y rz" if planar else None
    bodies, joints = {}, {}
    for i in range(stages):
        for name, sign in (("left", 1.0), ("right", -1.0)):
            bodies[f"{name} {i}"] = lg.RigidBody(
                1.0, (0.02, 0.05, 0.06), position=(0.0, 0.3 * i + 0.15, 0.0), free=free
            )
            if i:
                below = f"{'right' if name == 'left' else 'left'} {i - 1}"
                at = (-0.4 * sign, 0.3 * i, 0.0)
                joints[f"{name} foot {i}"] = lg.RevoluteJoint(below, f"{name} {i}", at=at, axis=Z)
        joints[f"middle {i}"] = lg.RevoluteJoint(f"left {i}", f"right {i}", at=(0.0, 0.3 * i + 0.15, 0.0), axis=Z)
    joints["pin"] = lg.RevoluteJoint(None, "left 0", at=(-0.4, 0.0, 0.0), axis=Z)
    joints["roller"] = lg.PointOnPlaneJoint(None, "right 0", at=(0.4, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    return lg.Model(
        bodies,
        joints,
        {"gravity": lg.Gravity(G)},
        redundant="refuse" if planar else "remove",
        linear_solver=lg.BlockSparse(),
    )


@SLOW
def test_of_many_loops_by_block_elimination():
    found, expected = (
        lg.simulate(scissors(planar), t1=0.1, num_steps=20, integrator=EXACT).body("left 5").position
        for planar in (False, True)
    )
    assert scissors(False).summary().degrees_of_freedom == 1
    np.testing.assert_allclose(found, expected, atol=1e-9)  # as above, with 12 bodies one above the other


@SLOW
def test_of_parts_that_fixed_joints_merge():
    """What a fixed joint carries is the same as with free planar bodies."""

    def carried(planar):
        model = sprung(0.0, planar=planar)
        free = "x y rz" if planar else None
        load = lg.RigidBody(0.5, (0.001, 0.001, 0.001), position=(0.9, 0.2, 0.0), free=free)
        joints = model.joints | {"weld": lg.FixedJoint("rocker", "load", at=(0.8, 0.2, 0.0))}
        options = {"redundant": "refuse" if planar else "remove", "merge_fixed": True}
        model = lg.Model(model.bodies | {"load": load}, joints, model.forces, **options)
        return lg.simulate(model, t1=0.1, num_steps=10, integrator=EXACT).joint("weld").force

    np.testing.assert_allclose(carried(False), carried(True), rtol=1e-8, atol=1e-8)  # as of the motion


@SLOW
def test_on_se3():
    found, expected = (
        seen(lg.simulate(sprung(0.0, planar=planar, formulation=of), t1=0.1, num_steps=100, integrator=EXACT))
        for planar, of in ((False, "SE3"), (True, "R3xSO3"))
    )
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3)  # two schemes of order two, ω h = 0.01 squared


def test_traced_numbers_take_what_was_left_out_before():
    model = hinged()
    with pytest.raises(ValueError, match=says("its numbers are traced", "redundant=model.removed")):
        jax.jit(lambda length: sprung(length, planar=False).bodies)(0.0)
    with pytest.raises(ValueError, match="its numbers are traced"):  # those of a force too
        jax.jit(lambda gravity: lg.Model(model.bodies, model.joints, gravity, redundant="remove").bodies)(model.forces)
    model = jax.jit(lambda length: sprung(length, planar=False, redundant=hinged().removed))(0.0)
    assert model.removed == hinged().removed
    assert dataclasses.replace(model, formulation="SE3").removed == hinged().removed
    assert model.reduced(lg.model.Without("spring")).removed == hinged().removed
    assert sprung(0.0, planar=False, redundant=hinged().removed).system().constraint_names == (
        hinged().system().constraint_names
    )


def test_what_cannot_be_left_out_is_said():
    model = hinged_four_bar(0.0, planar=False)
    twice = model.joints | {"other": lg.RotationDriver(None, "rocker", axis=Z)}
    with pytest.raises(ValueError, match=says("redundant='remove'", "'motor', 'other'", "prescribe", "leave one out")):
        lg.Model(model.bodies, twice, model.forces, redundant="remove")
    for wrong, words in (("some", "'some'"), ([("hinge1", 0)], "hinge1"), (3, "got 3"), ([("door", 1, 0)], "'door'")):
        with pytest.raises(ValueError, match=says("`redundant`", words)):
            sprung(0.0, planar=False, redundant=wrong)


@SLOW
def test_kinematics_takes_it():
    model = hinged_four_bar(0.0, planar=False)
    model = lg.Model(model.bodies, model.joints, model.forces, redundant="remove")
    found, expected = (
        lg.kinematics(of, {"motor": np.linspace(0.0, 1.5, 4)}, rates={"motor": 3.0})
        for of in (model, hinged_four_bar(0.0, planar=True))
    )
    for what in (lambda k: k.body("rocker").acceleration, lambda k: k.multiplier("motor")):
        np.testing.assert_allclose(what(found), what(expected), rtol=1e-11, atol=1e-11)  # round-off


def turned(angle, axis):
    """A homogeneous transform about x or z."""
    c, s = np.cos(angle), np.sin(angle)
    found, plane = np.eye(4), [1, 2] if axis == "x" else [0, 1]
    found[np.ix_(plane, plane)] = [[c, -s], [s, c]]
    return found


def bennett(angle=0.7, twists=(0.6, 1.1), tilt=0.0, motor=True, **options):
    """Four links whose hinges are skew, of lengths in proportion to the sines of their twists: three of 21 equations
    repeat others, in no plane. With a `tilt` of the last hinge they would not: nothing could move.
    Source: Hunt, Kinematic Geometry of Mechanisms (1978), §11.3."""
    first, second = twists
    lengths = np.array([1.0, np.sin(second) / np.sin(first)] * 2)
    ratio = np.sin((second + first) / 2) / np.sin((second - first) / 2)
    other = 2.0 * np.arctan2(ratio * np.cos(angle / 2), np.sin(angle / 2))
    frames = [np.eye(4)]
    for turn, length, twist in zip((angle, other, -angle), lengths, (first, second, first)):
        along = np.eye(4)
        along[0, 3] = length
        frames.append(frames[-1] @ turned(turn, "z") @ along @ turned(twist, "x"))
    names = [None, "1", "2", "3"]
    bodies = {
        name: lg.RigidBody(1.0, (0.02, 0.05, 0.06), position=(begin[:3, 3] + end[:3, 3]) / 2)
        for name, begin, end in zip(names[1:], frames, frames[1:])
    }
    tilted = lambda i, frame: frame[:3, 2] + (tilt * frame[:3, 0] if i == 3 else 0.0)
    joints = {
        f"hinge {i}": lg.RevoluteJoint(names[i], names[(i + 1) % 4], at=frame[:3, 3], axis=tilted(i, frame))
        for i, frame in enumerate(frames)
    }
    if motor:
        return lg.Model(bodies, joints | {"motor": lg.RotationDriver(None, "1", axis=Z)}, **options)
    bodies["1"] = dataclasses.replace(bodies["1"], angular_velocity=jnp.asarray((0.0, 0.0, 2.0)))
    spring = lg.TorsionSpringDamper(None, "1", axis=Z, stiffness=1.0, damping=0.0, free_angle=0.3)
    return lg.Model(bodies, joints, {"spring": spring}, **options)


@pytest.mark.slow  # motions are in the quick run
def test_kinematics_meet_what_is_left_out_or_have_failed():
    """Newton's iteration from one position to the next, 0.9 rad away, leads to a configuration at which the removed
    equations do not hold; a tilt of the last hinge, to others at which they do not."""
    model, way = bennett(redundant="remove"), 2.0 * np.linspace(0.0, 3.0, 13) + 0.3 * np.linspace(0.0, 3.0, 13) ** 2
    assert len(model.removed) == 3
    found = lg.kinematics(model, {"motor": way})
    np.testing.assert_allclose(found.joint("hinge 1").position, 0.0, atol=1e-11)  # round-off × condition
    tilted = bennett(tilt=0.1, redundant=model.removed)
    with pytest.raises(ValueError, match=says("No position satisfies", "position 1", "hinge", "redundant='remove'")):
        lg.kinematics(tilted, {"motor": way})
    lost = lg.kinematics(tilted, {"motor": way}, throw=False)
    assert int(lost.result) == lg.RESULTS.position_failed and np.isnan(lost.states.v[1:]).all()


def test_axes_that_are_not_quite_parallel_are_said():
    """A door whose hinges are out of line by 1e-5 has none of its freedom."""
    hinge = lambda x, z: lg.RevoluteJoint(None, "door", at=(x, 0.0, z), axis=Z)
    door = {"door": lg.RigidBody(20.0, (4.0, 1.0, 3.0), position=(0.4, 0.0, 1.0))}
    with pytest.warns(UserWarning, match=says("['lower', 'upper']", "but for", "out of line", "exact.removed")):
        model = lg.Model(door, {"lower": hinge(0.0, 0.3), "upper": hinge(1e-5, 1.7)}, redundant="remove")
    assert model.summary().degrees_of_freedom == 0
    exact = lg.Model(door, {"lower": hinge(0.0, 0.3), "upper": hinge(0.0, 1.7)}, redundant="remove")  # no warning
    assert exact.summary().degrees_of_freedom == 1


def test_single_precision_in_millimetres():
    with jax.enable_x64(False):
        pins = 300.0 * np.array([[0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [1.2, 0.8, 0.1], [1.5, 0.0, 0.05]])
        names = [None, "crank", "coupler", "rocker"]
        bar = lambda a, b: lg.RigidBody(1.0, (5e3, 6e3, 7e3), position=(a + b) / 2)
        bodies = {name: bar(a, b) for name, a, b in zip(names[1:], pins, pins[1:])}
        joints = {str(i): lg.RevoluteJoint(names[i], names[(i + 1) % 4], at=at, axis=Z) for i, at in enumerate(pins)}
        assert len(lg.Model(bodies, joints, redundant="remove").removed) == 3


# those of Bennett's linkage that are left out are of two of its hinges
APART = re.compile(r"(?s)redundant='remove' left out do not hold.* at step .*in joint 'hinge [12]'.*throw=False")


@pytest.fixture(scope="module")
def left_out():
    return bennett(motor=False, redundant="remove").removed


def test_a_motion_in_which_joints_come_apart_has_failed(left_out):
    """A Bennett linkage whose last hinge is tilted by 0.1 rad: without the equations left out it would move, with
    `hinge 1` open by more than a millimetre of the metre that it measures after some hundredths of a radian."""
    settings = {"t1": 0.2, "num_steps": 20}
    build = lambda tilt: bennett(tilt=tilt, motor=False, redundant=left_out)
    with pytest.raises(lg.SimulationError, match=APART):
        lg.simulate(build(0.1), **settings)
    assert lg.simulate(build(0.0), **settings).result == lg.RESULTS.successful


@SLOW
def test_joints_that_come_apart_are_seen_by_every_output(left_out):
    settings = {"t1": 0.2, "num_steps": 20}
    build = lambda tilt: bennett(tilt=tilt, motor=False, redundant=left_out)
    end = lambda s: s.body("2").position[0]

    @jax.jit
    def states(tilt):
        run = lg.simulate(build(tilt), **settings, throw=False)
        saved = lg.simulate(build(tilt), **settings, save=end, throw=False)
        return run.result, saved.result, lg.simulate(build(tilt), **settings).body("2").position[-1]

    for tilt, code in ((0.0, lg.RESULTS.successful), (0.1, lg.RESULTS.joints_apart)):
        *codes, position = states(tilt)
        assert set(map(int, codes)) == {code}
        assert bool(jnp.all(jnp.isfinite(position))) == (tilt == 0.0)
    criterion = lg.Criterion(terminal=lambda s, p: end(s))
    with pytest.raises(lg.SimulationError, match=APART):
        lg.differentiate(criterion, build, 0.1, **settings)


@SLOW
def test_an_equilibrium_at_which_joints_come_apart_has_failed(left_out):
    at_rest = lg.equilibrium(bennett(motor=False, redundant=left_out))
    assert float(jnp.max(jnp.abs(at_rest.v))) == 0.0
    with pytest.raises(lg.SimulationError, match=says("redundant='remove' left out do not hold", "|Φ| =", "hinge")):
        lg.equilibrium(bennett(tilt=0.1, motor=False, redundant=left_out))


def engine(phase, **options):
    """A slider-crank in space, as many equations as coordinates: on a ball at the crank, so that in the dead centre rod
    and piston turn freely about the bore."""
    pin = 0.04 * np.array([-np.sin(phase), np.cos(phase), 0.0])
    wrist = np.array([0.0, pin[1] + np.sqrt(0.13**2 - pin[0] ** 2), 0.0])
    bodies = {
        "crank": lg.RigidBody(5.0, (0.02,) * 3),
        "rod": lg.RigidBody(0.5, (3e-3,) * 3, position=(pin + wrist) / 2),
        "piston": lg.RigidBody(0.4, (1e-3,) * 3, position=wrist),
    }
    joints = {
        "main": lg.RevoluteJoint(None, "crank", at=(0.0, 0.0, 0.0), axis=Z),
        "big": lg.SphericalJoint("crank", "rod", at=pin),
        "small": lg.RevoluteJoint("rod", "piston", at=wrist, axis=Z),
        "bore": lg.CylindricalJoint(None, "piston", at=wrist, axis=(0.0, 1.0, 0.0)),
    }
    motor = {"motor": lg.RotationDriver(None, "crank", axis=Z, **options)} if options else {}
    return lg.Model(bodies, joints | motor)


@pytest.mark.parametrize("options", some_quick([{}, {"value": 0.0}, {"value": lg.Polynomial((0.0, 30.0))}]))
def test_nothing_is_left_out_in_a_dead_centre(options):
    """Its rank is one less there, with and without what holds the crank there, and nowhere else."""
    model = engine(0.0, **options)
    rank, beside = lg.constraint_rank(model), lg.constraint_rank(engine(0.3, **options))
    assert rank.singular and not beside.singular
    assert rank.rank == beside.rank == 17 + bool(options) and rank.joints == beside.joints == ()
    assert dataclasses.replace(model, redundant="remove").removed == ()
