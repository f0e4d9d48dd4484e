"""`minimize` where the optimum is known in closed form, or by another method."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from helpers import says

from lgsens import soft_maximum
from lgsens.optimize import Minimization, minimize

NO_CONSTRAINTS = jnp.zeros(0)


def disc(x):
    """The point of the unit disc closest to (2, 1): (2, 1)/√5, at a squared distance of (√5 − 1)²."""
    return (x["a"] - 2.0) ** 2 + (x["b"] - 1.0) ** 2, jnp.stack([x["a"] ** 2 + x["b"] ** 2 - 1.0])


BOX = {"a": -2.0, "b": -2.0}, {"a": 2.0, "b": 2.0}


def quiet(fun, x0, lower, upper, num_steps=200, **options):
    return minimize(fun, x0, lower=lower, upper=upper, num_steps=num_steps, progress=False, **options)


def test_the_optimum_on_an_active_constraint():
    bounds = ({"a": -2.0, "b": -2.0}, {"a": 2.0, "b": 2.0})
    result = quiet(disc, {"a": -1.0, "b": 0.0}, *bounds)
    assert result.reason == "converged" and result.feasible
    assert result.step == len(result.history.objective) - 1 < 50
    # g = |x|² − 1 is met to 1e-5; along the circle ∇L, 1e-5, is (√5 θ · 2)(4)/f(x₀), f(x₀) = 10.
    assert abs(float(result.constraints[0])) <= 1e-5
    assert result.objective == pytest.approx((np.sqrt(5) - 1) ** 2, abs=2 * (np.sqrt(5) - 1) * 1e-5)
    np.testing.assert_allclose([result.x["a"], result.x["b"]], np.array([2, 1]) / np.sqrt(5), rtol=0, atol=3e-5)
    # ∇f + |f(x₀)| μ ∇g = 0: (√5 − 1)/10
    assert float(result.multipliers[0]) == pytest.approx((np.sqrt(5) - 1) / 10, rel=1e-3)
    assert result.history.gradient_norm[-1] <= 1e-5 and result.history.complementarity[-1] <= 1e-5


@pytest.mark.parametrize("forward", [True, False])
@pytest.mark.parametrize(
    "x",
    [{"a": 0.5, "b": 1.7}, {"a": 0.25, "b": -2.0}, {"a": 2.0, "b": 2.0}, {"a": 3.0, "b": -2.5}],
    ids=["inside, constraint violated", "at two lower bounds", "at two upper bounds", "outside"],
)
def test_its_program_gives_the_gradient_of_the_objective_at_any_design(forward, x):
    """a by its logarithm."""
    bounds = {"lower": {"a": 0.25, "b": -2.0}, "upper": {"a": 2.0, "b": 2.0}}
    log = {"a": True, "b": False}
    program = Minimization(disc, {"a": 1.0, "b": 0.0}, **bounds, log_scale=log, forward=forward, progress=False)
    f, gradient = program.value_and_grad(x)
    # Some twenty roundings in numbers up to 16.
    assert f == pytest.approx((x["a"] - 2) ** 2 + (x["b"] - 1) ** 2, abs=4e-14)
    assert float(gradient["a"]) == pytest.approx(2 * (x["a"] - 2), abs=4e-14)
    assert float(gradient["b"]) == pytest.approx(2 * (x["b"] - 1), abs=4e-14)
    assert program(num_steps=100, progress=False).reason == "converged"


def test_a_program_searches_from_any_start():
    program = Minimization(disc, {"a": -1.0, "b": 0.0}, lower=BOX[0], upper=BOX[1], progress=False)
    found = program(num_steps=100, x0={"a": 0.5, "b": 1.5}, progress=False)
    again = quiet(disc, {"a": 0.5, "b": 1.5}, *BOX, num_steps=100)
    np.testing.assert_array_equal(found.history.objective, again.history.objective)
    with pytest.raises(ValueError, match=r"`x0` must lie within the bounds: b = 2\.5 is outside"):
        program(num_steps=1, x0={"a": 0.5, "b": 2.5}, progress=False)
    with pytest.raises(ValueError, match="must be like that of the program"):
        program(num_steps=1, x0={"a": 0.5}, progress=False)
    with pytest.raises(ValueError, match="`x` must be like that of the program"):
        program.value_and_grad({"a": 0.5})


@pytest.mark.parametrize("forward", [True, False])
def test_a_constraint_that_can_never_be_active_is_refused(forward):
    with pytest.raises(ValueError, match=r"A constraint is (−∞|not finite) at `x0`"):
        quiet(lambda x: (x**2, jnp.stack([-jnp.inf, x - 3.0])), jnp.asarray(1.0), -1.0, 2.0, forward=forward)


@pytest.mark.parametrize("forward", [True, False])
def test_a_search_from_a_bound_begins_with_the_whole_slope(forward):
    """f = (x − 1)² by z = x/0.1 at 0: −0.2, and not half of that, as the derivative of a clip has it."""
    found = quiet(lambda x: (x - 1.0) ** 2, jnp.asarray(0.0), 0.0, 0.1, num_steps=1, forward=forward)
    assert found.history.gradient_norm[0] == pytest.approx(0.2, rel=1e-15)  # rounding of 0.1 and of the slope


@pytest.mark.parametrize("forward", [True, False])
def test_an_objective_that_knows_nothing_of_the_variables_is_said(forward):
    """Not where only the box holds the first step."""
    lost = lambda x: 3.0 + jax.lax.stop_gradient(x["a"]) ** 2
    with pytest.warns(UserWarning, match="gradient of the objective is zero at `x0`"):
        quiet(lost, {"a": 1.0}, {"a": -2.0}, {"a": 2.0}, forward=forward)
    held = quiet(lambda x: x["a"], {"a": -2.0}, {"a": -2.0}, {"a": 2.0}, forward=forward)
    assert held.reason == "converged" and held.history.gradient_norm[0] == 0.0


@pytest.mark.parametrize("forward", [True, False])
def test_where_nothing_bounds_the_objective_it_does_not_converge(forward):
    """At x = 1e17, where a slope of 1 is less than round-off."""
    found = quiet(lambda x: -x[0], [1.0], None, None, num_steps=300, forward=forward)
    assert found.reason != "converged" and found.history.gradient_norm[-1] >= 1.0


@pytest.mark.parametrize(
    ("fun", "at", "expected"),
    [
        (lambda x: jnp.sqrt(x["a"]), -1.0, (np.nan, np.nan)),
        (lambda x: jnp.sqrt(x["a"]), 0.0, (0.0, np.inf)),
        (lambda x: ((x["a"] - 1.0) ** 2, jnp.stack([jnp.sqrt(x["a"]) - 9.0])), -1.0, (4.0, -4.0)),
    ],
    ids=["objective", "gradient", "constraint"],
)
def test_a_gradient_where_something_is_not_finite(fun, at, expected):
    """In reverse mode as in forward mode: that of the objective, and not zero."""
    for forward in (True, False):
        program = Minimization(fun, {"a": 1.0}, lower={"a": -2.0}, upper={"a": 2.0}, forward=forward, progress=False)
        value, gradient = program.value_and_grad({"a": at})
        np.testing.assert_allclose((value, gradient["a"]), expected, rtol=1e-14)


def test_a_tight_tolerance_is_reached():
    result = quiet(disc, {"a": -1.0, "b": 0.0}, {"a": -2.0, "b": -2.0}, {"a": 2.0, "b": 2.0}, tolerance=1e-10)
    assert result.reason == "converged"
    # As above with 1e-10.
    assert result.objective == pytest.approx((np.sqrt(5) - 1) ** 2, abs=3e-10)


def test_a_path_constraint_is_met_at_every_time():
    t = jnp.linspace(0.0, np.pi, 101)  # π/2 is the sample 50

    def fun(x):
        return -x[0] + 0.1 * x[1] ** 2, x[0] * jnp.sin(t) - 1.0

    result = quiet(fun, jnp.asarray([0.2, 0.7]), jnp.asarray(0.0), jnp.asarray(3.0))
    # max(a sin t) ≤ 1 is a ≤ 1, up to the tolerance of σ; b is free and quadratic: 0.2 b/|f(x₀)| · 3² is ∇L.
    assert float(result.x[0]) == pytest.approx(1.0, abs=1e-5)
    assert float(result.x[1]) == pytest.approx(0.0, abs=1e-5)
    # ∂f/∂a + |f(x₀)| Σ μ sin t = 0 with |f(x₀)| = 0.151; ∇L is met to 1e-5, of μ 6.6.
    assert np.argmax(result.multipliers) == 50
    assert np.sum(result.multipliers * np.sin(t)) == pytest.approx(1 / 0.151, rel=1e-4)
    assert result.constraints.shape == (101,)


def test_the_aggregate_is_one_constraint_on_the_safe_side():
    t = jnp.linspace(0.0, np.pi, 101)
    sharpness = 200.0

    def fun(x):
        return -x[0], soft_maximum(x[0] * jnp.sin(t) - 1.0, sharpness)

    result = quiet(fun, jnp.asarray([0.2]), jnp.asarray(0.0), jnp.asarray(3.0))
    assert result.multipliers.shape == ()
    # max g ≤ KS ≤ max g + ln(101)/ρ, and KS = 0 at the optimum to 1e-5.
    assert 1.0 - np.log(101) / sharpness - 1e-5 <= float(result.x[0]) < 1.0


def test_the_optimum_on_a_bound_is_exactly_there():
    x0, lower, upper = jnp.asarray([1.0, 2.0]), jnp.asarray([0.5, -1.0]), jnp.asarray(3.0)
    result = quiet(lambda x: (jnp.sum(x**2), NO_CONSTRAINTS), x0, lower, upper)
    assert float(result.x[0]) == 0.5  # projected, so no round-off
    assert float(result.x[1]) == pytest.approx(0.0, abs=1e-5)  # 2 b · 4/|f(x₀)|, f(x₀) = 5, is ∇L: 1e-5
    assert result.feasible and result.history.worst_constraint[0] == -np.inf


def test_many_variables_on_many_bounds():
    """Against L-BFGS-B of SciPy, another method, from the same start."""

    def valley(x):
        return jnp.sum(100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2)

    x0 = np.full(12, -0.5)
    result = quiet(lambda x: (valley(x), NO_CONSTRAINTS), jnp.asarray(x0), jnp.asarray(-2.0), jnp.asarray(0.8))
    value_and_grad = jax.jit(jax.value_and_grad(valley))
    found = scipy.optimize.minimize(
        value_and_grad, x0, jac=True, method="L-BFGS-B", bounds=[(-2.0, 0.8)] * 12, options={"ftol": 1e-15}
    )
    assert result.reason == "converged"
    # f − f* ~ ∇L²/curvature: (1e-5)² f(x₀) over a curvature of 2 · 2.8²/f(x₀), f(x₀) = 662
    assert result.objective == pytest.approx(found.fun, rel=1e-5)
    assert float(result.x[0]) == found.x[0] == 0.8
    assert len(result.history.objective) <= 2 * found.nfev


def test_a_logarithmic_scale_spans_decades():
    def fun(x):
        return jnp.log(x["rate"] / 20.0) ** 2 + (x["offset"] - 0.5) ** 2, NO_CONSTRAINTS

    bounds = ({"rate": 1.0, "offset": -1.0}, {"rate": 1e5, "offset": 1.0})
    result = quiet(fun, {"rate": 9e4, "offset": 0.0}, *bounds, log_scale={"rate": True, "offset": False})
    # ∇L = 2 Δ (width of the box)/f(x₀), f(x₀) = 71, is 1e-5: Δ = 3e-5 with the width ln 1e5, 2e-4 with 2.
    assert float(result.x["rate"]) == pytest.approx(20.0, rel=4e-5)
    assert float(result.x["offset"]) == pytest.approx(0.5, abs=2e-4)
    assert np.all(result.history.design["rate"] <= 1e5)


def test_an_infeasible_start_becomes_feasible():
    result = quiet(disc, {"a": 1.9, "b": -1.9}, {"a": -2.0, "b": -2.0}, {"a": 2.0, "b": 2.0})
    assert result.history.worst_constraint[0] > 1
    assert result.reason == "converged" and result.feasible
    assert result.objective == pytest.approx((np.sqrt(5) - 1) ** 2, abs=3e-5)


def test_an_infeasible_problem_says_so_and_returns_the_least_violation():
    def fun(x):
        return x**2, jnp.stack([1.0 - x, x + 1.0])  # x ≥ 1 and x ≤ −1

    result = quiet(fun, 1.5, -2.0, 2.0)
    assert result.reason == "infeasible" and not result.feasible
    assert len(result.history.objective) < 100
    # max(1 − x, 1 + x) is least, 1, at 0, where the multipliers of both grow alike.
    assert np.max(result.constraints) == pytest.approx(1.0, abs=1e-3)


def test_steps_that_run_out_keep_the_best_that_is_feasible():
    bounds = ({"a": -2.0, "b": -2.0}, {"a": 2.0, "b": 2.0})
    result = quiet(disc, {"a": -1.0, "b": 0.0}, *bounds, num_steps=8)
    history = result.history
    assert result.reason == "steps" and len(history.objective) == 8
    feasible = np.where(history.worst_constraint <= 1e-3, history.objective, np.inf)
    assert result.step == np.argmin(feasible) and result.objective == np.min(feasible)
    assert float(result.x["a"]) == history.design["a"][result.step]


def test_the_whole_loop_is_traced_once():
    traces = []

    def fun(x):
        traces.append(x)
        return disc(x)

    steps = []
    result = quiet(
        fun,
        {"a": -1.0, "b": 0.0},
        {"a": -2.0, "b": -2.0},
        {"a": 2.0, "b": 2.0},
        num_steps=9,
        tolerance=0.0,
        callback=lambda *args: steps.append(args),
    )
    assert len(traces) == 1
    assert [step for step, _, _ in steps] == list(range(9))
    assert [f for _, f, _ in steps] == list(result.history.objective)
    assert result.history.design["a"].shape == (9,)


def test_a_step_out_of_the_domain_is_halved():
    def fun(x):
        return jnp.where(x > 0.7, jnp.nan, -x), NO_CONSTRAINTS

    result = quiet(fun, 0.0, -1.0, 1.0, num_steps=60)
    assert np.any(np.isnan(result.history.objective))
    # The edge is approached until a step halved ten times still leaves the domain: 0.2 · 2 · 2⁻¹⁰.
    assert result.reason == "stalled"
    assert float(result.x) == pytest.approx(0.7, abs=4e-4) and float(result.x) <= 0.7
    assert result.objective == -float(result.x)


def rosenbrock(x):
    return jnp.sum(100 * (x["b"] - x["a"] ** 2) ** 2 + (1 - x["a"]) ** 2)


def test_a_function_without_forward_mode():
    """As `simulate(…, sensitivity=AdjointVariable())` is one."""
    square = jax.custom_vjp(lambda x: x**2)
    square.defvjp(lambda x: (x**2, x), lambda x, c: (2.0 * x * c,))
    fun = lambda x: (square(x - 1.0), x[None] - 0.5)
    with pytest.raises(ValueError, match=says("forward mode does not pass through", "`forward=False`")):
        quiet(fun, jnp.asarray(0.0), 0.0, 2.0)
    assert quiet(fun, jnp.asarray(0.0), 0.0, 2.0, forward=False).x == pytest.approx(0.5, abs=1e-3)  # to the violation


@pytest.mark.parametrize("forward", [None, True])
def test_a_function_without_bounds_or_constraints(forward):
    result = quiet(rosenbrock, {"a": -1.2, "b": 1.0}, None, None, tolerance=1e-8, forward=forward)
    assert result.reason == "converged" and result.constraints.shape == (0,)
    # ∇ of f/24.2 is 1e-8: over its least curvature, 0.4, 6e-7.
    np.testing.assert_allclose([result.x["a"], result.x["b"]], [1.0, 1.0], rtol=0, atol=2e-6)


@pytest.mark.parametrize("forward", [None, True])
def test_bounds_on_one_side_and_optima_far_from_the_start(forward):
    """x0 says nothing of where the optimum is: 1e3, e¹⁰, the lower bound, the upper one."""

    def fun(x):
        far, rate, low, high = x["far"], x["rate"], x["low"], x["high"]
        return (far / 1e3 - 1) ** 2 + (jnp.log(rate) - 10) ** 2 + low + (high - 9.0) ** 2

    x0 = {"far": 0.1, "rate": 1.0, "low": 3.0, "high": -7.0}
    lower = {"far": None, "rate": None, "low": 2.0, "high": -np.inf}
    upper = {"far": np.inf, "rate": None, "low": np.inf, "high": 4.0}
    log_scale = {"far": False, "rate": True, "low": False, "high": False}
    result = quiet(fun, x0, lower, upper, tolerance=1e-9, log_scale=log_scale, forward=forward)
    assert result.reason == "converged"
    # of reverse mode they are projected; SLSQP adds steps up to the bound, with the round-off of 11 on the way to 4
    round_off = 1e-14 if forward else 0.0
    assert 2.0 <= float(result.x["low"]) <= 2.0 + round_off and 4.0 - round_off <= float(result.x["high"]) <= 4.0
    # A unit of z is 0.1 for "far", where f/361 is as flat as 2e-8/361.
    assert float(result.x["rate"]) == pytest.approx(np.exp(10.0), rel=1e-6)


def test_constraints_without_bounds():
    result = quiet(disc, {"a": -1.0, "b": 0.0}, None, None)
    assert result.reason == "converged"
    np.testing.assert_allclose([result.x["a"], result.x["b"]], np.array([2, 1]) / np.sqrt(5), rtol=0, atol=3e-5)


@pytest.mark.parametrize("missing", [True, False])
def test_the_bar_is_optional(missing, monkeypatch, capsys):
    if missing:
        monkeypatch.setitem(sys.modules, "tqdm", None)
    result = minimize(lambda x: (x**2, NO_CONSTRAINTS), 0.5, lower=-1.0, upper=1.0, num_steps=3, tolerance=0.0)
    assert len(result.history.objective) == 3
    shown = capsys.readouterr().err
    assert ("3/3" in shown) == (not missing)
    assert shown.startswith("compiling objective, constraints and their derivatives … ")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lower": 2.0}, r"`lower` must be below `upper`, got 2.0 and 1.0 for x"),
        ({"x0": 3.0}, r"`x0` must lie within the bounds: x = 3.0 is outside \[-1.0, 1.0\]"),
        ({"lower": jnp.zeros(3)}, r"`lower` must have shape \(\) or \(\), got shape \(3,\)"),
        ({"upper": {"k": 1.0}}, r"`upper` must be a pytree like `x0`"),
        ({"num_steps": 0}, r"`num_steps` must be at least 1, got 0"),
        ({"num_steps": 2.5}, r"`num_steps` must be a Python int, got 2.5"),
        ({"tolerance": -1.0}, r"`tolerance` must not be negative, got -1.0"),
        ({"constraint_tolerance": -1.0}, r"`constraint_tolerance` must be positive, got -1.0"),
        ({"log_scale": True}, r"A logarithmic scale needs positive bounds, got -1.0 for x"),
        ({"fun": lambda x: (jnp.log(x - 1.0), NO_CONSTRAINTS)}, r"not finite at `x0`"),
        ({"fun": lambda x: (x, jnp.stack([x * jnp.nan]))}, r"not finite at `x0`"),
        (
            {"fun": lambda x: jnp.stack([x, x])},
            r"`fun` must return its objective, shape \(\), or a pair \(obj.*shape=\(2,\)",
        ),
        ({"fun": lambda x: (x, x, x)}, r"`fun` must return its objective, shape \(\), or a pair"),
        ({"fun": lambda x: (x, [x])}, r"`fun` must return its objective, shape \(\), or a pair"),
        ({"lower": np.inf, "upper": np.inf}, r"`lower` must be below `upper`, got inf and inf for x"),
        ({"lower": np.nan}, r"`lower` must be below `upper`, got nan and 1.0 for x"),
        ({"x0": np.inf, "upper": None}, r"`x0` must be finite, got inf for x"),
        ({"x0": -0.5, "lower": None, "log_scale": True}, r"A logarithmic scale needs positive `x0`, got -0.5 for x"),
        ({"x0": {}, "lower": {}, "upper": {}}, r"`x0` has no arrays"),
    ],
)
def test_bad_input(options, message):
    arguments = {
        "fun": lambda x: (x**2, NO_CONSTRAINTS),
        "x0": 0.5,
        "lower": -1.0,
        "upper": 1.0,
        "num_steps": 2,
    }
    arguments |= options
    with pytest.raises(ValueError, match=message):
        minimize(arguments.pop("fun"), arguments.pop("x0"), progress=False, **arguments)


def test_the_name_of_a_bad_entry_is_told():
    x0 = {"points": jnp.zeros((2, 3))}
    lower = {"points": jnp.full((2, 3), -1.0).at[1, 2].set(0.5)}
    with pytest.raises(ValueError, match=r"points\[1, 2\] = 0.0 is outside \[0.5, 1.0\]"):
        minimize(lambda x: (0.0, NO_CONSTRAINTS), x0, lower=lower, upper={"points": 1.0}, num_steps=1)
