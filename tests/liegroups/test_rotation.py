"""SO(3): the coefficient functions against exact series, and the logarithm where it is delicate."""

import math
from decimal import Decimal, localcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgsens.liegroups import SO3, _coefficients, cross, skew, unskew

GROUP = SO3()
DTYPES = [np.float32, np.float64]
exp, log, tangent, tangent_inv = (jax.jit(f) for f in (GROUP.exp, GROUP.log, GROUP.tangent, GROUP.tangent_inv))


def _series(k, s, order, weight=lambda j: 1):
    """The derivative of `Σ_j (-s)^j weight(j) / (k+2j)!` in 60 digits; 60 terms are plenty for s ≤ 40."""
    terms = (
        Decimal((-1) ** j * weight(j) * math.perm(j, order))
        / Decimal(math.factorial(k + 2 * j))
        * (s ** (j - order) if j > order else 1)
        for j in range(order, 60)
    )
    return sum(terms, Decimal(0))


def _inverse_series(s, order):
    """The derivatives of the quotient g / (2 c_2)."""
    g = [_series(4, s, i, lambda j: 2 * j + 2) for i in range(3)]
    h = [2 * _series(2, s, i) for i in range(3)]
    value = g[0] / h[0]
    first = (g[1] - value * h[1]) / h[0]
    return (value, first, (g[2] - 2 * first * h[1] - value * h[2]) / h[0])[order]


# Errors in units of eps, for the value and two derivatives, relative to the larger of the derivative at s and
# at 0. c_k: about one eps for the value; in each derivative of the closed form above the switch, terms larger
# than the result cancel (measured: 0.7, 2.3, 8.8). The inverse, a sum of positive terms, is amplified by its pole at
# 2π alone (measured: 3.3, 6.3, 9.4).
COEFFICIENTS = {
    "c1": (_coefficients.c1, lambda s, order: _series(1, s, order), (2, 5, 20)),
    "c2": (_coefficients.c2, lambda s, order: _series(2, s, order), (2, 5, 20)),
    "c3": (_coefficients.c3, lambda s, order: _series(3, s, order), (2, 5, 20)),
    "inverse": (_coefficients.inverse_tangent_coefficient, _inverse_series, (10, 15, 20)),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", COEFFICIENTS)
def test_coefficients_and_two_derivatives_to_round_off(name, dtype):
    function, reference, tolerances = COEFFICIENTS[name]
    switch = dtype(_coefficients.SWITCH)
    angles = [0.0, 1e-12, 1e-8, 1e-4, 1e-2, 0.5, 1.0, 2.0, 2.5, 3.0, np.pi - 1e-9, 4.0, 5.0, 6.0]
    around = [np.nextafter(switch, dtype(0)), switch, np.nextafter(switch, dtype(99))]
    s = np.concatenate([np.square(np.array(angles, dtype)), np.array(around, dtype)])
    derivatives = (function, jax.grad(function), jax.grad(jax.grad(function)))
    values = jax.jit(lambda s: [jax.vmap(f)(s) for f in derivatives])(jnp.asarray(s))
    with localcontext() as context:
        context.prec = 60
        for order in range(3):
            scale = abs(reference(Decimal(0), order))
            for argument, value in zip(s, np.asarray(values[order])):
                # At the argument as rounded to `dtype`: the error is the function's own.
                expected = reference(Decimal(float(argument)), order)
                error = abs(Decimal(float(value)) - expected) / max(abs(expected), scale)
                assert error <= tolerances[order] * Decimal(float(np.finfo(dtype).eps)), (order, argument)
    assert all(v.dtype == dtype for v in values)


def _axes():
    axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [-1, 2, -3], [3, -1, 1e-3], [1e-8, 1, -1]]
    return [np.array(a) / np.linalg.norm(a) for a in axes]


def _rodrigues(axis, angle):
    n = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * n + (1 - np.cos(angle)) * n @ n


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("below_pi", [1e-1, 1e-3, 1e-6, 1e-9, 0.0])
def test_log_near_pi(below_pi, dtype):
    eps = float(np.finfo(dtype).eps)
    for axis in _axes():
        x = (np.pi - below_pi) * axis
        value = np.asarray(log(jnp.asarray(_rodrigues(axis, np.pi - below_pi).astype(dtype))))
        assert value.dtype == dtype and np.linalg.norm(value) <= np.pi * (1 + 2 * eps)
        error = np.abs(value - x).max()
        if below_pi < 4 * eps:  # at π, to rounding, x and -x are the same rotation
            error = min(error, np.abs(value + x).max())
        # The entries of R carry half an eps each, which moves θ by about eps and the axis, times π, by a few.
        assert error <= 10 * eps, (axis, error / eps)


@pytest.mark.parametrize("dtype", DTYPES)
def test_log_is_relatively_accurate_near_the_identity(dtype):
    eps = float(np.finfo(dtype).eps)
    assert not np.any(log(GROUP.identity(dtype)))
    for angle in [1e-15, 1e-12, 1e-8, 1e-4, 1e-2, 0.3]:
        for axis in _axes():
            x = jnp.asarray(angle * axis, dtype)
            # R - R^T holds a small angle to a relative eps, though R itself is I to round-off.
            assert np.abs(log(exp(x)) - x).max() <= 8 * eps * angle


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivative_of_log_on_every_quaternion_branch(dtype):
    """Near half a turn about each coordinate axis, where three of the four branches are nearly singular."""

    @jax.jit
    def jacobians(q, x):
        def f(x):
            return GROUP.log(GROUP.retract(q, x))

        return jax.jacfwd(f)(x), jax.jacrev(f)(x)

    for axis in np.eye(3):
        q = jnp.asarray(_rodrigues(axis, 3.0).astype(dtype))
        # d log(q exp(x))/dx = T(log q)^{-1}: 20 eps, as entries reach 1.6 and come from quotients of sums.
        for jacobian in jacobians(q, jnp.zeros(3, dtype)):
            np.testing.assert_allclose(jacobian, tangent_inv(log(q)), rtol=0, atol=20 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", DTYPES)
def test_exp_is_orthogonal_to_round_off(dtype):
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(200, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    x = (rng.uniform(0, 6, size=(200, 1)) * axes).astype(dtype)
    R = np.asarray(jax.jit(jax.vmap(GROUP.exp))(jnp.asarray(x))).astype(float)
    # Entries are sums of three rounded terms below 2.
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() <= 8 * np.finfo(dtype).eps
    assert np.abs(np.linalg.det(R) - 1).max() <= 8 * np.finfo(dtype).eps


@pytest.mark.parametrize("dtype", DTYPES)
def test_composition_drifts_slower_than_one_eps_per_step(dtype):
    steps = 10_000
    x = jnp.asarray(np.random.default_rng(1).normal(scale=0.05, size=(steps, 3)), dtype)

    @jax.jit
    def compose_all(x):
        return jax.lax.scan(lambda q, x: (GROUP.retract(q, x), None), GROUP.identity(dtype), x)[0]

    R = np.asarray(compose_all(x)).astype(float)
    # Rounding errors of single steps, about eps, add up like a random walk, √n; n is the bound without luck.
    assert np.abs(R.T @ R - np.eye(3)).max() <= 0.1 * steps * np.finfo(dtype).eps


@pytest.mark.parametrize("angle", [1e-9, 1.0, 2.999, 3.001, 4.5, 6.0, 6.28])
def test_tangent_inverse_up_to_its_singularity(angle):
    for axis in _axes():
        x = jnp.asarray(angle * axis)
        T, T_inv = np.asarray(tangent(x)), np.asarray(tangent_inv(x))
        # Round-off in T is multiplied by the norm of its inverse, about 2π/(2π - θ).
        assert np.abs(T_inv @ T - np.eye(3)).max() <= 4 * np.finfo(float).eps * max(1, np.abs(T_inv).max())


def test_skew_is_the_cross_product():
    x, y = np.array([1.0, -2.0, 3.0]), np.array([0.5, 4.0, -1.0])
    # Small integers and halves: no rounding.
    np.testing.assert_array_equal(np.asarray(skew(x)) @ y, np.cross(x, y))
    np.testing.assert_array_equal(cross(x, y), np.cross(x, y))
    np.testing.assert_array_equal(skew(x), [[0, -3, -2], [3, 0, -1], [2, 1, 0]])
    symmetric = np.arange(9.0).reshape(3, 3) + np.arange(9.0).reshape(3, 3).T
    np.testing.assert_array_equal(unskew(skew(x) + symmetric), x)
