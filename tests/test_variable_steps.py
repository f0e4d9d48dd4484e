"""Steps of different sizes, given or under error control: accuracy, derivatives on the frozen grid, failures."""

import functools
import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from driven_pendulum import P, make
from helpers import says

import lgsens as lg
from lgsens.examples import PROBLEMS, spinning_top

SCHEME = lg.GeneralizedAlpha(rho_inf=0.8)
DATA = Path(__file__).parent / "data"
CARS = [("quarter_car_linear", 1e-5, 250)]


def observed(trajectory):
    """What shows every part of the state."""
    states = trajectory.states
    integrand = states.q[:, 0] ** 2 + 0.01 * states.vdot[:, 1] ** 2
    return lg.time_integral(trajectory.t, integrand) + states.v[-1, 1] + 0.01 * states.lam[-1, 0]


def value(p, t0, t1, fractions, scheme=SCHEME, **settings):
    settings |= {"num_steps": fractions.shape[0], "integrator": lg.GivenSteps(fractions, scheme)}
    return observed(lg.simulate(make(p), t0=t0, t1=t1, **settings))


def uneven(n):
    """Sizes that change smoothly, by a factor of e in all."""
    return np.exp(0.5 * np.sin(7.0 * (np.arange(n) + 0.5) / n))


@functools.cache
def adaptive(tolerance=1e-5, capacity=250, sensitivity=lg.DirectDifferentiation(), **settings):
    """One program for all values of the parameters."""
    integrator = lg.AdaptiveSteps(SCHEME, tolerance=tolerance, **settings)
    settings = {"num_steps": capacity, "integrator": integrator, "sensitivity": sensitivity}
    return jax.jit(lambda p: lg.simulate(make(p), t0=0.2, t1=1.2, **settings))


def test_equal_fractions_are_equal_steps():
    settings = {"t1": 1.0, "num_steps": 40}
    p = jnp.array(P)
    equal = lg.simulate(make(p), integrator=SCHEME, **settings)
    given = lg.simulate(make(p), integrator=lg.GivenSteps(jnp.full(40, 3.0), SCHEME), **settings)
    assert given.result == lg.RESULTS.successful
    np.testing.assert_allclose(given.t, equal.t, rtol=1e-15)
    for one, other in zip(jax.tree.leaves(given.states), jax.tree.leaves(equal.states), strict=True):
        # what Newton leaves in accelerations, round-off/(βh²) = 2e-16/1e-4, relative; forty steps of it
        np.testing.assert_allclose(one, other, rtol=0, atol=40 * 2e-12 * np.abs(other).max())


@pytest.mark.slow
def test_order():
    """Second order in every part of the state where sizes change smoothly, against another integrator."""
    p = jnp.array(P)
    exact = lg.simulate(make(p), t1=1.0, num_steps=200, integrator=lg.IndexReducedODE()).state(-1)
    errors = []
    for n in (80, 160, 320):
        last = lg.simulate(make(p), t1=1.0, num_steps=n, integrator=lg.GivenSteps(uneven(n), SCHEME)).state(-1)
        pairs = ((last.q, exact.q), (last.v, exact.v), (last.vdot, exact.vdot), (last.lam, exact.lam))
        errors.append([np.abs(one - other).max() for one, other in pairs])
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(np.abs(orders[-1] - 2.0) < 0.1), orders  # the next term of the error is a step of 3e-3 smaller


def test_multipliers_where_sizes_jump():
    """By 2 and 1/2 from step to step, then by 3 once: the largest error of all steps is of second order in index 3 too.

    With velocities that keep what belongs to the size before it is 10 times as large, of order 0.5.
    """
    p = jnp.array(P)
    exact = lg.simulate(make(p), t1=1.0, num_steps=2000, integrator=lg.IndexReducedODE())
    errors = []
    for n in (80, 160):
        sizes = np.concatenate([np.tile([1.0, 2.0], n // 4), np.full(n // 2, 3.0), np.zeros(160 - n)])
        run = lg.simulate(make(p), t1=1.0, num_steps=160, integrator=lg.GivenSteps(sizes, SCHEME))  # one program
        of = partial(np.interp, run.t, exact.t)  # its error is 1/8 (5e-4)² of a second derivative: 1e-3 of those
        parts = ((run.states.lam, exact.states.lam), (run.states.vdot, exact.states.vdot))
        errors.append([np.abs(one - np.apply_along_axis(of, 0, other)).max() for one, other in parts])
    orders = np.log2(np.array(errors[0]) / np.array(errors[1]))
    assert np.all(np.abs(orders - 2.0) < 0.2), (orders, errors)  # as `test_order`, with steps of 1/80 instead of 1/320


@pytest.mark.slow  # on the grid that error control has found: below
def test_derivatives_on_a_given_grid():
    """By parameters, times and sizes, with empty steps in the middle and at the end, each second one as long as the one
    before: both modes, differences, and JAX through the loop of the steps."""
    sizes = np.repeat(uneven(12), 2)
    sizes[[9, 10, 22, 23]] = 0.0
    point = (jnp.array(P), jnp.asarray(0.1), jnp.asarray(1.1), jnp.asarray(sizes))
    rng = np.random.default_rng(0)
    forward = jax.jit(jax.jacfwd(value, argnums=(0, 1, 2, 3)))(*point)
    both = jax.jit(jax.value_and_grad(value, argnums=(0, 1, 2, 3)))
    for one, other in zip(both(*point)[1], forward, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-12)  # other order of round-off
    tight = lg.GeneralizedAlpha(rho_inf=0.8, tolerance=1e-14)
    of = partial(value, scheme=tight, sensitivity=lg.Autodiff())
    through = jax.jit(jax.jacfwd(of, argnums=(0, 3)))(*point)
    for one, other in zip(through, (forward[0], forward[3]), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10)  # round-off of λ and v̇, 1e-14/(βh²), h = 1/24
    for i, leaf in enumerate(point):
        direction = jnp.asarray(rng.normal(size=leaf.shape)) * leaf  # an empty step stays empty
        shifted = lambda s, i=i, d=direction: both(*(x + s * d if j == i else x for j, x in enumerate(point)))[0]
        # differences: δ⁶ = 1e-18 × seventh derivative; λ carries round-off/(βh²)/δ = 1e-12/1e-3 of its weight 0.01
        np.testing.assert_allclose(jnp.sum(forward[i] * direction), central(shifted, 1e-3), rtol=1e-7)


@pytest.mark.slow  # two derivatives
@pytest.mark.parametrize("mode", ["reverse", "forward"])
def test_fixed_fractions_are_constants(mode):
    """Nothing but the derivative by them is left out: an uneven grid, whose ratios are not 1 in two steps of twelve."""
    sizes = jnp.array([1.0] * 5 + [2.0] * 4 + [0.5] * 3)

    def psi(p, t1, fractions, fixed, sensitivity):
        integrator = lg.GivenSteps(fractions, SCHEME, fixed=fixed)
        run = lg.simulate(make(p), t1=t1, num_steps=12, integrator=integrator, sensitivity=sensitivity)
        return observed(run)

    point = jnp.array(P), jnp.asarray(0.7), sizes
    methods = {"reverse": (jax.grad, lg.AdjointVariable()), "forward": (jax.jacfwd, lg.DirectDifferentiation())}
    derivative, method = methods[mode]
    every, found = (
        jax.jit(derivative(partial(psi, fixed=fixed, sensitivity=method), argnums=(0, 1, 2)))(*point)
        for fixed in (False, True)
    )
    for one, other in zip(found[:2], every[:2], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10)  # other order of round-off
    assert not found[2].any() and every[2].any()


@pytest.mark.slow
def test_derivatives_of_a_top_on_a_given_grid():
    """Rotations: by the initial angle and by the sizes of the steps, reverse mode against differences."""

    def psi(alpha0, fractions):
        integrator = lg.GivenSteps(fractions, SCHEME)
        run = lg.simulate(spinning_top(alpha0), t1=0.3, num_steps=fractions.shape[0], integrator=integrator)
        top = run.body("top")
        return lg.time_integral(run.t, top.position[:, 0] ** 2) + top.velocity[-1, 0]

    alpha0, sizes = jnp.asarray(0.7), jnp.asarray(np.append(uneven(20), [0.0, 0.0]))
    both = jax.jit(jax.value_and_grad(psi, argnums=(0, 1)))
    _, (by_angle, by_sizes) = both(alpha0, sizes)
    # differences: δ⁶ = 1e-18 × seventh derivative, round-off 1e-15/1e-3
    np.testing.assert_allclose(by_angle, central(lambda s: both(alpha0 + s, sizes)[0], 1e-3), rtol=1e-8)
    direction = jnp.asarray(np.random.default_rng(1).normal(size=22)) * sizes
    slope = central(lambda s: both(alpha0, sizes + s * direction)[0], 1e-3)
    np.testing.assert_allclose(by_sizes @ direction, slope, rtol=1e-7)  # a tenth of the sum's terms is left of them


@pytest.mark.slow
def test_second_derivatives_on_a_given_grid():
    sizes = jnp.asarray(np.append(uneven(12), 0.0))
    of = lambda p, t1: value(p, jnp.asarray(0.1), t1, sizes)
    p, t1 = jnp.array(P), jnp.asarray(0.9)
    (pp, pt), (_, tt) = jax.jit(jax.hessian(of, argnums=(0, 1)))(p, t1)
    slope = jax.jit(jax.grad(of, argnums=(0, 1)))
    e = jnp.eye(4)[1]
    columns = [central(lambda s, i=i: slope(p + s * e, t1)[i], 1e-3) for i in (0, 1)]
    # differences of a gradient whose round-off is 1e-12, over 1e-3
    np.testing.assert_allclose(pp[1], columns[0], rtol=1e-7)
    np.testing.assert_allclose(pt[1], columns[1], rtol=1e-7)
    np.testing.assert_allclose(tt, central(lambda s: slope(p, t1 + s)[1], 1e-3), rtol=1e-7)


def test_error_control():
    """Grid, statistics, and what repeats after the last step."""
    (_, run), _ = DIFFERENTIATED(jnp.array(P))
    steps, sizes = int(run.stats.steps), np.diff(run.t)
    assert run.result == lg.RESULTS.successful and 50 <= steps < 250
    assert np.all(sizes[:steps] > 0) and np.all(sizes[steps:] == 0)
    assert sizes.max() <= 0.02 * (1 + 1e-12)  # `longest`
    np.testing.assert_allclose(run.t[-1], 1.2, rtol=1e-14)
    assert np.all(run.stats.error <= 1e-5) and np.all(run.stats.error[steps:] == 0)
    assert np.all(run.stats.converged) and np.all((run.stats.iterations > 0) == (sizes > 0))
    assert run.stats.rejected.shape == (250,) and np.all(run.stats.rejected[steps:] == 0)
    for leaf in map(np.asarray, jax.tree.leaves(run.states)):
        assert np.all(np.isfinite(leaf)) and np.all(leaf[steps:] == leaf[steps])


@pytest.mark.slow
def test_forces_fall_with_the_tolerance():
    """The largest error of all steps, as that of the motion: tolerance^(2/3), 21."""
    p, errors = jnp.array(P), []
    exact = lg.simulate(make(p), t0=0.2, t1=1.2, num_steps=4000, integrator=SCHEME)
    for tolerance, n in ((1e-5, 250), (1e-7, 1000)):
        run = adaptive(tolerance, n)(p)
        errors.append(np.abs(run.states.lam[:, 0] - np.interp(run.t, exact.t, exact.states.lam[:, 0])).max())
    assert 10 < errors[0] / errors[1] < 40, errors


@pytest.mark.slow
def test_errors_fall_with_the_tolerance():
    p = jnp.array(P)
    exact = observed(lg.simulate(make(p), t0=0.2, t1=1.2, num_steps=4000, integrator=SCHEME))
    errors = [abs(float(observed(adaptive(tolerance, n)(p)) - exact)) for tolerance, n in ((1e-5, 250), (1e-7, 1000))]
    assert 10 < errors[0] / errors[1] < 40, errors  # tolerance^(2/3): 21


def differentiated(p):
    """Value and gradient, and the trajectory."""

    def evaluate(p):
        run = adaptive()(p)
        return observed(run), run

    return jax.value_and_grad(evaluate, has_aux=True)(p)


DIFFERENTIATED = jax.jit(differentiated)


def test_derivative_is_that_on_the_frozen_grid():
    """The grid that was found, given: the same run, and its differences."""
    p = jnp.array(P)
    (found, run), slopes = DIFFERENTIATED(p)
    grid = lg.GivenSteps.of(run, SCHEME)
    assert grid.num_steps == int(run.stats.steps)
    again = jax.jit(lambda p: observed(lg.simulate(make(p), t0=0.2, t1=1.2, num_steps=grid.num_steps, integrator=grid)))
    # Sizes are fractions again, and differ by round-off: 0.01 λ by 0.01 · 1e-16/(βh²)/(1 − ρ∞)² = 5e-12 at h = 4e-3.
    np.testing.assert_allclose(again(p), found, rtol=4e-12)
    expected = [central(lambda s, e=e: again(p + s * e * p), 1e-3) for e in jnp.eye(4)]
    # As on equal steps, test_own_system.py. The round-off of Ψ, 1e-12 of it in differences over 1e-3, is in all alike.
    np.testing.assert_allclose(slopes * p, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("method", [lg.DirectDifferentiation(), lg.AdjointVariable()], ids=lambda m: type(m).__name__)
def test_second_derivatives_with_room(method):
    """Those on the grid that was found, which has no empty steps: the sums in their place have derivatives, too."""
    p = jnp.array(P)
    grid = lg.GivenSteps.of(DIFFERENTIATED(p)[0][1], SCHEME)
    frozen = lambda p: observed(lg.simulate(make(p), t0=0.2, t1=1.2, num_steps=grid.num_steps, integrator=grid))
    controlled = lambda p: observed(adaptive(sensitivity=method)(p))
    found, expected = (jax.jit(jax.hessian(of))(p) for of in (controlled, frozen))
    # as `test_derivative_is_that_on_the_frozen_grid`, once more over h
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.slow
def test_forward_mode_and_the_explicit_adjoint_agree():
    p = jnp.array(P)
    _, slopes = DIFFERENTIATED(p)
    forward = jax.jit(jax.jacfwd(lambda p: observed(adaptive()(p))))(p)
    adjoint = jax.jit(jax.grad(lambda p: observed(adaptive(sensitivity=lg.AdjointVariable())(p))))(p)
    for other in (forward, adjoint):
        np.testing.assert_allclose(other, slopes, rtol=1e-10)  # other order of round-off


@pytest.mark.slow  # `test_each_lane_has_its_own_steps` is in the quick run
def test_lanes_have_grids_of_their_own():
    stiff, soft = jnp.array(P).at[2].set(100.0), jnp.array(P)
    (values, runs), slopes = jax.jit(jax.vmap(differentiated))(jnp.stack([stiff, soft]))
    assert runs.stats.steps[0] > runs.stats.steps[1] + 5
    for lane, p in enumerate((stiff, soft)):
        (one, run), slope = DIFFERENTIATED(p)
        # sizes follow from (a_{n+1} − a_n)/h, whose round-off is 1e-16/h³ = 1e-10, and more of it where it is small
        np.testing.assert_allclose(runs.t[lane], run.t, rtol=1e-7)
        np.testing.assert_allclose(values[lane], one, rtol=1e-7)
        np.testing.assert_allclose(slopes[lane], slope, rtol=1e-6)


EXHAUSTED = says("needs more steps", "`num_steps`", "`tolerance`", "t = 0.", "of 1.2 s in 30 steps", "`throw=False`")


def test_steps_exhausted():
    settings = {"t0": 0.2, "t1": 1.2, "num_steps": 30, "integrator": lg.AdaptiveSteps(SCHEME, tolerance=1e-5)}
    with pytest.raises(lg.SimulationError, match=EXHAUSTED):
        lg.simulate(make(jnp.array(P)), **settings)
    run = lg.simulate(make(jnp.array(P)), throw=False, **settings)
    assert run.result == lg.RESULTS.steps_exhausted and run.stats.steps == 30 and 0.2 < run.t[-1] < 1.2
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(run.states))


def test_bad_input():
    run = lambda integrator, **settings: lg.simulate(make(jnp.array(P)), t1=1.0, integrator=integrator, **settings)
    for wrong in (0.0, -1.0, float("nan"), "1e-6"):
        with pytest.raises(ValueError, match=says("AdaptiveSteps", "`tolerance`", repr(wrong))):
            lg.AdaptiveSteps(tolerance=wrong)
    for wrong in (0.0, 1.5):
        with pytest.raises(ValueError, match=says("AdaptiveSteps", "`longest`", repr(wrong))):
            lg.AdaptiveSteps(longest=wrong)
    for kind in (lg.AdaptiveSteps, functools.partial(lg.GivenSteps, [1.0])):
        with pytest.raises(ValueError, match=says("`integrator`", "GeneralizedAlpha", "Richardson")):
            kind(lg.Richardson())
    for wrong in ([[1.0]], []):
        with pytest.raises(ValueError, match=says("`fractions`", "shape")):
            lg.GivenSteps(wrong)
    for wrong in ([0.0, 1.0], [1.0, -1.0], [1.0, float("inf")]):
        with pytest.raises(ValueError, match=says("`fractions`", "first one positive")):
            lg.GivenSteps(wrong)
    with pytest.raises(ValueError, match=says("GivenSteps", "`fixed`", "'yes'")):
        lg.GivenSteps([1.0], fixed="yes")
    given = lg.GivenSteps([1.0, 2.0])
    with pytest.raises(ValueError, match=says("`num_steps` = 3", "has 2")):
        run(given, num_steps=3)
    with pytest.raises(ValueError, match=says("checkpoints")):
        run(given, num_steps=2, sensitivity=lg.DirectDifferentiation(checkpoints="sqrt"))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "tolerance", "capacity"), CARS)
def test_half_the_steps_on_the_bump(name, tolerance, capacity):
    """Twice as many equal steps are less accurate, in Ψ₀ and in its gradient, against independent numbers."""
    problem = PROBLEMS[name]
    exact = problem.reference(json.loads((DATA / problem.file).read_text()))["Psi0"]
    parameters = {key: jnp.asarray(number) for key, number in problem.parameters.items()}

    def errors(num_steps, integrator):
        def evaluate(p):
            run = problem.simulate(p, num_steps=num_steps, integrator=integrator)
            return problem.criteria["Psi0"](run, p), run.stats

        (found, stats), gradient = jax.jit(jax.value_and_grad(evaluate, has_aux=True))(parameters)
        slopes = np.array([[gradient[key], exact.gradient[key]] for key in exact.gradient]).T
        slopes *= np.array([problem.parameters[key] for key in exact.gradient])
        return abs(found / exact.value - 1), np.abs(slopes[0] - slopes[1]).max() / np.abs(slopes[1]).max(), stats

    *controlled, stats = errors(capacity, lg.AdaptiveSteps(lg.GeneralizedAlpha(0.9), tolerance=tolerance))
    *equal, _ = errors(2 * int(stats.steps), lg.GeneralizedAlpha(0.9))
    assert controlled[0] < equal[0] and controlled[1] < equal[1], (controlled, equal)
