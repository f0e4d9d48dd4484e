"""Bad input to constructors: each with the argument, the value and the remedy in its message."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg
from lgsens.examples import spatial_chain

BODY = lg.RigidBody(1.0, (1.0, 1.0, 1.0))
TWO = {"chassis": BODY, "wheel": lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=(1.0, 0.0, 0.0))}
ORIGIN, X, Z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
NAN, INF = float("nan"), float("inf")
LINES = lg.Sampled((0.0, 1.0), (0.0, 1.0))


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
    "driver along straight lines": (
        lambda: lg.TranslationDriver(None, "wheel", at=ORIGIN, axis=Z, value=LINES),
        ("`value`", "velocity would jump", 'kind="cubic"'),
    ),
    "rod along straight lines": (
        lambda: lg.DistanceJoint(None, "wheel", at_a=ORIGIN, at_b=X, length=LINES),
        ("`length`", "velocity would jump"),
    ),
    "friction that drives": (
        lambda: lg.JointFriction("pivot", coefficient=-0.3, slip_speed=0.1),
        ("JointFriction: `coefficient` must be ≥ 0", "-0.3"),
    ),
    "drag that drives": (lambda: lg.Drag("wheel", drag_area=-1.0), ("Drag: `drag_area` must be ≥ 0", "-1.0")),
    "stop that pulls": (
        lambda: lg.BumpStop(None, "wheel", at_a=ORIGIN, at_b=X, gap=0.1, stiffness=-1.0, rounding=0.01),
        ("BumpStop: `stiffness` must be ≥ 0", "-1.0"),
    ),
    "spring wound up by turns": (
        lambda: lg.TorsionSpringDamper(None, "wheel", axis=Z, stiffness=1.0, free_angle=12.0),
        ("`free_angle` must be within half a turn", "12.0", "`turns=True`"),
    ),
    "mass of text": (lambda: body(mass="heavy"), ("RigidBody: `mass`", "must be a number", "'heavy'")),
    "mass a truth value": (lambda: body(mass=True), ("RigidBody: `mass`", "must be a number", "True")),
    "position of texts": (lambda: body(position=["0", "1", "2"]), ("`position` must be a number", "['0', '1', '2']")),
    "position of truth values": (lambda: body(position=np.zeros(3, bool)), ("`position` must be a number", "False")),
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
    "a function for a signal": (
        lambda: lg.AppliedForce("wheel", force=X, signal=np.sin),
        ("`signal` must be a signal", "a subclass of AbstractSignal", "sin"),
    ),
    "a number for a road": (lambda: tyre(road=0.1), ("`road` must be a signal", "0.1")),
    "bodies in a list": (lambda: lg.Model([TWO["wheel"]]), ("`bodies` must be a dict", "got list")),
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
        ("Body 'chassis' must be of type RigidBody", "float"),
    ),
    "joint of another type": (
        lambda: lg.Model(TWO, {"strut": spring()}),
        ("Joint 'strut' must be of type AbstractJoint", "SpringDamper; put it into `forces`"),
    ),
    "force of another type": (
        lambda: lg.Model(TWO, {}, {"pivot": ball(None, "wheel")}),
        ("Force 'pivot' must be of type AbstractForce", "SphericalJoint; put it into `joints`"),
    ),
    "joint of an unknown body": (
        lambda: lg.Model(TWO, {"strut": ball("chasis", "wheel")}),
        ("Joint 'strut' refers to body 'chasis'", "the bodies are ['chassis', 'wheel']"),
    ),
    "coordinate by the name of a joint": (
        lambda: lg.CoordinateForce("hinge", stiffness=1.0),
        ("CoordinateForce", "needs a joint itself", "got 'hinge'"),
    ),
    "names of a coupling in one string": (
        lambda: lg.CoordinateCoupling(
            *[lg.RevoluteJoint(None, name, at=X, axis=Z) for name in TWO], coefficients=(1.0,), names="angle"
        ),
        ("`names` must be two names", "got 'angle'"),
    ),
    "freedoms by their number": (lambda: body(free=3), ("must be names of degrees of freedom", "got 3")),
    "body with a number for a name": (lambda: lg.Model({1: body()}), ("a name in `bodies`", "got 1; give '1'")),
    "inputs in one string": (
        lambda: lg.linearize(lg.Model({"wheel": body()}), inputs="zz"),
        ("`inputs` must be a sequence of names", "('zz',)"),
    ),
    "spring of an unknown body": (
        lambda: lg.Model(TWO, {}, {"coil": lg.SpringDamper("chassis", "weel", at_a=ORIGIN, at_b=X, stiffness=1.0)}),
        ("Force 'coil' refers to body 'weel'", "the bodies are ['chassis', 'wheel']"),
    ),
    "driver across a hinge": (
        lambda: lg.Model(
            TWO,
            {"pin": lg.RevoluteJoint(None, "wheel", at=X, axis=Z), "motor": lg.RotationDriver(None, "wheel", axis=X)},
        ),
        ("Joint 'motor': RotationDriver between None and 'wheel'", "these turn about", "their joint 'pin'"),
    ),
    "spring across the one rotation": (
        lambda: lg.Model(
            {"wheel": body(free="x z ry")}, {}, {"coil": lg.TorsionSpringDamper(None, "wheel", axis=X, stiffness=1.0)}
        ),
        ("Force 'coil': TorsionSpringDamper", "these turn about", "`free` rotations"),
    ),
    "controller across a hinge": (
        lambda: lg.Model(
            TWO,
            {"pin": lg.RevoluteJoint(None, "wheel", at=X, axis=Z)},
            {"servo": lg.PIDController(lg.RotationDriver(None, "wheel", axis=X), proportional=1.0)},
        ),
        ("Force 'servo': PIDController", "their joint 'pin'"),
    ),
    "angle in degrees": (
        lambda: lg.CoordinateForce(lg.RevoluteJoint(None, "wheel", at=X, axis=Z), stiffness=1.0, free=45.0),
        ("CoordinateForce: `free` must be within half a turn", "45.0", "not degrees"),
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
    "preload of a spring without a direction": (
        lambda: lg.static_preload(lg.Model(TWO, {}, {"coil": spring(at_b=ORIGIN)}), ("coil",)),
        ("does not determine the preloads of ['coil']", "a spring of no length"),
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
    **{
        f"factor_every = {value!r}": (
            lambda value=value: lg.GeneralizedAlpha(factor_every=value),
            ("GeneralizedAlpha: `factor_every` must be", "at least 0", "full Newton always", f"got {value!r}"),
        )
        for value in (-1, 2.5, "ten")
    },
    # the examples and the measurement of costs
    **{
        f"num_links = {value!r}": (
            lambda value=value: spatial_chain(value),
            ("`num_links` must be", f"got {value!r}"),
        )
        for value in (0, -1, 2.0, "two")
    },
    **{
        f"repeats = {value!r}": (
            lambda value=value: lg.measure_costs(
                lg.Criterion(terminal=lambda s, p: p), lambda p: p, 1.0, repeats=value
            ),
            ("`repeats`", f"got {value!r}"),
        )
        for value in (0, 2.5, "five")
    },
}


@pytest.mark.parametrize("mistake", CONSTRUCTORS)
def test_constructor(mistake):
    build, parts = CONSTRUCTORS[mistake]
    with pytest.raises(ValueError, match=says(*parts)):
        build()


def test_a_trajectory_for_a_state():
    with pytest.raises(ValueError, match=says("`state0` must be a State", "`trajectory.state(-1)`", "got Model")):
        lg.simulate(lg.Model(TWO), t1=1.0, num_steps=2, state0=lg.Model(TWO))


def pendulum(**changes):
    """A body 1 m below a ball joint."""
    bodies = {"bob": body(position=(0.0, 0.0, -1.0), **changes)}
    return lg.Model(bodies, {"pivot": ball(None, "bob")}, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})


def test_a_state_of_other_shapes():
    """A batch of states, by itself, in `jit` and in `differentiate`; and one of a model with fewer joints."""
    model = pendulum()
    states = lg.simulate(model, t1=0.1, num_steps=4).states
    run = lambda state0: lg.simulate(model, t1=0.1, num_steps=4, state0=state0).states.v
    parts = ("`state0` must be one state of this model", "v has (5, 6) and must have (6,)", "jax.vmap(lambda state0:")
    end = lg.Criterion(terminal=lambda s, p: s.body("bob").position[0])
    by_p = lambda states: lg.differentiate(
        end, lambda mass: pendulum(mass=mass), 1.0, t1=0.1, num_steps=4, state0=lambda mass: states
    )
    for given in (run, jax.jit(run), by_p):
        with pytest.raises(ValueError, match=says(*parts)):
            given(states)
    free = lg.initial_state(lg.Model(model.bodies))
    with pytest.raises(ValueError, match=says("`state0`", "lam has (0,) and must have (3,)", "`initial_state(model)`")):
        run(free)
    assert jax.eval_shape(jax.vmap(run), states).shape == (5, 5, 6)


def test_a_state_off_the_joints():
    """Of known numbers, those of `grad` too, before anything runs; inside `jit` the result says so, and the data are
    NaN. What is left of a rounded file passes."""
    model = pendulum()
    run = lambda state0: lg.simulate(model, t0=0.5, t1=0.6, num_steps=4, state0=state0).body("bob").position[-1, 0]
    off = lambda by: eqx.tree_at(lambda state: state.q.position, start, start.q.position + by)
    start = lg.initial_state(model, t0=0.5)
    parts = ("`state0` does not satisfy the joints at t0 = 0.5 s: |Φ| = 0.01", "'pivot'", "`trajectory.state(-1)`")
    for given in (run, jax.grad(run)):
        with pytest.raises(ValueError, match=says(*parts)):
            given(off(0.01))
    run(off(1e-4))
    whole = lambda state0: lg.simulate(model, t0=0.5, t1=0.6, num_steps=4, state0=state0, throw=False)
    states = jax.tree.map(lambda one, other: jnp.stack([one, other]), off(1e-4), off(0.01))
    batch = jax.jit(jax.vmap(whole))(states)
    assert batch.result.tolist() == [lg.RESULTS.successful, lg.RESULTS.off_joints]
    assert np.all(np.isfinite(batch.states.v[0])) and np.all(np.isnan(batch.states.v[1]))
    with pytest.raises(ValueError, match=says("given state does not satisfy the joints at t0", "`equilibrium(model")):
        lg.raise_if_failed(batch)


def test_a_state_with_velocities_that_joints_forbid():
    """As above; what index 3 leaves of them in coarse steps passes."""
    model = pendulum(velocity=(1.0, 0.0, 0.0))
    run = lambda state0: lg.simulate(model, t1=0.3, num_steps=1, state0=state0, throw=False)
    coarse = lg.simulate(model, t1=3.0, num_steps=15)  # 10 in a period
    assert run(coarse.state(-1)).result == lg.RESULTS.successful
    start = lg.initial_state(model)
    pushed = eqx.tree_at(lambda state: state.v, start, start.v + jnp.zeros(6).at[2].set(0.5))
    with pytest.raises(
        ValueError, match=says("`state0` does not satisfy", "|Φ̇| = 0.5", "'pivot'", "RigidBody(velocity")
    ):
        run(pushed)
    assert jax.jit(run)(pushed).result == lg.RESULTS.off_joints


def test_a_state_that_is_no_configuration():
    """The mean of two, or a reflection: of a free body, which has no joints to violate."""
    model = lg.Model({"bob": body(angular_velocity=X)})
    run = lambda state0: lg.simulate(model, t1=0.3, num_steps=3, state0=state0, throw=False)
    states = [lg.simulate(model, t1=0.5, num_steps=5).state(i) for i in (0, -1)]
    mean = jax.tree.map(lambda one, other: (one + other) / 2.0, *states)
    mirrored = eqx.tree_at(lambda state: state.q.orientation, mean, jnp.diag(jnp.array([-1.0, 1.0, 1.0]))[None])
    for wrong in (mean, mirrored):
        with pytest.raises(ValueError, match=says("`state0` is no configuration", "not a rotation matrix")):
            run(wrong)
        assert jax.jit(run)(wrong).result == lg.RESULTS.invalid_numbers
    lost = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), mean)
    with pytest.raises(ValueError, match=says("`state0` is not finite", "from the step on at which a run fails")):
        run(lost)


def test_steps_of_a_run_that_failed():
    model = pendulum(velocity=(1.0, 0.0, 0.0))
    short = lg.simulate(model, t1=3.0, num_steps=5, integrator=lg.AdaptiveSteps(tolerance=1e-8), throw=False)
    with pytest.raises(ValueError, match=says("GivenSteps.of: the trajectory has failed", "needs more steps")):
        lg.GivenSteps.of(short)


def test_half_of_a_divided_model():
    half = eqx.tree_at(lambda model: model.bodies["bob"].mass, pendulum(), None)
    with pytest.raises(ValueError, match=says("Body 'bob': `mass` is None", "`eqx.combine`")):
        lg.simulate(half, t1=0.1, num_steps=1)


def test_a_criterion_of_one_argument():
    with pytest.raises(ValueError, match=says("Criterion: `terminal` must take two arguments", "lambda s, p")):
        lg.Criterion(terminal=lambda s: s.body("bob").position[2])


def test_drivers_that_contradict_each_other():
    """They are named, where no configuration is found."""
    ramps = {
        f"to {end}": lg.RotationDriver(None, "bob", axis=Z, value=lg.Ramp(end=end, duration=1.0)) for end in (0.5, 1.0)
    }
    model = lg.Model({"bob": body(position=X, free="x rz")}, ramps)
    with pytest.raises(ValueError, match=says("constrain the same motion twice", "['to 0.5', 'to 1.0']")):
        lg.simulate(model, t1=0.1, num_steps=1)


@pytest.mark.slow
def test_a_state_in_single_precision():
    """It is taken in that of the model."""
    model = pendulum(velocity=(0.5, 0.0, 0.0))
    start = lg.initial_state(model)
    run = lambda state0: lg.simulate(model, t1=0.1, num_steps=4, state0=state0).states.v[-1]
    found = run(jax.tree.map(lambda leaf: leaf.astype(jnp.float32), start))
    assert found.dtype == jnp.float64
    np.testing.assert_allclose(found, run(start), rtol=0, atol=1e-5)  # 6e-8 of 10 m/s², of 0.5 m/s, in steps of 25 ms


def test_complex_numbers():
    """An imaginary part is not dropped: differences of complex steps would be zero."""
    with pytest.raises(ValueError, match=says("`t1` must be a number", "e-20j")):
        lg.simulate(pendulum(), t1=jnp.asarray(1.0 + 1e-20j), num_steps=2)
    with pytest.raises(ValueError, match=says("`mass` must be a number", "j")):
        pendulum(mass=np.asarray(1.0 + 0.0j))


def test_leaves_of_other_shapes():
    """A batch of models, and leaves that `tree_at` put in."""
    models = jax.vmap(lambda mass: pendulum(mass=mass))(jnp.array([1.0, 2.0]))
    with pytest.raises(ValueError, match=says("Body 'bob': `mass` must have shape (), got shape (2,)", "jax.vmap")):
        lg.simulate(models, t1=0.1, num_steps=2)
    leaf = lambda model: model.joints["pivot"].at
    for given in (lambda model: model.system(), jax.jit(lambda model: model.system())):
        with pytest.raises(ValueError, match=says("Joint 'pivot': `at` must have shape (3,), got shape (1,)")):
            given(eqx.tree_at(leaf, pendulum(), jnp.ones(1)))


def test_a_search_inside_of_a_transformation():
    search = lambda x: lg.optimize.minimize(lambda x: jnp.sum(x**2), x, num_steps=5, progress=False).x
    with pytest.raises(ValueError, match=says("`x0`", "traced", "`multi_start`", "`least_squares`")):
        jax.vmap(search)(jnp.ones((2, 2)))


def test_the_index_of_a_state():
    trajectory = lg.simulate(pendulum(), t1=0.1, num_steps=4)
    for index in (5, -6, np.int64(5)):
        with pytest.raises(IndexError, match=says("`index` must be from -5 to 4", "5 states", f"got {index}")):
            trajectory.state(index)
    np.testing.assert_array_equal(trajectory.state(-5).v, trajectory.states.v[0])
    np.testing.assert_array_equal(jax.jit(lambda i: trajectory.state(i).v)(5), trajectory.states.v[4])


@pytest.mark.filterwarnings("ignore:A JAX array is being set as static")  # Equinox, of the same
def test_a_setting_is_no_array():
    parts = ("GeneralizedAlpha: `rho_inf` must be a number", "got ", "settings are static", "give a Python number")
    for make in (lg.GeneralizedAlpha, jax.jit(lg.GeneralizedAlpha)):
        with pytest.raises(ValueError, match=says(*parts)):
            make(jax.numpy.float64(0.9))


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


def test_what_is_no_state_or_no_result():
    criterion = lg.Criterion(terminal=lambda s, p: s.body("chassis").position[0])
    build = lambda mass: lg.Model({"chassis": body(mass=mass)}, {}, {})
    start = lg.initial_state(build(1.0))
    with pytest.raises(ValueError, match=says("`state0` must be a function of the parameters", "got a State")):
        lg.differentiate(criterion, build, 1.0, t1=0.1, num_steps=2, state0=start)
    with pytest.raises(ValueError, match=says("`found` must have a `result`", "got a int")):
        lg.raise_if_failed(3)
