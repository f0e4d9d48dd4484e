"""Certificates against errors that are known otherwise, and what has to be named in them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from oscillator import CRITERION, T1, P, build, exact

import lgsens as lg
from lgsens.accuracy import certify

HEIGHT = lg.Criterion(terminal=lambda s, p: s.body("mass").position[2])


@pytest.fixture(scope="module")
def oscillator():
    return certify(CRITERION, build, P, t1=T1, num_steps=100)


def test_errors_are_those_of_the_closed_form(oscillator):
    """To the next term of their expansion, O(ωh) of them; ωh = 0.045 here."""
    p = jax.tree.map(jnp.asarray, P)
    value, gradient = jax.value_and_grad(exact)(p)
    np.testing.assert_allclose(oscillator.value_error, value - oscillator.value, rtol=0.1)
    for name in p:
        error = gradient[name] - oscillator.gradient[name]
        np.testing.assert_allclose(oscillator.gradient_error[name], error, rtol=0.1)
    assert oscillator.duality < 1e-10  # round-off of a hundred steps
    assert abs(oscillator.newton) < 1e-10 * abs(value)
    assert not oscillator.warnings


def test_it_says_how_many_digits_and_what_to_do(oscillator):
    of_value, of_gradient = oscillator.relative
    assert f"{-np.log10(of_value):.1f} digits" in str(oscillator)
    assert oscillator.good == (max(of_value, of_gradient) <= 1e-3)
    strict = oscillator._replace(tolerance=max(of_value, of_gradient) / 4.0)
    assert "take 2 times as many steps" in str(strict)
    assert not strict.good
    assert strict._replace(tolerance=0.5).good


def scene(p, signal):
    mass = lg.RigidBody(mass=p, inertia=None, free="z")
    forces = {
        "spring": lg.SpringDamper(None, "mass", at_a=(0, 0, 2), at_b=(0, 0, 0), stiffness=20.0, damping=1.0),
        "push": lg.AppliedForce("mass", at=(0.0, 0.0, 0.0), force=(0.0, 0.0, 1.0), signal=signal),
    }
    return lg.Model({"mass": mass}, {}, forces)


def pushed(p):
    return scene(p, lg.Sampled((0.0, 0.5037, 1.0), (0.0, 3.0, 0.0), "linear"))


def test_a_kink_inside_of_a_step_is_named():
    found = certify(HEIGHT, pushed, 1.0, t1=1.0, num_steps=100)
    ((t, body),) = found.kinks
    assert body == "mass"
    assert abs(t - 0.5037) <= 0.01
    assert not found.good
    assert "have a kink" in str(found)


def smoothly(p):
    return scene(p, lg.Sampled((0.0, 0.3, 0.6, 1.0), (0.0, 3.0, 1.0, 0.0)))


@pytest.mark.slow
def test_a_smooth_force_is_not():
    assert not certify(HEIGHT, smoothly, 1.0, t1=1.0, num_steps=100).kinks


@pytest.mark.slow
def test_steps_that_do_not_resolve_the_motion_are_named():
    found = certify(CRITERION, build, P | {"k": 1e6 * P["k"]}, t1=T1, num_steps=100)  # ωh = 45
    assert not found.good
    assert "do not resolve" in str(found)


def inverted(p):
    """A pendulum on a hinge, upright but for an angle p: it falls like exp(t √(3g/2l))."""
    axis, at = (0.0, 1.0, 0.0), jnp.stack([jnp.sin(p), jnp.zeros_like(p), jnp.cos(p)])
    body = lg.RigidBody(mass=1.0, inertia=(1.0 / 3.0, 1.0 / 3.0, 0.1), position=at)
    hinge = lg.RevoluteJoint(None, "body", at=(0.0, 0.0, 0.0), axis=axis)
    return lg.Model({"body": body}, {"hinge": hinge}, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})


@pytest.mark.slow
def test_exponential_growth_is_named():
    top = lg.Criterion(terminal=lambda s, p: s.body("body").position[0])
    found = certify(top, inverted, 1e-6, t1=3.0, num_steps=300)
    assert found.exponential
    # p = 1e-6 grows as cosh: by p for a relative change of 1
    np.testing.assert_allclose(found.growth, 1e-6 * np.cosh(3.0 * np.sqrt(9.81 / (4.0 / 3.0))), rtol=0.02)
    assert "unstable or chaotic" in str(found)


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"integrator": lg.AdaptiveSteps()}, says("`integrator`", "equal steps", "AdaptiveSteps")),
        ({"num_steps": 4}, says("`num_steps`", "at least 8", "got 4")),
        ({"tolerance": 2.0}, says("`tolerance`", "between 0 and 1", "2.0")),
        ({"p": {}}, says("`p`", "at least one number")),
        ({"criterion": 3.0}, says("`criterion` and `build`", "functions", "3.0")),
    ],
)
def test_bad_input(changes, message):
    given = {"criterion": HEIGHT, "build": build, "p": P, "num_steps": 100} | changes
    with pytest.raises(ValueError, match=message):
        certify(given.pop("criterion"), given.pop("build"), given.pop("p"), t1=1.0, **given)
