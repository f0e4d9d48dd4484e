"""Mixed precision: solutions against NumPy, values and gradients against those in double precision."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, says

import lgsens as lg
from lgsens.dynamics import mass_matrix, tangents
from lgsens.examples import QuarterCar, four_bar, spatial_chain, spinning_top
from lgsens.integrate import factorize_iteration_matrix
from lgsens.linear import LU, Inverse
from lgsens.linear._mixed import Refined, Rounded, factors_of

SINGLE = float(np.finfo(np.float32).eps)


def conditioned(condition: float, size: int = 12, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    left, right = (np.linalg.qr(rng.normal(size=(size, size)))[0] for _ in range(2))
    return left * np.geomspace(1.0, 1.0 / condition, size) @ right


@pytest.mark.parametrize("condition", [1e1, 1e3, 1e5])
@pytest.mark.parametrize("size_of_rhs", [1.0, 1e-200, 1e200])
def test_solutions_are_those_of_double_precision(condition, size_of_rhs):
    matrix = conditioned(condition)
    rhs = size_of_rhs * np.random.default_rng(1).normal(size=len(matrix))
    factors = factors_of(jnp.asarray(matrix), LU, mixed=True)
    assert all(leaf.dtype != jnp.float64 for leaf in jax.tree.leaves(factors.single))
    for transposed, wanted in ((False, matrix), (True, matrix.T)):
        expected = np.linalg.solve(wanted, rhs)
        # NumPy's own error is of this size as well
        near = {"rtol": 0, "atol": 30 * condition * EPS * np.abs(expected).max()}
        np.testing.assert_allclose(factors.solve(jnp.asarray(rhs), transposed=transposed), expected, **near)
        columns = factors.solve(jnp.asarray(np.stack([rhs, -3 * rhs], axis=1)), transposed=transposed)
        np.testing.assert_allclose(columns, np.stack([expected, -3 * expected], axis=1), rtol=0, atol=3 * near["atol"])
    if size_of_rhs == 1.0:
        rough = np.abs(factors.single.solve(jnp.asarray(rhs)) - np.linalg.solve(matrix, rhs)).max()
        assert rough > 0.01 * SINGLE * np.abs(np.linalg.solve(matrix, rhs)).max()
    assert not factors.solve(jnp.zeros(len(matrix))).any()


@pytest.mark.parametrize("condition", [1e9, 1e12])
def test_a_matrix_that_cannot_be_refined_is_said(condition):
    """Corrections that do not shrink: NaN, which fails the step, and not a wrong number."""
    matrix = jnp.asarray(conditioned(condition))
    assert np.isnan(factors_of(matrix, LU, mixed=True).solve(jnp.ones(len(matrix)))).all()


def test_single_precision_is_as_it_was():
    matrix = jnp.asarray(conditioned(10.0), jnp.float32)
    assert isinstance(factors_of(matrix, LU, mixed=True), LU)


@pytest.mark.parametrize("solver", [lg.DenseLU, lg.BlockSparse])
def test_iteration_matrix_and_its_transpose(solver):
    """Of a chain, dense and by blocks: LU refined, the inverse as it is."""
    system = dataclasses.replace(spatial_chain(9).system(), linear_solver=solver(mixed=True))
    double = dataclasses.replace(system, linear_solver=solver())
    rng = np.random.default_rng(3)
    q, v = system.reference()
    k, m = len(v), len(system.constraint_names)
    q = system.group.retract(q, jnp.asarray(0.1 * rng.normal(size=k)))
    point = (q, *(jnp.asarray(rng.normal(size=size)) for size in (k, k, m)), jnp.asarray(0.1))
    x = jnp.asarray(0.1 * rng.normal(size=k))
    columns = [jnp.asarray(rng.normal(size=(size, 2))) for size in (k, m)]

    def solutions(system, kind, transposed):
        at_point, mass = tangents(system, *point), mass_matrix(system)
        factors = factorize_iteration_matrix(lg.GeneralizedAlpha(), system, at_point, mass, x, 1e-3, kind)
        return factors.factors, np.concatenate(factors.solve(*columns, transposed=transposed))

    for transposed in (False, True):
        _, expected = solutions(double, LU, transposed)
        size = np.abs(expected).max()
        # the condition is below 1e5
        refined, actual = solutions(system, LU, transposed)
        assert isinstance(refined, Refined)
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e5 * EPS * size)
        rounded, rough = solutions(system, Inverse, transposed)
        assert isinstance(rounded, Rounded)
        assert 0.1 * SINGLE * size < np.abs(rough - expected).max() < 1e5 * SINGLE * size


def car():
    return QuarterCar.load().model(wheel="locked")


# scene, a body, steps, step size
SCENES = {
    "top": (lambda: spinning_top(0.7), "top", 50, 2e-3, lg.DenseLU),
    "four_bar": (four_bar, "coupler", 20, 2e-3, lg.DenseLU),
    "chain": (lambda: spatial_chain(9), "link8", 20, 2e-3, lg.BlockSparse),
    "quarter_car": (car, "chassis", 100, 2e-3, lg.DenseLU),
    "quarter_car, blocks": (car, "chassis", 100, 2e-3, lg.BlockSparse),
}
FAST = ("top",)


@pytest.mark.parametrize("name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in SCENES])
def test_gradients_by_every_number_are_those_of_double_precision(name):
    """Positions and accelerations; reverse mode, and forward mode along one direction."""
    scene, body, num_steps, h, solver = SCENES[name]
    double, mixed = (dataclasses.replace(scene().system(), linear_solver=solver(mixed=own)) for own in (False, True))

    def psi(system):
        trajectory = lg.simulate(system, t1=num_steps * h, num_steps=num_steps)
        motion = trajectory.body(body)
        return lg.time_integral(trajectory.t, motion.acceleration[:, 2] ** 2 + motion.position[:, 2])

    numbers = eqx.filter(double, eqx.is_inexact_array)
    direction = jax.tree.map(lambda leaf: 0.1 * leaf, numbers)

    def both(system):
        value, gradient = eqx.filter_value_and_grad(psi)(system)
        static = eqx.filter(system, eqx.is_inexact_array, inverse=True)
        along = jax.jvp(lambda numbers: psi(eqx.combine(numbers, static)), (numbers,), (direction,))[1]
        return value, jax.tree.leaves(gradient), along

    (value, gradient, along), (expected, wanted, wanted_along) = (eqx.filter_jit(both)(s) for s in (mixed, double))
    # The promise of `DenseLU`. Two programs in double precision differ as much: accelerations carry the round-off of
    # constraints over βh², 1e-16/1e-6 × the length of the scene.
    np.testing.assert_allclose(value, expected, rtol=1e-9)
    largest = max(float(jnp.abs(leaf).max()) for leaf in wanted if leaf.size)
    for actual, leaf in zip(gradient, wanted):
        np.testing.assert_allclose(actual, leaf, rtol=0, atol=1e-9 * max(largest, 1e-300))
    np.testing.assert_allclose(along, wanted_along, rtol=1e-9)
    # and mixed precision was at work: other round-off
    assert any(np.any(np.asarray(a) != np.asarray(b)) for a, b in zip(gradient, wanted))


def test_bad_setting():
    with pytest.raises(ValueError, match=says("BlockSparse: `mixed` must be True or False, got 'yes'")):
        lg.BlockSparse(mixed="yes")
