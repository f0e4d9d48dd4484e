"""Forces along relative coordinates, and couplings of two: closed forms, energy, every number's derivative."""

import pickle

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says, some_quick

import lgsens as lg
from lgsens.testing import check_force, check_sensitivities

ORIGIN, X, Y, Z = np.zeros(3), *np.eye(3)
AT, SLOPE, SKEW = (0.3, -0.7, 1.1), (1.0, 2.0, -0.5), (0.4, -0.3, 1.0)
G = 9.81

HINGE = lg.RevoluteJoint("a", "b", at=AT, axis=SLOPE)
CROSS = lg.UniversalJoint("a", "b", at=AT, axis_a=SLOPE, axis_b=SKEW)
NUMBERS = {"stiffness": 3.0, "damping": 0.4, "free": 0.2, "motor": lg.Polynomial([0.5, 0.3])}
FORCES = {
    "hinge": lg.CoordinateForce(HINGE, **NUMBERS),
    "slider": lg.CoordinateForce(lg.PrismaticJoint("a", "b", at=AT, axis=SLOPE), **NUMBERS),
    "arm of a cross": lg.CoordinateForce(CROSS, "angle_b", **NUMBERS),
    "ball": lg.RotationalSpringDamper("a", "b", stiffness=3.0, damping=0.4, turned=(0.3, -0.2, 0.5)),
}


SLOW = pytest.mark.slow  # ten seconds of processor each


@pytest.mark.parametrize("name", ["ball", *(pytest.param(name, marks=SLOW) for name in FORCES if name != "ball")])
def test_forces(name):
    """Tangents, action and reaction, carrying on merged bodies."""
    check_force(FORCES[name]).raise_if_failed()


def coupled(rotor=0.7, coefficients=(1.0,), linear_solver=None, merged=False):
    """A pendulum, 0.4 rad from hanging, with a rotor that turns with it, on a spring with a motor.

    With `merged` half of its bob is a body of its own.
    """
    arm = np.array([np.sin(0.4), 0.0, -np.cos(0.4)])
    hinge = lg.RevoluteJoint(None, "bob", at=ORIGIN, axis=Y)
    turn = lg.RevoluteJoint(None, "rotor", at=ORIGIN, axis=X)
    half = {"mass": 1.0, "inertia": (0.05, 0.1, 0.08), "position": 0.5 * arm}
    whole = {"mass": 2.0, "inertia": (0.1, 0.2, 0.16), "position": 0.5 * arm}
    bodies = {"bob": lg.RigidBody(**(half if merged else whole))}
    joints = {"hinge": hinge}
    if merged:
        bodies["rest"] = lg.RigidBody(**half)
        joints = {"weld": lg.FixedJoint("bob", "rest", at=0.4 * arm), "hinge": hinge}
        hinge = lg.RevoluteJoint(None, "rest", at=ORIGIN, axis=Y)
    bodies["rotor"] = lg.RigidBody(1.0, np.full(3, rotor), free="rx")
    joints["gear"] = lg.CoordinateCoupling(turn, hinge, coefficients)
    forces = {
        "weight": lg.Gravity((0.0, 0.0, -G)),
        "spring": lg.CoordinateForce(hinge, stiffness=3.0, free=0.2, motor=1.5),
    }
    return lg.Model(bodies, joints, forces, linear_solver=linear_solver, merge_fixed=merged)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [{}, {"linear_solver": lg.BlockSparse()}, {"merged": True}],
)
def test_a_rotor_is_an_inertia_of_the_hinge(options):
    """(J + m l² + ρ² J_r) θ̈ = m g l sin θ₀ + k θ_f + M with the ratio ρ of the rotor."""
    model = coupled(coefficients=(3.0,), **options)
    state = eqx.filter_jit(lg.initial_state)(model)
    *_, change = model.system().motion(0, state.q, state.v, state.vdot)
    expected = (2.0 * G * 0.5 * np.sin(0.4) + 3.0 * 0.2 + 1.5) / (0.2 + 2.0 * 0.25 + 9.0 * 0.7)
    np.testing.assert_allclose(change[1], expected, rtol=1e-12)  # round-off times the condition of B M⁻¹ Bᵀ, 1e3


@SLOW
def test_many_turns():
    """Two wheels on a belt, a motor on the second: θ₁ = 2 θ₂ = t² M/(J₂ + 4 J₁), more than three turns."""
    moment, first, second = 40.0, 0.3, 0.8
    hinges = {name: lg.RevoluteJoint(None, name, at=at, axis=Z) for name, at in (("one", ORIGIN), ("two", X))}
    model = lg.Model(
        {
            "one": lg.RigidBody(1.0, (1.0, 1.0, first), free="rz"),
            "two": lg.RigidBody(1.0, (1.0, 1.0, second), X, free="rz"),
        },
        {"belt": lg.CoordinateCoupling(hinges["one"], hinges["two"], (2.0,))},  # bodies are on hinges by `free`
        {"motor": lg.CoordinateForce(hinges["two"], motor=moment)},
    )
    motion = lg.simulate(model, t1=1.0, num_steps=100)
    rate = moment / (second + 4.0 * first)
    # generalized-α is exact for a constant acceleration; Newton's tolerance remains
    for name, ratio in (("one", 2.0), ("two", 1.0)):
        spin, axes = (getattr(motion.body(name), of)[-1] for of in ("angular_velocity", "orientation"))
        np.testing.assert_allclose(spin[2], ratio * rate, rtol=1e-9)
        turned = ratio * rate / 2.0
        np.testing.assert_allclose(axes[:2, 0], [np.cos(turned), np.sin(turned)], atol=1e-9)
    assert rate > 6.0 * np.pi


@pytest.mark.slow
def test_planetary_gear_on_a_carrier():
    """Sun and ring on one axis in a carrier that turns: ω_s − ω_c = −(z_r/z_s)(ω_r − ω_c) (Willis), their moments are
    as 1 : z_r/z_s, and the carrier's is minus their sum; over eight turns of the sun."""
    z_ring, z_sun, ring, carrier = 60, 24, 2.0, -5.0
    turn = lambda a, b: lg.RevoluteJoint(a, b, at=ORIGIN, axis=Z)
    bodies = {name: lg.RigidBody(1.0, (0.1, 0.1, 0.2)) for name in ("carrier", "sun", "ring")}
    joints = {
        "bearing": turn(None, "carrier"),
        "sun": turn("carrier", "sun"),
        "ring": turn("carrier", "ring"),
        "mesh": lg.CoordinateCoupling(turn("carrier", "sun"), turn("carrier", "ring"), (-z_ring / z_sun,), teeth=z_sun),
        "turns": lg.RotationDriver(None, "carrier", axis=Z),
        "drives": lg.RotationDriver(None, "ring", axis=Z),
    }
    t = np.linspace(0.0, 2.5, 41)
    model = lg.Model(bodies, joints, {"load": lg.AppliedForce("sun", moment=(0.0, 0.0, 1.7))})
    motion = lg.kinematics(model, {"turns": carrier * t, "drives": ring * t}, rates={"turns": carrier, "drives": ring})
    sun = carrier - z_ring / z_sun * (ring - carrier)
    # round-off times the condition of the mechanism
    np.testing.assert_allclose(motion.body("sun").angular_velocity[:, 2], sun, rtol=1e-10)
    x = motion.body("sun").orientation[:, :2, 0]
    np.testing.assert_allclose(x, np.stack([np.cos(sun * t), np.sin(sun * t)], axis=1), atol=1e-9)
    moments = [motion.multiplier(name)[:, 0] for name in ("drives", "turns")]
    # what drives a body does to it −λ
    np.testing.assert_allclose(moments[0], 1.7 * -z_ring / z_sun, rtol=1e-9)
    np.testing.assert_allclose(moments[1], 1.7 * (1.0 + z_ring / z_sun), rtol=1e-9)
    assert abs(sun) * t[-1] > 8 * 2 * np.pi


@pytest.mark.parametrize("c", some_quick([-0.5, -1.0]))
def test_rope_over_a_pulley(c):
    """Atwood's machine, and a block and tackle, on ropes of different lengths: s̈₂ = g (m₁ c + m₂)/(m₁ c² + m₂)."""
    masses, lengths = (1.0, 3.0), (1.0, 2.0)
    below = [np.array([x, 0.0, -length]) for x, length in zip((0.0, 1.0), lengths)]
    names = ("light", "heavy")
    bodies = {name: lg.RigidBody(m, None, position=at, free="z") for name, m, at in zip(names, masses, below)}
    ropes = [lg.DistanceJoint(None, name, at_a=at * (1, 1, 0), at_b=at) for name, at in zip(names, below)]
    model = lg.Model(bodies, {"pulley": lg.CoordinateCoupling(*ropes, (c,))}, {"weight": lg.Gravity((0.0, 0.0, -G))})
    run = lg.simulate(model, t1=0.4, num_steps=10)
    down = G * (masses[0] * c + masses[1]) / (masses[0] * c**2 + masses[1])
    ends = [float(run.body(name).position[-1, 2]) for name in names]
    # of a constant acceleration the scheme is exact: round-off, 1e-16/(βh²) of forces
    np.testing.assert_allclose(ends, [-(lengths[0] + c * down * 0.08), -(lengths[1] + down * 0.08)], rtol=1e-10)
    tension = masses[1] * (G - down) / -c
    for known in (run, pickle.loads(pickle.dumps(run))):
        np.testing.assert_allclose(known.multiplier("pulley")[1:], tension, rtol=1e-9)


@pytest.mark.slow  # three programs, a minute of processor
def test_every_number():
    """DDM, AVM and differences of random sums of the state, with a curved coupling of hinge and rotor."""

    def asked(model):
        # a body with one rotation has derivatives by turns and speeds about it only
        rotor = lambda model: model.bodies["rotor"]
        held = rotor(model).angular_velocity * X
        model = eqx.tree_at(lambda model: rotor(model).orientation, model, jnp.eye(3))
        model = eqx.tree_at(lambda model: rotor(model).velocity, model, jnp.zeros(3))
        model = eqx.tree_at(lambda model: rotor(model).angular_velocity, model, held)
        motion = lg.simulate(model, t1=0.1, num_steps=5)
        found = [motion.body(name) for name in ("bob", "rotor")]  # of the rotor, what its one freedom moves
        end = jnp.concatenate([jnp.ravel(part[-1]) for of in found for part in (of.orientation, of.angular_velocity)])
        return jnp.asarray(np.random.default_rng(0).standard_normal((3, end.size))) @ end

    check_sensitivities(asked, coupled(coefficients=(1.3, 0.4))).raise_if_failed()


BAD = {
    "no coordinate": (lambda: lg.CoordinateForce(lg.FixedJoint("a", "b", at=AT)), "has no relative coordinate"),
    "which coordinate": (lambda: lg.CoordinateForce(CROSS), "give the name of one"),
    "unknown coordinate": (lambda: lg.CoordinateForce(HINGE, "length"), "'length' is not one of ['angle']"),
    "no coefficient": (lambda: lg.CoordinateCoupling(HINGE, HINGE, ()), "must have shape (n,)"),
    "teeth": (lambda: lg.CoordinateCoupling(HINGE, HINGE, teeth=0), "`teeth` must be at least 1, got 0"),
    "zero": (lambda: lg.CoordinateCoupling(HINGE, HINGE, (0.0,)), "`coefficients` are all zero"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input(name):
    make, message = BAD[name]
    with pytest.raises(ValueError, match=says(message)):
        make()


def test_other_bodies_are_checked():
    """Also the third and fourth body of a coupling."""
    turn = lg.RevoluteJoint(None, "c", at=AT, axis=SLOPE)
    bodies = {name: lg.RigidBody(1.0, (1.0, 1.0, 1.0)) for name in "ab"}
    with pytest.raises(ValueError, match=says("Joint 'gear' refers to body 'c'")):
        lg.Model(bodies, {"gear": lg.CoordinateCoupling(HINGE, turn)})
