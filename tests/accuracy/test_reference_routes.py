"""How a reference converges and what it says of its error, on functions that are known."""

import numpy as np
import pytest

from lgsens.accuracy._balance import cumulative
from lgsens.accuracy._programs import Evaluated
from lgsens.accuracy._reference import by_doubling, doubled, extrapolated

EXACT = Evaluated(2.0, np.array([3.0, -1.0]))


def series(*terms, noise=0.0):
    """n ↦ the exact numbers with an error Σ c n^−p, the largest entry of the gradient with twice of it."""

    def run(n):
        error = sum(c * float(n) ** -p for c, p in terms) + noise * np.sin(1e3 * n)
        return Evaluated(EXACT.value * (1 + error), EXACT.gradient * (1 + 2 * error))

    return run


def test_the_error_of_a_doubled_sequence():
    """Errors c/4^k have changes 3c/4^k, the last of which is three times the error that is left."""
    assert by_doubling([3 / 4, 3 / 16]) == pytest.approx(1 / 16)
    assert by_doubling([1.0]) == 1.0  # one change says nothing of the ratio
    assert by_doubling([1.0, 1e-3]) == pytest.approx(1e-3 / 7)  # no more credit than a ratio of 8
    assert by_doubling([1.0, 0.9]) == 0.9


@pytest.mark.parametrize("order", [1, 2, 5, 8])
def test_doubling_bounds_its_error(order):
    found = doubled("route", series((0.3 * 10.0**order, order)), 10, 5)
    left = found.found.relative(EXACT)
    # the estimate is exact for one power up to the third order; 1e-3: the relative errors themselves
    assert all(a <= b * (1 + 1e-3 + 0.5 * (order == 1)) for a, b in zip(left, found.error))
    assert found.error[1] == pytest.approx(2 * found.error[0], rel=0.2)


def test_doubling_stops_at_round_off():
    calls = []
    run = series((1e3, 8), noise=1e-9)
    found = doubled("route", lambda n: calls.append(n) or run(n), 10, 9)
    assert len(calls) < 9  # 640 steps and more would not be better
    assert 1e-11 < max(found.error) < 1e-7


@pytest.mark.parametrize("powers", [(2, 3, 4), (2, 4, 6), (2, 3, 5)])
def test_extrapolation(powers):
    """Four runs take three powers out; what is left is less than the estimate, that of one power less."""
    found = extrapolated("route", series(*((10.0, p) for p in powers)), 10, 4)
    left = found.found.relative(EXACT)
    assert max(left) <= max(found.error) < 1e-5
    assert max(left) < 1e-2 * 10.0 * 80.0**-2  # the last run itself has 1.6e-3


def test_a_start_that_fails():
    """Runs that are not finite are left out; nothing finite is no reference."""
    run = series((10.0, 2))
    late = lambda n: run(n) if n > 20 else Evaluated(np.nan, np.full(2, np.nan), "too coarse")
    assert max(extrapolated("route", late, 10, 6).found.relative(EXACT)) < 1e-9
    assert doubled("route", lambda n: late(n), 20, 5).found.finite
    never = doubled("route", lambda n: late(1), 10, 5)
    assert never.steps == (10, 20) and "too coarse" in never.sentence and not np.isfinite(max(never.error))


def test_cumulative_integral():
    """Exact for cubics on any grid; of fourth order for others."""
    t = np.array([0.0, 0.1, 0.3, 0.35, 0.8, 1.0])
    np.testing.assert_allclose(cumulative(t, 4 * t**3 - 3 * t**2 + 1), t**4 - t**3 + t, rtol=0, atol=1e-14)
    errors = []
    for n in (20, 40):
        t = np.linspace(0.0, 2.0, n + 1)
        errors.append(np.abs(cumulative(t, np.exp(t)) - np.expm1(t)).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.2)  # the next order adds h
    np.testing.assert_allclose(cumulative(np.array([0.0, 2.0]), np.array([1.0, 3.0])), [0.0, 4.0], rtol=1e-15)
