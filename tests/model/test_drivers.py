"""Constraints with time: their rates along a given motion, the state that drivers start from, driven motions."""

import math
import re
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import GRAVITY, close, equations, random_body, says

import lgsens as lg
from lgsens.dynamics import (
    constraint_acceleration,
    constraint_velocity,
    full_jacobian,
    initial_state,
    prescribed_velocity,
)
from lgsens.examples import slider_crank

TIME = 0.4
TURN = lg.Polynomial((0.3, 2.0, 1.5))
SHAKE = lg.Harmonic(amplitude=0.1, frequency=1.5, phase=0.4)
SPLINE = lg.Sampled((0.0, 0.3, 0.5, 1.0), (0.9, 1.1, 1.0, 1.2), "cubic")
JOINTS = {
    "angle": lg.RotationDriver("a", "b", axis=(0.3, 1.0, -0.2), value=TURN),
    "displacement": lg.TranslationDriver("a", "b", at=(0.2, 0.1, 0.5), axis=(1.0, 0.2, 0.4), value=SHAKE),
    "length": lg.DistanceJoint("a", "b", at_a=(0.1, 0.0, 0.3), at_b=(0.8, 0.5, -0.4), length=SPLINE),
    "fixed number": lg.TranslationDriver("a", "b", at=(0.2, 0.1, 0.5), axis=(1.0, 0.2, 0.4), value=0.3),
    "ball": lg.SphericalJoint("a", "b", at=(0.2, 0.1, 0.5)),
}


def scene(*names):
    rng = np.random.default_rng(3)
    return lg.Model({name: random_body(rng) for name in "ab"}, {name: JOINTS[name] for name in names})


def test_rates_of_constraints_along_a_motion():
    """Φ̇ and Φ̈ of every element against differences of Φ(q(t), t), q(t) = q exp(s v + s² v̇/2)."""
    system = scene(*JOINTS).system()
    k, rng = system.group.dim, np.random.default_rng(1)
    v, vdot = jnp.asarray(rng.normal(size=k)), jnp.asarray(rng.normal(size=k))

    @jax.jit
    def along(s):
        q = system.group.retract(system.pose, s * v + s**2 / 2 * vdot)
        return system.constraint(q, TIME + s)

    h = 2e-4
    phi = [along(i * h) for i in (-2, -1, 0, 1, 2)]
    first = (phi[0] - 8 * phi[1] + 8 * phi[3] - phi[4]) / (12 * h)
    second = (-phi[0] + 16 * phi[1] - 30 * phi[2] + 16 * phi[3] - phi[4]) / (12 * h**2)
    t = jnp.asarray(TIME)
    rate = jax.jit(lambda: constraint_velocity(system, system.pose, v, t))()
    # round-off of h⁻¹ and h⁻², truncation of h⁴ of fifth derivatives of up to 1e4
    np.testing.assert_allclose(rate, first, rtol=0, atol=1e-10)
    acceleration = jax.jit(lambda: constraint_acceleration(system, system.pose, v, vdot, t))()
    np.testing.assert_allclose(acceleration, second, rtol=0, atol=1e-6)
    still = prescribed_velocity(system, system.pose, t)
    close(rate, full_jacobian(system, system.pose, t) @ v + still, 64, scale=10.0)
    names = np.asarray(system.constraint_names)
    assert not np.isin(names[np.asarray(still) == 0.0], ["angle", "displacement", "length"]).any()
    assert np.isin(names[np.asarray(still) == 0.0], ["ball", "fixed number"]).all()


def test_time_costs_nothing_where_nothing_depends_on_it():
    """The tangent of t is a symbolic zero: the program has as many operations as one that differentiates by q only."""
    system, v = scene("fixed number", "ball").system(), jnp.ones(12)
    along = lambda q, t: constraint_velocity(system, q, v, t)
    fixed = lambda q, t: jax.jvp(lambda q: system.constraint(q, t), (q,), (system.group.to_ambient(q, v),))[1]
    count = lambda f: sum(1 for _ in equations(jax.make_jaxpr(f)(system.pose, 0.0).jaxpr))
    assert count(along) <= count(fixed) + 1  # ones_like(t), of which nothing is made
    alone = jax.jit(lambda q, t: prescribed_velocity(system, q, t)).lower(system.pose, 0.0).compile().as_text()
    made = set(re.findall(r"= \S+ ([a-z-]+)\(", alone))
    assert "constant" in made and made <= {"parameter", "constant", "broadcast", "fusion", "copy"}  # zeros alone


def driven(value) -> lg.Model:
    model = slider_crank(a=0.4)
    motor = lg.RotationDriver(None, "crank", axis=(0.0, 0.0, 1.0), value=value)
    return lg.Model(model.bodies, model.joints | {"motor": motor}, model.forces | {"weight": lg.Gravity(GRAVITY)})


def test_start_of_a_driven_crank():
    """By hand: its centre on a circle, and the moment of the motor, (J + m r²) times the acceleration."""
    body = lg.RigidBody(2.0, (0.1, 0.2, 0.3), position=(0.5, 0.0, 0.0))
    axis = (0.0, 0.0, 1.0)
    joints = {
        "hinge": lg.RevoluteJoint(None, "crank", at=(0.0, 0.0, 0.0), axis=axis),
        "motor": lg.RotationDriver(None, "crank", axis=axis, value=TURN),
    }
    system = lg.Model({"crank": body}, joints, {"weight": lg.Gravity(GRAVITY)}).system()
    start = jax.jit(initial_state)(system, jnp.asarray(TIME))
    assert start.result == lg.RESULTS.successful
    angle, rate, change = 0.3 + 2.0 * TIME + 1.5 * TIME**2, 2.0 + 3.0 * TIME, 3.0
    along, across = np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0]])
    state = start.state
    close(state.q.position[0], 0.5 * along, 64, scale=1.0)
    close(state.q.orientation[0], np.stack([along, across, axis], axis=1), 64)
    close(state.v, [*(0.5 * rate * across), 0.0, 0.0, rate], 64, scale=4.0)
    close(state.vdot, [*(0.5 * (change * across - rate**2 * along)), 0.0, 0.0, change], 256, scale=10.0)
    close(state.lam[system.multiplier_rows("motor")], [-(0.3 + 2.0 * 0.5**2) * change], 256, scale=20.0)


@pytest.mark.slow  # small version: test_start_of_a_driven_crank
@pytest.mark.parametrize("t", [TIME, 0.0])
def test_start_of_a_driven_slider_crank(t):
    """q, v, v̇ and λ that the crank's angle, rate and acceleration determine, though no body was given a velocity."""
    model = driven(TURN)
    system = model.system()
    start = jax.jit(initial_state)(system, jnp.asarray(t))
    assert start.result == lg.RESULTS.successful
    angle = float(TURN(jnp.asarray(t)))
    # there in small turns, by numbers in place of the signal
    way = lg.kinematics(model, {"motor": np.linspace(0.0, angle, 8)}, rates={"motor": 0.0})
    found = lg.kinematics(model, t=[t])
    # Newton ends at round-off of Φ, of order 1 m; solutions of 18 equations amplify it, accelerations are of 10 m/s²
    close(found.states.q.position[0], way.states.q.position[-1], 256, scale=1.0)
    close(start.state.q.position, found.states.q.position[0], 256, scale=1.0)
    for name, size in (("v", 4.0), ("vdot", 40.0), ("lam", 100.0)):
        close(getattr(start.state, name), getattr(found.states, name)[0], 1024, scale=size)
    crank = found.body("crank")
    np.testing.assert_allclose(crank.angular_velocity[0], [0.0, 0.0, 2.0 + 3.0 * t], rtol=0, atol=1e-12)
    np.testing.assert_allclose(crank.angular_acceleration[0], [0.0, 0.0, 3.0], rtol=0, atol=1e-11)


@pytest.mark.slow  # a driven slider-crank: `test_driven_motion.py`
def test_kinematics_by_signals_and_by_their_values():
    """t, s(t), ṡ(t) and s̈ = 0: the same motion whether the signal runs or its values and rates are given."""
    model, t = driven(lg.Polynomial((0.0, 3.0))), np.linspace(0.0, 0.5, 6)
    running = lg.kinematics(model, {}, t=t)
    given = lg.kinematics(model, {"motor": 3.0 * t}, rates={"motor": 3.0})
    for name in ("v", "vdot", "lam"):
        size = float(np.abs(getattr(given.states, name)).max())
        close(getattr(running.states, name), getattr(given.states, name), 1024, scale=size)
    held = lg.kinematics(model, {"motor": [0.3]}, rates={})
    # held at t0, signals have no rate
    other = lg.kinematics(driven(lg.Harmonic(amplitude=0.3, frequency=0.0, phase=np.pi / 2)), t=[0.0])
    np.testing.assert_allclose(held.states.q.position[0], other.states.q.position[0], rtol=0, atol=1e-13)
    assert not np.any(held.states.v)


@pytest.mark.slow  # as `test_driven_motion`
def test_gradients_of_a_driven_motion_by_the_numbers_of_the_signal():
    """Position, velocity and motor moment at a time, by frequency, amplitude and the crank, in both modes."""

    def motion(x):
        model = driven(lg.Harmonic(amplitude=x[0], frequency=x[1], phase=x[2]))
        found = lg.kinematics(model, t=[0.0, 0.15, 0.3])
        slider = found.body("slider")
        return jnp.stack([slider.position[-1, 0], slider.velocity[-1, 0], found.multiplier("motor")[-1, 0]])

    x = np.array([0.4, 0.7, 0.2])
    forward, backward = (np.asarray(jax.jit(mode(motion))(jnp.asarray(x))) for mode in (jax.jacfwd, jax.jacrev))
    h = 1e-5
    difference = [(motion(x + h * e) - motion(x - h * e)) / (2 * h) for e in np.eye(3)]
    # h² times third derivatives of a moment of some 10 N m, up to 1e3; round-off ε·100/h
    np.testing.assert_allclose(forward, np.stack(difference, axis=1), rtol=0, atol=2e-7)
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-11)


def test_equilibrium_holds_a_driver_at_t0():
    """A pendulum on a rod whose length is a signal hangs where the rod of that length lets it, and moves with it."""
    body = lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=(0.0, 0.0, -1.0))
    signal = lg.Ramp(start=1.0, end=1.5, duration=1.0)
    rod = lg.DistanceJoint(None, "b", at_a=(0.0, 0.0, 0.0), at_b=(0.0, 0.0, -1.0), length=signal)
    state = lg.equilibrium(lg.Model({"b": body}, {"rod": rod}, {"weight": lg.Gravity(GRAVITY)}), t0=0.5)
    np.testing.assert_allclose(state.q.position[0], [0.0, 0.0, -1.25], rtol=0, atol=1e-9)
    np.testing.assert_allclose(state.lam, [9.81], rtol=0, atol=1e-8)
    # in the middle of a ramp the rate is 1.875/2, the curvature zero; λ is that of rest
    np.testing.assert_allclose(state.v, [0.0, 0.0, -0.9375, 0.0, 0.0, 0.0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(state.vdot, 0.0, rtol=0, atol=1e-8)


class Own(lg.AbstractSignal):
    value: jax.Array
    of: Callable = eqx.field(static=True)

    def __call__(self, t):
        return self.of(self.value, t)


def motor(of):
    return lg.RotationDriver(None, "crank", axis=(0.0, 0.0, 1.0), value=Own(jnp.asarray(0.2), of))


@pytest.mark.parametrize(
    ("of", "message"),
    [
        (lambda x, t: x if t < 0.5 else 2.0 * x, says("`value`", "Own", "jnp.where")),
        (lambda x, t: x * math.sin(t), says("`value`", "Own", "jax.numpy")),
        (lambda x, t: x * np.asarray(t), says("`value`", "Own", "jax.numpy")),
        (lambda x, t: x * jnp.ones(1) * t, says("`value`", "Own", "(1,)")),
    ],
)
def test_signals_of_ones_own_that_cannot_be_compiled(of, message):
    with pytest.raises(ValueError, match=message):
        motor(of)


@pytest.mark.slow
def test_a_signal_without_a_finite_rate_is_no_success():
    """√t at 0, at the second position."""
    crank = lg.RigidBody(mass=1.0, inertia=(0.1, 0.1, 0.1), free="rz")
    model = lg.Model({"crank": crank}, {"motor": motor(lambda x, t: jnp.sqrt(jnp.abs(t)))})
    with pytest.raises(ValueError, match=says("a signal has no finite rate", "position 1", "t = 0 s")):
        lg.kinematics(model, t=[0.1, 0.0, 0.2])
    found = lg.kinematics(model, t=[0.1, 0.0, 0.2], throw=False)
    assert found.result == lg.RESULTS.invalid_numbers
    with pytest.raises(ValueError, match="a signal has no finite rate"):
        lg.initial_state(model)


def test_bad_input():
    with pytest.raises(ValueError, match=says("`value` must be a number or a signal", "AbstractSignal")):
        lg.RotationDriver(None, "a", axis=(0.0, 0.0, 1.0), value=lambda t: t)
    with pytest.raises(ValueError, match=says("`length` must be positive")):
        lg.DistanceJoint(None, "a", at_a=(0.0, 0.0, 0.0), at_b=(1.0, 0.0, 0.0), length=-1.0)
    with pytest.raises(ValueError, match=says("`driven` is empty", "['motor']", "times `t`")):
        lg.kinematics(driven(TURN))
    with pytest.raises(ValueError, match=says("`t` be one", "'t': (2,)")):
        lg.kinematics(driven(TURN), {"motor": [0.0]}, t=[0.0, 1.0])
