"""`minimize` where the optimum is known in closed form; `check_gradient` on right and wrong gradients."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lgsens.optimize import check_gradient, minimize

NO_CONSTRAINTS = jnp.zeros(0)


def disc(x):
    """The point of the unit disc closest to (2, 1): (2, 1)/√5, at a squared distance of (√5 − 1)²."""
    return (x["a"] - 2.0) ** 2 + (x["b"] - 1.0) ** 2, jnp.stack([x["a"] ** 2 + x["b"] ** 2 - 1.0])


def quiet(fun, x0, lower, upper, num_steps=200, **options):
    return minimize(fun, x0, lower=lower, upper=upper, num_steps=num_steps, progress=False, **options)


def test_the_optimum_on_an_active_constraint():
    bounds = ({"a": -2.0, "b": -2.0}, {"a": 2.0, "b": 2.0})
    result = quiet(disc, {"a": -1.0, "b": 0.0}, *bounds)
    assert result.feasible and np.max(result.constraints) <= 1e-3
    # A violation of 1e-3 of g = |x|² − 1 moves the point by 5e-4 outwards, f by 2 (√5 − 1) 5e-4 = 1.2e-3.
    assert result.objective == pytest.approx((np.sqrt(5) - 1) ** 2, abs=1.3e-3)
    # Along the circle f rises by √5 θ² only, so θ is known to the root of that error.
    np.testing.assert_allclose([result.x["a"], result.x["b"]], np.array([2, 1]) / np.sqrt(5), atol=0.025)


def test_a_path_constraint_is_met_at_every_time():
    t = jnp.linspace(0.0, np.pi, 101)  # π/2 is the sample 50

    def fun(x):
        return -x[0] + 0.1 * x[1] ** 2, x[0] * jnp.sin(t) - 1.0

    result = quiet(fun, jnp.asarray([0.2, 0.7]), jnp.asarray(0.0), jnp.asarray(3.0))
    # max(a sin t) ≤ 1 is a ≤ 1, up to the tolerance of the constraint; b is free and quadratic.
    assert 1 - 1e-3 <= float(result.x[0]) <= 1 + 1e-3
    assert float(result.x[1]) == pytest.approx(0.0, abs=0.02)
    # ∂f/∂a + |f(x₀)| Σ μ sin t = 0 with |f(x₀)| = 0.151; the last update of μ leaves some 5 % of ∇L.
    assert np.argmax(result.multipliers) == 50
    assert np.sum(result.multipliers) == pytest.approx(1 / 0.151, rel=0.05)
    assert result.constraints.shape == (101,)


def test_the_optimum_on_a_bound_is_exactly_there():
    x0, lower, upper = jnp.asarray([1.0, 2.0]), jnp.asarray([0.5, -1.0]), jnp.asarray(3.0)
    result = quiet(lambda x: (jnp.sum(x**2), NO_CONSTRAINTS), x0, lower, upper)
    assert float(result.x[0]) == 0.5  # projected, so no round-off
    assert float(result.x[1]) == pytest.approx(0.0, abs=1e-2)
    assert result.feasible and result.history.worst_constraint[0] == -np.inf


def test_a_logarithmic_scale_spans_decades():
    def fun(x):
        return jnp.log(x["rate"] / 20.0) ** 2 + (x["offset"] - 0.5) ** 2, NO_CONSTRAINTS

    bounds = ({"rate": 1.0, "offset": -1.0}, {"rate": 1e5, "offset": 1.0})
    result = quiet(fun, {"rate": 9e4, "offset": 0.0}, *bounds, log_scale={"rate": True, "offset": False})
    # Adam's last steps are 1e-3 of the box: ln(1e5) · 1e-3 in the logarithm.
    assert float(result.x["rate"]) == pytest.approx(20.0, rel=0.02)
    assert float(result.x["offset"]) == pytest.approx(0.5, abs=4e-3)
    assert np.all(result.history.design["rate"] <= 1e5)


def test_an_infeasible_start_becomes_feasible():
    result = quiet(disc, {"a": 1.9, "b": -1.9}, {"a": -2.0, "b": -2.0}, {"a": 2.0, "b": 2.0})
    assert result.history.worst_constraint[0] > 1
    assert result.feasible
    assert result.objective == pytest.approx((np.sqrt(5) - 1) ** 2, rel=0.01)


def test_an_infeasible_problem_says_so_and_returns_the_least_violation():
    def fun(x):
        return x**2, jnp.stack([1.0 - x, x + 1.0])  # x ≥ 1 and x ≤ −1

    result = quiet(fun, 1.5, -2.0, 2.0)
    assert not result.feasible
    # max(1 − x, 1 + x) is least, 1, at 0, up to the step that passes closest to it.
    assert np.max(result.constraints) == pytest.approx(1.0, abs=0.05)


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
        num_steps=23,
        callback=lambda *args: steps.append(args),
    )
    assert len(traces) == 1
    assert [step for step, _, _ in steps] == list(range(23))
    assert [f for _, f, _ in steps] == list(result.history.objective)
    assert result.history.design["a"].shape == (23,)


def test_a_step_out_of_the_domain_is_halved():
    def fun(x):
        return jnp.where(x > 0.7, jnp.nan, -x), NO_CONSTRAINTS

    result = quiet(fun, 0.0, -1.0, 1.0, num_steps=60)
    assert np.any(np.isnan(result.history.objective))
    # Steps of at most 0.05 of the box of 2, halved at each failure: the edge is approached to within one.
    assert 0.6 < float(result.x) <= 0.7
    assert result.objective == -float(result.x)


@pytest.mark.parametrize("missing", [True, False])
def test_the_bar_is_optional(missing, monkeypatch, capsys):
    if missing:
        monkeypatch.setitem(sys.modules, "tqdm", None)
    result = minimize(lambda x: (x**2, NO_CONSTRAINTS), 0.5, lower=-1.0, upper=1.0, num_steps=3)
    assert len(result.history.objective) == 3
    assert ("3/3" in capsys.readouterr().err) == (not missing)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lower": 2.0}, r"`lower` must be below `upper`, got 2.0 and 1.0 for x"),
        ({"x0": 3.0}, r"`x0` must lie within the bounds: x = 3.0 is outside \[-1.0, 1.0\]"),
        ({"lower": jnp.zeros(3)}, r"`lower` must have shape \(\) or \(\), got shape \(3,\)"),
        ({"upper": {"k": 1.0}}, r"`upper` must be a pytree like `x0`"),
        ({"num_steps": 0}, r"`num_steps` must be at least 1, got 0"),
        ({"num_steps": 2.5}, r"`num_steps` must be a Python int, got 2.5"),
        ({"learning_rate": 0.0}, r"`learning_rate` must be positive, got 0.0"),
        ({"constraint_tolerance": -1.0}, r"`constraint_tolerance` must be positive, got -1.0"),
        ({"log_scale": True}, r"A logarithmic scale needs positive bounds, got -1.0 for x"),
        ({"fun": lambda x: (jnp.log(x - 1.0), NO_CONSTRAINTS)}, r"not finite at `x0`"),
        ({"fun": lambda x: (x, jnp.stack([x * jnp.nan]))}, r"not finite at `x0`"),
        ({"fun": lambda x: x**2}, r"`fun` must return \(objective of shape \(\), array of constraints\)"),
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


def test_a_right_gradient_agrees_with_differences():
    def fun(x):
        return jnp.sin(x["k"] / 1e5) * jnp.sum(jnp.exp(x["p"]))

    x = {"k": 1.1e5, "p": jnp.asarray([0.1, 0.2])}
    check = check_gradient(fun, x)
    assert check.directions == ("k", "p[0]", "p[1]")
    assert np.max(check.error) < 1e-9  # ε^(2/3) = 4e-11 times the curvature and the condition of fun
    # Scaled by the size of each leaf: k ∂f/∂k.
    exact = 1.1 * np.cos(1.1) * (np.exp(0.1) + np.exp(0.2))
    assert check.exact[0] == pytest.approx(exact, rel=1e-12)


def test_many_entries_are_checked_along_random_directions():
    x = jnp.linspace(0.1, 1.0, 40)
    check = check_gradient(lambda x: jnp.sum(x**3), x, max_directions=5)
    assert check.directions == tuple(f"direction {i}" for i in range(1, 6))
    assert check.exact.shape == (5,) and np.min(np.abs(check.exact)) > 0
    assert np.max(check.error) < 1e-9  # as above


def test_a_wrong_gradient_is_seen():
    @jax.custom_jvp
    def wrong(x):
        return x**2

    wrong.defjvp(lambda primals, tangents: (wrong(*primals), 2.02 * primals[0] * tangents[0]))
    check = check_gradient(wrong, 1.5)
    assert check.error[0] == pytest.approx(0.02 / 2.02, rel=1e-6)  # 1 % too large, seen to round-off


@pytest.mark.parametrize(
    ("options", "message"),
    [({"step": 0.0}, "`step` must be positive, got 0.0"), ({"fun": lambda x: x[None]}, "scalar")],
)
def test_bad_gradient_checks(options, message):
    fun = options.pop("fun", lambda x: x**2)
    with pytest.raises((ValueError, TypeError), match=message):
        check_gradient(fun, 1.0, **options)
