"""Where Newton's iteration starts: what the prediction from past values is exact for."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS

from lgsens.integrate._guess import PastValues

STEPS = 8
AXES = np.array([1.0, -2.0, 0.5])
CURVES = {
    "cubic": lambda n: AXES * n**3 + np.array([3.0, 1.0, -2.0]) * n**2 + n - 4.0,  # misses by as much, θ = 1
    "alternating": lambda n: AXES * (-1.0) ** n + 0.5 * n**2,  # by as much to the other side, θ = −1
    "parabola": lambda n: AXES * n**2 - 3.0 * n,  # by nothing
    "rest": lambda n: AXES,
}


def predictions(values):
    """What is predicted for each value but the first, and for one after the last."""
    past, found = PastValues.none(values[0]), []
    for value in values:
        found.append(past.predicted(value))
        past = past.after(value)
    return np.stack(found)


@pytest.mark.parametrize("curve", CURVES.values(), ids=list(CURVES))
def test_exact(curve):
    """From the sixth value on, when the last two misses are known and are those of the curve, not of the start."""
    values = np.stack([curve(float(n)) for n in range(STEPS + 1)])
    found = predictions(jnp.asarray(values[:-1]))
    np.testing.assert_allclose(found[5:], values[6:], rtol=0, atol=100 * EPS * np.abs(values).max())  # 3 + 3 + 1 + θ …


def test_extrapolates_by_no_more_than_a_cubic():
    """A miss that has doubled is expected to stay as it is."""
    values = jnp.asarray([[2.0**n] for n in range(STEPS)])
    past = PastValues.none(values[0])
    for value in values[:-1]:
        past = past.after(value)
    parabola = 3.0 * (values[-1] - values[-2]) + values[-3]
    np.testing.assert_allclose(past.predicted(values[-1]), parabola + values[-1] - past.expected, rtol=4 * EPS)


@pytest.mark.parametrize("size", [1e200, 1e-200])
def test_squares_beyond_the_numbers(size):
    """The parabola, where squares of what is missed overflow or vanish."""
    values = jnp.asarray([size * AXES * n**3 for n in range(STEPS)])
    parabola = 3.0 * (values[-1] - values[-2]) + values[-3]
    found = predictions(values)[-1]
    assert np.all(np.isfinite(found))
    np.testing.assert_allclose(found, parabola, rtol=8 * EPS)
