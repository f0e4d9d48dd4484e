"""`minimize` by SLSQP, with the Jacobian of all constraints: problems of Hock & Schittkowski (1981), bands, failures.

SLSQP is deterministic: what is continued or repeated is equal bit by bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgsens.optimize import minimize, multi_start


def hs43(x):
    a, b, c, d = x
    f = a**2 + b**2 + 2 * c**2 + d**2 - 5 * a - 5 * b - 21 * c + 7 * d
    g = (
        a**2 + b**2 + c**2 + d**2 + a - b + c - d - 8,
        a**2 + 2 * b**2 + c**2 + 2 * d**2 - a - d - 10,
        2 * a**2 + b**2 + c**2 + 2 * a - b - d - 5,
    )
    return f, jnp.stack(g) / 5


def hs71(x):
    a, b, c, d = x
    square = jnp.sum(x**2) - 40  # = 0
    return a * d * (a + b + c) + c, jnp.stack([25 - jnp.prod(x), square, -square]) / 25


def hs100(x):
    a, b, c, d, e, f, g = x
    objective = ((a - 10) ** 2 + 5 * (b - 12) ** 2 + c**4 + 3 * (d - 11) ** 2 + 10 * e**6 + 7 * f**2 + g**4) - (
        4 * f * g + 10 * f + 8 * g
    )
    constraints = (
        2 * a**2 + 3 * b**4 + c + 4 * d**2 + 5 * e - 127,
        7 * a + 3 * b + 10 * c**2 + d - e - 282,
        23 * a + b**2 + 6 * f**2 - 8 * g - 196,
        4 * a**2 + b**2 - 3 * a * b + 2 * c**2 + 5 * f - 11 * g,
    )
    return objective, jnp.stack(constraints) / 50


@pytest.mark.parametrize(
    ("fun", "x0", "lower", "optimum", "point"),
    [
        (hs43, (0.0, 0.0, 0.0, 0.0), -5.0, -44.0, (0.0, 1.0, 2.0, -1.0)),
        (hs71, (1.0, 5.0, 5.0, 1.0), 1.0, 17.0140173, (1.0, 4.7429994, 3.8211503, 1.3794082)),
        (hs100, (1.0, 2.0, 0.0, 4.0, 0.0, 1.0, 1.0), -5.0, 680.6300573, None),
    ],
)
def test_problems_of_hock_and_schittkowski(fun, x0, lower, optimum, point):
    bounds = {"lower": jnp.asarray(lower), "upper": jnp.asarray(5.0)}
    found = minimize(fun, jnp.asarray(x0), **bounds, num_steps=60, progress=False, tolerance=1e-7)
    assert found.reason == "converged"
    # Constraints are met to 1e-7 and f/|f(x₀)| is stationary to 1e-7: with Σμ ≤ 10 in these units 1e-6 of f(x₀).
    first = abs(float(found.history.objective[0])) or 1.0
    assert found.objective == pytest.approx(optimum, abs=1e-6 * first + 1e-7 * abs(optimum))
    if point is not None:
        # 1e-7 over curvatures of 1e-2 and more, in the width of the box
        np.testing.assert_allclose(found.x, point, rtol=0, atol=1e-4)


def parallel_bands(x):
    """24 bands of half width 1 on a cubic's coefficients seen at 12 stations: their gradients are nearly parallel."""
    t = jnp.linspace(-1.0, 1.0, 12)
    angles = 2.0 * jnp.arange(8.0)
    modes = jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.cos(2 * angles), jnp.sin(3 * angles)])
    curve = 20 * (jnp.stack([jnp.ones_like(t), t, 0.3 * t**2, 0.1 * t**3], axis=1) @ (modes @ x) + (x @ x) * t**2 / 10)
    goal = jnp.linspace(1.0, 2.0, 8)
    return jnp.sum((x - goal) ** 2), jnp.concatenate([curve - 1.0, -curve - 1.0])


BOX = {"lower": jnp.asarray(-1.0), "upper": jnp.asarray(1.0), "progress": False}


@pytest.mark.slow
def test_a_stiff_valley_of_bands():
    """By the conditions of an optimum; the gradients of reverse mode do not get there."""
    found = minimize(parallel_bands, jnp.zeros(8), **BOX, num_steps=60)
    assert found.reason == "converged"
    scale, mu = found.history.objective[0], found.multipliers
    lagrangian = lambda x: parallel_bands(x)[0] / scale + mu @ parallel_bands(x)[1]
    # ∇L of 1e-5 in the width of the box, 2; σ of 1e-5
    slope, x = 2 * np.asarray(jax.grad(lagrangian)(found.x)), np.asarray(found.x)
    np.testing.assert_allclose(np.clip((x + 1) / 2 - slope, 0, 1), (x + 1) / 2, rtol=0, atol=1e-5)
    assert np.all(mu >= 0) and np.max(np.minimum(mu, np.abs(found.constraints))) <= 1e-5
    reverse = minimize(parallel_bands, jnp.zeros(8), **BOX, num_steps=60, forward=False)
    gain = lambda result: 1 - result.objective / result.history.objective[0]
    assert reverse.reason == "steps" and gain(reverse) < 0.95 * gain(found)


def test_a_start_on_a_constraint_moves_along_it():
    def fun(x):  # the ring around 0 of radius 1, from (−1, 0) to (1, 1)/√2
        return (x[0] - 2) ** 2 + (x[1] - 2) ** 2, jnp.stack([x @ x - 1, 1 - x @ x])

    found = minimize(fun, jnp.asarray([-1.0, 0.1]), lower=jnp.asarray(-2.0), upper=jnp.asarray(2.0), num_steps=60)
    assert found.reason == "converged"
    np.testing.assert_allclose(found.x, np.sqrt([0.5, 0.5]), rtol=0, atol=1e-4)  # ∇L of 1e-5, curvature above 0.1


def test_both_modes_find_the_same():
    def fun(x):
        return jnp.sum((x - jnp.asarray([2.0, 1.0, -0.5])) ** 2), jnp.stack([x @ x - 1, x[0] - 0.8])[None]

    both = [minimize(fun, jnp.zeros(3), **BOX, num_steps=60, forward=mode) for mode in (True, False)]
    assert [found.reason for found in both] == ["converged"] * 2
    assert both[0].constraints.shape == both[0].multipliers.shape == (1, 2)
    # tolerance 1e-5 of each, over curvatures of 2 · 2²/f(x₀), f(x₀) = 5.25
    np.testing.assert_allclose(both[0].x, both[1].x, rtol=0, atol=4e-5)
    np.testing.assert_allclose(both[0].multipliers, both[1].multipliers, rtol=0, atol=1e-3)
    assert len(both[0].history.objective) <= len(both[1].history.objective)


def test_without_constraints_and_out_of_the_domain():
    def fun(x):
        return jnp.where(x > 0.7, jnp.nan, -x), jnp.zeros(0)

    found = minimize(fun, 0.0, lower=-1.0, upper=1.0, num_steps=80, forward=True, progress=False)
    assert np.any(np.isnan(found.history.objective)) and found.reason == "stalled"
    assert 0.699 < float(found.x) <= 0.7  # a step halved ten times: 0.2 · 2 · 2⁻¹⁰


def test_constraints_that_contradict_each_other_at_the_start():
    """Linearized at 0.1, x² ≥ 1/2 asks for x ≥ 2.55, beyond the box."""

    def fun(x):
        return x, jnp.stack([0.5 - x**2, jnp.sin(7 * x) - 0.9])

    found = minimize(fun, 0.1, lower=0.0, upper=1.0, num_steps=60, progress=False)
    assert found.reason == "converged" and float(found.x) == pytest.approx(np.sqrt(0.5), abs=1e-5)


def test_many_starts_are_what_each_is_alone(tmp_path):
    starts = jnp.asarray([[0.0] * 8, [0.3] * 8])
    options = {"lower": -jnp.ones(8), "upper": jnp.ones(8), "progress": False}
    half = multi_start(parallel_bands, starts, **options, num_steps=3, folder=tmp_path)
    assert list(half.reason) == ["steps"] * 2 and list(half.steps) == [3, 3]
    found = multi_start(parallel_bands, starts, **options, num_steps=60, folder=tmp_path)  # goes on
    assert list(found.reason) == ["converged"] * 2
    alone = minimize(parallel_bands, jnp.zeros(8), **BOX, num_steps=60)
    assert found.objective[0] == alone.objective and found.steps[0] == len(alone.history.objective)  # one program
    np.testing.assert_array_equal(found.x[0], alone.x)
