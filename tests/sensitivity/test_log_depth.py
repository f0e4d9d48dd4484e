"""`AssociativeScan`: the derivative of the sweeps, in O(log n) depth."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import equations, random_like, some_quick
from implicit_midpoint import ImplicitMidpoint

import lgsens as lg
from lgsens.dynamics import initial_state
from lgsens.examples import QuarterCar, spinning_top
from lgsens.integrate import EqualGrid, UnevenGrid, Variation, states_of
from lgsens.linear import programs_in
from lgsens.sensitivity import Parameters, direct_sweep
from lgsens.sensitivity._carried import Carried
from lgsens.sensitivity._linearization import matvec
from lgsens.sensitivity._log_depth import _Composed, adjoint_at_once, direct_at_once
from lgsens.sensitivity._sweeps import adjoint_sweep

SWEEPS, AT_ONCE = lg.DirectDifferentiation(), lg.AssociativeScan()
ALPHA, STABILIZED = lg.GeneralizedAlpha(0.9), lg.GeneralizedAlpha(0.9, stabilized=True)
STEPS = 12
SIZES = 1.0 + 0.3 * np.sin(np.arange(STEPS))
INTEGRATORS = {
    "index 3": ALPHA,
    "stabilized": STABILIZED,
    "Radau": lg.RadauIIA(),
    "index-reduced": lg.IndexReducedODE(),
    "given": lg.GivenSteps(SIZES, ALPHA),
    "adaptive": lg.AdaptiveSteps(ALPHA, tolerance=1e-3, longest=0.1),  # most of its steps are empty
    "given, Radau": lg.GivenSteps(SIZES, lg.RadauIIA()),
    "own": ImplicitMidpoint(),
}
CAR = QuarterCar.load()
X = jnp.array([0.7, 1.0, 1.0, 1.0, 1.0])


def top(x, sensitivity, integrator=ALPHA, num_steps=STEPS, t1=0.3):
    """Two criteria by an angle, the mass, the length (where the joint is), the end, and the velocities at the start.

    Multipliers are asked for at h = 25 ms: by eq. (26) they have the round-off of configurations over βh².
    """
    model = spinning_top(x[0], mass=15.0 * x[1], length=x[2])
    start = lg.initial_state(model)
    start = dataclasses.replace(start, v=x[4] * start.v)
    settings = {"sensitivity": sensitivity, "integrator": integrator, "throw": False}
    run = lg.simulate(model, t1=t1 * x[3], num_steps=num_steps, state0=start, **settings)
    side = lg.time_integral(run.t, run.body("top").position[:, 0] ** 2)
    return jnp.stack([side, lg.time_integral(run.t, run.multiplier("pivot")[:, 2])])


def car(x, sensitivity, num_steps):
    """Ψ₀ of eq. (47) and the tyre's force by a damper, a mass and hardpoints."""
    names = sorted(CAR.links)
    design = eqx.tree_at(lambda car: car.damper.rate, CAR, 4900.0 * x[0])
    design = eqx.tree_at(
        lambda car: [car.links[name].chassis for name in names],
        design,
        [design.links[name].chassis + (x[1] - 1.0) * jnp.array([0.1, 0.2, 0.3]) for name in names],
    )
    model = eqx.tree_at(lambda m: m.bodies["chassis"].mass, design.model(), replace_fn=lambda mass: mass * x[2])
    run = lg.simulate(model, t1=0.01 * num_steps * x[3], num_steps=num_steps, sensitivity=sensitivity)
    lifted = lg.time_integral(run.t, run.body("chassis").acceleration[:, 2] ** 2)
    return jnp.stack([lifted, run.force("tyre")[-1] * 1e-3])


def both_modes(function, x, *settings):
    """Of the sweeps and at once, each forward and in reverse, row by row over the largest derivative."""
    f = lambda method: lambda x: function(x, method, *settings)
    compute = jax.jit(lambda x: [mode(f(m))(x) for m in (SWEEPS, AT_ONCE) for mode in (jax.jacfwd, jax.jacrev)])
    expected, *others = map(np.asarray, compute(x))
    scale = np.abs(expected).max(axis=1, keepdims=True)
    assert np.all(scale > 0.0)
    return [np.abs((other - expected) / scale).max() for other in others]


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) for name in INTEGRATORS],
)
def test_the_top(name):
    """12 steps × condition 5e2 × round-off."""
    assert max(both_modes(top, X, INTEGRATORS[name])) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("integrator", [ALPHA, STABILIZED, lg.RadauIIA()])
def test_a_long_run_of_the_top(integrator):
    """500 steps of 2 ms: positions, as multipliers have the round-off of these over h²; 500 × condition × round-off."""
    side = lambda x, method: top(x, method, integrator, 500, 1.0)[:1]
    assert max(both_modes(side, X)) < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", [8, 100])
def test_the_quarter_car(num_steps):
    """100 steps × condition 5e2 × round-off."""
    assert max(both_modes(car, jnp.ones(4), num_steps)) < 1e-11


def linear_problem(scheme, num_steps, uneven=False):
    """A run of the top, and right-hand sides everywhere, as derivatives of derivatives have them."""
    system, t0, h = spinning_top(0.7).system(), jnp.asarray(0.1), jnp.asarray(0.02)
    sizes = h * jnp.array([1.0, 0.0, 1.5, 0.0, 0.0, 1.2][:num_steps])
    grid = UnevenGrid.first(t0, sizes) if uneven else EqualGrid(t0, h, num_steps)
    parameters = Parameters(system, grid)
    start = lambda: scheme.complete(system, initial_state(system, t0).state)
    states, _ = jax.jit(lambda: states_of(scheme, *parameters, start()))()
    rng = np.random.default_rng(1)
    return scheme, states, parameters, *(random_like((Variation.none(states), parameters), rng) for _ in range(2))


@pytest.mark.slow  # small version: test_right_hand_sides_share_the_products
@pytest.mark.parametrize(
    ("scheme", "uneven"),
    [
        (ALPHA, True),
        (STABILIZED, False),
        (ALPHA, False),
        (lg.RadauIIA(), False),
        (lg.RadauIIA(), True),
        (lg.IndexReducedODE(), True),
    ],
)
def test_the_linear_equations_with_rows_everywhere(scheme, uneven):
    """L δ = b and Lᵀ μ = c, empty steps among others: as the sweeps, to 6 steps × round-off × 1/βh² of 1e4."""
    scheme, states, parameters, b, c = linear_problem(scheme, 6, uneven)

    @jax.jit
    def found(states, parameters, b, c):
        of = scheme, states, parameters
        delta = direct_at_once(*of, *b)
        pairs = (delta, direct_sweep(*of, *b)), (adjoint_at_once(*of, *c), adjoint_sweep(*of, *c))
        return *pairs, (matvec(*of, *delta), b)

    for actual, expected in found(states, parameters, b, c):
        scale = max(np.abs(leaf).max(initial=0.0) for leaf in jax.tree.leaves(expected))
        for one, other in zip(jax.tree.leaves(actual), jax.tree.leaves(expected)):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-11 * max(scale, 1e2))  # of 1/βh², in matvec


@pytest.mark.parametrize(
    ("scheme", "size"),
    some_quick([(ALPHA, 3 * 6 + 3), (STABILIZED, 2 * 6 + 2 * 3), (lg.RadauIIA(), 2 * 3)]),
)
def test_a_step_hands_on_what_its_coordinates_hold(scheme, size):
    """R E = 1 and E R A = A: nothing is lost, and no matrix is larger than it need be. A has entries of 1/βh² = 1e4."""
    scheme, states, parameters, (delta, _), _ = linear_problem(scheme, 3)

    @jax.jit
    def found(states, parameters, delta):
        every, previous = _Composed.of(scheme, states, parameters), jax.tree.map(lambda leaf: leaf[1:], delta)
        load = lambda linear: every.equations.loads(linear, parameters, linear.step.place)
        nothing = jax.tree.map(jnp.zeros_like, (jax.vmap(load)(every.steps), previous))
        unread = {name: 7.0 + getattr(previous, name) for name in ("vdot", "lam", "a") if name not in scheme.carries}
        back, into = jax.vmap(Carried.back), jax.vmap(Carried.into)
        end = every.forward(previous, *nothing)
        y = back(every.after, end)
        again = into(every.after, y, end)
        return end, again, every.forward(previous._replace(**unread), *nothing), y, back(every.after, again)

    end, again, unread, y, same = found(states, parameters, delta)
    assert y.shape == (3, size)
    np.testing.assert_allclose(same, y, rtol=1e-11)
    for name in scheme.carries:
        expected = getattr(end, name)
        np.testing.assert_allclose(getattr(again, name), expected, rtol=0, atol=1e-11 * np.abs(expected).max())
        np.testing.assert_array_equal(getattr(unread, name), expected)


@pytest.mark.slow
def test_hessian():
    """Forward over reverse, the products with L differentiated as for the sweeps; by an angle, the mass, the length."""
    side = lambda x, method: top(jnp.concatenate([x, X[3:]]), method)[0]
    found, expected = (jax.jit(jax.hessian(lambda x, m=m: side(x, m)))(X[:3]) for m in (AT_ONCE, SWEEPS))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())  # as `test_the_top`


@pytest.mark.slow
def test_batches_of_designs():
    """As one by one; a batched LU rounds differently."""
    designs = X[None, :] * jnp.array([[1.0], [1.02]]) * jnp.ones((1, 5))
    gradient = jax.grad(lambda x: top(x, AT_ONCE)[0])
    lanes = jax.jit(jax.vmap(gradient))(designs)
    one_by_one = np.stack([jax.jit(gradient)(x) for x in designs])
    np.testing.assert_allclose(lanes, one_by_one, rtol=0, atol=1e-11 * np.abs(one_by_one).max())


@pytest.mark.slow
def test_outside_of_jit_and_saved_and_by_differentiate():
    """A run whose number of steps is data with the sweeps (`Steps`), one that keeps outputs only, and one call."""
    build = lambda p: spinning_top(p[0], length=p[1])
    side = lambda s, p=None: s.body("top").position[0] ** 2
    settings = {"t1": 0.3, "num_steps": STEPS}

    def psi(p, method):
        run = lg.simulate(build(p), sensitivity=method, **settings)
        return lg.time_integral(run.t, run.body("top").position[:, 0] ** 2)

    def saved(p, method):
        run = lg.simulate(build(p), sensitivity=method, save=side, **settings)
        return lg.time_integral(run.t, run.values)

    p = X[:2]
    expected = jax.grad(psi)(p, SWEEPS)
    by_call = lg.differentiate(lg.Criterion(integrand=side), build, p, method=AT_ONCE, **settings)
    assert by_call.method == AT_ONCE
    for found in (jax.grad(psi)(p, AT_ONCE), jax.jacfwd(saved)(p, AT_ONCE), by_call.gradient):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


# Depth.


def depth(jaxpr) -> int:
    """The operations on the longest way through a program: bodies of scans as often as they run, those of `while` once.

    Of a call or a loop it is the longest way inside, whatever enters where: never less than the true one.
    """
    at = {}
    for equation in jaxpr.eqns:
        inside = max((depth(program) for program in programs_in(equation)), default=1)
        cost = inside * equation.params["length"] if equation.primitive.name == "scan" else inside
        begun = max((at.get(var, 0) for var in equation.invars if not hasattr(var, "val")), default=0)
        at |= dict.fromkeys(equation.outvars, begun + cost)
    return max(at.values(), default=0)


def programs(scheme, n):
    """The derivative alone, at given states, which the march finds one after the other: forward, reverse; and twice.

    Programs do not depend on the numbers in states: these are zeros.
    """
    system, zero = spinning_top(0.7).system(), jnp.asarray(0.0)
    parameters = Parameters(system, EqualGrid(zero, jnp.asarray(1e-3), n))
    state = jax.eval_shape(lambda: scheme.complete(system, initial_state(system, zero).state))
    states = jax.tree.map(lambda leaf: jnp.zeros((n + 1, *leaf.shape), leaf.dtype), state)
    b = Variation.none(states), parameters
    of = scheme, states, parameters
    pairs = {"forward": (direct_sweep, direct_at_once), "reverse": (adjoint_sweep, adjoint_at_once)}
    return {
        name: [jax.make_jaxpr(lambda b, solve=solve: solve(*of, *b))(b).jaxpr for solve in solvers]
        for name, solvers in pairs.items()
    }


@pytest.mark.slow  # three programs; that steps compose is in the quick run
@pytest.mark.parametrize("scheme", [ALPHA, lg.RadauIIA()])
def test_depth(scheme):
    """Eight times as many steps: eight times the depth of the sweeps, and three levels more of the scan.

    A level has a product, a sum, and what takes rows apart and puts them together again, on the way down and up, in
    two solutions: 12 to 16 operations each.
    """
    few, many = programs(scheme, 16), programs(scheme, 128)
    for name in few:
        (sweep, scan), (long_sweep, long_scan) = (list(map(depth, found[name])) for found in (few, many))
        assert 7.0 < long_sweep / sweep <= 8.5, name
        assert 0 < long_scan - scan <= 3 * 4 * 16, name
        assert long_scan < long_sweep / 10, name


def test_right_hand_sides_share_the_products():
    """Of 7 tangents at once no product of matrices, 21 × 21, is taken seven times: those with more are of vectors."""
    scheme, states, parameters, *_ = linear_problem(ALPHA, 5)
    b = jax.tree.map(lambda leaf: jnp.zeros((7, *leaf.shape)), (Variation.none(states), parameters))
    program = jax.make_jaxpr(jax.vmap(lambda b: direct_at_once(scheme, states, parameters, *b)))(b).jaxpr
    shapes = [e.outvars[0].aval.shape for e in equations(program) if e.primitive.name == "dot_general"]
    assert [shape for shape in shapes if shape[-2:] == (21, 21)]
    assert not [shape for shape in shapes if shape.count(21) > 1 and 7 in shape]
