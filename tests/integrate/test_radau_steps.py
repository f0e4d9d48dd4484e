"""Radau IIA under error control: errors, numbers of steps, and derivatives on the grid that was found."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from driven_pendulum import P, make
from scipy.integrate import solve_ivp
from test_radau import stiff_pair

import lgsens as lg

RADAU = lg.RadauIIA()
TIMES = {"t0": 0.2, "t1": 1.2}


@functools.cache
def controlled(tolerance, scheme=RADAU, num_steps=100):
    """One program for all values of the parameters."""
    integrator = lg.AdaptiveSteps(scheme, tolerance=tolerance, longest=1.0)
    return jax.jit(lambda p: lg.simulate(make(p), num_steps=num_steps, integrator=integrator, **TIMES))


@functools.cache
def exact():
    """q at the end, by the angle of the rod and SciPy."""
    mass, length, stiffness, damping = P

    def rates(t, y):
        angle, spin = y
        place = np.array([np.cos(3.0 * t), np.exp(-((5.0 * (t - 0.6)) ** 2))])
        push = stiffness * place @ [-np.sin(angle), np.cos(angle)]
        return [spin, (push - damping * length * spin) / (mass * length)]

    start = [0.0, 1.0 / length]
    angle = solve_ivp(rates, (TIMES["t0"], TIMES["t1"]), start, method="DOP853", rtol=1e-13, atol=1e-13).y[0, -1]
    return length * np.array([np.cos(angle), np.sin(angle)])


def error(run):
    return np.abs(np.asarray(run.states.q[-1]) - exact()).max()


def test_error_control():
    """The tolerance bounds the error within a step; errors at the ends of all steps are smaller here."""
    run = controlled(1e-5)(jnp.array(P))
    steps, sizes = int(run.stats.steps), np.diff(run.t)
    assert run.result == lg.RESULTS.successful and 10 <= steps <= 40
    assert np.all(sizes[:steps] > 0) and np.all(sizes[steps:] == 0)
    assert np.all(run.stats.error <= 1e-5) and run.stats.rejected[0] == 0
    assert np.median(run.stats.error[1:steps]) > 1e-6  # the aim is half of the tolerance
    assert error(run) < 1e-5


@pytest.mark.slow  # four programs
def test_the_estimate_is_the_error_within_the_step():
    """At the first stage, of one step that error control accepts as it is; against 20 steps of order 8 up to there."""
    p, ratios = jnp.array(P), []
    for h in (0.02, 0.005):
        settings = {"t0": 0.2, "t1": 0.2 + h, "num_steps": 1}
        integrator = lg.AdaptiveSteps(RADAU, tolerance=1.0, longest=1.0)
        run = lg.simulate(make(p), integrator=integrator, **settings)
        first = jax.tree.map(lambda leaf: leaf[0], run.stages)
        explicit = lg.IndexReducedODE(diffrax.Dopri8())
        true = lg.simulate(make(p), t0=0.2, t1=first.t, num_steps=20, integrator=explicit)
        ratios.append(run.stats.error[0] / np.abs(first.states.q - true.states.q[-1]).max())
    assert abs(ratios[1] - 1.0) < 0.1 and abs(ratios[1] - 1.0) < 0.5 * abs(ratios[0] - 1.0), ratios


@pytest.mark.slow  # three programs
def test_errors_follow_the_tolerance():
    """Over four decades: steps as its fourth to fifth root, errors as its power 1 to 5/4."""
    runs = [controlled(tolerance, num_steps=400)(jnp.array(P)) for tolerance in (1e-4, 1e-6, 1e-8)]
    steps, errors = (np.array([of(run) for run in runs]) for of in (lambda run: int(run.stats.steps), error))
    assert np.all(errors < [1e-4, 1e-6, 1e-8]), errors
    decades = np.log10(errors[:-1] / errors[1:]) / 2.0
    assert np.all((decades > 0.8) & (decades < 1.6)), errors
    growth = np.log10(steps[1:] / steps[:-1]) / 2.0
    assert np.all((growth > 0.15) & (growth < 0.3)), steps


@pytest.mark.slow  # two programs
def test_a_tenth_of_the_steps_that_the_estimate_of_second_order_needs():
    """That of a scheme that says nothing of its error, which follows from the motion alone."""
    tolerance = 1e-8
    own = int(controlled(tolerance, num_steps=400)(jnp.array(P)).stats.steps)
    other = controlled(tolerance, lg.IndexReducedODE(), num_steps=3000)(jnp.array(P))
    assert other.result == lg.RESULTS.successful
    assert 5 * own < int(other.stats.steps)


@pytest.mark.slow  # the reference has 6,500 stages
def test_stiff_pair():
    """The bushing of 1e7 N/m, 3e3 rad/s, does not show in the steps; errors stay below the tolerance."""
    model = stiff_pair()
    true = lg.simulate(model, t1=0.5, num_steps=5000, integrator=lg.IndexReducedODE(diffrax.Dopri8()))
    for tolerance, most in ((1e-4, 25), (1e-6, 50)):
        integrator = lg.AdaptiveSteps(RADAU, tolerance=tolerance, longest=1.0)
        run = lg.simulate(model, t1=0.5, num_steps=100, integrator=integrator)
        assert run.stats.steps <= most
        assert np.abs(run.states.q.position[-1] - true.states.q.position[-1]).max() < tolerance


def observed(run):
    """What shows every part of the state."""
    states = run.states
    return jnp.sum(states.q[-1] ** 2) + states.v[-1, 1] + 0.01 * states.lam[-1, 0] + 0.01 * states.vdot[-1, 0]


def differentiated(p):
    """Value and gradient, and the trajectory."""

    def evaluate(p):
        run = controlled(1e-5)(p)
        return observed(run), run

    return jax.value_and_grad(evaluate, has_aux=True)(p)


def on_grid(grid, p, **how):
    return observed(lg.simulate(make(p), num_steps=grid.num_steps, integrator=grid, throw=False, **TIMES, **how))


@pytest.mark.slow
def test_derivatives_on_the_frozen_grid():
    """Both modes and the explicit adjoint, against differences of runs on the grid that was found."""
    p = jnp.array(P)
    (found, run), slopes = jax.jit(differentiated)(p)
    grid = lg.GivenSteps.of(run, RADAU)
    assert grid.num_steps == int(run.stats.steps)
    again = jax.jit(functools.partial(on_grid, grid))
    np.testing.assert_allclose(again(p), found, rtol=1e-11)  # Newton's tolerance, 1e-12, in λ
    expected = [central(lambda s, e=e: again(p + s * e * p), 1e-3) for e in jnp.eye(4)]
    # differences: δ⁶ = 1e-18 × seventh derivative; what Newton leaves of Ψ, 1e-14, over 1e-3
    np.testing.assert_allclose(slopes * p, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    forward = jax.jit(jax.jacfwd(lambda p: observed(controlled(1e-5)(p))))(p)
    adjoint = jax.jit(jax.grad(lambda p: on_grid(grid, p, sensitivity=lg.AdjointVariable())))(p)
    for other in (forward, adjoint):
        np.testing.assert_allclose(other, slopes, rtol=1e-10)  # other order of round-off


@pytest.mark.slow
def test_lanes_have_grids_of_their_own():
    """And the values and slopes that runs of their own have on them."""
    stiff, soft = jnp.array(P).at[2].set(100.0), jnp.array(P)
    (values, runs), slopes = jax.jit(jax.vmap(differentiated))(jnp.stack([stiff, soft]))
    assert runs.stats.steps[0] > runs.stats.steps[1]
    for lane, p in enumerate((stiff, soft)):
        (_, run), _ = jax.jit(differentiated)(p)
        # estimates are carried by the matrix at hand; where one lane makes a new one, the other has a new one too
        np.testing.assert_allclose(runs.t[lane], run.t, rtol=1e-3)
        sizes = np.diff(runs.t[lane])
        grid = lg.GivenSteps(sizes[sizes > 0.0], RADAU)
        value, slope = jax.jit(jax.value_and_grad(functools.partial(on_grid, grid)))(p)
        np.testing.assert_allclose(values[lane], value, rtol=1e-11)  # Newton's tolerance, 1e-12, in λ
        np.testing.assert_allclose(slopes[lane], slope, rtol=1e-10)
