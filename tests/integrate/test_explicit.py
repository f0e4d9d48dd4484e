"""The explicit Runge–Kutta scheme: its linearization against its equations, every method, the stages' quadrature."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from helpers import EPS, random_like

import lgsens as lg
from lgsens.dynamics import initial_state
from lgsens.examples import spinning_top
from lgsens.integrate import EqualGrid, UnevenGrid, Variation, states_of
from lgsens.sensitivity import Parameters, direct_sweep
from lgsens.sensitivity._linearization import matvec
from lgsens.sensitivity._sweeps import adjoint_sweep

TSIT5 = lg.IndexReducedODE()
GIVEN = lg.GivenSteps([1.0, 2.0, 0.0, 1.5, 1.0], TSIT5)
STEPS = 5
P = jnp.array([0.7, 1.0, 0.1])  # angle, length, end
CRITERION = lg.Criterion(
    integrand=lambda s, p: s.body("top").position[0] ** 2 + 1e-5 * s.multiplier("pivot")[2],
    terminal=lambda s, p: s.body("top").acceleration[1] ** 2,
)


def build(p):
    return spinning_top(p[0], length=p[1])


def psi(p, integrator=TSIT5, **settings):
    """A criterion by an angle, a length and the end of the run."""
    return CRITERION(lg.simulate(build(p), t1=p[2], num_steps=STEPS, integrator=integrator, throw=False, **settings))


def inner(one, other):
    pairs = [(np.ravel(a), np.ravel(b)) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other))]
    return sum(a @ b for a, b in pairs), sum(np.abs(a) @ np.abs(b) for a, b in pairs)


@pytest.mark.slow  # `test_given_steps` has both modes in the quick run
@pytest.mark.parametrize("uneven", [False, True])
def test_the_sweeps_solve_the_linearized_equations(uneven):
    """L times the solution of the direct sweep is its right-hand side, with rows everywhere; Lᵀ is the adjoint's.

    Steps of 20 ms end off the constraints by 1e-8: both projections count. Round-off by the condition of the solves,
    1e4, and the operations.
    """
    system = build(P).system()
    t0, h = jnp.asarray(0.1), jnp.asarray(0.02)
    grid = UnevenGrid.first(t0, h * jnp.array([1.0, 0.0, 1.5])) if uneven else EqualGrid(t0, h, 3)
    state0 = TSIT5.complete(system, initial_state(system, t0).state)
    rng = np.random.default_rng(1)

    @jax.jit
    def found(state0, parameters, b, c):
        states, _ = states_of(TSIT5, *parameters, state0)
        delta = direct_sweep(TSIT5, states, parameters, *b)
        return delta, matvec(TSIT5, states, parameters, *delta), adjoint_sweep(TSIT5, states, parameters, *c)

    parameters = Parameters(system, grid)
    states, _ = jax.jit(lambda: states_of(TSIT5, *parameters, state0))()
    b, c = (random_like((Variation.none(states), parameters), rng) for _ in range(2))
    delta, product, mu = found(state0, parameters, b, c)
    for actual, expected in zip(jax.tree.leaves(product), jax.tree.leaves(b)):
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9)
    (forward, size), (backward, _) = inner(c, delta), inner(mu, b)
    assert abs(forward - backward) < 1e6 * EPS * size


def differences(f, step=1e-3):
    """Central differences of sixth order: δ⁶ = 1e-18 × derivatives of size 10, round-off 1e-15/1e-3 of Ψ."""
    compiled = jax.jit(f)
    return np.array([central(lambda s, e=e: compiled(P + s * e), step) for e in jnp.eye(3)])


@pytest.mark.slow  # first ones on given steps are below
def test_first_and_second_derivatives():
    """In reverse mode, against differences of sixth order."""
    gradient = jax.jit(jax.value_and_grad(psi))
    both = lambda s, e: jnp.concatenate([jnp.ravel(part) for part in gradient(P + s * e)])
    slopes = np.array([central(lambda s, e=e: both(s, e), 1e-3) for e in jnp.eye(3)])
    expected, second = slopes[:, 0], slopes[:, 1:]
    _, reverse = gradient(P)
    np.testing.assert_allclose(reverse, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    hessian = jax.jit(jax.hessian(psi))(P)
    np.testing.assert_allclose(hessian, second, rtol=1e-6, atol=1e-7 * np.abs(second).max())


@pytest.mark.slow
@pytest.mark.parametrize("method", [lg.DirectDifferentiation(), lg.AdjointVariable()])
def test_every_method(method):
    value, reverse = jax.jit(jax.value_and_grad(psi))(P)
    settings = {"t1": P[2], "num_steps": STEPS, "integrator": TSIT5, "method": method}
    found = lg.differentiate(CRITERION, build, P[:2], **settings)
    np.testing.assert_allclose(found.value, value, rtol=1e-12)
    np.testing.assert_allclose(found.gradient, reverse[:2], rtol=1e-9)  # other order of round-off


@pytest.mark.slow  # as the combinations
def test_given_steps():
    """An empty step has no stages to integrate over, and the sizes of the others count."""
    f = lambda p: psi(p, GIVEN)
    forward, reverse = jax.jit(lambda p: (jax.jacfwd(f)(p), jax.grad(f)(p)))(P)
    np.testing.assert_allclose(forward, differences(f), rtol=1e-7, atol=1e-9 * np.abs(forward).max())
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)
    even = lg.GivenSteps(np.ones(STEPS), TSIT5)
    np.testing.assert_allclose(psi(P, even), psi(P), rtol=1e-12)


def side(s):
    return s.body("top").position[0] ** 2 + 1e-5 * s.multiplier("pivot")[2]


@pytest.mark.slow  # as the combinations
def test_outputs_and_checkpoints():
    """`save`, with checkpoints and without, is the trajectory by Gregory's rule."""

    def saved(p, **settings):
        if "save" in settings:
            run = lg.simulate(build(p), t1=p[2], num_steps=STEPS, integrator=TSIT5, throw=False, **settings)
            return lg.time_integral(run.t, run.values, order=4)
        run = lg.simulate(build(p), t1=p[2], num_steps=STEPS, integrator=TSIT5, throw=False)
        values = run.body("top").position[:, 0] ** 2 + 1e-5 * run.multiplier("pivot")[:, 2]
        return lg.time_integral(run.t, values, order=4)

    value, slope = jax.jit(jax.value_and_grad(saved))(P)
    for method in (lg.DirectDifferentiation(), lg.AdjointVariable(checkpoints=2)):
        f = lambda p, m=method: saved(p, save=side, sensitivity=m)
        found = jax.jit(jax.value_and_grad(f))(P)
        np.testing.assert_allclose(found[0], value, rtol=1e-12)
        np.testing.assert_allclose(found[1], slope, rtol=1e-9)


@pytest.mark.slow  # two programs
def test_growth_and_control():
    """What else knows schemes only: the growth of changes, and steps under error control."""
    growth = lg.sensitivity_growth(build(P), t1=0.1, num_steps=STEPS, integrator=TSIT5)
    assert growth.factor.shape == (STEPS + 1,) and np.all(np.isfinite(growth.factor))
    adaptive = lg.AdaptiveSteps(TSIT5, tolerance=1e-4, longest=0.5)
    found = lg.simulate(build(P), t1=0.1, num_steps=20, integrator=adaptive)
    wanted = lg.simulate(build(P), t1=0.1, num_steps=20, integrator=TSIT5)
    assert int(found.stats.steps) < 20
    # (h ω)⁵ of the longest step: 30 ms and 10 rad/s, and the constant of Tsit5
    np.testing.assert_allclose(found.states.v[-1], wanted.states.v[-1], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("solver", "counts", "order"),
    [pytest.param(diffrax.Tsit5(), (8, 16), 5, marks=pytest.mark.slow), (diffrax.Dopri8(), (4, 8), 8)],
)
def test_quadrature_of_the_stages(solver, counts, order):
    """∫ of the square of an acceleration, which Gregory's rule of order 4 would spoil, falls as the motion does.

    Orders by slope, of which one is left to steps that are not small.
    """
    criterion = lg.Criterion(integrand=lambda s, p: s.body("top").acceleration[0] ** 2)

    def psi(num_steps, solver):
        trajectory = lg.simulate(spinning_top(0.7), t1=0.4, num_steps=num_steps, integrator=lg.IndexReducedODE(solver))
        assert trajectory.stages is not None
        assert trajectory.stages.t.shape == trajectory.stages.weights.shape == trajectory.stages.states.v.shape[:1]
        np.testing.assert_allclose(trajectory.stages.weights.sum(), 0.4, rtol=8 * EPS)
        return float(criterion(trajectory))

    exact = psi(64, diffrax.Dopri8())
    coarse, fine = (abs(psi(n, solver) - exact) for n in counts)
    assert np.log2(coarse / fine) > order - 1, (coarse, fine)
