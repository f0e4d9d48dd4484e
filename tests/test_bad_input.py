"""Bad input: every mistake raises, and the message names the argument, the value and the remedy."""

import re
import warnings
from importlib import resources

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.dynamics import AbstractSystem, Tangents
from lgsens.examples import QuarterCar, spinning_top
from lgsens.liegroups import Rn

BODY = lg.RigidBody(1.0, (1.0, 1.0, 1.0))
TWO = {"chassis": BODY, "wheel": lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=(1.0, 0.0, 0.0))}
ORIGIN, X, Z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
NAN, INF = float("nan"), float("inf")


def says(*parts):
    """A pattern for a message with these parts, in this order."""
    return "(?s)" + ".*".join(re.escape(part) for part in parts)


def body(**changes):
    return lg.RigidBody(**({"mass": 1.0, "inertia": (1.0, 1.0, 1.0)} | changes))


def spring(**changes):
    return lg.SpringDamper("chassis", None, **({"at_a": ORIGIN, "at_b": X, "stiffness": 1.0} | changes))


def tyre(**changes):
    return lg.TyreSpring("wheel", **({"at": ORIGIN, "stiffness": 1.0} | changes))


def ball(a, b, at=ORIGIN):
    return lg.SphericalJoint(a, b, at=at)


# What is built, and what the message says: argument, value, remedy.
CONSTRUCTORS = {
    # bodies
    "mass of shape (2,)": (
        lambda: body(mass=[1.0, 2.0]),
        ("RigidBody: `mass`", "shape ()", "got shape (2,)"),
    ),
    "mass of text": (lambda: body(mass="heavy"), ("RigidBody: `mass`", "must be a number", "'heavy'")),
    "mass zero": (lambda: body(mass=0.0), ("RigidBody: `mass` must be positive", "0.0 kg")),
    "mass negative": (lambda: body(mass=-2.5), ("RigidBody: `mass` must be positive", "-2.5 kg")),
    "mass nan": (lambda: body(mass=NAN), ("RigidBody: `mass` must be positive", "nan kg")),
    "mass infinite": (lambda: body(mass=INF), ("RigidBody: `mass` must be positive", "inf kg")),
    "inertia of shape (2,)": (
        lambda: body(inertia=(1.0, 1.0)),
        ("`inertia`", "(3,)", "(3, 3)", "got shape (2,)"),
    ),
    "inertia of shape ()": (
        lambda: body(inertia=1.0),
        ("`inertia`", "three principal moments", "got shape ()"),
    ),
    "inertia asymmetric": (
        lambda: body(inertia=np.eye(3) + 0.1 * np.eye(3, k=1)),
        ("`inertia`", "0.1", "must be symmetric and positive definite", "check units"),
    ),
    "inertia negative": (lambda: body(inertia=(1.0, -1.0, 1.0)), ("`inertia`", "-1.", "positive definite")),
    "inertia zero": (lambda: body(inertia=(0.0, 1.0, 1.0)), ("`inertia`", "positive definite")),
    "inertia indefinite": (
        lambda: body(inertia=np.eye(3) + 2.0 * (1.0 - np.eye(3))),
        ("`inertia`", "positive definite"),
    ),
    "inertia nan": (lambda: body(inertia=(1.0, NAN, 1.0)), ("`inertia`", "nan")),
    "inertia against the triangle inequality": (
        lambda: body(inertia=(1.0, 1.0, 2.1)),
        ("`inertia`", "2.1", "each principal moment at most the sum of the other two"),
    ),
    "position of shape (2,)": (
        lambda: body(position=(0.0, 1.0)),
        ("`position`", "shape (3,)", "got shape (2,)"),
    ),
    "orientation as a vector": (
        lambda: body(orientation=X),
        ("`orientation`", "shape (3, 3)", "got shape (3,)"),
    ),
    "orientation not orthogonal": (
        lambda: body(orientation=1.01 * np.eye(3)),
        ("`orientation` must be a rotation matrix", "RᵀR = I", "columns"),
    ),
    "orientation a reflection": (
        lambda: body(orientation=np.diag([1.0, 1.0, -1.0])),
        ("`orientation`", "det R = 1"),
    ),
    "velocity of shape (6,)": (
        lambda: body(velocity=np.zeros(6)),
        ("`velocity`", "shape (3,)", "got shape (6,)"),
    ),
    "angular velocity of shape ()": (
        lambda: body(angular_velocity=1.0),
        ("`angular_velocity`", "got shape ()"),
    ),
    # joints
    "hardpoint of shape (2,)": (
        lambda: ball(None, "wheel", (0.0, 1.0)),
        ("`at`", "shape (3,)", "got shape (2,)"),
    ),
    "hardpoint of text": (lambda: ball(None, "wheel", "here"), ("`at`", "numbers", "'here'")),
    **{
        f"zero axis of {kind.__name__}": (
            lambda kind=kind: kind(None, "wheel", at=ORIGIN, axis=ORIGIN),
            ("`axis` has zero length", "give a direction"),
        )
        for kind in (lg.RevoluteJoint, lg.PrismaticJoint, lg.CylindricalJoint)
    },
    "axis of nan": (lambda: lg.RevoluteJoint(None, "wheel", at=ORIGIN, axis=(NAN, 0.0, 0.0)), ("`axis`",)),
    "zero arm": (
        lambda: lg.UniversalJoint(None, "wheel", at=ORIGIN, axis_a=X, axis_b=ORIGIN),
        ("`axis_b` has zero length", "give a direction"),
    ),
    "parallel arms": (
        lambda: lg.UniversalJoint(None, "wheel", at=ORIGIN, axis_a=X, axis_b=(-2.0, 0.0, 0.0)),
        ("UniversalJoint: `axis_a`", "`axis_b`", "-2.", "are parallel", "must be orthogonal"),
    ),
    "rod without length": (
        lambda: lg.DistanceJoint(None, "wheel", at_a=X, at_b=X),
        ("DistanceJoint: `at_a` and `at_b` coincide", "use a SphericalJoint, or move one end"),
    ),
    "rod of negative length": (
        lambda: lg.DistanceJoint(None, "wheel", at_a=ORIGIN, at_b=X, length=-1.0),
        ("DistanceJoint: `length` must be positive", "-1.0 m"),
    ),
    # forces
    "gravity as a number": (lambda: lg.Gravity(9.81), ("`acceleration`", "shape (3,)", "got shape ()")),
    "stiffness of shape (3,)": (lambda: spring(stiffness=X), ("`stiffness`", "shape ()", "got shape (3,)")),
    "free length and preload": (
        lambda: spring(free_length=1.0, preload=2.0),
        ("SpringDamper: give `free_length` or `preload`, not both", "preload = stiffness"),
    ),
    "free radius and preload": (
        lambda: tyre(free_radius=1.0, preload=2.0),
        ("TyreSpring: give `free_radius` or `preload`, not both", "preload = stiffness"),
    ),
    "force of shape (2,)": (
        lambda: lg.AppliedForce("wheel", force=(1.0, 2.0)),
        ("`force`", "got shape (2,)"),
    ),
    "bump without duration": (
        lambda: lg.BumpRoad(height=0.05, duration=0.0),
        ("BumpRoad: `duration` must be positive", "0.0 s"),
    ),
    "samples of two lengths": (
        lambda: lg.SampledRoad([0.0, 1.0], [0.0, 1.0, 2.0]),
        ("SampledRoad: `times` and `heights`", "same length", "(2,)", "(3,)"),
    ),
    "samples not sorted": (
        lambda: lg.SampledRoad([0.0, 2.0, 1.0], [0.0, 1.0, 2.0]),
        ("SampledRoad: `times` must increase", "sort them"),
    ),
    # scenes
    "no bodies": (lambda: lg.Model({}), ("Model: `bodies` is empty", "at least one RigidBody")),
    "body of another type": (
        lambda: lg.Model({"chassis": 3.0}),
        ("Body 'chassis' must be a RigidBody", "float"),
    ),
    "joint of another type": (
        lambda: lg.Model(TWO, {"strut": spring()}),
        ("Joint 'strut' must be a AbstractJoint", "SpringDamper"),
    ),
    "force of another type": (
        lambda: lg.Model(TWO, {}, {"pivot": ball(None, "wheel")}),
        ("Force 'pivot' must be a AbstractForce", "SphericalJoint"),
    ),
    "joint of an unknown body": (
        lambda: lg.Model(TWO, {"strut": ball("chasis", "wheel")}),
        ("Joint 'strut' refers to body 'chasis'", "the bodies are ['chassis', 'wheel']"),
    ),
    "spring of an unknown body": (
        lambda: lg.Model(TWO, {}, {"coil": lg.SpringDamper("chassis", "weel", at_a=ORIGIN, at_b=X, stiffness=1.0)}),
        ("Force 'coil' refers to body 'weel'", "the bodies are ['chassis', 'wheel']"),
    ),
    "joint to itself": (
        lambda: lg.Model(TWO, {"strut": ball("wheel", "wheel")}),
        ("Joint 'strut' connects body 'wheel' to itself", "name two different bodies"),
    ),
    "joint of the ground to itself": (
        lambda: lg.Model(TWO, {"strut": ball(None, None)}),
        ("Joint 'strut' connects the ground to itself", "name two different bodies"),
    ),
    "spring to itself": (
        lambda: lg.Model(TWO, {}, {"coil": lg.SpringDamper("wheel", "wheel", at_a=ORIGIN, at_b=X, stiffness=1.0)}),
        ("Force 'coil' connects body 'wheel' to itself", "name two different bodies"),
    ),
    "duplicate connection": (
        lambda: lg.Model(TWO, {"one": ball("wheel", "chassis", X), "two": ball("chassis", "wheel", X)}),
        ("Joints 'one' and 'two' are the same SphericalJoint", "'wheel'", "'chassis'", "remove one of them"),
    ),
    "preload of a force that is no spring": (
        lambda: lg.static_preload(lg.Model(TWO, {}, {"g": lg.Gravity(X), "coil": spring()}), ("g",)),
        ("`static_preload`: 'g' is not one of ['coil']",),
    ),
    # the integrator
    **{
        f"rho_inf = {value!r}": (
            lambda value=value: lg.GeneralizedAlpha(rho_inf=value),
            ("GeneralizedAlpha: `rho_inf` must be a number in [0, 1)", f"got {value!r}", "0.9"),
        )
        for value in (1.0, -0.1, 1.5, NAN, INF, "a", None)
    },
    **{
        f"tolerance = {value!r}": (
            lambda value=value: lg.GeneralizedAlpha(tolerance=value),
            ("GeneralizedAlpha: `tolerance` must be positive", f"got {value!r}", "1e-10"),
        )
        for value in (0.0, -1e-8, NAN, INF, "small", None)
    },
    **{
        f"max_iterations = {value!r}": (
            lambda value=value: lg.GeneralizedAlpha(max_iterations=value),
            ("GeneralizedAlpha: `max_iterations` must be", "at least 1", f"got {value!r}"),
        )
        for value in (0, -3, 2.5, "ten")
    },
}


@pytest.mark.parametrize("mistake", CONSTRUCTORS)
def test_constructor(mistake):
    build, parts = CONSTRUCTORS[mistake]
    with pytest.raises(ValueError, match=says(*parts)):
        build()


def test_what_looks_like_a_duplicate_and_is_none():
    """Two ball joints at different points, and two rods that cross."""
    at = {"at_a": ORIGIN, "at_b": X}
    lg.Model(TWO, {"one": ball("wheel", "chassis", X), "two": ball("chassis", "wheel", ORIGIN)})
    lg.Model(
        TWO,
        {
            "one": lg.DistanceJoint("wheel", "chassis", **at),
            "two": lg.DistanceJoint("chassis", "wheel", **at),
        },
    )


def test_duplicate_rod_given_from_its_other_end():
    joints = {
        "one": lg.DistanceJoint("wheel", "chassis", at_a=ORIGIN, at_b=X),
        "two": lg.DistanceJoint("chassis", "wheel", at_a=X, at_b=ORIGIN),
    }
    with pytest.raises(ValueError, match=says("Joints 'one' and 'two' are the same DistanceJoint")):
        lg.Model(TWO, joints)


def test_inertia_at_the_limits_is_accepted():
    """A thin bar (J₁ = J₂, J₃ → 0), and a lamina (J₃ = J₁ + J₂) up to the round-off of its rotation."""
    lg.RigidBody(1.0, (1.0, 1.0, 1e-9))
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    lg.RigidBody(1.0, q @ np.diag([0.3, 0.4, 0.7]) @ q.T)


# Arguments of the functions. The scene is the one that the failures below use, so that it compiles once.


def pendulum(push=0.0, length=None, extra=()):
    """A body at rest under a ball joint; after 0.5 s a force of up to `push` N."""
    signal = lg.SampledRoad([0.0, 0.5, 0.6, 1.0], [0.0, 0.0, 1.0, 1.0])
    bob = lg.RigidBody(2.0, (0.1, 0.2, 0.3), position=(0.0, 0.0, -1.0))
    joints = {"pivot": ball(None, "bob")}
    if length is not None:
        ends = {"at_a": (1.0, 0.0, -1.0), "at_b": (0.0, 0.0, -1.0)}
        joints["rod"] = lg.DistanceJoint(None, "bob", **ends, length=length)
    force = jnp.stack([push + jnp.zeros(()), jnp.zeros(()), jnp.zeros(())])
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -9.81)),
        "push": lg.AppliedForce("bob", force=force, signal=signal),
    }
    return lg.Model({"bob": bob}, joints | dict(extra), forces)


ARGUMENTS = {
    "model": (dict(model=3.0), ("`model` must be a Model or an AbstractSystem", "float")),
    "num_steps zero": (dict(num_steps=0), ("`num_steps` must be at least 1", "got 0")),
    "num_steps negative": (dict(num_steps=-5), ("`num_steps` must be at least 1", "got -5")),
    "num_steps a float": (dict(num_steps=10.0), ("`num_steps` must be a Python int", "static", "10.0")),
    "num_steps text": (dict(num_steps="ten"), ("`num_steps` must be a Python int", "'ten'")),
    "t1 before t0": (dict(t0=2.0, t1=1.0), ("`t1` must be later than `t0`", "t0 = 2.0 s", "t1 = 1.0 s")),
    "t1 at t0": (dict(t0=1.0, t1=1.0), ("`t1` must be later than `t0`", "t0 = 1.0 s", "t1 = 1.0 s")),
    "t1 nan": (dict(t1=NAN), ("`t1` must be later than `t0`", "nan")),
    "t1 of shape (2,)": (dict(t1=[1.0, 2.0]), ("`t1` must have shape ()", "got shape (2,)")),
    "integrator": (dict(integrator="RK4"), ("`integrator` must be a GeneralizedAlpha", "'RK4'")),
    "sensitivity": (
        dict(sensitivity="adjoint"),
        ("`sensitivity` must be DirectDifferentiation() or", "'adjoint'"),
    ),
}


@pytest.mark.parametrize("mistake", ARGUMENTS)
def test_argument_of_simulate(mistake):
    changes, parts = ARGUMENTS[mistake]
    arguments = {"model": pendulum(), "t1": 1.0, "num_steps": 10} | changes
    with pytest.raises(ValueError, match=says(*parts)):
        lg.simulate(arguments.pop("model"), **arguments)


def test_number_of_steps_is_static():
    with pytest.raises(ValueError, match=says("`num_steps` must be a Python int (it is static)")):
        jax.jit(lambda n: lg.simulate(pendulum(), t1=1.0, num_steps=n).t)(10)


@pytest.mark.parametrize("function", [lg.initial_state, lg.equilibrium])
def test_arguments_of_the_other_functions(function):
    with pytest.raises(ValueError, match=says("`model` must be a Model or an AbstractSystem", "dict")):
        function({"bob": BODY})
    with pytest.raises(ValueError, match=says("`t0` must have shape ()", "got shape (2,)")):
        function(pendulum(), t0=[0.0, 1.0])


# Mechanisms.

UNREACHABLE = says("cannot be assembled", "lengths, hardpoints and axes", "|Φ| =", "largest in joint 'rod'")


def test_mechanism_that_cannot_be_assembled():
    """The bob is 1 m from the pivot and the rod's foot √2 m: a rod of 5 m reaches nowhere."""
    with pytest.raises(ValueError, match=UNREACHABLE):
        lg.initial_state(pendulum(length=5.0))
    state = lg.initial_state(pendulum(length=1.2))  # the same scene can be assembled with a rod of 1.2 m
    assert np.all(np.isfinite(state.q.position))


DOOR = {
    f"{name} hinge": lg.RevoluteJoint(None, "bob", at=(0.0, 0.0, z), axis=Z)
    for name, z in (("upper", 2.0), ("lower", 1.0))
}
REDUNDANT = {
    "door on two hinges": (DOOR, ["lower hinge", "upper hinge"]),
    "weld and hinge": (
        {"weld": lg.FixedJoint(None, "bob", at=ORIGIN), "hinge": lg.RevoluteJoint(None, "bob", at=X, axis=Z)},
        ["hinge", "weld"],
    ),
}


@pytest.mark.parametrize("case", REDUNDANT)
def test_redundant_constraints(case):
    joints, names = REDUNDANT[case]
    model = lg.Model({"bob": BODY}, joints)
    parts = (
        "constrain the same motion twice",
        "Replace one of the joints",
        "spherical",
        f"Joints involved: {names}",
    )
    with pytest.raises(ValueError, match=says(*parts)):
        lg.initial_state(model)


def test_an_innocent_joint_is_not_named_among_the_redundant():
    """A door on two hinges and a stone on a rod from it: 11 equations for 12 coordinates, of rank 6."""
    bodies = {"door": BODY, "stone": TWO["wheel"]}
    joints = {name: lg.RevoluteJoint(None, "door", at=hinge.at, axis=Z) for name, hinge in DOOR.items()}
    model = lg.Model(bodies, joints | {"rod": lg.DistanceJoint("door", "stone", at_a=Z, at_b=X)})
    with pytest.raises(ValueError, match=says("Joints involved: ['lower hinge', 'upper hinge'].")):
        lg.initial_state(model)


def test_body_that_nothing_holds_has_no_equilibrium():
    model = lg.Model({"stone": BODY}, {}, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
    with pytest.raises(
        lg.SimulationError, match=says("No static equilibrium was found", "a body that nothing holds falls")
    ):
        lg.equilibrium(model)


# Newton failures. One iteration is enough while the pendulum hangs (its predictor is the answer), and not
# enough once it is pushed: step 6 of 10, t = 0.6 s.

IMPATIENT = lg.GeneralizedAlpha(max_iterations=1)
FAILURE = says(
    "Newton's iteration did not converge",
    "smaller step (more `num_steps`)",
    "`max_iterations`",
    "step 6 of 10, t = 0.6 s, after 1 iterations",
    "increment",
    "tolerance 1e-10",
    "residual",
    "`throw=False`",
)


def fail(push, throw=True):
    return lg.simulate(pendulum(push), t1=1.0, num_steps=10, integrator=IMPATIENT, throw=throw)


def test_newton_failure_raises():
    with pytest.raises(lg.SimulationError, match=FAILURE) as caught:
        fail(30.0)
    numbers = re.search(r"increment (\S+) \(.*residual (\S+)\. ", str(caught.value)).groups()
    assert all(0 < float(number) < INF for number in numbers)
    assert fail(0.0).result == lg.RESULTS.successful


def test_newton_failure_as_data():
    """`throw=False`: the code, finite data up to the step before the failure, NaN from there on."""
    trajectory = fail(30.0, throw=False)
    assert trajectory.result == lg.RESULTS.newton_failed
    assert lg.RESULTS(int(trajectory.result)).message.startswith("Newton's iteration did not converge")
    np.testing.assert_array_equal(trajectory.stats.converged, [True] * 5 + [False] * 5)
    for leaf in jax.tree.leaves((trajectory.states, trajectory.body("bob"), trajectory.multiplier("pivot"))):
        finite = np.isfinite(leaf).reshape(11, -1)
        assert np.all(finite[:6]) and not np.any(finite[6:])
    assert np.all(np.isfinite(trajectory.t))


def test_newton_failure_inside_jit():
    """JAX's runtime error, with the same text; the run that works is untouched."""
    path = jax.jit(lambda push: fail(push).body("bob").position[:, 0])
    with pytest.raises(jax.errors.JaxRuntimeError, match=FAILURE):
        jax.block_until_ready(path(30.0))
    np.testing.assert_array_equal(path(0.0), fail(0.0).body("bob").position[:, 0])


def test_newton_failure_under_vmap():
    paths = jax.jit(jax.vmap(lambda push: fail(push).body("bob").position[:, 0]))
    with pytest.raises(jax.errors.JaxRuntimeError, match=FAILURE):
        jax.block_until_ready(paths(jnp.asarray([0.0, 30.0])))
    assert np.all(np.isfinite(paths(jnp.zeros(2))))


def test_newton_failure_under_differentiation():
    """Where the model is traced but its values are known the error is the library's own."""
    with pytest.raises(lg.SimulationError, match=FAILURE):
        jax.jvp(lambda push: fail(push).body("bob").position, (30.0,), (1.0,))


def test_mechanism_that_cannot_be_assembled_inside_jit():
    with pytest.raises(jax.errors.JaxRuntimeError, match=UNREACHABLE):
        jax.block_until_ready(jax.jit(lambda length: lg.initial_state(pendulum(length=length)).q)(5.0))


# What a trajectory is asked for.


def test_names_of_a_trajectory():
    trajectory = fail(0.0)
    with pytest.raises(ValueError, match=says("`body`: 'bop' is not one of ['bob']")):
        trajectory.body("bop")
    with pytest.raises(ValueError, match=says("`multiplier`: 'pivott' is not one of ['pivot']")):
        trajectory.multiplier("pivott")
    with pytest.raises(ValueError, match=says("`force`: 'pull' is not one of ['gravity', 'push']")):
        trajectory.force("pull")


def test_force_that_acts_on_several_bodies():
    system = lg.Model(TWO, {}, {"gravity": lg.Gravity(Z)}).system()
    with pytest.raises(ValueError, match=says("`force`: 'gravity' acts on 2 bodies and has no single value")):
        system.measure("gravity", system.pose, system.velocity, jnp.zeros(1))


class Oscillator(AbstractSystem):
    """ẍ = −ω² x: a system of a user's own, which has no bodies."""

    square: jax.Array
    assembled: bool = eqx.field(static=True, default=True)
    group = Rn(1)
    constraint_names = ()

    def reference(self):
        return jnp.ones_like(self.square)[None], jnp.zeros_like(self.square)[None]

    def coordinate_scale(self):
        return jnp.ones_like(self.square)[None]

    def mass_matrix(self):
        return jnp.ones_like(self.square)[None, None]

    def residual(self, q, v, vdot, lam, t):
        return vdot + self.square * q

    def constraint(self, q):
        return q[:0]

    def constraint_jacobian(self, q):
        return q[:0, None]

    def tangents(self, q, v, vdot, lam, t):
        return Tangents(self.square[None, None], jnp.zeros_like(self.square)[None, None], self.constraint_jacobian(q))


def test_trajectory_without_bodies():
    trajectory = lg.simulate(Oscillator(jnp.asarray(4.0)), t1=1.0, num_steps=4)
    for ask in (trajectory.body, trajectory.multiplier, trajectory.force):
        with pytest.raises(
            ValueError, match=says("trajectory is one of a Oscillator", "no named bodies", "use `states`")
        ):
            ask("x")


@pytest.mark.parametrize("f", [np.zeros(4), np.zeros((4, 5)), 3.0])
def test_time_integral_of_another_length(f):
    with pytest.raises(
        ValueError, match=says("`time_integral`: `t` must have shape (n,) and `f` shape (n, …)", "(5,)")
    ):
        lg.time_integral(np.arange(5.0), f)


# Single precision.


def test_single_precision_warns_and_works():
    """A `UserWarning` says what to do; the top in float32 is near the one in float64."""

    def path():
        trajectory = lg.simulate(spinning_top(jnp.asarray(np.pi / 4, dtype=float)), t1=0.2, num_steps=20)
        return trajectory.body("top").position

    expected = path()
    assert expected.dtype == jnp.float64
    with jax.enable_x64(False):
        with pytest.warns(
            UserWarning, match=says("single precision", 'jax.config.update("jax_enable_x64", True)', "before")
        ):
            actual = path()
        assert actual.dtype == jnp.float32
    # A step is solved to 64 round-offs of 1 m or 1 rad (4e-6 for 6e-8), more than any other error, and 20
    # steps of 10 ms add up to no more than each other's: 20 × 64 × EPS32 bounds it, and the motion is a
    # thousand times larger.
    difference = np.abs(np.asarray(actual, np.float64) - expected).max()
    assert np.ptp(expected, axis=0).max() > 0.05
    assert 0 < difference < 20 * 64 * np.finfo(np.float32).eps


def test_double_precision_does_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fail(0.0)


# Hardpoint files.

FILE = (resources.files("lgsens.examples") / "data" / "five_link_suspension.toml").read_text(encoding="utf-8")
FORMAT = "see lgsens/examples/data/five_link_suspension.toml for the format"


def line(pattern):
    """The lines of the shipped file that match."""
    found = re.search(pattern, FILE, re.MULTILINE)
    assert found, pattern
    return found.group(0)


# What is replaced by what, and the key and the reason in the message.
FILES = {
    "missing number": (r"^stiffness = 150000.*$", "", ("key 'tyre.stiffness'", "is missing", FORMAT)),
    "missing point": (r"^bearing = .*$", "", ("key 'wheel.bearing'", "is missing", FORMAT)),
    "missing table": (r"^\[damper\]$", "[dampr]", ("key 'damper'", "is missing", FORMAT)),
    "missing point of a link": (
        r"^chassis = \[-8.8.*$",
        "",
        ("key 'links.track_strut.chassis'", "is missing", FORMAT),
    ),
    "table that is a number": (
        r"^\[links.wishbone\]\n.*\n.*\n.*$",
        "[links]\nwishbone = 1",
        ("key 'links.wishbone'", "a table"),
    ),
    "number of text": (
        r"^damping = 4900.0",
        'damping = "firm"',
        ("key 'damper.damping'", "must be a finite number", "'firm'"),
    ),
    "number that is true": (
        r"^radius = 0.0125",
        "radius = true",
        ("key 'link_section.radius'", "a finite number", "True"),
    ),
    "negative rate": (
        r"^stiffness = 109000.0",
        "stiffness = -1.0",
        ("key 'spring.stiffness'", "positive", "-1.0"),
    ),
    "zero mass": (r"^mass = 83.5", "mass = 0", ("key 'wheel.mass'", "must be positive", "got 0")),
    "mass nan": (r"^mass = 83.5", "mass = nan", ("key 'wheel.mass'", "must be", "got nan")),
    "mass infinite": (r"^mass = 83.5", "mass = inf", ("key 'wheel.mass'", "must be", "got inf")),
    "point with two numbers": (
        r"^bearing = .*$",
        "bearing = [0.0, 1.0]",
        ("key 'wheel.bearing'", "three numbers [x, y, z]", "[0.0, 1.0]"),
    ),
    "point with text": (
        r"^bearing = .*$",
        'bearing = [0.0, 1.0, "up"]',
        ("key 'wheel.bearing'", "three numbers", "'up'"),
    ),
    "point that is a number": (
        r"^bearing = .*$",
        "bearing = 3.0",
        ("key 'wheel.bearing'", "three numbers", "3.0"),
    ),
    "point with nan": (
        r"^bearing = .*$",
        "bearing = [0.0, nan, 1.0]",
        ("key 'wheel.bearing'", "three numbers", "nan"),
    ),
    "unknown link": (
        r'^link = "rollover_strut"',
        'link = "tie_rod"',
        ("key 'spring.link'", "one of ['guide_link'", "'tie_rod'"),
    ),
    "link as a list": (
        r'^link = "rollover_strut"',
        'link = ["rollover_strut"]',
        ("key 'spring.link'", "must be one of"),
    ),
    "four links": (
        r"^\[links.guide_link\]\n.*\n.*\n.*$",
        "",
        (
            "key 'links'",
            "five links are needed",
            "['rollover_strut', 'track_strut', 'trailing_arm', 'wishbone']",
        ),
    ),
    "link without length": (
        r"^chassis = \[-2.0, -15.8, 16.7\]",
        "chassis = [-0.4, -25.6, 16.3]",
        ("key 'links.wishbone.knuckle'", "must differ from 'chassis'"),
    ),
    "spring without length": (
        r"^link_point = \[-4.4, -18.4, 5.2\]",
        "link_point = [-4.9, -17.6, 16.0]",
        ("key 'spring.chassis_point'", "must differ from 'link_point'"),
    ),
    "unphysical inertia": (
        r"^inertia = \[0.75, 1.2, 0.75\]",
        "inertia = [0.75, 12.0, 0.75]",
        ("key 'wheel.inertia'", "12.", "each principal moment at most the sum"),
    ),
    "not TOML": (
        r"^\[tyre\]$",
        "[tyre",
        ("is not valid TOML", f"line {FILE[: FILE.index('[tyre]')].count(chr(10)) + 1}"),
    ),
}


@pytest.mark.parametrize("mistake", FILES)
def test_hardpoint_file(mistake, tmp_path):
    pattern, replacement, parts = FILES[mistake]
    path = tmp_path / "mine.toml"
    path.write_text(FILE.replace(line(pattern), replacement, 1), encoding="utf-8")
    with pytest.raises(ValueError, match=says(f"Hardpoint file {str(path)!r}", *parts)):
        QuarterCar.load(path)


def test_hardpoint_file_that_cannot_be_read(tmp_path):
    with pytest.raises(ValueError, match=says("Hardpoint file", "nowhere.toml", "cannot be read", "No such file")):
        QuarterCar.load(tmp_path / "nowhere.toml")
    with pytest.raises(ValueError, match=says("Hardpoint file", "cannot be read", "directory")):
        QuarterCar.load(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=says("Hardpoint file", "binary.toml", "cannot be read", "utf-8")):
        QuarterCar.load(tmp_path / "binary.toml")


def test_shipped_hardpoint_file_reads_as_a_users_own(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(FILE, encoding="utf-8")
    jax.tree.map(np.testing.assert_array_equal, QuarterCar.load(path), QuarterCar.load())


def test_kind_of_wheel():
    with pytest.raises(ValueError, match=says("`wheel` must be 'hinged' or 'locked'", "'flat'")):
        QuarterCar.load().model(wheel="flat")
