"""`differentiate` itself: structures, explicit parameters, memory, factorizations, advice, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import equations, says, some_quick

import lgsens as lg
from lgsens.examples import spinning_top
from lgsens.linear import LU
from lgsens.sensitivity._step_blocks import StepBlocks

SIDE = lg.Criterion(integrand=lambda s, p: s.body("top").position[0] ** 2)
SETTINGS = {"t1": 0.2, "num_steps": 40}


def build(p):
    return spinning_top(p["alpha0"], p["mass"], length=p["length"])


P = {"alpha0": 0.7, "mass": 15.0, "length": jnp.asarray(1.0)}
CRITERIA = {
    "side": SIDE,
    "others": (
        lg.Criterion(terminal=lambda s, p: p["mass"] * s.body("top").position[2]),
        lg.Criterion(
            integrand=lambda s, p: s.t * p["length"] * s.body("top").acceleration[1] ** 2,
            terminal=lambda s, p: s.multiplier("pivot")[0] + p["alpha0"] ** 3,
        ),
    ),
}


def psi(criterion, p, **settings):
    return criterion(lg.simulate(build(p), **SETTINGS, **settings), p)


@pytest.fixture(scope="module")
def by_jax():
    """The gradients by jax.grad of the criterion of a trajectory."""
    p = jax.tree.map(jnp.asarray, P)
    is_criterion = lambda leaf: isinstance(leaf, lg.Criterion)

    def all_of(p):
        values = jax.tree.map(lambda c: psi(c, p), CRITERIA, is_leaf=is_criterion)
        return values, values

    gradients, values = jax.jit(jax.jacrev(all_of, has_aux=True))(p)
    return values, gradients


@pytest.mark.parametrize(
    "method",
    some_quick([lg.AdjointVariable(), lg.DirectDifferentiation(), lg.ContinuousAdjoint()]),
    ids=lambda m: type(m).__name__,
)
def test_structures_and_explicit_parameters(method, by_jax):
    """Nested criteria, F and G of one criterion, both with explicit dependence on p, t, v̇ and λ."""
    found = lg.differentiate(CRITERIA, build, P, method=method, **SETTINGS)
    assert jax.tree.structure(found[:2]) == jax.tree.structure(by_jax)
    # the continuous method differs by its error, (10 rad/s × 5e-3 s)² on derivatives that cancel by a digit
    rtol = 2e-2 if isinstance(method, lg.ContinuousAdjoint) else 1e-9
    for actual, expected in zip(jax.tree.leaves(found.value), jax.tree.leaves(by_jax[0])):
        np.testing.assert_allclose(actual, expected, rtol=1e-9)  # λ carries round-off of 150 N / h²
    for name, wanted in {"side": by_jax[1]["side"], 0: by_jax[1]["others"][0], 1: by_jax[1]["others"][1]}.items():
        actual = found.gradient["side"] if name == "side" else found.gradient["others"][name]
        size = max(abs(float(wanted[k] * P[k])) for k in P)
        for k in P:
            np.testing.assert_allclose(
                actual[k] * P[k], wanted[k] * P[k], rtol=0, atol=rtol * size, err_msg=f"{name} {k}"
            )


@pytest.mark.slow  # README does it in the quick run
def test_with_respect_to_a_whole_model():
    """p may be a Model; the gradient is again one."""
    model = spinning_top(jnp.asarray(0.7))
    found = lg.differentiate(SIDE, lambda model: model, model, method=lg.AdjointVariable(), **SETTINGS)
    expected = jax.jit(jax.grad(lambda m: SIDE(lg.simulate(m, **SETTINGS))))(model)
    assert jax.tree.structure(found.gradient) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found.gradient), jax.tree.leaves(expected)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * float(jnp.abs(b).max()))


@pytest.mark.slow
@pytest.mark.parametrize("method", [lg.DirectDifferentiation(), lg.ContinuousAdjoint()], ids=["direct", "continuous"])
def test_start_from_a_given_state(method):
    """`state0` as a function of p: its derivative counts; two runs in a row are one."""
    p = {"alpha0": 0.7, "mass": 15.0, "length": 1.0}
    middle = lambda p: lg.simulate(build(p), t1=0.1, num_steps=20).state(-1)
    second = lg.differentiate(SIDE, build, p, t0=0.1, t1=0.2, num_steps=20, state0=middle, method=method)
    first = lg.differentiate(SIDE, build, p, t1=0.1, num_steps=20, method=method)
    whole = lg.differentiate(SIDE, build, p, method=method, **SETTINGS)
    # The discrete method is exact; the adjoint equations of the two halves are two integrations, O(h²)
    rtol = 1e-9 if isinstance(method, lg.DirectDifferentiation) else 1e-2
    for name, value in whole.gradient.items():
        np.testing.assert_allclose(first.gradient[name] + second.gradient[name], value, rtol=rtol)


def temporary_memory(method, num_steps):
    run = lambda p: lg.differentiate(SIDE, build, p, t1=1.0, num_steps=num_steps, method=method).gradient
    analysis = jax.jit(run).lower(jax.tree.map(jnp.asarray, P)).compile().memory_analysis()
    assert analysis is not None
    return analysis.temp_size_in_bytes


@pytest.mark.slow  # three compilations
def test_direct_differentiation_stores_no_trajectory():
    """On the fly: what grows with the steps is Newton's statistics, four numbers a step, not the 33 of a state."""
    grown = temporary_memory(lg.DirectDifferentiation(), 2000) - temporary_memory(lg.DirectDifferentiation(), 1000)
    assert grown <= 1000 * 8 * 8
    assert temporary_memory(lg.AdjointVariable(), 2000) > 2000 * 33 * 8  # that one keeps the states


@pytest.mark.parametrize(
    "method",
    some_quick([lg.DirectDifferentiation(), lg.AdjointVariable(), lg.ContinuousAdjoint(None)]),
    ids=lambda m: type(m).__name__,
)
def test_one_factorization_for_all_parameters_and_criteria(method, monkeypatch):
    """Factors in the program: as many for three parameters and criteria as for one of each, and not in a batch,
    except over the steps of a block."""
    made = []
    block = (StepBlocks.of(SETTINGS["num_steps"], 81).length, 9, 9)
    original = LU.of.__func__

    def counted(cls, matrix):
        factors = original(cls, matrix)
        made.append(factors.lu.shape)
        return factors

    monkeypatch.setattr(LU, "of", classmethod(counted))

    def factorizations(criteria, build, p):
        made.clear()
        jax.clear_caches()  # what has been traced before makes none
        jaxpr = jax.make_jaxpr(lambda p: lg.differentiate(criteria, build, p, method=method, **SETTINGS).gradient)(p)
        batched = [s for s in _lu_shapes(jaxpr.jaxpr) if s not in ((9, 9), block)]
        return len(made), batched

    three = {"a": SIDE, "b": CRITERIA["others"][0], "c": lg.Criterion(integrand=lambda s, p: s.body("top").velocity[1])}
    one_p = lambda alpha0: build({**P, "alpha0": alpha0})
    p = jax.tree.map(jnp.asarray, P)
    many, batched = factorizations(three, build, p)
    one, _ = factorizations(SIDE, one_p, p["alpha0"])
    assert many == one > 0
    assert batched == []


def _lu_shapes(jaxpr):
    """The shapes of the matrices of 6 coordinates and 3 constraints that the program factorizes."""
    shapes = (equation.invars[0].aval.shape for equation in equations(jaxpr) if equation.primitive.name == "lu")
    return [shape for shape in shapes if shape[-1] == 9]


def test_advice():
    """Few parameters and many criteria: direct; many parameters and one criterion: adjoint; by cost, and it says so."""
    assert isinstance(lg.direct_or_adjoint(2, 200).method, lg.DirectDifferentiation)
    advice = lg.direct_or_adjoint(2, 1, active_constraints=400)
    assert isinstance(advice.method, lg.DirectDifferentiation)
    assert "401 criteria" in advice.reason and advice.direct_cost < advice.adjoint_cost
    assert isinstance(lg.direct_or_adjoint(500).method, lg.AdjointVariable)
    dear = lg.Costs(direct_fixed=1.0, direct_per_parameter=10.0, adjoint_fixed=1.0, adjoint_per_criterion=0.1)
    assert isinstance(lg.direct_or_adjoint(2, 3, costs=dear).method, lg.AdjointVariable)
    for bad, message in (((0, 1), "num_parameters"), ((1, 0), "num_criteria"), ((1.5, 1), "num_parameters")):
        with pytest.raises(ValueError, match=message):
            lg.direct_or_adjoint(*bad)
    with pytest.raises(ValueError, match=says("active_constraints", "-1")):
        lg.direct_or_adjoint(1, 1, active_constraints=-1)


def test_the_advice_is_taken():
    found = lg.differentiate(SIDE, build, P, **SETTINGS)
    assert found.method == lg.direct_or_adjoint(3, 1).method


@pytest.mark.slow  # five compilations
def test_measured_costs():
    """Costs are in simulations: at least one for either method, and further right-hand sides are cheaper than runs."""
    costs = lg.measure_costs(CRITERIA, build, P, repeats=3, t1=0.2, num_steps=100)
    assert costs.direct_fixed + costs.direct_per_parameter > 0.5
    assert costs.adjoint_fixed + costs.adjoint_per_criterion > 0.5
    assert costs.direct_per_parameter > 0.0 and costs.adjoint_per_criterion > 0.0


def attempt(criteria=SIDE, p=P, scene=build, **settings):
    return lg.differentiate(criteria, scene, p, **(SETTINGS | settings))


VELOCITY = lg.Criterion(integrand=lambda s, p: s.body("top").velocity)
ACCELERATION = lg.Criterion(integrand=lambda s, p: s.body("top").acceleration[0] ** 2)
FINAL_FORCE = lg.Criterion(terminal=lambda s, p: s.multiplier("pivot")[0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"criteria": VELOCITY}, says("integrand", "scalar", "shape (3,)", "jnp.sum")),
        ({"criteria": lg.Criterion(terminal=lambda s, p: None)}, says("terminal", "scalar", "NoneType")),
        ({"criteria": lg.Criterion(terminal=lambda s, p: s.t > 0)}, says("terminal", "real number", "bool")),
        ({"criteria": SIDE.integrand}, says("`criteria`", "Criterion")),
        ({"criteria": {}}, says("`criteria`", "Criterion", "{}")),
        ({"scene": spinning_top(0.7)}, says("`build`", "function")),
        ({"p": {"alpha0": "x"}}, says("`p`['alpha0']", "number")),
        ({"p": {}}, says("`p`", "at least one number")),
        ({"method": "adjoint"}, says("`method`", "AdjointVariable()", "'adjoint'")),
        ({"num_steps": 2.5}, says("num_steps", "2.5")),
        ({"t1": -1.0}, says("`t1`", "later")),
        ({"method": lg.ContinuousAdjoint(), "num_steps": 3}, says("num_steps", "at least 4", "3", "AdjointVariable()")),
        (
            {"criteria": {"comfort": ACCELERATION}, "method": lg.ContinuousAdjoint(None)},
            says("comfort", "accelerations", "DirectDifferentiation()", "'state'", "'first_order'"),
        ),
        (
            {"criteria": FINAL_FORCE, "method": lg.ContinuousAdjoint("first_order")},
            says("terminal", "multipliers", "AdjointVariable()", "'state'"),
        ),
        (
            {"method": lg.IndexReduced(), "scene": build, "state0": lambda p: lg.initial_state(build(p))},
            says("IndexReduced", "state0"),
        ),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        attempt(**arguments)


@pytest.mark.parametrize(
    ("construct", "message"),
    [
        (lambda: lg.Criterion(), says("Criterion", "integrand", "terminal")),
        (lambda: lg.Criterion(integrand=3.0), says("`integrand`", "function", "3.0")),
        (lambda: lg.ContinuousAdjoint("exact"), says("accelerations", "'state'", "'exact'")),
        (lambda: lg.FiniteDifferences(-1.0), says("`step`", "-1.0")),
        (lambda: lg.IndexReduced(rtol=0.0), says("`rtol`", "0.0")),
        (
            lambda: lg.simulate(build(P), sensitivity=lg.ContinuousAdjoint(), **SETTINGS),
            says("`sensitivity`", "ContinuousAdjoint", "Criterion", "differentiate"),
        ),
    ],
)
def test_bad_values_of_methods(construct, message):
    with pytest.raises(ValueError, match=message):
        construct()


def door(p):
    """A door on two hinges: ten equations for six coordinates, of which five are independent."""
    e_z = jnp.array([0.0, 0.0, 1.0])
    hinge = lambda z: lg.RevoluteJoint(None, "door", at=jnp.array([0.0, 0.0, z]), axis=e_z)
    body = lg.RigidBody(mass=p, inertia=(1.0, 1.0, 1.0), position=(0.5, 0.0, 0.0), angular_velocity=e_z)
    return lg.Model({"door": body}, {"upper": hinge(0.5), "lower": hinge(-0.5)})


@pytest.mark.slow
def test_a_criterion_of_multipliers_that_are_not_unique():
    criterion = {"pull": lg.Criterion(integrand=lambda s, p: s.multiplier("upper")[0] ** 2)}
    with pytest.raises(ValueError, match=says("pull", "multipliers", "not unique", "lower", "upper")):
        lg.differentiate(criterion, door, 10.0, t1=0.1, num_steps=10, method=lg.AdjointVariable())


def test_a_failed_simulation_raises_or_says_so():
    """A step that is far too long: the error of `simulate`, or its result code with NaN."""
    fast = lambda p: spinning_top(0.7, p, spin=300.0)
    long_steps = {"t1": 2.0, "num_steps": 8, "integrator": lg.GeneralizedAlpha(max_iterations=2)}
    for method in (lg.DirectDifferentiation(), lg.AdjointVariable()):
        with pytest.raises(lg.SimulationError, match=says("step 1 of 8")):
            lg.differentiate(SIDE, fast, 15.0, method=method, **long_steps)
        found = lg.differentiate(SIDE, fast, 15.0, method=method, throw=False, **long_steps)
        assert found.result == lg.RESULTS.newton_failed
        assert np.isnan(found.value) and np.isnan(found.gradient)


def falls(mass):
    body = lg.RigidBody(mass, None, free="z")
    return lg.Model(
        {"stone": body},
        {},
        {"g": lg.Gravity((0.0, 0.0, -9.81)), "pull": lg.AppliedForce("stone", force=(0.0, 0.0, 3.0))},
    )


SPEED = lg.Criterion(integrand=lambda s, p: jnp.linalg.norm(s.body("stone").velocity))  # no derivative at rest
LATE = lg.Criterion(terminal=lambda s, p: jnp.log(s.body("stone").position[2]))  # of a height below zero
SLOPE = {"t1": 0.1, "num_steps": 8}


@pytest.mark.slow  # `test_a_failed_simulation_raises_or_says_so` is in the quick run
@pytest.mark.parametrize("method", some_quick([lg.DirectDifferentiation(), lg.AdjointVariable()]))
def test_what_is_not_finite_is_said_with_its_place(method):
    """The motion is as it should be; a gradient of NaN would go into the design without a word."""
    ask = lambda criterion, build=falls, **more: lg.differentiate(
        {"it": criterion}, build, 2.0, method=method, **SLOPE, **more
    )
    by_p = "'it'.*gradient by p is not finite, as the derivative of `integrand` is not finite at t = 0 s: jnp.linalg"
    with pytest.raises(ValueError, match=by_p):
        ask(SPEED)
    assert np.isnan(ask(SPEED, throw=False).gradient["it"])
    with pytest.raises(ValueError, match=r"value is nan, as `terminal` is not finite at t = 0.1 s"):
        ask(LATE)
    height = lg.Criterion(terminal=lambda s, p: s.body("stone").position[2])
    with pytest.raises(ValueError, match=r"gradient by p is not finite, though .* finite derivatives.*`build`"):
        ask(height, lambda mass: falls(2.0 + jnp.sqrt(mass - 2.0)))


@pytest.mark.slow  # a program of its own
def test_a_certificate_of_what_is_not_finite_is_not_good():
    found = lg.certify({"speed": SPEED, "late": LATE}, falls, 2.0, **SLOPE)
    for one, name in ((found["speed"], "dΨ/dp"), (found["late"], "Ψ")):
        assert not one.good and np.inf in one.relative
        assert f"{name} or its error is not finite" in one.warnings[0]
    with pytest.raises(ValueError, match="gradient by p is not finite"):
        lg.differentiate(SPEED, falls, 2.0, certificate=True, **SLOPE)


@pytest.mark.slow  # programs of their own
@pytest.mark.parametrize("criterion", [SPEED, LATE])
def test_no_accuracy_is_reached_by_what_is_not_finite(criterion):
    with pytest.raises(ValueError, match="is not finite at t = "):
        lg.differentiate(criterion, falls, 2.0, t1=0.1, accuracy=1e-3)
    with pytest.raises(ValueError, match="not finite; `differentiate` says where"):
        lg.steps_for(criterion, falls, 2.0, t1=0.1, pilot=16, tolerance=1e-2)


def test_a_criterion_of_a_batch_is_one_of_each():
    def run(tilt):
        body = lg.RigidBody(1.0, (0.1, 0.1, 0.1), velocity=jnp.array([0.0, 0.0, 1.0]) * tilt, free="z")
        return lg.simulate(lg.Model({"body": body}, {}), t1=0.1, num_steps=4, throw=False)

    batch = jax.vmap(run)(jnp.asarray([1.0, 2.0, 3.0]))
    speed = lg.Criterion(terminal=lambda s, p: jnp.sum(s.state.v**2) * (1.0 if p is None else p))
    np.testing.assert_allclose(speed(batch), [1.0, 4.0, 9.0], rtol=1e-14)  # no force acts
    np.testing.assert_allclose(jax.vmap(speed, in_axes=(0, None))(batch, 2.0), [2.0, 8.0, 18.0], rtol=1e-14)
    with pytest.raises(ValueError, match=r"batch of trajectories, of shape \(3,\).*jax.vmap\(criterion\)"):
        speed(batch, 2.0)
    with pytest.raises(ValueError, match=r"batch of trajectories; jax\.vmap"):
        lg.accuracy.error_estimate(batch)
