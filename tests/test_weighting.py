"""Frequency weightings against the factors that the standard prints, and what is weighted in time by them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg

# ISO 2631-1:1997, table 3: factors × 1000 at third octaves, printed with three digits
FREQUENCIES = (0.5, 0.8, 1.0, 1.25, 1.6, 2.0, 2.5, 3.15, 4.0, 5.0, 6.3, 8.0, 12.5, 16.0, 20.0, 31.5, 40.0, 63.0, 80.0)
PRINTED = {
    "Wk": (418, 477, 482, 484, 494, 531, 631, 804, 967, 1039, 1054, 1036, 902, 768, 636, 405, 314, 186, 132),
    "Wd": (853, 992, 1011, 1008, 968, 890, 776, 642, 512, 409, 323, 253, 161, 125, 100, 63.2, 49.4, 29.5, 21.1),
}


@pytest.mark.parametrize("name", PRINTED)
def test_factors_are_those_of_the_standard(name):
    """Third octaves are at 10^(n/10) Hz, and printed at rounded ones: up to 1 % apart where the curve is steep."""
    exact = 10.0 ** (np.round(10 * np.log10(FREQUENCIES)) / 10)
    found = 1e3 * np.abs(lg.FrequencyWeighting(name).frequency_response(exact))
    np.testing.assert_allclose(found, PRINTED[name], rtol=0.016)
    assert np.median(np.abs(found / PRINTED[name] - 1.0)) < 4e-3


@pytest.mark.parametrize("name", ["Wb", "Wc", "Wd", "We", "Wf", "Wj", "Wk"])
def test_equations_are_the_product_of_the_factors(name):
    """By the formula of ISO 8041 as it stands, with its parameters once more."""
    f1, f2, f3, f4, q4, f5, q5, f6, q6, gain = {
        "Wb": (0.4, 100, 16, 16, 0.55, 2.5, 0.9, 4, 0.95, 1.024),
        "Wc": (0.4, 100, 8, 8, 0.63, np.inf, 1, np.inf, 1, 1),
        "Wd": (0.4, 100, 2, 2, 0.63, np.inf, 1, np.inf, 1, 1),
        "We": (0.4, 100, 1, 1, 0.63, np.inf, 1, np.inf, 1, 1),
        "Wf": (0.08, 0.63, np.inf, 0.25, 0.86, 0.0625, 0.8, 0.1, 0.8, 1),
        "Wj": (0.4, 100, np.inf, np.inf, 1, 3.75, 0.91, 5.32, 0.91, 1),
        "Wk": (0.4, 100, 12.5, 12.5, 0.63, 2.37, 0.91, 3.35, 0.91, 1),
    }[name]
    f = np.geomspace(0.01, 1000.0, 60)
    quadratic = lambda f0, q: 1.0 + 1j * f / (f0 * q) - (f / f0) ** 2
    expected = gain * -((f / f1) ** 2) / quadratic(f1, np.sqrt(0.5)) / quadratic(f2, np.sqrt(0.5))
    expected = expected * (1.0 + 1j * f / f3) / quadratic(f4, q4)
    step = 1.0 if np.isinf(f5) else (f5 / f6) ** 2
    expected = expected * quadratic(f5, q5) / quadratic(f6, q6) * step
    np.testing.assert_allclose(lg.FrequencyWeighting(name).frequency_response(f), expected, rtol=1e-10)


def test_a_harmonic_in_time_has_the_amplitude_of_its_frequency():
    """After 10 s the slowest pole, 1.8/s, has left 1e-8; linear between samples, a sine lacks (ωh)²/12 = 1e-4."""
    weighting = lg.FrequencyWeighting("Wk")
    t, f = jnp.linspace(0.0, 12.0, 12001), 5.0
    rms = lambda amplitude: jnp.sqrt(jnp.mean(weighting.apply(t, amplitude * jnp.sin(2 * jnp.pi * f * t))[10000:] ** 2))
    expected = np.abs(weighting.frequency_response(f)) / np.sqrt(2.0)
    np.testing.assert_allclose(rms(3.0), 3.0 * expected, rtol=4e-4)  # and 10 periods by their samples
    np.testing.assert_allclose(jax.grad(rms)(3.0), rms(1.0), rtol=1e-12)


def test_bad_input():
    with pytest.raises(ValueError, match=says("must be one of Wb, Wc", "got 'Wz'")):
        lg.FrequencyWeighting("Wz")
    with pytest.raises(ValueError, match=says("one shape (n,)", "(3,) and (4,)")):
        lg.FrequencyWeighting("Wk").apply(jnp.arange(3.0), jnp.arange(4.0))
