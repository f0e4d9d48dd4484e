"""Problems handed to `scipy.optimize`: its methods find what `minimize` finds, with exact derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from lgsens.optimize import minimize, scipy_least_squares, scipy_problem

X0 = {"rate": 30.0, "p": jnp.asarray([0.2, 0.7])}
BOUNDS = {"lower": {"rate": 1.0, "p": -1.0}, "upper": {"rate": 1e3, "p": 1.0}, "log_scale": {"rate": True, "p": False}}


def fun(x):
    """Curved, coupled, with one active constraint of six at the optimum."""
    f = jnp.log(x["rate"] / 100.0) ** 2 + jnp.sum((x["p"] - 0.8) ** 2) + 0.1 * x["p"][0] * jnp.log(x["rate"])
    t = jnp.linspace(0.0, 1.0, 6)
    return f, x["p"][0] * t + x["p"][1] ** 2 * t**2 - 1.0


@pytest.fixture(scope="module")
def problem():
    return scipy_problem(fun, X0, **BOUNDS)


@pytest.fixture(scope="module")
def expected():
    return minimize(fun, X0, **BOUNDS, num_steps=100, tolerance=1e-8, progress=False, forward=False)


def test_values_and_derivatives_against_differences(problem):
    rng = np.random.default_rng(0)
    z, p = rng.uniform(0.3, 0.7, 3), rng.normal(size=3)
    h = 1e-5  # truncation h² and round-off 1e-16/h, both 1e-10 of values and derivatives up to 50
    difference = lambda function: (function(z + h * p) - function(z - h * p)) / (2 * h)
    tolerance = {"rtol": 1e-7, "atol": 1e-7}
    np.testing.assert_allclose(problem.jac(z) @ p, difference(problem.fun), **tolerance)
    np.testing.assert_allclose(problem.constraints_jac(z) @ p, difference(problem.constraints), **tolerance)
    np.testing.assert_allclose(problem.hessp(z, p), difference(problem.jac), **tolerance)
    reverse = scipy_problem(fun, X0, **BOUNDS, forward=False)
    np.testing.assert_allclose(reverse.jac(z), problem.jac(z), rtol=1e-13)  # the other mode: round-off
    for array in (problem.z0, problem.jac(z), problem.hessp(z, p), problem.constraints(z), problem.constraints_jac(z)):
        assert isinstance(array, np.ndarray) and array.dtype == np.float64
    assert isinstance(problem.fun(z), float)
    assert float(problem.x(problem.z0)["rate"]) == pytest.approx(30.0, rel=1e-14)


@pytest.mark.parametrize("method", ["SLSQP", "trust-constr"])
def test_constrained_methods_agree_with_the_augmented_lagrangian(problem, expected, method):
    assert expected.reason == "converged" and np.max(expected.constraints) == pytest.approx(0.0, abs=1e-8)
    if method == "SLSQP":
        constraints = {
            "type": "ineq",
            "fun": lambda z: -problem.constraints(z),
            "jac": lambda z: -problem.constraints_jac(z),
        }
        options = {"ftol": 1e-14}
    else:
        constraints = scipy.optimize.NonlinearConstraint(
            problem.constraints, -np.inf, 0.0, jac=problem.constraints_jac, hess=scipy.optimize.BFGS()
        )
        options = {"gtol": 1e-9, "xtol": 1e-12, "barrier_tol": 1e-9}
    found = scipy.optimize.minimize(
        problem.fun,
        problem.z0,
        jac=problem.jac,
        hessp=problem.hessp if method == "trust-constr" else None,
        bounds=problem.bounds,
        constraints=constraints,
        method=method,
        options=options,
    )
    # Constraints met to 1e-8 on either side, times multipliers of order 1; the barrier leaves some 3e-7.
    assert found.fun == pytest.approx(expected.objective, abs=1e-7 if method == "SLSQP" else 1e-6)
    np.testing.assert_allclose(problem.x(found.x)["p"], expected.x["p"], rtol=0, atol=1e-3)  # the root of it


@pytest.mark.parametrize("method", ["L-BFGS-B", "Newton-CG"])
def test_methods_without_constraints(method):
    problem = scipy_problem(lambda x: (fun(x)[0], jnp.zeros(0)), X0, **BOUNDS)
    own = minimize(lambda x: (fun(x)[0], jnp.zeros(0)), X0, **BOUNDS, num_steps=100, tolerance=1e-9, progress=False)
    second = {"hessp": problem.hessp} if method == "Newton-CG" else {"bounds": problem.bounds}
    found = scipy.optimize.minimize(problem.fun, problem.z0, jac=problem.jac, method=method, **second)
    assert found.fun == pytest.approx(own.objective, abs=1e-8)  # SciPy's gradient is below 1e-5 or so: its square


def test_a_problem_without_bounds():
    problem = scipy_problem(lambda x: fun(x)[0], X0, log_scale=BOUNDS["log_scale"])
    assert problem.bounds == [(-np.inf, np.inf)] * 3
    found = scipy.optimize.minimize(problem.fun, problem.z0, jac=problem.jac, bounds=problem.bounds)
    assert found.success and np.linalg.norm(jax.grad(lambda x: fun(x)[0])(problem.x(found.x))["p"]) < 1e-4


def test_a_design_is_simulated_once_for_value_and_constraints():
    calls = []

    def counted(x):
        jax.debug.callback(lambda _: calls.append(0), x["rate"])
        return fun(x)

    problem = scipy_problem(counted, X0, **BOUNDS)
    problem.fun(problem.z0), problem.constraints(problem.z0), problem.fun(problem.z0.copy())
    assert len(calls) == 1
    problem.fun(problem.z0 + 1e-3)
    assert len(calls) == 2


def test_least_squares_within_bounds():
    t = np.linspace(0.0, 2.0, 21)
    model = lambda x: x["a"] * jnp.exp(-x["rate"] * t)
    data = np.asarray(model({"a": 3.0, "rate": 2.0}))
    bounds = {"lower": {"a": 0.1, "rate": 0.1}, "upper": {"a": 10.0, "rate": 1.5}, "log_scale": True}
    problem = scipy_least_squares(lambda x: {"decay": model(x) - data}, {"a": 1.0, "rate": 1.0}, **bounds)
    found = scipy.optimize.least_squares(problem.fun, problem.z0, jac=problem.jac, bounds=problem.bounds, xtol=1e-12)
    x = problem.x(found.x)
    assert float(x["rate"]) == pytest.approx(1.5, rel=1e-6)  # on its bound, which an interior method approaches
    basis = np.exp(-1.5 * t)
    assert float(x["a"]) == pytest.approx(basis @ data / (basis @ basis), rel=1e-5)


def test_bad_problems():
    with pytest.raises(ValueError, match=r"`fun` must return"):
        scipy_problem(lambda x: x["p"], X0, **BOUNDS)
    with pytest.raises(ValueError, match=r"must lie within the bounds: rate = 30\.0"):
        scipy_problem(fun, X0, lower=BOUNDS["lower"], upper={"rate": 20.0, "p": 1.0})
