"""Friction of joints from what they carry: closed forms, proven tangents, ∂r/∂λ, derivatives, LuGre's steady state."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, says, some_quick

import lgsens as lg
from lgsens.dynamics import accelerations, initial_state, jerk, multiplier_jacobian
from lgsens.testing import check_force, check_sensitivities

G, X, Y, Z, ORIGIN = 9.81, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
AT, AXIS = (0.3, -0.7, 1.1), (1.0, 2.0, -0.5)
MU, W_0, EPSILON = 0.3, 1e-3, 0.1
LAW = {"coefficient": MU, "slip_speed": W_0, "load_rounding": EPSILON}
BRISTLES = {"static_coefficient": 0.4, "stribeck_speed": 0.05, "stiffness": 100.0, "damping": 5.0}

JOINTS = {
    "hinge": lg.RevoluteJoint("a", "b", at=AT, axis=AXIS),
    "sleeve": lg.CylindricalJoint("a", "b", at=AT, axis=AXIS),
    "ball": lg.SphericalJoint("a", "b", at=AT),
    "cross": lg.UniversalJoint("a", "b", at=AT, axis_a=AXIS, axis_b=(0.5, 1.0, 2.0)),
}
SHAPE = {"radius": 0.2, "arm": 0.7, "viscous": 0.3, "preload": 0.2}
FRICTIONS = {
    "Coulomb in a sleeve": lg.JointFriction("sleeve", **LAW, **SHAPE),
    "Coulomb with given load": lg.JointFriction("hinge", **LAW, **SHAPE, own_forces=False),
    "Coulomb in a cross": lg.JointFriction("cross", **LAW, **SHAPE),
    "LuGre in a ball": lg.LuGreFriction("ball", **LAW, **BRISTLES, **SHAPE),
}


@pytest.mark.slow  # a program each
@pytest.mark.parametrize("name", FRICTIONS)
def test_frictions_are_what_they_say(name):
    check_force(FRICTIONS[name].on(JOINTS), length=0.1).raise_if_failed()


# Bodies that rub, each in its own joint on the ground.

MASS, SLOPE, RADIUS, ARM, VISCOUS = 2.0, 0.5, 0.1, 0.25, 0.4
INERTIA = np.array([0.1, 0.1, 0.1])
DOWN = (float(np.cos(SLOPE)), 0.0, -float(np.sin(SLOPE)))
SPIN, SPEED, MOMENT = np.array([3.0, -2.0, 1.0]), 0.7, 1.3
ARM_RATES = (3.0, -2.0)


EVERY = ("block", "wheel", "sleeve", "ball", "puck", "cross")
FEW = ("block", "ball")


def rubbing(names=EVERY, solver=None):
    body = lambda y, **more: lg.RigidBody(MASS, INERTIA, position=(0.0, y, 0.0), **more)
    spinning = lambda e: {"angular_velocity": tuple(5.0 * np.array(e))}
    bodies = {
        "block": body(0.0, velocity=tuple(SPEED * np.array(DOWN))),
        "wheel": body(1.0, **spinning(Y)),
        "sleeve": body(2.0, velocity=(SPEED, 0.0, 0.0), **spinning(X)),
        "ball": body(3.0, angular_velocity=tuple(SPIN)),
        "puck": body(4.0, velocity=(SPEED, 0.0, 0.0), **spinning(Z)),
        "cross": body(5.0, angular_velocity=(*ARM_RATES, 0.0)),
    }
    at = lambda y: (0.0, y, 0.0)
    joints = {
        "block": lg.PrismaticJoint(None, "block", at=at(0.0), axis=DOWN),
        "wheel": lg.RevoluteJoint(None, "wheel", at=at(1.0), axis=Y),
        "sleeve": lg.CylindricalJoint(None, "sleeve", at=at(2.0), axis=X),
        "ball": lg.SphericalJoint(None, "ball", at=at(3.0)),
        "puck": lg.PlanarJoint(None, "puck", at=at(4.0), axis=Z),
        "cross": lg.UniversalJoint(None, "cross", at=at(5.0), axis_a=X, axis_b=Y),
    }
    bodies, joints = ({name: own[name] for name in names} for own in (bodies, joints))
    options = {"block": {"arm": ARM}, "wheel": {"radius": RADIUS, "viscous": VISCOUS, "preload": 3.0}}
    of = lambda name: options.get(name, {"radius": RADIUS})
    forces = {f"{name} rubs": lg.JointFriction(name, **LAW, **of(name)) for name in joints}
    forces |= {
        "gravity": lg.Gravity((0.0, 0.0, -G)),
        "tilt": lg.AppliedForce("block", moment=(0.0, MOMENT, 0.0)),
    }
    return lg.Model(bodies, joints, forces, linear_solver=solver)


def rubbed(load, slip):
    """The force against a slip, from the definition."""
    load, slip = load**2 / np.sqrt(load**2 + EPSILON**2), np.asarray(slip)
    return -MU * load * slip / np.sqrt(slip @ slip + W_0**2)


@pytest.mark.slow
@pytest.mark.parametrize("names", [FEW, EVERY])
def test_accelerations_of_what_rubs(names):
    model = rubbing(names)
    state = eqx.filter_jit(lg.initial_state)(model)
    found = dict(zip(model.system().body_names, np.asarray(state.vdot).reshape(-1, 6)))
    weight, free = MASS * G, np.zeros(3)
    load = np.hypot(weight * np.cos(SLOPE), MOMENT / ARM)
    (force,) = rubbed(load, [SPEED])
    expected = {"block": [*((G * np.sin(SLOPE) + force / MASS) * np.array(DOWN)), *free]}
    slip = 5.0 * RADIUS
    force = rubbed(weight, [slip])[0] - 3.0 * MU * slip / np.hypot(slip, W_0) - VISCOUS * slip
    expected["wheel"] = [*free, 0.0, RADIUS * force / INERTIA[1], 0.0]
    along, about = rubbed(weight, [SPEED, slip])
    expected["sleeve"] = [along / MASS, 0.0, 0.0, RADIUS * about / INERTIA[0], 0.0, 0.0]
    expected["ball"] = [*free, *(RADIUS * rubbed(weight, RADIUS * SPIN) / INERTIA)]
    expected["puck"] = [along / MASS, *free, 0.0, RADIUS * about / INERTIA[2]]
    # ω·(y × x) = 0 with y fixed in the cross, x in the ground: its derivative
    expected["cross"] = [
        *free,
        *(RADIUS * rubbed(weight, RADIUS * np.array(ARM_RATES)) / INERTIA[:2]),
        np.prod(ARM_RATES),
    ]
    for name in names:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-10, atol=1e-10)  # condition of 1e5 round-offs


@pytest.mark.parametrize(
    ("names", "solver"), some_quick([(FEW, lg.DenseLU()), (EVERY, lg.DenseLU()), (EVERY, lg.BlockSparse())])
)
def test_forces_by_multipliers(names, solver):
    """∂r/∂λ is that of the residual by differences, which Jᵀ is not; nothing else makes it of another kind."""
    system = rubbing(names, solver).system()
    q, v = system.reference()
    lam = jnp.asarray(np.random.default_rng(0).uniform(3.0, 5.0, len(system.constraint_names)))
    jacobian, t = system.constraint_jacobian(q, 0.0), jnp.zeros(())
    found = multiplier_jacobian(system, jacobian, q, v, lam, t)
    residual = jax.jit(jax.vmap(lambda lam: system.residual(q, v, jnp.zeros_like(v), lam, t)))
    h = 1e-4  # (h/3)² of curvature, and round-off over h
    steps = h * np.eye(len(lam))
    differences = (residual(lam[None] + steps) - residual(lam[None] - steps)).T / (2 * h)
    np.testing.assert_allclose(found, differences, atol=1e-9)
    assert np.abs(found - jacobian.T).max() > 0.1


@pytest.mark.slow  # small version: test_jerk_is_the_rate_of_the_accelerations
def test_jerk_with_forces_that_read_multipliers():
    """v̈ of the start is the rate of `accelerations` along the motion, by central differences of fourth order."""
    system = swing().system()
    state = initial_state(system, jnp.zeros(())).state
    h, q, v, vdot = 1e-4, state.q, state.v, state.vdot
    found = jerk(system, q, v, vdot, state.lam, jnp.zeros(()))

    def along(s):
        """Accelerations where v̇ and v̈ bring the motion in s, but for O(s³) of the speed, which the differences take
        out."""
        x = s * v + s**2 / 2 * vdot + s**3 / 6 * found
        return accelerations(system, system.group.retract(q, x), v + s * vdot + s**2 / 2 * found, s)[0]

    ahead, behind, far, back = jax.jit(jax.vmap(along))(h * jnp.array([1.0, -1.0, 2.0, -2.0]))
    differences = (8 * (ahead - behind) - (far - back)) / (12 * h)
    size = np.abs(found).max()
    assert size > 1.0
    # what changes at rates of up to w = 100/s is off by (w h)⁴ = 1e-8 of itself
    np.testing.assert_allclose(found, differences, rtol=0, atol=1e-8 * size)


def swing(solver=None):
    """A pendulum whose hinge rubs twice, by Coulomb's law and by bristles."""
    bar = lg.RigidBody(MASS, INERTIA, position=(0.4, 0.1, 0.0), velocity=(0.0, 0.0, 0.4), angular_velocity=(0, -1.0, 0))
    hinge = lg.RevoluteJoint(None, "bar", at=ORIGIN, axis=Y)
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -G)),
        "rubs": lg.JointFriction("hinge", **LAW | {"slip_speed": 0.1}, **SHAPE),
        "bristles": lg.LuGreFriction("hinge", **LAW | {"slip_speed": 0.02}, **BRISTLES, **SHAPE),
    }
    return lg.Model({"bar": bar}, {"hinge": hinge}, forces, linear_solver=solver)


@pytest.mark.slow  # its partial derivatives are in the quick run
def test_gradient_of_what_is_carried():
    """AVM against differences of a program of one joint, by numbers of the friction, of the body and of the joint."""

    def carried(p):
        scene = eqx.tree_at(
            lambda s: (s.forces["rubs"].coefficient, s.forces["rubs"].arm, s.bodies["bar"].mass, s.joints["hinge"].at),
            swing(),
            (p[0], p[1], p[2], jnp.stack([p[3], jnp.zeros(()), jnp.zeros(())])),
        )
        scene = lg.Model(scene.bodies, scene.joints, {name: scene.forces[name] for name in ("gravity", "rubs")})
        return jnp.sum(lg.simulate(scene, t1=0.05, num_steps=5).multiplier("hinge")[-1] * jnp.arange(1.0, 6.0))

    both, h, p = jax.jit(jax.value_and_grad(carried)), 1e-4, jnp.array([0.3, 0.7, 2.0, 0.01])
    found = both(p)[1]
    differences = [(both(p + e)[0] - both(p - e)[0]) / (2 * h) for e in h * jnp.eye(4)]
    np.testing.assert_allclose(found, differences, rtol=1e-6, atol=1e-6 * np.abs(found).max())  # h² over scales of 0.1


@pytest.mark.slow  # three programs each, two minutes of processor
@pytest.mark.parametrize(("solver", "stabilized"), [(None, False), (None, True), (lg.BlockSparse(), False)])
def test_every_number(solver, stabilized):
    """DDM, AVM and differences of random sums of the end, which λ is a part of."""
    integrator = lg.GeneralizedAlpha(stabilized=stabilized)

    def asked(model):
        states = lg.simulate(model, t1=0.05, num_steps=5, integrator=integrator).states
        end = jnp.concatenate([jnp.ravel(leaf[-1]) for leaf in (*states.q, states.v, states.lam)])
        return jnp.asarray(np.random.default_rng(0).standard_normal((3, end.size))) @ end

    check_sensitivities(asked, swing(solver)).raise_if_failed()


@pytest.mark.slow
def test_bristles_slip_and_stick():
    """Driven at a constant rate: −N μ(w) − c w. On a slope below atan μ_s: it rests where N σ₀ z holds the weight."""
    rate, tilt = 0.1, 0.3
    down = (float(np.cos(tilt)), 0.0, -float(np.sin(tilt)))
    bodies = {
        "driven": lg.RigidBody(MASS, INERTIA),
        "held": lg.RigidBody(MASS, INERTIA, position=(0.0, 1.0, 0.0)),
    }
    joints = {
        "rail": lg.PrismaticJoint(None, "driven", at=ORIGIN, axis=X),
        "slope": lg.PrismaticJoint(None, "held", at=(0.0, 1.0, 0.0), axis=down),
        "drive": lg.TranslationDriver(None, "driven", at=ORIGIN, axis=X, value=lg.Polynomial(coefficients=(0.0, rate))),
    }
    friction = lambda joint, **more: lg.LuGreFriction(joint, **LAW, **BRISTLES, **more)
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -G)),
        "slides": friction("rail", viscous=VISCOUS),
        "sticks": friction("slope"),
    }
    scene = lg.Model(bodies, joints, forces)
    trajectory = eqx.filter_jit(lambda scene: lg.simulate(scene, t1=2.0, num_steps=200))(scene)
    load = lambda carried: carried**2 / np.hypot(carried, EPSILON)
    more = (BRISTLES["static_coefficient"] - MU) * np.exp(-((rate / BRISTLES["stribeck_speed"]) ** 2))
    push = load(MASS * G) * (MU + more) * np.hypot(rate, W_0) / rate + VISCOUS * rate
    # bristles follow within μ/σ₀ = 3 mm, e⁻⁶⁶ of 0.2 m are left; Newton's tolerance
    np.testing.assert_allclose(trajectory.multiplier("drive")[-1], [-push], rtol=1e-8)
    np.testing.assert_allclose(trajectory.force("slides").force[-1], [-push], rtol=1e-8)
    bent = MASS * G * np.sin(tilt) / (load(MASS * G * np.cos(tilt)) * BRISTLES["stiffness"])
    np.testing.assert_allclose(trajectory.states_of("sticks")["bristle_x"][-1], bent, rtol=1e-6)  # e⁻²⁰ of swinging
    travel = np.asarray(trajectory.joint("slope").displacement)
    assert bent < travel[-1] < 0.02 and abs(travel[-1] - travel[-20]) < 1e-3 * bent  # no bristle bends more than that
    np.testing.assert_allclose(trajectory.force("sticks").load[-1], load(MASS * G * np.cos(tilt)), rtol=1e-8)


@pytest.mark.slow
def test_a_cross_slips_as_its_arms_turn():
    """Between two bodies that tumble: w is r times the rates of both angles, and Σ s·w is the power of what acts."""
    spins = {"a": (0.3, -0.5, 0.4), "b": (0.7, 0.2, 0.1)}
    bodies = {name: lg.RigidBody(MASS, (0.1, 0.2, 0.25), angular_velocity=spin) for name, spin in spins.items()}
    friction = {"rubs": lg.JointFriction("cross", **LAW, **SHAPE)}
    model = lg.Model(bodies, {"cross": lg.UniversalJoint("a", "b", at=ORIGIN, axis_a=X, axis_b=Y)}, friction)

    @eqx.filter_jit
    def run(model):
        trajectory = lg.simulate(model, t1=1.0, num_steps=100)
        cross = trajectory.joint("cross")
        rates = jnp.stack([cross.rates[name] for name in ("angle_a", "angle_b")], axis=1)
        return rates, cross.coordinates["angle_a"], trajectory.force("rubs")

    rates, angle, rubs = run(model)
    assert np.ptp(angle) > 0.2
    # ẋ, which w has none of, is O(h²) in velocities, and so are rates about the arms
    np.testing.assert_allclose(rubs.slip, SHAPE["radius"] * rates, atol=1e-6)


@pytest.mark.slow  # a program for each number of steps
def test_what_is_lost_is_rubbed():
    """Kinetic and potential energy decrease by the work of the friction, to the order of the scheme."""

    @eqx.filter_jit
    def missing(scene, steps):
        trajectory = lg.simulate(scene, t1=0.4, num_steps=steps)
        bar = trajectory.body("bar")
        spin = bar.angular_velocity**2 @ INERTIA
        energy = MASS * (jnp.sum(bar.velocity**2, axis=1) / 2 + G * bar.position[:, 2]) + spin / 2
        rubs = [trajectory.force(name) for name in ("rubs", "bristles")]
        work = sum(lg.time_integral(trajectory.t, jnp.sum(one.force * one.slip, axis=1)) for one in rubs)
        return energy[-1] - energy[0] - work, work

    few, work = missing(swing(), 40)
    many, _ = missing(swing(), 80)
    assert work < -0.05 and abs(few) < 0.02 * abs(work)
    assert 3.0 < few / many < 5.0


def test_joint_without_its_forces_in_the_plane():
    """Of a planar body the hinge carries forces in the plane, and they alone load it."""
    wheel = lg.RigidBody(MASS, INERTIA, angular_velocity=(0.0, 5.0, 0.0), free=("x", "z", "ry"))
    hinge = lg.RevoluteJoint(None, "wheel", at=ORIGIN, axis=Y)
    push = lg.AppliedForce("wheel", force=(0.0, 7.0, 0.0))
    friction = lg.JointFriction("hinge", **LAW, radius=RADIUS)
    forces = {"gravity": lg.Gravity((0.0, 0.0, -G)), "push": push, "rubs": friction}
    state = eqx.filter_jit(lg.initial_state)(lg.Model({"wheel": wheel}, {"hinge": hinge}, forces))
    expected = RADIUS * rubbed(MASS * G, [5.0 * RADIUS])[0] / INERTIA[1]
    close(state.vdot, [0.0, 0.0, expected], 1e3)


@pytest.mark.slow  # two programs
def test_hinge_on_a_part_of_a_merged_body():
    """A hinge on a part that is fixed to the bar rubs as if both were one: accelerations, and what is measured."""
    scene = swing()
    part = lg.RigidBody(0.5, INERTIA, position=(0.1, 0.0, 0.0), velocity=(0.0, 0.0, 0.1), angular_velocity=(0, -1.0, 0))
    joints = {
        "hinge": lg.RevoluteJoint(None, "part", at=ORIGIN, axis=Y),
        "weld": lg.FixedJoint("part", "bar", at=ORIGIN),
    }

    @eqx.filter_jit
    def start(merged):
        model = lg.Model(scene.bodies | {"part": part}, joints, scene.forces, merge_fixed=merged)
        state = lg.initial_state(model)
        instant = lg.Instant(t=jnp.zeros(()), state=state, system=model.system())
        return instant.body("bar"), instant.force("rubs"), instant.force("bristles")

    whole, parts = start(True), start(False)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(parts)):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)  # condition of 1e5 round-offs
    assert np.abs(whole[1].force).max() > 1.0


def test_a_scene_without_friction_has_nothing_of_it():
    bar = swing()
    plain = lg.Model(bar.bodies, bar.joints, {"gravity": bar.forces["gravity"]}).system()
    assert not plain.reads_multipliers and bar.system().reads_multipliers
    q, v = plain.reference()
    jacobian = plain.constraint_jacobian(q, 0.0)
    program = jax.make_jaxpr(lambda lam: multiplier_jacobian(plain, jacobian, q, v, lam, 0.0))(jnp.zeros(5))
    assert [operation.primitive.name for operation in program.eqns] == ["transpose"]


def test_bad_input():
    joints = {"rod": lg.DistanceJoint("a", "b", at_a=ORIGIN, at_b=X), "hinge": JOINTS["hinge"]}
    for friction, message in (
        (lg.JointFriction("hing", **LAW), "JointFriction: `joint`: 'hing' is not one of"),
        (lg.JointFriction("rod", **LAW), "is a DistanceJoint, of which no friction is known"),
        (lg.JointFriction("hinge", **LAW), "`radius` is missing"),
    ):
        with pytest.raises(ValueError, match=says(message)):
            friction.on(joints)
    for name in ("slip_speed", "load_rounding", "radius", "arm"):
        with pytest.raises(ValueError, match=says(f"JointFriction: `{name}` must be positive, got 0.0")):
            lg.JointFriction("hinge", **LAW | {name: 0.0})
    bar = swing()
    twice = lg.Model(bar.bodies, bar.joints, bar.forces, redundant="minimum_norm")
    with pytest.raises(ValueError, match=says("needs multipliers that are unique")):
        twice.system()
    with pytest.raises(ValueError, match=says("needs forces that do not depend on multipliers")):
        lg.simulate(bar, t1=0.1, num_steps=2, integrator=lg.IndexReducedODE())


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.01, 100.0])
def test_it_holds_bodies_of_any_mass(mass):
    """A block slides down a slope by g (sin α − μ cos α) t²/2, however light: ε is relative to its weight."""
    axis, speed, mu, t1 = np.array([np.cos(0.5), 0.0, -np.sin(0.5)]), 1e-3, 0.3, 0.2
    block = lg.RigidBody(mass, (0.1 * mass,) * 3)
    slope = lg.PrismaticJoint(None, "block", at=(0.0, 0.0, 0.0), axis=axis)
    forces = {
        "weight": lg.Gravity((0.0, 0.0, -9.81)),
        "rubs": lg.JointFriction("slope", coefficient=mu, slip_speed=speed),
    }
    run = lg.simulate(lg.Model({"block": block}, {"slope": slope}, forces), t1=t1, num_steps=400)
    way = 0.5 * 9.81 * (np.sin(0.5) - mu * np.cos(0.5)) * t1**2
    # until it slips at 10 w₀, in 5 ms, it is held by less: that much more speed at most, 10 w₀ t₁, of which 1/4 is seen
    np.testing.assert_allclose(run.body("block").position[-1] @ axis, way, atol=3.0 * speed * t1)
