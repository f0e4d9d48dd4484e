"""Steps for a criterion: expected errors against closed forms, where the steps are, what is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from jax.flatten_util import ravel_pytree
from oscillator import CRITERION, T1, P, V, build, exact

import lgsens as lg
from lgsens.criteria._defect_density import Densities, defect_densities
from lgsens.criteria._steps_for import _confirmed
from lgsens.examples import PROBLEMS

CENTRE, WIDTH = 0.3, 0.05
EARLY = lg.Criterion(integrand=lambda s, p: window(s.t) * (s.body("mass").position[2] - 1.0) ** 2)
BOTH = {"early": EARLY, "squares": CRITERION}
PILOT = 100
SCENE = {"t1": T1, "pilot": PILOT}


def window(t):
    return jnp.exp(-(((t - CENTRE) / WIDTH) ** 2))


def exact_early(p):
    """∫ window (v/ω sin ωt)² dt: the trapezoidal rule, exact to round-off for a function that is none at both ends."""
    w = jnp.sqrt(p["k"] / p["m"])
    t = jnp.linspace(0.0, T1, 2001)
    return jnp.trapezoid(window(t) * (V / w * jnp.sin(w * t)) ** 2, t)


def relative_errors(integrator, num_steps, criterion=EARLY, exact=exact_early):
    """Of the value, and of the gradient by its norm."""
    found = lg.differentiate(criterion, build, P, t1=T1, num_steps=num_steps, integrator=integrator)
    value, gradient = jax.value_and_grad(exact)(jax.tree.map(jnp.asarray, P))
    vector = lambda tree: np.array([float(tree[name]) for name in sorted(P)])
    difference = np.linalg.norm(vector(found.gradient) - vector(gradient))
    return abs(float(found.value / value) - 1.0), difference / np.linalg.norm(vector(gradient))


@pytest.fixture(scope="module")
def early():
    return lg.steps_for(EARLY, build, P, num_steps=60, **SCENE)


def test_steps_are_where_the_criterion_looks(early):
    """Half of them in the 0.2 s around the window; equal ones have a fifth of them there."""
    t = np.concatenate([[0.0], np.cumsum(early.integrator.fractions)]) * T1
    assert t[-1] == pytest.approx(T1, rel=1e-14)  # round-off of a sum
    assert np.mean(np.abs(t - CENTRE) < 0.1) > 0.4
    longest = float(early.integrator.fractions.max()) * PILOT
    assert longest < 3.5  # three steps of the pilot, and what plateaus are moved by
    assert (
        int(np.sum(np.abs(np.diff(np.asarray(early.integrator.fractions))) > 1e-12)) < 32
    )  # sizes change between plateaus only


@pytest.mark.slow
def test_expected_errors_are_the_true_ones_and_far_below_those_of_equal_steps(early):
    """They have 3 % of what adds up regardless of signs on top: from above, within a factor of 5 where signs cancel."""
    true = relative_errors(early.integrator, early.num_steps)
    for found, expected in zip(true, (early.value_error, early.gradient_error)):
        assert found < 1.2 * float(expected)  # the next order, O(ωh) of the pilot
    equal = relative_errors(lg.GeneralizedAlpha(), 2 * early.num_steps)
    assert true[1] < equal[1]  # in twice as many steps


@pytest.mark.slow  # a certificate besides; the errors of the criterion itself are in the quick run
def test_densities_add_up_to_the_errors_of_a_certificate():
    """Signed: η_n by adjoint variables, and by the corrected run as a whole."""
    numbers = jax.tree.map(jnp.asarray, P)
    begin, end = jnp.zeros(()), jnp.asarray(T1)
    rows = defect_densities((EARLY,), build, None, numbers, begin, end, PILOT, lg.GeneralizedAlpha()).rows
    one = lg.certify(EARLY, build, P, t1=T1, num_steps=PILOT)
    of_value, of_gradient = one.relative
    assert np.sign(rows[0, 0].sum()) == np.sign(one.value_error)
    np.testing.assert_allclose(abs(rows[0, 0].sum()), of_value, rtol=0.05)  # Gregory's rule, and h of the errors
    np.testing.assert_allclose(np.linalg.norm(rows[0, 1:].sum(1)), of_gradient, rtol=0.05)


@pytest.mark.slow  # where the steps are is in the quick run
def test_a_tolerance_is_reached(early):
    found = lg.steps_for(EARLY, build, P, tolerance=3e-4, **SCENE)
    assert max(float(found.value_error), float(found.gradient_error)) <= 3e-4
    assert max(relative_errors(found.integrator, found.num_steps)) <= 3e-4
    fewer = lg.steps_for(EARLY, build, P, num_steps=int(0.8 * found.num_steps), **SCENE)
    assert max(float(fewer.value_error), float(fewer.gradient_error)) > 3e-4  # so many were needed


def test_a_run_that_is_elsewhere_does_not_confirm_its_steps():
    """Two criteria, of two parameters, on a pilot whose own errors are 1e-3 of values and gradients."""
    rows = jnp.full((2, 3, PILOT), 1e-3 / PILOT)
    values, slopes = jnp.asarray([2.0, -3.0]), jnp.asarray([[1.0, 0.5], [0.3, 4.0]])
    pilot = Densities(rows, values, slopes, jnp.eye(2), None)
    confirmed = lambda values, slopes: _confirmed(pilot, 3e-3, list(values), [{"a": a, "b": b} for a, b in slopes])
    allowed = 3e-3 + 0.1 * 1e-3 * np.asarray([1.0, np.sqrt(2.0)])  # gradients by norms
    assert confirmed(values, slopes)
    for factor, holds in ((0.99, True), (1.01, False)):
        off = values.at[1].multiply(1.0 + factor * allowed[0])
        assert confirmed(off, slopes) == holds
        turned = slopes.at[0].add(factor * allowed[1] * jnp.asarray([-0.5, 1.0]))  # as long as itself
        assert confirmed(values, turned) == holds
    assert not confirmed(values.at[0].set(jnp.nan), slopes)
    assert not confirmed(values, slopes.at[1, 1].set(jnp.nan))


@pytest.mark.slow  # of quick ones, whether steps are confirmed
@pytest.mark.parametrize(
    ("name", "least", "most"), [("simple_pendulum_A01", 1.0, 1.5), ("slider_crank_sundials", 6.0, 10.0)]
)
def test_steps_behind_a_criterion_are_as_long_as_the_motion_lets_them(name, least, most):
    """A criterion that looks at the begin. Newton's iteration fails in steps of three of the pilot's on the pendulum;
    the crank takes eight."""
    problem = PROBLEMS[name]
    p = jax.tree.map(lambda value: jnp.asarray(value, float), problem.parameters)
    look = lambda s, p: jnp.exp(-(((s.t / problem.t1 - 0.1) / 0.03) ** 2)) * jnp.sum(s.state.v**2)
    criterion, scheme = lg.Criterion(integrand=look), lg.GeneralizedAlpha(problem.rho_inf)
    pilot = problem.num_steps // 2
    steps = lg.steps_for(criterion, problem.build, p, t1=problem.t1, pilot=pilot, tolerance=1e-3, integrator=scheme)
    assert least <= float(steps.integrator.fractions.max()) * pilot <= most
    of = lambda n, how: lg.differentiate(criterion, problem.build, p, t1=problem.t1, num_steps=n, integrator=how)[:2]
    for found, true in zip(of(steps.num_steps, steps.integrator), of(16 * problem.num_steps, scheme)):
        found, true = (np.asarray(ravel_pytree(part)[0]) for part in (found, true))
        assert np.linalg.norm(found - true) <= 1e-3 * np.linalg.norm(true)


@pytest.mark.slow  # programs of two criteria, and of a batch
def test_steps_serve_several_criteria():
    found = lg.steps_for(BOTH, build, P, tolerance=3e-4, **SCENE)
    for name in BOTH:
        assert max(float(found.value_error[name]), float(found.gradient_error[name])) <= 3e-4
    assert max(relative_errors(found.integrator, found.num_steps)) <= 3e-4
    assert max(relative_errors(found.integrator, found.num_steps, CRITERION, exact)) <= 3e-4


@pytest.mark.slow
def test_each_design_of_a_batch_has_its_own_steps(early):
    stiffness = jnp.asarray([P["k"], 2.0 * P["k"]])

    @jax.jit
    def run(k):
        p = P | {"k": k}
        steps = lg.steps_for(EARLY, build, p, num_steps=60, **SCENE)
        trajectory = lg.simulate(build(p), t1=T1, num_steps=60, integrator=steps.integrator, throw=False)
        return EARLY(trajectory), steps.integrator.fractions

    values, fractions = jax.vmap(run)(stiffness)
    np.testing.assert_allclose(fractions[0], early.integrator.fractions, rtol=1e-6)  # thirty iterations of round-off
    assert float(jnp.abs(fractions[0] - fractions[1]).max()) > 1e-4
    slope = jax.grad(lambda k: run(k)[0])(stiffness[1])
    frozen = lg.GivenSteps(fractions[1])
    on_them = lg.differentiate(EARLY, build, P | {"k": stiffness[1]}, t1=T1, num_steps=60, integrator=frozen)
    np.testing.assert_allclose(values[1], on_them.value, rtol=1e-11)
    np.testing.assert_allclose(slope, on_them.gradient["k"], rtol=1e-9)  # the steps are constants for derivatives


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"criteria": lambda run, p: run.t[-1]}, ("`criteria`", "Criterion")),
        ({"pilot": 4}, ("`pilot`", "8", "4")),
        ({"num_steps": 60, "tolerance": 1e-3}, ("either `tolerance`", "`num_steps`")),
        ({}, ("either `tolerance`", "`num_steps`")),
        ({"num_steps": 20}, ("`num_steps` = 20", "100", "at least 34")),
        ({"tolerance": 2.0}, ("`tolerance`", "between 0 and 1")),
        ({"num_steps": 60, "integrator": lg.GeneralizedAlpha(stabilized=True)}, ("index 3", "AdaptiveSteps")),
        ({"num_steps": 60, "integrator": lg.AdaptiveSteps()}, ("`integrator`", "GeneralizedAlpha")),
        ({"num_steps": 60, "build": P}, ("`build`", "function")),
        ({"num_steps": 60, "p": {}}, ("`p`", "at least one number")),
    ],
)
def test_bad_input(changed, message):
    arguments = {"criteria": EARLY, "build": build, "p": P, "pilot": PILOT} | changed
    with pytest.raises(ValueError, match=says(*message)):
        lg.steps_for(arguments.pop("criteria"), arguments.pop("build"), arguments.pop("p"), t1=T1, **arguments)


def test_a_pilot_that_resolves_nothing_is_refused():
    """ωh = 14."""
    with pytest.raises(ValueError, match=says("`pilot` = 100", "do not resolve", "more steps")):
        lg.steps_for(EARLY, build, P | {"k": 4e6}, tolerance=1e-3, **SCENE)


def test_a_tolerance_inside_of_jit_is_refused():
    run = lambda k: lg.steps_for(EARLY, build, P | {"k": k}, tolerance=1e-3, **SCENE).value_error
    with pytest.raises(ValueError, match=says("`tolerance`", "`num_steps`")):
        eqx.filter_jit(run)(jnp.asarray(P["k"]))


def test_forces_that_depend_on_multipliers_are_refused():
    def rubbing(p):
        body = lg.RigidBody(p["m"], (0.1, 0.1, 0.1), position=(0.0, 0.0, 1.0))
        hinge = lg.RevoluteJoint(None, "mass", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
        friction = lg.JointFriction("hinge", coefficient=0.1, slip_speed=1e-2, radius=0.01)
        return lg.Model({"mass": body}, {"hinge": hinge}, {"friction": friction})

    with pytest.raises(ValueError, match=says("friction in joints", "AdaptiveSteps")):
        lg.steps_for(EARLY, rubbing, P, num_steps=60, **SCENE)
