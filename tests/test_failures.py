"""Bad arguments of functions, and failures: mechanisms, equilibrium, Newton, precision."""

import re
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says, some_quick

import lgsens as lg
from lgsens.dynamics import AbstractSystem, Tangents
from lgsens.examples import spinning_top
from lgsens.liegroups import Rn

BODY = lg.RigidBody(1.0, (1.0, 1.0, 1.0))
TWO = {"chassis": BODY, "wheel": lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=(1.0, 0.0, 0.0))}
ORIGIN, X, Z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
NAN, INF = float("nan"), float("inf")


def ball(a, b, at=ORIGIN):
    return lg.SphericalJoint(a, b, at=at)


# Arguments of the functions. The scene is the one that the failures below use, so that it compiles once.


def pendulum(push=0.0, length=None, extra=(), free=None):
    """A body at rest under a ball joint; after 0.5 s a force of up to `push` N."""
    signal = lg.SampledRoad([0.0, 0.5, 0.6, 1.0], [0.0, 0.0, 1.0, 1.0])
    bob = lg.RigidBody(2.0, (0.1, 0.2, 0.3), position=(0.0, 0.0, -1.0), free=free)
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
    "t1 infinite": (dict(t1=float("inf")), ("`t0` and `t1` must be finite", "t1 = inf s")),
    "t0 infinite": (dict(t0=-float("inf")), ("`t0` and `t1` must be finite", "t0 = -inf s")),
    "t1 text": (dict(t1="1"), ("`t1` must be a number", "got '1'")),
    "t1 a truth value": (dict(t1=True), ("`t1` must be a number", "got True")),
    "num_steps a truth value": (dict(num_steps=True), ("`num_steps` must be a Python int", "got True")),
    "num_steps NumPy's": (dict(num_steps=np.True_), ("`num_steps` must be a Python int", "True")),
    "t1 of shape (2,)": (dict(t1=[1.0, 2.0]), ("`t1` must have shape ()", "got shape (2,)")),
    "integrator": (dict(integrator="RK4"), ("`integrator` must be a GeneralizedAlpha", "'RK4'")),
    "sensitivity": (
        dict(sensitivity="adjoint"),
        ("`sensitivity` must be DirectDifferentiation(),", "'adjoint'"),
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
    "rods in line": (
        {f"at {x}": lg.DistanceJoint(None, "bob", at_a=(x, 0.0, 0.0), at_b=ORIGIN) for x in (-1.0, 1.0)},
        ["at -1.0", "at 1.0"],
    ),
}


@pytest.mark.parametrize("case", REDUNDANT)
def test_redundant_constraints(case):
    joints, names = REDUNDANT[case]
    model = lg.Model({"bob": BODY}, joints)
    parts = (
        "constrain the same motion twice",
        "free='x y rz'",
        "replace one of the joints",
        "spherical",
        f"Joints involved: {names}",
        *(("singular; begin beside it",) if case == "rods in line" else ()),
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
    held = {"weld": lg.FixedJoint(None, "anchor", at=(0.0, 0.0, 0.0))}
    model = lg.Model({"anchor": BODY, "stone": BODY}, held, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
    message = says("No static equilibrium was found", "a body that nothing holds falls", "farthest with body 'stone'")
    with pytest.raises(lg.SimulationError, match=message):
        lg.equilibrium(model)


# Newton failures. One iteration is enough while the pendulum hangs (its predictor is the answer), and not
# enough once it is pushed: step 6 of 10, t = 0.6 s.

IMPATIENT = lg.GeneralizedAlpha(max_iterations=1, factor_every=0)
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


def fail(push, throw=True, free=None):
    return lg.simulate(pendulum(push, free=free), t1=1.0, num_steps=10, integrator=IMPATIENT, throw=throw)


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
    """NaN in what is computed of the motion and in its derivatives; what comes out says why, and raises where asked."""

    def run(push):
        trajectory = fail(push)
        return jnp.sum(trajectory.body("bob").position[:, 0]), trajectory

    (value, trajectory), slope = jax.jit(jax.value_and_grad(run, has_aux=True))(30.0)
    assert np.isnan(value) and np.isnan(slope)
    assert trajectory.result == lg.RESULTS.newton_failed
    said = says("did not converge", "step 6 of 10, t = 0.6 s, after 1 iterations: last increment", "residual")
    with pytest.raises(lg.SimulationError, match=said):
        lg.raise_if_failed(trajectory)
    (value, trajectory), _ = jax.jit(jax.value_and_grad(run, has_aux=True))(0.0)
    assert lg.raise_if_failed(trajectory) is trajectory
    np.testing.assert_array_equal(value, jnp.sum(fail(0.0).body("bob").position[:, 0]))


@pytest.mark.slow
def test_derivatives_of_what_came_before_a_failure():
    """Backwards as forwards and as differences; NaN if asked for the rest."""

    def early(push, row):
        run = fail(push, throw=False, free="x z ry")
        motion, turned = run.body("bob"), run.joint("pivot").coordinates["rotation_y"]
        return turned[row] + motion.position[row, 0] + jnp.sum(motion.orientation[row] @ motion.angular_velocity[row])

    all_of_it = jax.jit(lambda *at: (early(*at), jax.grad(early)(*at), jax.jacfwd(early)(*at)))
    _, backwards, forwards = all_of_it(30.0, 3)
    np.testing.assert_allclose(backwards, forwards, rtol=1e-10)  # other order of round-off
    # differences: δ² of a third derivative, relative
    np.testing.assert_allclose(backwards, (all_of_it(30.01, 3)[0] - all_of_it(29.99, 3)[0]) / 0.02, rtol=1e-5)
    assert np.isnan(all_of_it(30.0, 8)[1])


@pytest.mark.slow  # small version: one run, above
def test_derivatives_of_a_batch_of_which_a_lane_failed():
    early = lambda push: fail(push, throw=False).body("bob").position[3, 0]
    lanes = lambda scale: jnp.sum(jax.vmap(early)(scale * jnp.asarray([0.1, 30.0])))
    np.testing.assert_allclose(jax.jit(jax.grad(lanes))(1.0), jax.jit(jax.jacfwd(lanes))(1.0), rtol=1e-10)


@pytest.mark.parametrize(
    ("bad", "result"),
    some_quick([({"length": 0.2}, lg.RESULTS.assembly_failed), ({"mass": -2.0}, lg.RESULTS.invalid_numbers)]),
)
def test_a_masked_run_that_did_not_begin_has_no_derivative(bad, result):
    """Backwards as forwards: it would make NaN of what the other runs of a batch share. Who asks for it has NaN."""

    def masked(at, mass=2.0, length=1.05):
        push, velocity = at[:, None] * jnp.asarray([[0.0, 1.0, 0.0]])
        bob = {"bob": lg.RigidBody(mass, None, position=(0.0, 0.0, -1.0), velocity=velocity, free="x y z")}
        rods = {
            name: lg.DistanceJoint(None, "bob", at_a=(x, 0.0, 0.0), at_b=(0.0, 0.0, -1.0), length=length)
            for name, x in (("left", -0.3), ("right", 0.3))
        }
        force = {"push": lg.AppliedForce("bob", at=(0.0, 0.0, -1.0), force=push)}
        run = lg.simulate(lg.Model(bob, rods, force), t1=0.2, num_steps=4, throw=False)
        end = run.body("bob").position[-1, 1]
        return (jnp.where(run.result == lg.RESULTS.successful, end, 0.0), end), run.result

    of = jax.jit(lambda numbers: jax.jacrev(masked, has_aux=True)(jnp.asarray([3.0, 0.1]), **numbers))
    (of_masked, asked_for), found = of({name: jnp.asarray(value) for name, value in bad.items()})
    assert np.all(of_masked == 0.0) and np.all(np.isnan(asked_for)) and found == result
    (of_masked, asked_for), found = of({name: 1.05 * abs(value) + 0.95 for name, value in bad.items()})
    assert np.all(of_masked > 0.0) and np.all(of_masked == asked_for) and found == lg.RESULTS.successful


def test_first_failure_of_a_batch_is_raised():
    trajectories = jax.jit(jax.vmap(fail))(jnp.asarray([0.0, 30.0]))
    positions = trajectories.body("bob").position
    assert np.all(np.isfinite(positions[0])) and np.all(np.isnan(positions[1]))
    with pytest.raises(lg.SimulationError, match="at step 6 of 10"):
        lg.raise_if_failed(trajectories)


@pytest.mark.slow  # `test_newton_failure_inside_jit` is in the quick run
def test_callbacks_raise_inside_jit():
    """JAX's runtime error, with the same text; the run that works is untouched."""
    path = lambda push: fail(push).body("bob").position[:, 0]
    with lg.failures_by_callback():
        one, every = jax.jit(path), jax.jit(jax.vmap(path))
        with pytest.raises(jax.errors.JaxRuntimeError, match=FAILURE):
            jax.block_until_ready(one(30.0))
        with pytest.raises(jax.errors.JaxRuntimeError, match=FAILURE):
            jax.block_until_ready(every(jnp.asarray([0.0, 30.0])))
        assert np.all(np.isfinite(every(jnp.zeros(2))))


@pytest.mark.slow  # `test_newton_failure_inside_jit` is in the quick run
def test_newton_failure_under_differentiation():
    """Where the model is traced but its values are known the error is the library's own."""
    with pytest.raises(lg.SimulationError, match=FAILURE):
        jax.jvp(lambda push: fail(push).body("bob").position, (30.0,), (1.0,))


@pytest.mark.slow
def test_mechanism_that_cannot_be_assembled_inside_jit():

    def build(length):
        bob = lg.RigidBody(2.0, None, position=(0.0, 0.0, -1.0), free="x y z")
        lines = {"pivot": (ORIGIN, 1.0), "rod": ((1.0, 0.0, -1.0), length)}
        joints = {
            name: lg.DistanceJoint(None, "bob", at_a=at, at_b=bob.position, length=long)
            for name, (at, long) in lines.items()
        }
        return lg.Model({"bob": bob}, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})

    start = lambda length: lg.initial_state(build(length)).v
    run = lambda length: lg.simulate(build(length), t1=0.1, num_steps=2)
    begun, found = jax.jit(lambda length: (start(length), run(length)))(5.0)
    assert np.all(np.isnan(begun))
    with pytest.raises(ValueError, match=UNREACHABLE):
        lg.raise_if_failed(found)
    with lg.failures_by_callback(), pytest.raises(jax.errors.JaxRuntimeError, match=UNREACHABLE):
        jax.block_until_ready(jax.jit(start)(5.0))
    with pytest.raises(ValueError, match="for what comes out of `jit`"):
        jax.jit(lambda length: lg.raise_if_failed(run(length)))(5.0)


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
        lg.model.measured(system, "gravity", system.pose, *(system.velocity,) * 2, jnp.zeros(0), jnp.zeros(1))


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

    def constraint(self, q, t):
        return q[:0]

    def constraint_jacobian(self, q, t):
        return q[:0, None]

    def tangents(self, q, v, vdot, lam, t):
        return Tangents(
            self.square[None, None], jnp.zeros_like(self.square)[None, None], self.constraint_jacobian(q, t)
        )


def test_trajectory_without_bodies():
    trajectory = lg.simulate(Oscillator(jnp.asarray(4.0)), t1=1.0, num_steps=4)
    for ask in (trajectory.body, trajectory.multiplier, trajectory.force):
        with pytest.raises(ValueError, match=says("motion of a Oscillator", "no named bodies", "use `states`")):
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


def test_times_far_from_zero_are_warned_of():
    """Seconds since 1970 are known to 2e-7 s, and a driver's acceleration at steps of 10 ms to nothing."""
    driver = lg.TranslationDriver(
        None, "body", at=(0, 0, 0), axis=(1, 0, 0), value=lg.Harmonic(amplitude=1.0, frequency=1.0)
    )
    model = lg.Model({"body": lg.RigidBody(1.0, None, free="x")}, {"driver": driver})
    with pytest.warns(UserWarning, match=says("`t0` = 1.7e+09 s", "beginning of the run")):
        lg.simulate(model, t0=1.7e9, t1=1.7e9 + 0.2, num_steps=20)
