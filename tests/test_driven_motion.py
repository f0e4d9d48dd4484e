"""Simulations with a prescribed motion: against `kinematics`, against ODEs, and their derivatives."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, GRAVITY, some_quick
from scipy.integrate import solve_ivp

import lgsens as lg
from lgsens.accuracy._balance import quality
from lgsens.examples import slider_crank

END = 0.4
INTEGRATORS = {
    "index 3": lg.GeneralizedAlpha(),
    "stabilized": lg.GeneralizedAlpha(stabilized=True),
    "index reduced": lg.IndexReducedODE(),
}


def crank(value) -> lg.Model:
    """A slider-crank whose crank a motor turns; no body is given a velocity."""
    model = slider_crank(a=0.4)
    motor = lg.RotationDriver(None, "crank", axis=(0.0, 0.0, 1.0), value=value)
    return lg.Model(model.bodies, model.joints | {"motor": motor}, model.forces | {"weight": lg.Gravity(GRAVITY)})


@jax.jit
def quantities(motion):
    """Of a motion at its end: positions, velocities, accelerations of slider and rod, the motor's moment."""
    bodies = [motion.body(name) for name in ("slider", "conrod")]
    parts = [getattr(body, name)[-1] for body in bodies for name in ("position", "velocity", "acceleration")]
    return jnp.concatenate([*parts, motion.multiplier("motor")[-1]])


@pytest.mark.parametrize("name", some_quick(INTEGRATORS))
def test_driven_slider_crank_is_that_of_kinematics(name):
    model, integrator = crank(lg.Polynomial((0.2, 3.0, 2.0))), INTEGRATORS[name]
    exact = quantities(lg.kinematics(model, t=np.linspace(0.0, END, 5)))
    run = lambda n: lg.simulate(model, t1=END, num_steps=n, integrator=integrator)
    coarse, fine = run(20), run(40)
    errors = [np.abs(quantities(found) - exact).max() / np.abs(exact).max() for found in (coarse, fine)]
    # order 2 or more, until Newton's tolerance of 1e-10 is left
    assert errors[1] < max(errors[0] / 3.5, 1e-9)
    assert errors[0] < 2e-2
    system, states = fine.system, fine.states
    violation = jax.jit(jax.vmap(system.constraint))(states.q, fine.t)
    # Newton ends at round-off of accelerations, that is of Φ/h² where h < 1
    assert np.abs(violation).max() < 256 * EPS
    # the motor's work is in the balance of energy
    drift = [quality(found).energy_drift for found in (coarse, fine)]
    assert drift[1] < max(drift[0] / 3.5, 1e-9) and drift[0] < 1e-2


def shaken(x, num_steps, t0=0.0, **settings):
    """The end of a pendulum of which the pivot moves along x, by amplitude, frequency and length."""
    amplitude, frequency, length = x
    tip = jnp.stack([jnp.sin(0.5) * length, jnp.zeros(()), -jnp.cos(0.5) * length])
    held = {"mass": 1.0, "inertia": (0.1, 0.1, 0.1)}
    model = lg.Model(
        {"cart": lg.RigidBody(**held, free="x"), "bob": lg.RigidBody(**held, position=tip, free="x y z")},
        {
            "shaker": lg.TranslationDriver(
                None,
                "cart",
                at=(0.0, 0.0, 0.0),
                axis=(1.0, 0.0, 0.0),
                value=lg.Harmonic(amplitude=amplitude, frequency=frequency),
            ),
            "rod": lg.DistanceJoint("cart", "bob", at_a=(0.0, 0.0, 0.0), at_b=tip),
        },
        {"weight": lg.Gravity(GRAVITY)},
    )
    end = lg.simulate(model, t0=t0, t1=0.5, num_steps=num_steps, **settings).body("bob")
    return jnp.stack([end.position[-1, 0], end.position[-1, 2], end.velocity[-1, 0], end.acceleration[-1, 0]])


def by_angle(x):
    """The same by its angle φ: L φ̈ = −g sin φ − ẍ cos φ, where the start keeps the bob's velocity across the rod."""
    amplitude, frequency, length = x
    omega = 2.0 * jnp.pi * frequency
    pivot = lambda t: amplitude * jnp.sin(omega * t)
    rate = lambda t: jax.jvp(pivot, (t,), (jnp.ones_like(t),))[1]
    acceleration = lambda t: jax.jvp(rate, (t,), (jnp.ones_like(t),))[1]
    turning = lambda t, phi: -(9.81 * jnp.sin(phi) + acceleration(t) * jnp.cos(phi)) / length
    rates = lambda t, y, _: jnp.stack([y[1], turning(t, y[0])])
    # no impulse across the rod: φ̇ L + ẋ cos φ = 0 at the start
    start = jnp.stack([jnp.asarray(0.5), -rate(jnp.zeros(())) * jnp.cos(0.5) / length])
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(rates),
        diffrax.Dopri8(),
        0.0,
        0.5,
        0.01,
        start,
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
        adjoint=diffrax.ForwardMode(),
    )
    t, (phi, dphi) = jnp.asarray(0.5), solution.ys[0]
    ddphi = turning(t, phi)
    return jnp.stack([
        pivot(t) + length * jnp.sin(phi),
        -length * jnp.cos(phi),
        rate(t) + length * jnp.cos(phi) * dphi,
        acceleration(t) + length * (jnp.cos(phi) * ddphi - jnp.sin(phi) * dphi**2),
    ])  # fmt: skip


NUMBERS = np.array([0.1, 1.3, 0.8])


@pytest.mark.slow  # a load that hangs from a slide is below
def test_shaken_pendulum_is_that_of_its_ode():
    """The motion, and its derivatives by the signal and the rod, at second order."""
    expected, slope = by_angle(NUMBERS), jax.jit(jax.jacfwd(by_angle))(jnp.asarray(NUMBERS))
    found = [jax.jit(partial(shaken, num_steps=n))(jnp.asarray(NUMBERS)) for n in (50, 100)]
    slopes = [jax.jit(jax.jacfwd(partial(shaken, num_steps=n)))(jnp.asarray(NUMBERS)) for n in (50, 100)]
    for coarse, fine, exact in ((*found, expected), (*slopes, slope)):
        size = np.abs(exact).max()
        first, second = (np.abs(each - exact).max() / size for each in (coarse, fine))
        assert second < first / 3.0 and first < 2e-2  # order 2 up to higher terms


def check_gradients(end, x):
    """DDM = AVM to round-off, and = differences."""
    forward, backward = (np.asarray(jax.jit(mode(end))(jnp.asarray(x))) for mode in (jax.jacfwd, jax.jacrev))
    size = np.abs(forward).max()
    np.testing.assert_allclose(backward, forward, rtol=0, atol=1e-10 * size)
    h, run = 1e-4, jax.jit(end)
    at = lambda i, e: run(x + i * h * e)
    difference = [(at(-2, e) - 8 * at(-1, e) + 8 * at(1, e) - at(2, e)) / (12 * h) for e in np.eye(x.size)]
    # Newton's tolerance on accelerations, 1e-10, over h, and h⁴ of fifth derivatives
    np.testing.assert_allclose(forward, np.stack(difference, axis=1), rtol=0, atol=3e-7 * size)


@pytest.mark.slow  # a driven rotation: `model/test_drivers.py`
@pytest.mark.parametrize("name", ["index 3", "stabilized"])
def test_gradients_by_the_signal_in_both_modes(name):
    """By amplitude, frequency, length and the initial time, at which the signal has a rate."""
    end = lambda x: shaken(x[:3], num_steps=8, t0=x[3], integrator=INTEGRATORS[name])
    check_gradients(end, np.append(NUMBERS, 0.1))


SPRING, LOAD, BEGUN = 40.0, 2.0, 0.1  # k, mass on it, time of the equilibrium


def hung(x):
    """A load that hangs on a spring and damper from a slide: amplitude and frequency of the slide, damping."""
    slide = lg.TranslationDriver(
        None, "slide", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), value=lg.Harmonic(amplitude=x[0], frequency=x[1])
    )
    spring = lg.SpringDamper(
        "slide", "load", at_a=(0.0, 0.0, 0.0), at_b=(0.0, 0.0, -1.0), stiffness=SPRING, damping=x[2], free_length=1.0
    )
    return lg.Model(
        {
            "slide": lg.RigidBody(1.0, None, position=(0.0, 0.0, 0.0), free="z"),
            "load": lg.RigidBody(LOAD, None, position=(0.0, 0.0, -1.0), free="z"),
        },
        {"slide": slide},
        {"spring": spring, "weight": lg.Gravity(GRAVITY)},
    )


def from_equilibrium(x, num_steps, integrator):
    """Place and speed of the load at the end, force of the slide then and at the start, from an equilibrium."""
    model = hung(x)
    rest = lg.equilibrium(model, t0=BEGUN)
    found = lg.simulate(model, t0=BEGUN, t1=BEGUN + END, num_steps=num_steps, integrator=integrator, state0=rest)
    load, force = found.body("load"), found.multiplier("slide")
    return jnp.stack([load.position[-1, 2], load.velocity[-1, 2], force[-1, 0], force[0, 0]])


def by_height(x):
    """The same by the height of the load: m z̈ = f − m g with f = k (s − 1 − z) + c (ṡ − ż), which does not move yet."""
    amplitude, omega, damping = x[0], 2 * np.pi * x[1], x[2]
    place = lambda t: amplitude * np.sin(omega * t)
    rate = lambda t: amplitude * omega * np.cos(omega * t)
    force = lambda t, y: SPRING * (place(t) - 1.0 - y[0]) + damping * (rate(t) - y[1])
    start = [place(BEGUN) - 1.0 - LOAD * 9.81 / SPRING, 0.0]
    rates = lambda t, y: [y[1], force(t, y) / LOAD - 9.81]
    y = solve_ivp(rates, (BEGUN, BEGUN + END), start, method="DOP853", rtol=1e-12, atol=1e-13).y
    # λ pulls the slide, of 1 kg, downwards
    load = lambda t, y: -force(t, y) - 9.81 + omega**2 * place(t)
    return np.array([*y[:, -1], load(BEGUN + END, y[:, -1]), load(BEGUN, start)])


@pytest.mark.slow  # a program each; the start of a driven slider-crank: `model/test_drivers.py`
@pytest.mark.parametrize("name", INTEGRATORS)
def test_motion_begins_from_an_equilibrium_with_the_rate_of_its_driver(name):
    x, exact = np.array([0.1, 1.3, 3.0]), by_height(np.array([0.1, 1.3, 3.0]))
    run = jax.jit(partial(from_equilibrium, integrator=INTEGRATORS[name]), static_argnums=1)
    coarse, fine = (np.abs(run(x, n) - exact) for n in (40, 80))
    assert coarse[3] < 1e-9  # at the start, to the round-off of Newton's iteration there
    # order 2; in λ of index 3 there is also what a given state excites, h v̈ at first, which decays with n ρⁿ
    assert np.all(fine[:3] < np.maximum(coarse[:3] / 3.5, 1e-9)) and fine.max() < 1e-3 * np.abs(exact).max()


@pytest.mark.slow  # others of an equilibrium: `test_statics.py`
def test_gradients_of_an_equilibrium_with_a_moving_driver():
    def state(x):
        found = lg.equilibrium(hung(x), t0=x[3])
        return jnp.concatenate([found.q.position[:, 2], found.v, found.vdot, found.lam])

    check_gradients(state, np.array([0.1, 1.3, 3.0, BEGUN]))


def test_redundant_driver_has_no_motion_from_equilibrium():
    model = hung(np.array([0.1, 1.3, 3.0]))
    line = {"at_a": (0.0, 0.0, 1.0), "at_b": (0.0, 0.0, 0.0), "length": 1.0}  # holds the slide where the driver does
    twice = lg.Model(model.bodies, model.joints | {"rod": lg.DistanceJoint(None, "slide", **line)}, model.forces)
    with pytest.raises(ValueError, match="redundant"):
        lg.equilibrium(twice)


@pytest.mark.slow
@pytest.mark.parametrize("name", INTEGRATORS)
def test_gradients_from_an_equilibrium_with_a_moving_driver(name):
    check_gradients(partial(from_equilibrium, num_steps=8, integrator=INTEGRATORS[name]), np.array([0.1, 1.3, 3.0]))


@pytest.mark.slow
@pytest.mark.parametrize("name", INTEGRATORS)
def test_gradients_of_the_slider_crank(name):
    """The same of the motor's moment."""

    def end(x):
        value = lg.Harmonic(amplitude=x[0], frequency=x[1], phase=x[2])
        found = lg.simulate(crank(value), t0=x[3], t1=END, num_steps=8, integrator=INTEGRATORS[name])
        return quantities(found)[np.array([0, 3, 6, -1])]

    check_gradients(end, np.array([0.5, 0.8, 0.3, 0.1]))
