"""Tolerances against closed forms and against scatter that was drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg
from lgsens.optimize import allocate_tolerances, monte_carlo, tolerance_stack

P = {"crank": 0.2, "rod": jnp.array([0.5, 0.1])}
T = {"crank": 1e-4, "rod": jnp.array([2e-4, 0.0])}


def slider(p):
    """Where the slider of a crank is, a right angle from the line, and what it misses it by; by Pythagoras."""
    return {"x": jnp.sqrt(p["rod"][0] ** 2 - p["crank"] ** 2), "y": 3.0 * p["rod"][1]}


@pytest.fixture(scope="module")
def stack():
    return tolerance_stack(slider, P, T)


def test_first_order_is_the_closed_form(stack):
    """∂x/∂c = −c/x, ∂x/∂l = l/x: exact, to round-off."""
    x = np.sqrt(0.25 - 0.04)
    parts = np.array([0.2 / x * 1e-4, 0.5 / x * 2e-4])
    assert stack.inputs == ("crank", "rod[0]", "rod[1]")
    assert stack.outputs == ("x", "y")
    np.testing.assert_allclose(stack.statistical, [np.linalg.norm(parts), 0.0], rtol=1e-13)
    np.testing.assert_allclose(stack.worst_case, [parts.sum(), 0.0], rtol=1e-13)
    shares = dict(stack.ranked("x"))
    np.testing.assert_allclose(shares["rod[0]"], parts[1] ** 2 / np.sum(parts**2), rtol=1e-13)
    assert stack.ranked("x")[0][0] == "rod[0]"
    assert "rod[0] 96 %" in str(stack)


@pytest.mark.parametrize("distribution, sigmas", [("normal", 3.0), ("uniform", np.sqrt(3.0))])
def test_small_tolerances_scatter_as_the_first_order_says(stack, distribution, sigmas):
    """Within four standard deviations of a standard deviation of 10,000 samples, 1/√(2 N) = 0.7 % each."""
    found = monte_carlo(slider, P, T, distribution=distribution, progress=False)
    assert found.ok.all()
    expected = float(stack.statistical[0]) / sigmas
    assert abs(np.std(found.values["x"]) / expected - 1.0) < 4.0 / np.sqrt(2.0 * 10_000)


def test_large_ones_do_not():
    """x + x² at 0 with a normal x of standard deviation s: √(s² + 2 s⁴), and a mean of s²."""
    fun = lambda p: p["x"] + p["x"] ** 2
    s, p = 0.5, {"x": 0.0}
    first = tolerance_stack(fun, p, {"x": s})
    np.testing.assert_allclose(first.statistical, s, rtol=1e-14)
    values = monte_carlo(fun, p, {"x": s}, sigmas=1.0, progress=False).values
    deviation = np.sqrt(s**2 + 2.0 * s**4)
    # the fourth moment of x + x² makes its standard deviation less certain than that of a normal number: by 2 %
    np.testing.assert_allclose(np.std(values), deviation, rtol=0.06)
    np.testing.assert_allclose(np.mean(values), s**2, atol=4.0 * deviation / 100.0)
    assert abs(np.std(values) / s - 1.0) > 0.15


def test_one_band_is_allocated_as_the_closed_form(stack):
    """t ∝ (c/J²)^(1/3) with T = b; to the tolerance of the search, 1e-14 of the cost, whose minimum is flat: 1e-7."""
    costs = np.array([2.0, 1.0, 1.0])
    found = allocate_tolerances(stack, {"x": 5e-5}, costs=costs)
    slopes = np.asarray(stack.jacobian[0, :2])
    t = (costs[:2] / slopes**2) ** (1.0 / 3.0)
    t = t * 5e-5 / np.linalg.norm(slopes * t)
    np.testing.assert_allclose([found["crank"], found["rod[0]"]], t, rtol=1e-6)
    assert found["rod[1]"] == 0.0
    named = dict(zip(["crank", "rod[0]"], costs))
    assert allocate_tolerances(stack, {"x": 5e-5}, costs=named, largest={"crank": 1.0, "rod[0]": 1.0}) == found


def test_several_bands():
    """Each band holds, and no tolerance can grow without breaking one: that is the least cost where all cost."""
    random = np.random.default_rng(0)
    matrix = jnp.asarray(random.normal(size=(3, 5)))
    stack = tolerance_stack(lambda p: matrix @ p, jnp.zeros(5), jnp.full(5, 0.01))
    bands = {"value[0]": 0.02, "value[1]": 0.05, "value[2]": 0.01}
    found = np.array(list(allocate_tolerances(stack, bands).values()))
    reached = np.linalg.norm(np.asarray(matrix) * found, axis=1) / np.array(list(bands.values()))
    assert reached.max() <= 1.0 + 1e-9
    assert reached.max() >= 1.0 - 1e-6
    # KKT: c/t = Σ_k μ_k 2 (J t)²/b², with μ ≥ 0 of the bands that are reached
    active = reached > 1.0 - 1e-6
    of = (np.asarray(matrix)[active] * found / np.array(list(bands.values()))[active][:, None]) ** 2
    multipliers = np.linalg.lstsq(of.T, 1.0 / found, rcond=None)[0]
    assert (multipliers > 0.0).all()
    np.testing.assert_allclose(
        of.T @ multipliers, 1.0 / found, rtol=1e-5
    )  # of a search that stops at 1e-14 of the cost


@pytest.mark.slow
def test_of_a_simulation():
    """The top's criterion by tilt and length: T is that of its gradient."""
    from lgsens.examples import spinning_top

    @jax.jit
    def psi(p):
        run = lg.simulate(spinning_top(p["tilt"], length=p["length"]), t1=0.1, num_steps=5, throw=False)
        return lg.time_integral(run.t, run.body("top").position[:, 0] ** 2)

    p, t = {"tilt": 0.7, "length": 1.0}, {"tilt": 1e-3, "length": 2e-3}
    stack = tolerance_stack(psi, p, t)
    slopes = [
        (psi(p | {name: p[name] + 1e-4}) - psi(p | {name: p[name] - 1e-4})) / 2e-4 * t[name] for name in stack.inputs
    ]
    np.testing.assert_allclose(stack.statistical, [np.linalg.norm(slopes)], rtol=1e-6)  # δ² = 1e-8 of third derivatives


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda s: tolerance_stack(slider, P, {"crank": 1.0}), says("`tolerances`", "structure of `p`")),
        (lambda s: tolerance_stack(slider, P, T | {"crank": -1.0}), says("`tolerances`['crank']", "at least 0")),
        (lambda s: tolerance_stack(slider, P, T | {"crank": jnp.ones(2)}), says("`tolerances`['crank']", "shape ()")),
        (lambda s: monte_carlo(slider, P, T, distribution="cauchy"), says("`distribution`", "normal", "'cauchy'")),
        (lambda s: s.ranked("z"), says("`output`", "'z'")),
        (lambda s: allocate_tolerances(s, {"z": 1.0}), says("`bands`", "'z'")),
        (lambda s: allocate_tolerances(s, {"x": -1.0}), says("`bands` must be positive")),
        (lambda s: allocate_tolerances(s, {"x": 1.0}, costs={"crank": 1.0}), says("`costs` must name", "['rod[0]']")),
    ],
)
def test_bad_input(stack, call, message):
    with pytest.raises(ValueError, match=message):
        call(stack)
