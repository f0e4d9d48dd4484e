"""Least squares and what noise leaves of them; parametrizations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest
import scipy.optimize
import scipy.stats

from lgsens.examples import AccelerationTest
from lgsens.optimize import Affine, Interval, Log, covariance, least_squares, scipy_least_squares, variables

T = np.linspace(0.0, 3.0, 61)
TRUTH = {"c": 0.6, "k": 30.0, "m": 2.0}
GUESS = {"c": 0.9, "k": 25.0, "m": 1.5}
NOISE = 0.05


def oscillator(p):
    """A mass on a spring and damper that is let go on a slope; in closed form."""
    decay = p["c"] / (2 * p["m"])
    rate = jnp.sqrt(p["k"] / p["m"] - decay**2)
    return 5.0 * jnp.exp(-decay * T) * jnp.cos(rate * T) + 9.0 / p["m"] * T


def readings(seed):
    return oscillator(TRUTH) + NOISE * np.random.default_rng(seed).standard_normal(T.size)


@functools.cache
def solve(kind="default"):
    options = {
        "default": {},
        "log": {"parametrization": Log()},
        "mixed": {"parametrization": {"c": None, "k": Interval(10.0, 60.0), "m": Affine(0.5, 2.0)}},
        "damped": {"parametrization": Log(), "solver": optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)},
    }[kind]
    return jax.jit(lambda data: least_squares(lambda p: (oscillator(p) - data) / NOISE, GUESS, **options))


def errors(found, truth):
    return np.array([float(found.x[name]) - truth[name] for name in sorted(truth)])


def test_the_optimum_is_scipys_and_the_jacobian_that_of_differences():
    found = solve()(readings(0))
    bounds = {"lower": {"c": 0.1, "k": 5.0, "m": 0.5}, "upper": {"c": 3.0, "k": 100.0, "m": 5.0}}
    problem = scipy_least_squares(lambda p: (oscillator(p) - readings(0)) / NOISE, GUESS, **bounds)
    other = problem.x(
        scipy.optimize.least_squares(problem.fun, problem.z0, jac=problem.jac, bounds=problem.bounds, xtol=1e-12).x
    )
    assert bool(found.converged)
    for name, value in other.items():
        # the last step is below 1e-5 of the scale, and the next by the curvature times the noise, 1e-2, of it
        assert float(found.x[name]) == pytest.approx(float(value), rel=1e-6)
    np.testing.assert_allclose(found.residual, (oscillator(found.x) - readings(0)) / NOISE, rtol=0, atol=1e-11)
    for i, name in enumerate(sorted(TRUTH)):
        h = 1e-5 * TRUTH[name]
        plus, minus = (oscillator(found.x | {name: found.x[name] + sign * h}) for sign in (1, -1))
        # truncation h²f‴ and round-off 1e-15/h, both some 1e-9 of the column
        column = np.asarray(plus - minus) / (2 * h) / NOISE
        np.testing.assert_allclose(found.jacobian[:, i], column, rtol=0, atol=1e-7 * np.abs(column).max())


@pytest.mark.parametrize("kind", ["log", "mixed", "damped"])
def test_the_optimum_does_not_depend_on_how_it_is_searched(kind):
    found, expected = solve(kind)(readings(0)), solve()(readings(0))
    assert bool(found.converged)
    np.testing.assert_allclose(errors(found, TRUTH), errors(expected, TRUTH), rtol=0, atol=1e-6)  # as above
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-4)  # x differs by 1e-6 of 0.01


def test_estimates_scatter_as_the_bound_says():
    """eᵀ C⁻¹ e of n parameters is χ² with n degrees of freedom, so of 100 data sets 300 ± √600."""
    found = jax.vmap(solve())(np.stack([readings(seed) for seed in range(100)]))
    assert np.all(found.converged)
    estimates = np.stack([found.x[name] - TRUTH[name] for name in sorted(TRUTH)], axis=1)
    exact = jax.jacfwd(lambda p: oscillator(p) / NOISE)(TRUTH)
    bound = covariance(jnp.stack([exact[name] for name in sorted(TRUTH)], axis=1))
    scatter = np.einsum("ni,ij,nj->", estimates, np.linalg.inv(bound), estimates)
    assert abs(scatter - 300) < 4 * np.sqrt(600)
    # and what is left, with 61 − 3 degrees of freedom each
    left = np.sum(np.asarray(found.residual) ** 2)
    assert abs(left - 5800) < 4 * np.sqrt(2 * 5800)
    # one by one: deviations are the roots of the diagonal
    assert np.all(np.abs(estimates) < 4.5 * np.sqrt(np.diag(bound)))
    np.testing.assert_allclose(
        [float(found.deviation[name][0]) for name in sorted(TRUTH)], np.sqrt(np.diag(found.covariance[0])), rtol=1e-13
    )


def test_parameters_that_data_do_not_tell_apart():
    """Two of three by their product alone: it is found, and that their covariance is not finite."""
    residual = lambda x: jnp.stack([x[0] * x[1] - 2.0, 2.0 * x[0] * x[1] - 4.0, x[0] * x[1] * x[2] - 6.0])
    found = least_squares(residual, jnp.ones(3))
    assert found.converged
    # quadratic convergence: an increment of 1e-6 is followed by one of round-off
    np.testing.assert_allclose([found.x[0] * found.x[1], found.x[2]], [2.0, 3.0], rtol=1e-8)
    assert np.all(np.isinf(found.covariance)) and np.all(np.isinf(found.deviation))


def test_the_covariance_is_the_inverse():
    jacobian = np.random.default_rng(0).normal(size=(20, 4)) * np.array([1.0, 1e-3, 1e4, 1.0])
    expected = np.linalg.inv(jacobian.T @ jacobian)
    size = np.sqrt(np.diag(expected))
    found = np.asarray(covariance(jnp.asarray(jacobian)))
    np.testing.assert_allclose(found / np.outer(size, size), expected / np.outer(size, size), rtol=0, atol=1e-12)


def test_a_parameter_that_the_data_do_not_show_has_no_finite_deviation():
    found = least_squares(lambda p: p["a"] * T + 0 * p["b"] - 1.0, {"a": 1.0, "b": 1.0})
    assert not np.isfinite(found.deviation["b"])


@pytest.mark.parametrize("parametrization", [Affine(3.0, [1.0, 2.0]), Log(0.1), Interval(0.0, [5.0, 9.0])])
def test_a_parametrization_and_its_inverse(parametrization):
    x = jnp.asarray([0.7, 4.0])
    np.testing.assert_allclose(parametrization.value(parametrization.variable(x)), x, rtol=1e-14)  # a few round-offs
    z = jnp.asarray([-1.3, 0.4])
    h = 1e-5
    slope = jax.jvp(parametrization.value, (z,), (jnp.ones(2),))[1]
    difference = (parametrization.value(z + h) - parametrization.value(z - h)) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-8)  # truncation h² and round-off 1e-16/h


def test_variables_of_a_pytree():
    x0 = {"points": jnp.asarray([[0.1, 0.2], [0.3, -0.4]]), "rate": 100.0}
    z, design = variables({"points": Interval(-1.0, 1.0), "rate": Log(100.0)}, x0)
    assert z.shape == (5,) and float(z[4]) == 0.0
    again = design(z)
    np.testing.assert_allclose(again["points"], x0["points"], rtol=1e-14)
    moved = design(jnp.full(5, 50.0))
    assert np.all(np.asarray(moved["points"]) <= 1.0)
    z, _ = variables(None, x0)
    np.testing.assert_allclose(z, [0.25, 0.5, 0.75, -1.0, 1.0], rtol=1e-15)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Interval(1.0, 1.0), "Interval: `lower` must be below `upper`"),
        (lambda: Affine(0.0), "`scale` must be positive, got 0.0"),
        (lambda: Log(-1.0), "`scale` must be positive, got -1.0"),
        (lambda: variables(Log(), {"a": -1.0}), "`x0` is out of the range of its parametrization"),
        (lambda: variables({"a": Log()}, {"b": 1.0}), "`parametrization` must be one for all, or a pytree like `x0`"),
        (lambda: variables({"a": 3.0}, {"a": 1.0}), "must consist of Affine, Log, Interval or None, got 3.0"),
        (lambda: variables(None, {}), "`x0` has no arrays"),
        (lambda: least_squares(lambda p: p["a"], {"a": 1.0, "b": 1.0}), "`residual` has 1 entries, fewer than the 2"),
        (lambda: least_squares(lambda p: p, 1.0, max_steps=0), "`max_steps` must be at least 1, got 0"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.slow
def test_a_four_bar_is_identified_from_noisy_accelerations():
    """Masses, stiffness, damping and a hardpoint: within four deviations, and scattered as the bound says."""
    test = AccelerationTest()
    rates = ("m3", "m4", "k", "cd")
    parametrization = {name: Log() if name in rates else None for name in test.guess}

    @jax.jit
    def identify(key):
        data = test.measure(key, test.truth)
        return least_squares(lambda p: test.residual(p, data), test.guess, parametrization=parametrization)

    found = [identify(jax.random.key(seed)) for seed in range(16)]
    assert all(each.converged for each in found)
    names = sorted(test.truth)
    for name in names:
        error = float(found[0].x[name]) - test.truth[name]
        assert abs(error) < 4 * float(found[0].deviation[name]) < 0.2 * test.truth[name]
    jacobian = jax.jit(jax.jacfwd(lambda p: test.accelerations(p).ravel() / test.deviation))(test.truth)
    bound = np.asarray(covariance(jnp.stack([jacobian[name] for name in names], axis=1)))
    scatter = sum(e @ np.linalg.solve(bound, e) for e in (errors(each, test.truth) for each in found))
    # χ² with 16 · 6 degrees of freedom; the two-sided probability of being outside is 1e-4
    low, high = scipy.stats.chi2.ppf([5e-5, 1 - 5e-5], 96)
    assert low < scatter < high
    left = sum(float(jnp.sum(each.residual**2)) for each in found)
    low, high = scipy.stats.chi2.ppf([5e-5, 1 - 5e-5], 16 * (found[0].residual.size - 6))
    assert low < left < high


def test_the_same_residual_is_traced_once_whatever_the_start():
    traces = []

    def residual(p):
        traces.append(p)
        return oscillator(p) - oscillator(TRUTH)

    first = least_squares(residual, GUESS)
    count = len(traces)
    second = least_squares(residual, {"c": 0.7, "k": 31.0, "m": 1.8})
    assert first.converged and second.converged
    assert count < len(traces) <= count + 1  # that of the number of residuals


def test_the_answer_depends_on_what_the_residual_closes_over():
    """By data, in both modes, against central differences: 1e-10 of their third derivatives, 1e-16/1e-5 of round-off.

    Implicit derivatives are those at the end of the search, to its tolerance of 1e-5 and the curvature there.
    """
    t = jnp.linspace(0.0, 1.0, 20)
    data = jnp.exp(-1.3 * t) + 0.01 * jnp.sin(40.0 * t)
    fit = lambda data: least_squares(lambda x: jnp.exp(-x * t) - data, jnp.asarray(1.0)).x
    moved = lambda e: (fit(data + 1e-5 * e) - fit(data - 1e-5 * e)) / 2e-5
    expected = [moved(e) for e in jnp.eye(20)[1:4]]
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(fit)(data)[1:4], expected, rtol=1e-5)
