"""Every row of `benchmarks/extremes.py` holds, and what holds for chosen numbers holds for any."""

import numpy as np
import pytest
from extremes import EXTREMES
from extremes_rotation import STEPS, any_ball, ball_bound, exact_ball
from extremes_rows import Row, linear_error, worst_row
from extremes_scales import unit_rows
from hypothesis import given, settings, strategies as st

QUICK = ("failures",)  # the others compile larger programs, or run for a minute
LABELLED = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in EXTREMES]


@pytest.mark.parametrize("name", LABELLED)
def test_extreme(name):
    rows = EXTREMES[name]()
    assert rows
    assert [row for row in rows if not row.holds] == []


def test_rows_that_are_wrong_say_so():
    """NaN is wrong, and the worst of several cases is the one shown."""
    row = worst_row("x", "y", [1.0, float("nan"), 3.0], [2.0, 2.0, 2.0], ["a", "b", "c"], "z")
    assert row.measures.endswith("b") and not row.holds and row.verdict == "WRONG"
    assert Row("x", "y", 1.0, 1.0, "z").holds and not Row("x", "y", 1.1, 1.0, "z").holds


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_error_of_the_linear_oscillation_is_of_second_order(rho):
    """The bound itself: over the same time half the step leaves a quarter of the error."""
    coarse, fine = linear_error(rho, 0.02, 100)[0], linear_error(rho, 0.01, 200)[0]
    assert abs(np.log2(coarse / fine) - 2.0) < 0.05  # ρ∞ = 0 adds a damping of third order, 2 % here


rotations = st.lists(st.floats(-40.0, 40.0), min_size=3, max_size=3).map(np.array)


@pytest.mark.slow  # `test_extreme` is in the quick run
@settings(max_examples=40, deadline=None, derandomize=True)
@given(spin=rotations, start=rotations)
def test_any_rotation_per_step_from_any_orientation(spin, start):
    """As `rotation_per_step`; the start is exp of up to 70 rad, rounded to ε of the angle."""
    p = np.concatenate([spin, start])
    value, forward, reverse = any_ball(p)
    exact, slopes = exact_ball(p)
    bound = ball_bound(p)
    assert np.abs(value - exact).max() <= bound
    assert np.abs(forward - slopes).max() <= STEPS * bound
    assert np.abs(reverse - slopes).max() <= STEPS * bound


@pytest.mark.slow
@settings(max_examples=20, deadline=None, derandomize=True)
@given(length=st.floats(-9.0, 9.0), mass=st.floats(-9.0, 9.0))
def test_any_units(length, mass):
    """A unit of length of 1e-9 to 1e9 m, of mass of 1e-9 to 1e9 kg, and none of them a power of two."""
    rows = unit_rows([(0.0, 0.0), (length, mass)], ["SI", "drawn"], "units")
    assert [row for row in rows if not row.holds] == []
