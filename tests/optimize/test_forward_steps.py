"""`minimize` with the Jacobian of all constraints: problems of Hock & Schittkowski (1981), bands, its model of L."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from lgsens.optimize import minimize, multi_start, scipy_problem
from lgsens.optimize._penalty_model import PenaltyModel, minimum


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


def test_a_stiff_valley_of_bands():
    """Against SLSQP of SciPy; the gradients of reverse mode do not get there."""
    x0 = jnp.zeros(8)
    found = minimize(parallel_bands, x0, **BOX, num_steps=60)
    assert found.reason == "converged"
    problem = scipy_problem(parallel_bands, x0, lower=BOX["lower"], upper=BOX["upper"])
    other = scipy.optimize.minimize(
        problem.fun,
        problem.z0,
        jac=problem.jac,
        bounds=problem.bounds,
        constraints={
            "type": "ineq",
            "fun": lambda z: -problem.constraints(z),
            "jac": lambda z: -problem.constraints_jac(z),
        },
        method="SLSQP",
        options={"ftol": 1e-12},
    )
    # Constraints to 1e-5, times multipliers of order 1 and f(x₀) = 19.
    assert found.objective == pytest.approx(other.fun, rel=1e-4)
    reverse = minimize(parallel_bands, x0, **BOX, num_steps=60, forward=False)
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


def test_many_starts_at_once():
    starts = jnp.asarray([[0.0] * 8, [0.3] * 8])
    found = multi_start(parallel_bands, starts, lower=-jnp.ones(8), upper=jnp.ones(8), num_steps=60, progress=False)
    assert list(found.reason) == ["converged"] * 2
    alone = minimize(parallel_bands, jnp.zeros(8), **BOX, num_steps=60)
    # one program and its batched version: round-off, which a search may enlarge up to its tolerance
    assert found.objective[0] == pytest.approx(alone.objective, rel=1e-5)


@pytest.mark.parametrize("seed", [*range(4), 103, 150])  # 103, 150: a step ends one round-off short of a bound
def test_the_minimum_of_the_model(seed):
    """Against L-BFGS-B of SciPy, and by its conditions: q is convex."""
    random = np.random.default_rng(seed)
    n, m = 6, 40
    root = random.normal(size=(n, n))
    few = random.normal(size=(m, 2)) @ random.normal(size=(2, n))  # nearly parallel rows
    pushed, jacobian = random.normal(size=m), few + 0.05 * random.normal(size=(m, n))
    penalty = 10.0 ** random.uniform(0, 3)
    reach = random.uniform(0.05, 0.5, size=n) * (random.uniform(size=n) > 0.2)  # some have no room on one side
    slope = random.normal(size=n)
    model = PenaltyModel(
        *map(jnp.asarray, (slope, root @ root.T / n, pushed, jacobian, penalty, -reach, 0.3 * reach + 0.1))
    )
    d, value = jax.jit(minimum)(model)
    assert np.all(d >= model.lower) and np.all(d <= model.upper)
    np.testing.assert_allclose(model.gradient(d), jax.grad(model.value)(d), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(model.hessian(d), jax.hessian(model.value)(d), rtol=1e-9, atol=1e-6)
    # ∇q is met to the square root of 1e-12 of what the first direction promised
    gradient = model.gradient(d)
    assert np.max(np.abs(np.clip(d - gradient, model.lower, model.upper) - d)) < 1e-5 * np.linalg.norm(slope)
    other = scipy.optimize.minimize(
        jax.jit(jax.value_and_grad(model.value)),
        np.zeros(n),
        jac=True,
        method="L-BFGS-B",
        bounds=list(zip(*(np.asarray(bound) for bound in (model.lower, model.upper)))),
        options={"maxiter": 5000, "maxfun": 20000, "ftol": 1e-15, "gtol": 1e-10},
    )
    assert value <= other.fun + 1e-9 * abs(other.fun)
    assert value == pytest.approx(other.fun, rel=1e-4)  # L-BFGS-B ends early in the valley
