"""Runs that continue from another one in steps of another size."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from helpers import says, some_quick

import lgsens as lg

HALF, END = 0.4, 0.8
SCHEMES = {
    "as before": {"num_steps": 40},
    "longer": {"num_steps": 20},
    "shorter": {"num_steps": 160},
    "aligned": {"num_steps": 160, "integrator": lg.AlignedSteps()},
    "error control": {"num_steps": 600, "integrator": lg.AdaptiveSteps(tolerance=1e-6)},
    "extrapolated": {"num_steps": 80, "integrator": lg.Richardson()},
    "stabilized": {"num_steps": 160, "integrator": lg.GeneralizedAlpha(stabilized=True)},
    "Radau IIA": {"num_steps": 40, "integrator": lg.RadauIIA()},
}


def pendulum(length=0.5):
    body = lg.RigidBody(2.0, (0.02, 0.05, 0.05), position=(length, 0, 0), angular_velocity=(0, 5.0, 0))
    gravity = lg.Gravity((0, 0, -9.81))
    return lg.Model(
        {"bob": body}, {"hinge": lg.RevoluteJoint(None, "bob", at=(0, 0, 0), axis=(0, 1, 0))}, {"g": gravity}
    )


def force(run):
    return np.asarray(run.joint("hinge").force)


@functools.cache
def exact():
    """In steps of 0.2 ms: 1/2500 of the error of those of 10 ms."""
    run = lg.simulate(pendulum(), t1=END, num_steps=4000)
    return np.asarray(run.t), force(run)


@functools.cache
def half():
    return lg.simulate(pendulum(), t1=HALF, num_steps=40)


def off(run):
    """The largest error of the hinge's force, relative to the largest force."""
    t, reference = exact()
    wanted = np.stack([np.interp(run.t, t, column) for column in reference.T], axis=1)  # to (ωh)²/8 = 1e-6
    return np.abs(force(run) - wanted).max() / np.abs(reference).max()


@pytest.mark.slow  # four programs; derivatives, below, go through them
@pytest.mark.parametrize("name", SCHEMES)
def test_forces_are_those_of_the_motion_from_the_first_step_on(name):
    """In longer steps with the error of these: four times that of the run before."""
    found = off(lg.simulate(pendulum(), t0=HALF, t1=END, state0=half().continued(), **SCHEMES[name]))
    assert found < off(half()) * (5.0 if name == "longer" else 1.5)


@pytest.mark.slow  # derivatives, below, go through what is handed on
def test_a_state_alone_does_not_know_its_step():
    """Which is what `continued` is for: 16 times the size of the new steps, 256 times their offset of the velocity."""
    run = lg.simulate(pendulum(), t0=HALF, t1=END, state0=half().state(-1), **SCHEMES["shorter"])
    assert off(run) > 10.0 * off(half())


def test_in_equal_steps_it_is_one_run():
    whole = lg.simulate(pendulum(), t1=END, num_steps=80)
    rest = lg.simulate(pendulum(), t0=HALF, t1=END, state0=half().continued(), **SCHEMES["as before"])
    np.testing.assert_allclose(force(rest), force(whole)[40:], rtol=0, atol=1e-8)  # ε l m/(βh²), as `limits` says


@pytest.mark.slow
def test_from_any_step_and_of_a_batch():
    run = lg.simulate(pendulum(), t1=HALF, num_steps=600, integrator=lg.AdaptiveSteps(tolerance=1e-6))
    for index in (0, 7, -1):  # t1 is repeated by the rows of steps that were not needed
        at, start = run.t[index], run.continued(index)
        assert off(lg.simulate(pendulum(), t0=at, t1=at + 0.1, num_steps=20, state0=start)) < 2e-3, index
    several = jax.vmap(lambda length: lg.simulate(pendulum(length), t1=0.1, num_steps=10))(jnp.array([0.4, 0.5]))
    one = lg.simulate(pendulum(0.5), t1=0.1, num_steps=10).continued(3)
    for of_all, of_one in zip(jax.tree.leaves(several.continued(3)), jax.tree.leaves(one), strict=True):
        np.testing.assert_allclose(of_all[1], of_one, atol=1e-9)  # round-off
    with pytest.raises(IndexError, match="from -11 to 10"):
        several.continued(11)


def test_a_step_that_is_not_there():
    with pytest.raises(IndexError, match="from -41 to 40"):
        half().continued(41)


@pytest.mark.slow  # `test_in_equal_steps_it_is_one_run` is in the quick run
@pytest.mark.parametrize("both", some_quick([False, True]), ids=["reverse", "forward too"])
def test_derivatives_through_it_are_exact(both):
    """By a length, and by the time at which the size of the steps changes."""

    def psi(p, sensitivity):
        settings = {"sensitivity": sensitivity}
        first = lg.simulate(pendulum(p[0]), t1=p[1], num_steps=10, **settings)
        rest = lg.simulate(
            pendulum(p[0]), t0=p[1], t1=END, num_steps=30, state0=first.continued(), throw=False, **settings
        )
        return lg.time_integral(rest.t, jnp.sum(rest.joint("hinge").force ** 2, axis=1))

    p, reverse = jnp.array([0.5, 0.4]), jax.jit(jax.value_and_grad(lambda p: psi(p, lg.AdjointVariable())))
    gradient = reverse(p)[1]
    if both:
        forward = jax.jit(jax.jacfwd(lambda p: psi(p, lg.DirectDifferentiation())))(p)
        np.testing.assert_allclose(gradient, forward, rtol=1e-9)  # other order of round-off
    slopes = [central(lambda s, e=e: reverse(p + s * e)[0], 1e-3) for e in np.eye(2)]
    np.testing.assert_allclose(gradient, slopes, rtol=1e-7)  # δ⁶ × seventh derivative, round-off of forces over δ


def discs(joints, inertia=3.0):
    inertias = {"a": (2.0,) * 3, "b": inertia * jnp.ones(3)}
    return lg.Model({name: lg.RigidBody(1.0, values, free="rz") for name, values in inertias.items()}, joints)


def test_a_driver_is_released_and_a_clutch_is_closed():
    """A disc is driven to A sin 2πt, let go at 0.6 s, and at once joined to another one, which is at rest."""
    signal = lg.Harmonic(amplitude=0.3, frequency=1.0)
    driver = lambda a, b, value: {"driver": lg.RotationDriver(a, b, axis=(0.0, 0.0, 1.0), value=value)}
    end = lg.simulate(discs(driver(None, "a", signal)), t1=0.6, num_steps=60).state(-1)
    free = lg.initial_state(discs({}), t0=0.6, state=end)
    # that of the driver is off by O(h²), (2πh)² = 4e-3 of it and less
    rate = 0.6 * np.pi * np.cos(1.2 * np.pi)
    np.testing.assert_allclose(free.v, [rate, 0.0], rtol=1e-3)
    assert free.lam.shape == (0,)

    def closed(inertia):
        both = discs(driver("b", "a", signal(0.6)), inertia)
        return lg.initial_state(both, t0=0.6, state=free).v

    kept = 2.0 / 5.0  # 2/(2 + inertia)
    np.testing.assert_allclose(closed(3.0), kept * free.v[0] * np.ones(2), rtol=1e-12)
    np.testing.assert_allclose(jax.jacrev(closed)(3.0), -kept / 5.0 * free.v[0] * np.ones(2), rtol=1e-12)
    with pytest.raises(ValueError, match=says("`state` must be one state of this model", "same bodies")):
        lg.initial_state(discs({}), state=half().state(-1))
    with pytest.raises(ValueError, match=says("`state` must be a State, as `trajectory.state(-1)` is")):
        lg.initial_state(discs({}), state=half())
