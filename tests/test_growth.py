"""The growth of sensitivities: against closed forms, and its arguments."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg

MASS, ARM, INERTIA, GRAVITY = 2.0, 0.8, 0.3, 9.81
RATE = float(np.sqrt(MASS * GRAVITY * ARM / (MASS * ARM**2 + INERTIA)))  # ω = √(mgl/J) of small swings, 3.3 1/s
TIME, STEPS = 4.0, 800


def pendulum(sign):
    """A pendulum in the plane at rest, upright (+1) or hanging (−1)."""
    body = lg.RigidBody(MASS, (INERTIA, INERTIA, INERTIA), position=(0.0, 0.0, sign * ARM), free="x z ry")
    joint = lg.SphericalJoint(None, "bob", at=(0.0, 0.0, 0.0))
    return lg.Model({"bob": body}, {"pivot": joint}, {"g": lg.Gravity((0.0, 0.0, -GRAVITY))})


@pytest.fixture(scope="module")
def growths():
    return {sign: lg.sensitivity_growth(pendulum(sign), t1=TIME, num_steps=STEPS) for sign in (1.0, -1.0)}


def test_upright_pendulum_grows_by_its_exponent(growths):
    """δ₀ cosh ωt + v₀/ω sinh ωt grows by e^{ωT/2} in the second half, but for e^{−ωT} = 2e-6 and (ωh)² ωT/12 = 3e-4."""
    growth = growths[1.0]
    grown = float(growth.factor[-1] / growth.factor[STEPS // 2])
    np.testing.assert_allclose(np.log(grown), RATE * TIME / 2, rtol=1e-3)
    assert bool(growth.exponential) and np.isinf(growth.horizon)
    assert f"by e each {1 / RATE:.3g} s: the motion is unstable or chaotic" in str(growth)


def test_hanging_pendulum_does_not_grow(growths):
    """|δ| ≤ (|δ₀|² + |v₀/ω|²)^½, at most of the angle and the two places that it moves."""
    growth = growths[-1.0]
    assert np.all(np.diff(growth.factor) >= 0.0)
    assert 0.5 < float(growth.factor[-1]) <= np.hypot(1.0, 1.0)
    assert not bool(growth.exponential)
    assert "regular motion" in str(growth)


def test_the_horizon_is_where_round_off_has_grown_to_the_scene(growths):
    """The same pendulum for so long that e^{ωt} passes 1/ε = 4.5e15, ωt = 36 and some: where g is read from the run."""
    growth = lg.sensitivity_growth(pendulum(1.0), t1=4 * TIME, num_steps=STEPS)
    at = int(np.argmax(np.asarray(growth.factor) * np.finfo(float).eps >= 1.0))
    assert at > 0
    np.testing.assert_allclose(growth.horizon, growth.t[at], rtol=1e-15)
    assert abs(RATE * float(growth.horizon) - np.log(1 / np.finfo(float).eps)) < 4.0  # the start is no pure e^{ωt}
    assert f"From t = {float(growth.horizon):.4g} s on" in str(growth)


def test_arguments():
    with pytest.raises(ValueError, match=says("`model` must be a Model")):
        lg.sensitivity_growth(jnp.zeros(3), t1=1.0, num_steps=10)
    with pytest.raises(ValueError, match=says("`num_steps` must be at least 1")):
        lg.sensitivity_growth(pendulum(1.0), t1=1.0, num_steps=0)
    with pytest.raises(ValueError, match=says("`integrator` must be a GeneralizedAlpha")):
        lg.sensitivity_growth(pendulum(1.0), t1=1.0, num_steps=10, integrator="alpha")
