"""Several load cases as one problem, against what they are one by one; the smooth maximum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgsens import soft_maximum
from lgsens.optimize import load_cases, minimize

TARGETS = np.array([0.0, 1.0, 3.0])


def one(x, case):
    """A parabola around the target of the case, and a constraint for each entry of x."""
    return jnp.sum((x - case) ** 2), x - case - 4.0


def test_arrays_and_lists_of_cases_agree():
    x = jnp.asarray([0.4, 2.0])
    f, g = load_cases(one, jnp.asarray(TARGETS))(x)
    alone = [one(x, jnp.asarray(target)) for target in TARGETS]
    # three additions: a few round-offs
    np.testing.assert_allclose(f, np.mean([f for f, _ in alone]), rtol=1e-15)
    np.testing.assert_array_equal(g, np.concatenate([g for _, g in alone]))
    listed = load_cases(one, [jnp.asarray(target) for target in TARGETS])(x)
    np.testing.assert_allclose(listed[0], f, rtol=1e-15)
    np.testing.assert_array_equal(listed[1], g)
    weighted, _ = load_cases(one, jnp.asarray(TARGETS), weights=[1.0, 0.0, 2.0])(x)
    np.testing.assert_allclose(weighted, alone[0][0] + 2 * alone[2][0], rtol=1e-15)


def test_a_tuple_is_a_tree_of_arrays():
    amplitudes, rates = jnp.array([1.0, 2.0, 3.0]), jnp.array([1.0, 1.0, 10.0])
    f, _ = load_cases(lambda x, case: x * case[0] * case[1], (amplitudes, rates))(2.0)
    assert float(f) == 2.0 * (1.0 + 2.0 + 30.0) / 3.0
    with pytest.raises(ValueError, match="must be arrays with an axis over the cases, or a list of cases"):
        load_cases(one, (lambda x: x, lambda x: 2.0 * x))


def test_a_list_may_hold_anything():
    cases = [lambda x: x[0], lambda x: jnp.sum(x) ** 2]
    f, g = load_cases(lambda x, case: case(x), cases)(jnp.asarray([1.0, 2.0]))
    assert (float(f), g.shape) == (5.0, (0,))


def test_the_worst_case_decides():
    """Of the parabolas around 0, 1 and 3 the worst one is least in the middle of the outer ones, at 1.5."""
    sharpness = 40.0
    fun = load_cases(one, {"target": jnp.asarray(TARGETS)}["target"], sharpness=sharpness)
    found = minimize(fun, jnp.asarray([0.3]), lower=-5.0, upper=5.0, num_steps=60, progress=False)
    assert found.reason == "converged"
    # KS of two equal ones and one far below: symmetric about 1.5 up to exp(−40 · 2); ∇L is 1e-5.
    assert float(found.x[0]) == pytest.approx(1.5, abs=1e-5)
    assert found.objective == pytest.approx(1.5**2 + np.log(2) / sharpness, rel=1e-6)


@pytest.mark.parametrize(
    ("cases", "options", "message"),
    [
        ([], {}, "`cases` must be a list, or arrays of one leading axis"),
        ({"a": jnp.zeros(2), "b": jnp.zeros(3)}, {}, "`cases` must be a list, or arrays of one leading axis"),
        (jnp.zeros(()), {}, "`cases` must be a list, or arrays of one leading axis"),
        (jnp.zeros(3), {"weights": [1.0]}, r"`weights` must have shape \(3,\)"),
        (jnp.zeros(3), {"sharpness": 0.0}, "`sharpness` must be positive, got 0.0"),
    ],
)
def test_bad_cases(cases, options, message):
    with pytest.raises(ValueError, match=message):
        load_cases(one, cases, **options)


def test_the_smooth_maximum_is_bounded_on_both_sides():
    values = jnp.asarray([[0.3, -1.0], [0.29, 1e3]])
    for sharpness in (1.0, 50.0, 1e4):
        excess = float(soft_maximum(values, sharpness)) - 1e3
        assert 0 <= excess <= np.log(4) / sharpness + 1e-12  # round-off of 1e3: 2e-13
    assert float(soft_maximum(jnp.zeros(7), 2.0)) == pytest.approx(np.log(7) / 2, rel=1e-15)


def test_the_gradient_of_the_smooth_maximum_is_a_mean():
    values, sharpness = jnp.asarray([0.3, 0.31, -2.0]), 50.0
    gradient = jax.grad(soft_maximum)(values, sharpness)
    weights = np.exp(sharpness * np.asarray(values))
    np.testing.assert_allclose(gradient, weights / weights.sum(), rtol=1e-13)  # 50 round-offs of the exponent
    np.testing.assert_allclose(jax.jacfwd(soft_maximum)(values, sharpness), gradient, rtol=1e-13)
    h = 1e-6
    direction = np.array([0.3, -0.7, 0.2])
    plus, minus = (float(soft_maximum(values + sign * h * direction, sharpness)) for sign in (1, -1))
    # truncation (50 h)² and round-off 1e-16/h
    assert float(gradient @ direction) == pytest.approx((plus - minus) / (2 * h), rel=1e-8)


def test_bad_maxima():
    with pytest.raises(ValueError, match="`values` is empty"):
        soft_maximum(jnp.zeros(0), 1.0)
    with pytest.raises(ValueError, match=r"`sharpness` must be positive, got -1.0"):
        soft_maximum(jnp.zeros(2), -1.0)
