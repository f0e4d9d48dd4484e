"""Mixed precision: solutions against NumPy, values and gradients against those in double precision."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, says, some_quick

import lgsens as lg
from lgsens.dynamics import mass_matrix, tangents
from lgsens.examples import QuarterCar, four_bar, spatial_chain, spinning_top
from lgsens.integrate import factorize_iteration_matrix
from lgsens.linear import LU, Factors, Inverse, many_runs
from lgsens.linear._mixed import Refined, Rounded, factors_of

SINGLE = float(np.finfo(np.float32).eps)


def conditioned(condition: float, size: int = 12, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    left, right = (np.linalg.qr(rng.normal(size=(size, size)))[0] for _ in range(2))
    return left * np.geomspace(1.0, 1.0 / condition, size) @ right


@eqx.filter_jit
def solutions(matrix, rhs, transposed: bool):
    """S⁻¹ b, or S⁻ᵀ b, of b and of [b, −3 b]; and x₀, before it is refined."""
    factors = factors_of(matrix, LU, mixed=True)
    columns = jnp.stack([rhs, -3.0 * rhs], axis=1)
    solve = lambda rhs: factors.solve(rhs, transposed=transposed)
    return factors, solve(rhs), solve(columns), factors.single.solve(rhs, transposed=transposed)


@pytest.mark.parametrize("condition", [1e1, 1e3, 1e5])
@pytest.mark.parametrize("transposed", [False, True])
def test_solutions_are_those_of_double_precision(condition, transposed):
    matrix = conditioned(condition)
    wanted = matrix.T if transposed else matrix
    b = np.random.default_rng(1).normal(size=len(matrix))
    expected = np.linalg.solve(wanted, b)
    # NumPy's own error is of this size as well
    error = 30 * condition * EPS * np.abs(expected).max()
    for unit in (1.0, 1e-200, 1e200):
        factors, single, columns, rough = solutions(jnp.asarray(matrix), jnp.asarray(unit * b), transposed)
        assert all(leaf.dtype != jnp.float64 for leaf in jax.tree.leaves(factors.single))
        np.testing.assert_allclose(single / unit, expected, rtol=0, atol=error)
        np.testing.assert_allclose(columns / unit, np.stack([expected, -3 * expected], axis=1), rtol=0, atol=3 * error)
        if unit == 1.0:
            assert np.abs(rough - expected).max() > 0.01 * SINGLE * np.abs(expected).max()
    assert not solutions(jnp.asarray(matrix), jnp.zeros(len(matrix)), transposed)[1].any()


@pytest.mark.parametrize("condition", [1e9, 1e12])
def test_a_matrix_that_cannot_be_refined_is_said(condition):
    """Corrections that do not shrink: NaN, which fails the step, and not a wrong number."""
    matrix = jnp.asarray(conditioned(condition))
    assert np.isnan(solutions(matrix, jnp.ones(len(matrix)), False)[1]).all()


def test_single_precision_is_as_it_was():
    matrix = jnp.asarray(conditioned(10.0), jnp.float32)
    assert isinstance(factors_of(matrix, LU, mixed=True), LU)


@pytest.mark.parametrize("solver", some_quick([lg.BlockSparse, lg.DenseLU]))
def test_iteration_matrix_and_its_transpose(solver):
    """Of a chain, dense and by blocks: LU refined, the inverse as it is."""
    rng = np.random.default_rng(3)
    system = spatial_chain(6).system()
    q, v = system.reference()
    k, m = len(v), len(system.constraint_names)
    displacement, vdot, x = (jnp.asarray(0.1 * rng.normal(size=k)) for _ in range(3))
    point = (system.group.retract(q, displacement), v, vdot, jnp.asarray(rng.normal(size=m)), jnp.asarray(0.1))
    columns = [jnp.asarray(rng.normal(size=(size, 2))) for size in (k, m)]

    @eqx.filter_jit
    def solved(system):
        at_point, mass = tangents(system, *point), mass_matrix(system)
        scheme = lg.GeneralizedAlpha()
        both = [factorize_iteration_matrix(scheme, system, at_point, mass, x, 1e-3, kind) for kind in (LU, Inverse)]
        return both, [
            [jnp.concatenate(factors.solve(*columns, transposed=transposed)) for transposed in (False, True)]
            for factors in both
        ]

    _, (expected, _) = solved(dataclasses.replace(system, linear_solver=solver()))
    (lu, inverse), (refined, rounded) = solved(dataclasses.replace(system, linear_solver=solver(mixed=True)))
    assert isinstance(lu.factors, Refined)
    assert isinstance(inverse.factors, Rounded)
    for wanted, actual, rough in zip(expected, refined, rounded):
        size = np.abs(wanted).max()
        # the condition is below 1e5
        np.testing.assert_allclose(actual, wanted, rtol=0, atol=1e5 * EPS * size)
        assert 0.1 * SINGLE * size < np.abs(rough - wanted).max() < 1e5 * SINGLE * size


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


def rounded_anew(system, seed: int):
    """Every number, or the one before or after it."""
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: leaf * (1.0 + EPS * rng.integers(-1, 2, leaf.shape)), system)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_gradients_by_every_number_are_those_of_double_precision(name):
    """Of motion and of accelerations: reverse mode by all numbers, and forward mode along one direction.

    Accelerations carry the round-off of constraints over βh², and their derivatives by places that joints must meet
    carry it again. What double precision leaves open there is seen where the numbers of the scene are rounded anew, and
    in full Newton: 1e-8 to 1.3e-6 of the largest derivative of the chain, in 14 such programs; in as many of mixed
    precision, too. One draw may be a hundredth of another, the largest of three a tenth.
    """
    scene, body, num_steps, h, solver = SCENES[name]

    def psi(system, every):
        scheme = lg.GeneralizedAlpha(0.9, factor_every=every)
        trajectory = lg.simulate(system, t1=num_steps * h, num_steps=num_steps, integrator=scheme)
        motion = trajectory.body(body)
        squares = motion.position[:, 2] + motion.velocity[:, 2] ** 2, motion.acceleration[:, 2] ** 2
        return jnp.stack([lg.time_integral(trajectory.t, square) for square in squares])

    @eqx.filter_jit
    def run(system, every):
        gradient = eqx.filter_jacrev(psi)(system, every)
        direction = jax.tree.map(lambda leaf: 0.1 * leaf, system)
        value, along = jax.jvp(lambda system: psi(system, every), (system,), (direction,))
        return (
            value,
            jnp.concatenate([leaf.reshape(2, -1) for leaf in jax.tree.leaves(gradient) if leaf.size], 1),
            along,
        )

    double, mixed = (dataclasses.replace(scene().system(), linear_solver=solver(mixed=own)) for own in (False, True))
    programs = (double, 20), (double, 0), (rounded_anew(double, 1), 20), (rounded_anew(double, 2), 20), (mixed, 20)
    expected, *others, found = (jax.device_get(run(*own)) for own in programs)
    for wanted, actual, *again in zip(expected, found, *others):
        for i, share in enumerate((0.0, 10.0)):  # motion; accelerations
            own = max(np.abs(wanted[i] - other[i]).max() for other in again)
            assert np.abs(wanted[i] - actual[i]).max() <= max(1e-9 * np.abs(wanted[i]).max(), share * own)
    # and mixed precision was at work: other round-off
    assert np.any(found[1] != expected[1])


def test_bad_setting():
    with pytest.raises(ValueError, match=says("BlockSparse: `mixed` must be True or False, got 'yes'")):
        lg.BlockSparse(mixed="yes")


@pytest.mark.parametrize("unit", [1.0, 1e-45, 1e45])
def test_an_inverse_of_many_numbers_is_rounded_in_any_unit(unit):
    """Beyond 1e38 single precision has no numbers: S and the right-hand side are in units of the largest of S."""
    matrix = conditioned(1e3, size=200)
    k = 150
    parts = (matrix[:k, :k], matrix[:k, k:], matrix[k:, :k])
    b = np.random.default_rng(1).normal(size=len(matrix))
    matrix[k:, k:] = 0.0
    expected = np.linalg.solve(matrix, b)
    factors = {
        exact: Factors.of(*(jnp.asarray(unit * part) for part in parts), jnp.ones(()), kind=Inverse, exact=exact)
        for exact in (False, True)
    }
    assert isinstance(factors[False].factors, Rounded) and isinstance(factors[True].factors, Inverse)
    # a few round-offs times the condition of the whole
    condition = np.linalg.cond(matrix)
    for exact, eps in ((False, SINGLE), (True, EPS)):
        solution = np.concatenate(factors[exact].solve(jnp.asarray(unit * b[:k]), jnp.asarray(unit * b[k:])))
        error = np.abs(solution - expected).max() / np.abs(expected).max()
        assert error < 4 * condition * eps
        assert exact or error > 0.01 * SINGLE
    assert isinstance(Factors.of(*map(jnp.asarray, parts), jnp.ones(()), kind=LU).factors, LU)
    single = (jnp.asarray(part, jnp.float32) for part in parts)
    assert isinstance(Factors.of(*single, jnp.ones((), jnp.float32), kind=Inverse).factors, Inverse)


@pytest.mark.slow  # inverses of many runs are rounded below
def test_steps_with_a_rounded_inverse_are_those_of_full_newton():
    """Residuals are in double precision, so the motion is."""
    model = spatial_chain(40)  # of 440 unknowns
    dense = lg.Model(model.bodies, model.joints, model.forces, linear_solver=lg.DenseLU())
    rounded, full = (
        lg.simulate(dense, t1=0.02, num_steps=20, integrator=lg.GeneralizedAlpha(factor_every=every))
        for every in (20, 0)
    )
    assert len(rounded.states.v[0]) + len(rounded.states.lam[0]) >= 181  # the root of 2¹⁵
    # each step adds the round-off of positions, in velocities over h; with an inverse in double precision the two
    # differ by half as much
    roundoff = 4 * 20 * EPS * float(np.ptp(np.asarray(full.states.q.position)))
    np.testing.assert_allclose(rounded.states.q.position, full.states.q.position, rtol=0, atol=roundoff)
    np.testing.assert_allclose(rounded.states.v, full.states.v, rtol=0, atol=roundoff / 1e-3)
    assert int(rounded.stats.iterations.max()) <= 8  # as many as in double precision: it contracts


@pytest.mark.slow  # programs of a batch
def test_inverses_of_many_runs_are_rounded_earlier():
    """Those of a batch share the caches; the motion is that of one run."""

    def inverse(size):
        parts = [jnp.asarray(part) for part in (np.eye(size - 4), np.eye(size - 4, 4), np.eye(4, size - 4))]
        return type(Factors.of(*parts, jnp.ones(()), kind=Inverse).factors)

    assert inverse(40) is inverse(12) is Inverse
    with many_runs():
        assert (inverse(40), inverse(12)) == (Rounded, Inverse)

    def height(tilt):
        chain = spatial_chain(3, tilt=tilt)  # 33 unknowns, 1089 numbers
        return lg.simulate(chain, t1=0.02, num_steps=20).body("link2").position[-1, 2]

    tilts = np.asarray([0.4, 0.8, 1.2])
    # round-off of positions in each step, as above
    expected = [height(tilt) for tilt in tilts]
    np.testing.assert_allclose(lg.sweep(height, tilts).values, expected, rtol=0, atol=4 * 20 * EPS)
