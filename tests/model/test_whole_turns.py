"""Springs over whole turns: a clock spring against its closed form, and one that does not count them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says, some_quick

import lgsens as lg
from lgsens.model._scaled import ScaledForce

Z = (0.0, 0.0, 1.0)
INERTIA, STIFFNESS, WOUND = 0.02, 0.3, 6 * np.pi  # kg m², N m/rad, rad
T1, STEPS = 1.0, 100


def hinge(rotor="rotor"):
    return lg.RevoluteJoint(None, rotor, at=(0.0, 0.0, 0.0), axis=Z)


def torsion(stiffness, free, **options):
    return lg.TorsionSpringDamper(None, "rotor", axis=Z, stiffness=stiffness, free_angle=free, **options)


def coordinate(stiffness, free, **options):
    return lg.CoordinateForce(hinge(), stiffness=stiffness, free=free, **options)


def scene(spring, **rotor):
    body = lg.RigidBody(1.0, (0.03, 0.03, INERTIA), free="rz", **rotor)
    return lg.Model({"rotor": body}, {}, {"spring": spring})


def unwinding(p, make=torsion):
    return scene(make(*p, turns=True))


def closed_form(p):
    """θ = θ₀ (1 − cos ωt), ω² = k/J, from rest in the reference configuration."""
    stiffness, free = p
    return free * (1.0 - jnp.cos(jnp.sqrt(stiffness / INERTIA) * T1))


def end(p, make, steps, **options):
    found = lg.simulate(unwinding(p, make), t1=T1, num_steps=steps, **options)
    return found.force("spring")[0][-1]  # the angle


INTEGRATORS = {
    "alpha": lg.GeneralizedAlpha(),
    "stabilized": lg.GeneralizedAlpha(stabilized=True),
    "radau": lg.RadauIIA(),
    "ode": lg.IndexReducedODE(),
    "adaptive": lg.AdaptiveSteps(tolerance=1e-5),
}


@pytest.mark.slow
def test_a_clock_spring_unwinds():
    p = jnp.array([STIFFNESS, WOUND])
    value, gradient = jax.value_and_grad(end)(p, torsion, STEPS)
    # the frequency is off by (ωh)² = 0.0015 times ½ or less
    np.testing.assert_allclose(value, closed_form(p), rtol=2e-3)
    np.testing.assert_allclose(gradient, jax.grad(closed_form)(p), rtol=2e-3)


@pytest.mark.slow  # a minute of compilation
@pytest.mark.parametrize("make", [torsion, coordinate])
def test_its_order_and_both_modes(make):
    p = jnp.array([STIFFNESS, WOUND])
    coarse, fine = (end(p, make, n) - closed_form(p) for n in (STEPS, 2 * STEPS))
    np.testing.assert_allclose(coarse / fine, 4.0, rtol=0.02)  # the next term is (ωh)² = 0.0015 of it
    direct = jax.jacfwd(end)(p, make, STEPS)
    adjoint = jax.grad(end)(p, make, STEPS, sensitivity=lg.AdjointVariable())
    np.testing.assert_allclose(adjoint, direct, rtol=1e-11)  # round-off of 100 steps


@pytest.mark.slow  # a program each
@pytest.mark.parametrize("name", INTEGRATORS)
def test_whatever_the_integrator(name):
    p, step = jnp.array([STIFFNESS, WOUND]), 1e-5
    room = 10 * STEPS if name == "adaptive" else STEPS
    of = lambda p: end(p, torsion, room, integrator=INTEGRATORS[name])
    np.testing.assert_allclose(of(p), closed_form(p), rtol=2e-3)
    if name == "adaptive":  # its steps are not those of the next p
        return
    difference = [(of(p + d) - of(p - d)) / (2 * step) for d in step * jnp.eye(2)]
    np.testing.assert_allclose(
        jax.grad(of)(p), difference, rtol=1e-6
    )  # step² of the third derivative, 1e3 of the first


@pytest.mark.slow
@pytest.mark.parametrize("moment", [pytest.param(0.2, marks=pytest.mark.slow), 7.5])
def test_equilibrium_winds_it_up(moment):
    """Within half a turn, and by four: on the way of a damped motion."""
    found = lg.equilibrium(scene(torsion(STIFFNESS, 0.0, turns=True, motor=moment)))
    angle = moment / STIFFNESS
    np.testing.assert_allclose(found.v[-1], angle, rtol=1e-12)
    turned = np.arctan2(found.q.orientation[0, 1, 0], found.q.orientation[0, 0, 0])
    np.testing.assert_allclose(np.sin(turned - angle), 0.0, atol=1e-12 * angle)
    model = scene(torsion(STIFFNESS, 0.0, turns=True, motor=moment))
    run = lg.simulate(model, t1=0.1, num_steps=5, state0=found)
    np.testing.assert_allclose(run.force("spring").moment, 0.0, atol=1e-11 * moment)
    np.testing.assert_allclose(run.states_of("spring")["angle"], angle, rtol=1e-12)


@pytest.mark.slow  # positions that do not tell it are in the quick run
def test_a_spring_that_passes_half_a_turn_has_failed():
    """ω₀ sin(ωt)/ω comes to π at 0.3 s of 1: later on the spring would push where it pulled."""
    rate, start = np.sqrt(STIFFNESS / INERTIA), 13.0
    step = int(np.ceil(np.arcsin(np.pi * rate / start) / rate * STEPS / T1))
    uncounted = scene(torsion(STIFFNESS, 0.0), angular_velocity=(0.0, 0.0, start))
    message = says("passes half a turn", "turns=True", f"in step {step} of {STEPS}, t = {step * T1 / STEPS:.6g} s")
    with pytest.raises(lg.SimulationError, match=message):
        lg.simulate(uncounted, t1=T1, num_steps=STEPS)
    for spring in (torsion(STIFFNESS, 0.0, turns=True), torsion(0.0, 0.0, motor=-0.1)):
        passed = scene(spring, angular_velocity=(0.0, 0.0, start))
        assert lg.simulate(passed, t1=T1, num_steps=STEPS).result == lg.RESULTS.successful


@pytest.mark.slow
def test_so_it_has_where_no_trajectory_is_kept():
    build = lambda k: scene(torsion(k, 0.0), angular_velocity=(0.0, 0.0, 13.0))
    angle = lambda instant: instant.force("spring").angle
    with pytest.raises(lg.SimulationError, match="passes half a turn"):
        lg.simulate(build(STIFFNESS), t1=T1, num_steps=STEPS, save=angle)
    criterion = lg.Criterion(terminal=lambda instant, p: angle(instant))
    with pytest.raises(lg.SimulationError, match="passes half a turn"):
        options = {"t1": T1, "num_steps": STEPS, "method": lg.DirectDifferentiation()}
        lg.differentiate(criterion, build, STIFFNESS, **options)


@pytest.mark.slow
def test_on_a_part_of_a_merged_body():
    """The same motion as of one body, and the same failure."""
    half = lambda spin: lg.RigidBody(0.5, (0.01, 0.01, INERTIA / 2), angular_velocity=(0.0, 0.0, spin))
    joints = {"hinge": hinge("shaft"), "weld": lg.FixedJoint("shaft", "rotor", at=(0.0, 0.0, 0.3))}

    def of_parts(spring, spin):
        return lg.Model({"shaft": half(spin), "rotor": half(spin)}, joints, {"spring": spring}, merge_fixed=True)

    run = lambda model: lg.simulate(model, t1=T1, num_steps=STEPS)
    spring = coordinate(STIFFNESS, WOUND, turns=True)
    found, expected = (run(model).force("spring").force for model in (of_parts(spring, 0.0), scene(spring)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * STIFFNESS * WOUND)  # Newton's tolerance, 1e-10
    with pytest.raises(lg.SimulationError, match="passes half a turn"):
        run(of_parts(coordinate(STIFFNESS, 0.0), 13.0))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: torsion(1.0, 0.0, turns=2), "`turns` must be True or False"),
        (lambda: torsion(1.0, 4.0), "turns=True"),
        (
            lambda: lg.CoordinateForce(lg.PrismaticJoint(None, "rotor", at=Z, axis=Z), turns=True),
            "'displacement' is none",
        ),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


SPRINGS = {
    "bushing": lambda k: lg.Bushing(None, "rotor", at=(0.0, 0.0, 0.0), rotational_stiffness=(k, k, k)),
    "rotational": lambda k: lg.RotationalSpringDamper(None, "rotor", stiffness=k),
    "torsion": lambda k: lg.TorsionSpringDamper(None, "rotor", axis=Z, stiffness=k),
    "coordinate": lambda k: lg.CoordinateForce(hinge(), stiffness=k),
    "scaled": lambda k: ScaledForce(lg.TorsionSpringDamper(None, "rotor", axis=Z, stiffness=2.0 * k), factor=0.5),
}

AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # the first along z
SHAFT = lg.BeamElement(  # G I/l = 0.2949 N m/rad
    None,
    "rotor",
    at_a=(0.0, 0.0, -1.0),
    at_b=(0.0, 0.0, 0.0),
    axes_a=AXES,
    axes_b=AXES,
    section=lg.BeamSection.round(0.0025, young=2e11, poisson=0.3, density=1.0),
)


@pytest.mark.parametrize("name", some_quick(SPRINGS))
def test_positions_do_not_tell_more_than_half_a_turn(name):
    """Up to 3 rad the moment of the drive is k φ; at 4 rad it would be that of 4 − 2π."""
    body = lg.RigidBody(1.0, (0.03, 0.03, INERTIA))
    joints = {"hinge": hinge(), "drive": lg.RotationDriver(None, "rotor", axis=Z)}
    model = lg.Model({"rotor": body}, joints, {"spring": SPRINGS[name](STIFFNESS)})
    angles = np.linspace(0.0, 3.0, 5)  # as many as below: one program
    found = lg.kinematics(model, {"drive": angles}, rates={"drive": 0.0})
    np.testing.assert_allclose(-found.multiplier("drive")[:, 0], STIFFNESS * angles, atol=1e-12)  # round-off of 1
    with pytest.raises(lg.SimulationError, match=says("passes half a turn", "before position 4", "drive = 4")):
        lg.kinematics(model, {"drive": np.linspace(0.0, 4.0, 5)}, rates={"drive": 0.0})


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) for name in ("bushing", "beam", "rotational")]
)  # in the quick run: positions of a bushing, above, and the motion of a torsion spring
def test_springs_against_all_rotations_fail_there_too(name):
    """ω₀ √(J/k) = 4 rad, which none within half a turn can hold; without stiffness about the hinge it may turn."""
    start = 4.0 * np.sqrt(STIFFNESS / INERTIA)
    spring = SHAFT if name == "beam" else SPRINGS[name](STIFFNESS)
    body = lg.RigidBody(1.0, (0.03, 0.03, INERTIA), angular_velocity=(0.0, 0.0, start))
    run = lambda spring: lg.simulate(
        lg.Model({"rotor": body}, {"hinge": hinge()}, {"spring": spring}), t1=0.5, num_steps=STEPS, throw=False
    )
    assert run(spring).result == lg.RESULTS.angle_jumped
    if name == "bushing":
        loose = lg.Bushing(None, "rotor", at=(0.0, 0.0, 0.0), rotational_stiffness=(STIFFNESS, STIFFNESS, 0.0))
        free = run(loose)
        assert free.result == lg.RESULTS.successful
        np.testing.assert_allclose(free.joint("hinge").angle[-1], 0.5 * start, rtol=1e-12)


@pytest.mark.parametrize(
    "spring",
    [
        lambda x: torsion(STIFFNESS, x),
        lambda x: coordinate(STIFFNESS, x),
        lambda x: lg.RotationalSpringDamper(
            None, "rotor", stiffness=STIFFNESS, turned=jnp.stack([0.0 * x, 0.0 * x, x])
        ),
    ],
    ids=["torsion", "coordinate", "rotational"],
)
def test_half_a_turn_is_the_most_for_traced_numbers_too(spring):
    """Whether the numbers of a scene are sound; a spring that is wound up by more would pull the other way."""
    sound = jax.jit(lambda x: scene(spring(x)).system().is_valid())
    assert sound(np.pi) and not sound(np.pi + 0.01) and not sound(-4.0)
    slope = jax.jit(jax.grad(lambda x: lg.initial_state(scene(spring(x))).vdot[0]))
    # J θ̈ = ± k x; one factorization of a scalar
    np.testing.assert_allclose(abs(slope(1.0)), STIFFNESS / INERTIA, rtol=1e-13)
