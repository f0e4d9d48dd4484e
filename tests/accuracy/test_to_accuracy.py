"""`accuracy=`: what is asked for is reached, by references that share nothing with it, or said not to be."""

import functools
import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says
from jax.flatten_util import ravel_pytree
from oscillator import CRITERION, T1, P, build, exact

import lgsens as lg
from lgsens.criteria import differentiate_to
from lgsens.dynamics import RESULTS
from lgsens.examples import PROBLEMS
from lgsens.simulation import Compared, to_accuracy


def sequence(error, runs=3):
    """Runs of which the error is known: a result is a number, the exact one 1."""
    run = lambda n, throw: SimpleNamespace(value=1.0 + error(n), result=RESULTS.successful)
    distance = lambda coarse, fine: abs(coarse.value - fine.value)

    def extrapolated(runs):
        values = [run.value for run in runs]
        for power in (4.0, 16.0)[: len(runs) - 1]:
            values = [b + (b - a) / (power - 1.0) for a, b in itertools.pairwise(values)]
        return SimpleNamespace(value=values[0])

    return run, Compared(distance, extrapolated, runs)


ERRORS = {
    "h²": lambda n: 30.0 / n**2,
    "h² and h³": lambda n: 30.0 / n**2 + 4e3 / n**3,
    "h² and h⁴": lambda n: -30.0 / n**2 + 1e5 / n**4,
    "h² and h⁴, little h³": lambda n: -30.0 / n**2 + 2.0 / n**3 + 1e5 / n**4,
    "h² and h⁴ of a size that changes": lambda n: -30.0 / n**2 + 1e5 / n**4 * (1.0 + 0.3 * np.sin(n)),
    "an edge between times": lambda n: 30.0 / n**2 + 6.0 * (0.37 * n % 1.0) / n**2,
    "h": lambda n: 2.0 / n + 30.0 / n**2,
    "another branch at first": lambda n: (1.0 if n < 100 else 0.0) + 30.0 / n**2,
    "coarse runs are accidents": lambda n: 0.3 * np.sin(n) if n < 1000 else 30.0 / n**2,
}


@pytest.mark.parametrize("runs", [1, 2, 3])
@pytest.mark.parametrize("accuracy", [1e-2, 1e-4, 1e-6, 1e-9])
@pytest.mark.parametrize("error", ERRORS.values(), ids=ERRORS)
def test_never_worse_than_asked(error, accuracy, runs):
    try:
        found, reached = to_accuracy(*sequence(error, runs), accuracy, lg.GeneralizedAlpha())
    except lg.SimulationError as failure:  # of first order 1e-6 takes more steps than there are
        assert abs(error(2**17)) > accuracy / 4.0
        assert "is not reached in 131072 steps" in str(failure)
        return
    assert abs(found.value - 1.0) <= accuracy
    assert reached.error <= accuracy
    assert reached.error > 0.4 * abs(found.value - 1.0) - 1e-15  # of two runs in three the ratio is not yet 4


@pytest.mark.parametrize("accuracy", [1e-2, 1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize("error", ERRORS.values(), ids=ERRORS)
def test_the_cheapest_setting_has_what_is_asked_too(error, accuracy):
    def run(n, throw):
        value = np.asarray(1.0 + error(n))
        return lg.Sensitivities(value, value, lg.AdjointVariable(), RESULTS.successful)

    try:
        found = differentiate_to(run, accuracy, lg.GeneralizedAlpha(), None, extrapolate=True)
    except lg.SimulationError:
        assert abs(error(2**17)) > accuracy / 4.0
        return
    assert abs(found.value - 1.0) <= accuracy
    assert found.reached.error > 0.4 * abs(found.value - 1.0) - 1e-15  # as above
    first = to_accuracy(*sequence(error), accuracy, lg.GeneralizedAlpha())[1]
    assert sum(found.reached.numbers) <= sum(first.numbers)


def test_five_eighths_of_the_steps_are_taken_where_they_do():
    error = lambda n: -30.0 / n**2 + 2e5 / n**4 + 40.0 / n**3  # of which three runs leave the last
    run = lambda n, throw: lg.Sensitivities(*2 * [np.asarray(1.0 + error(n))], None, RESULTS.successful)
    found = differentiate_to(run, 2e-7, lg.GeneralizedAlpha(), None, extrapolate=True)
    assert found.reached.numbers == (160, 320, 640)
    assert abs(found.value - 1.0) <= found.reached.error <= 2e-7


def test_no_more_steps_than_the_order_of_extrapolated_runs_says():
    error = lambda n: -30.0 / n**2 + 2e3 / n**4
    found, reached = to_accuracy(*sequence(error, 2), 3e-8, lg.GeneralizedAlpha())
    left = abs(found.value - 1.0)
    assert reached.runs == 2 and left <= 3e-8 < 16.0 * left  # half as many steps would not do
    np.testing.assert_allclose(reached.error, 2.0 * left, rtol=0.02)  # twice what it is; of h⁶ there is nothing


def test_three_runs_remove_the_fourth_order_too():
    error = lambda n: -30.0 / n**2 + 2e3 / n**4 + 1e4 / n**6
    found, reached = to_accuracy(*sequence(error), 1e-9, lg.GeneralizedAlpha())
    left = abs(found.value - 1.0)
    assert reached.runs == 3 and reached.numbers == (256, 512, 1024)  # of two, 2048
    np.testing.assert_allclose(reached.error, 63.0 * left, rtol=1e-3)  # 64 of them less 1; round-off 1e-16/1e-12
    again = reached.again(lambda n: jnp.asarray(1.0 + error(n)))
    np.testing.assert_allclose(again, found.value, rtol=1e-15)
    assert "in 256, 512 and 1024 steps, extrapolated" in str(reached)


def test_round_off_of_single_precision_may_hide_that_errors_fall():
    """The best run is one of the first, and others, whose changes grow, are no reason to refuse it."""
    error = lambda n: 1.0 / n**2 + 3e-8 * n**2 * np.cos(n)
    with jax.enable_x64(False):
        found, reached = to_accuracy(*sequence(error), 1e-2, lg.GeneralizedAlpha())
        assert abs(found.value - 1.0) < reached.error <= 1e-2 and reached.runs == 1
        with pytest.raises(lg.SimulationError, match=says("0.0001 is not reached in 8192 steps", "single precision")):
            to_accuracy(*sequence(error), 1e-4, lg.GeneralizedAlpha())
    with pytest.raises(lg.SimulationError, match=says("0.01 is not reached in 131072 steps")):  # it is not round-off
        to_accuracy(*sequence(error), 1e-2, lg.GeneralizedAlpha())


def test_coarse_runs_that_fail_are_no_answer():
    run, *rest = sequence(lambda n: 1.0 / n**2)
    asked = []

    def failing(n, throw):
        asked.append((n, throw))
        found = run(n, throw)
        return found if n >= 512 else SimpleNamespace(value=np.nan, result=RESULTS.newton_failed)

    _, reached = to_accuracy(failing, *rest, 1e-4, lg.GeneralizedAlpha())
    assert asked[:4] == [(64, False), (128, False), (256, False), (512, False)]
    assert [n for n, _ in reached.tried] == [512, 1024, 2048]
    assert str(reached).startswith(f"error {reached.error:.1e}, asked 0.0001, in 2048 steps; steps and change from")


@functools.partial(jax.jit, static_argnums=1)
def position(p, num_steps):
    return lg.simulate(build(p), t1=T1, num_steps=num_steps).body("mass").position


@pytest.mark.parametrize("accuracy", [1e-3, 1e-6])
def test_values_and_gradients_are_those_of_the_closed_form(accuracy):
    found = lg.differentiate(CRITERION, build, P, t1=T1, accuracy=accuracy)
    value, gradient = jax.value_and_grad(exact)(jax.tree.map(jnp.asarray, P))
    flat = lambda tree: np.asarray(ravel_pytree(tree)[0])
    assert abs(found.value - value) <= accuracy * abs(value)
    assert np.linalg.norm(flat(found.gradient) - flat(gradient)) <= accuracy * np.linalg.norm(flat(gradient))
    assert found.reached.error <= accuracy
    assert found.reached.extrapolated == (accuracy < 1e-4)


@pytest.mark.slow  # gradients to an accuracy are in the quick run
def test_motions_have_it_and_their_derivatives_follow():
    run = lg.simulate(build(P), t1=T1, accuracy=1e-5)
    n = run.t.shape[0] - 1
    fine = np.asarray(position(jax.tree.map(jnp.asarray, P), 64 * n))[::64]
    length = float(jnp.max(run.system.coordinate_scale()))
    assert np.abs(np.asarray(run.body("mass").position) - fine).max() < 1.0001e-5 * length  # of the fine run: 1/4096
    assert run.reached.error <= 1e-5
    assert run.reached.brief in repr(run)
    assert run.order == (4 if run.reached.extrapolated else 2)
    last = lambda k: lg.simulate(build(P | {"k": k}), t1=T1, accuracy=1e-5).body("mass").position[-1, 2]
    slope = (last(P["k"] + 1e-3) - last(P["k"] - 1e-3)) / 2e-3  # the same steps three times
    assert abs(jax.grad(last)(P["k"]) - slope) < 1e-9  # 1e-6 k³/6 of a third derivative of 1e-6, round-off 1e-13/1e-3


def test_bad_requests_are_refused():
    simulate = lambda **given: lg.simulate(build(P), t1=T1, **given)
    of = lambda **given: lg.differentiate(CRITERION, build, P, t1=T1, **given)
    requests = {
        "between 0 and 1, got 2": lambda: simulate(accuracy=2),
        "unless `accuracy` is given, got None": simulate,
        "chooses its steps": lambda: simulate(accuracy=1e-3, integrator=lg.AdaptiveSteps()),
        "extrapolates itself": lambda: simulate(accuracy=1e-3, integrator=lg.Richardson()),
        "leave `save`, `throw` out": lambda: simulate(accuracy=1e-3, throw=False),
        "outside of `jit`": lambda: jax.jit(lambda t0: simulate(accuracy=1e-3, t0=t0))(0.0),
        "leave `throw` out": lambda: of(accuracy=1e-3, throw=False),
        "(it is static), unless": of,
    }
    for message, request in requests.items():
        with pytest.raises(ValueError, match=says(message)):
            request()


SCENES = (
    "spinning_top_brulls.l_1.0_reproduces_published_number",
    "lagrange_top_analytic.nutating",
    "free_rigid_body.asymmetric",
    "simple_pendulum_A01",
    "slider_crank_sundials",
    "four_bar_spring",
    "quarter_car_linear",
    "five_link_quarter_car",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_eight_scenes_reach_what_is_asked(name):
    """Beside an explicit scheme of order 8 on other equations, good to 1e-9 by its own change from half the steps."""
    import diffrax

    problem = PROBLEMS[name]
    exact = lg.IndexReducedODE(diffrax.Dopri8())
    settings = {"t1": problem.t1}
    steps = 8 * problem.num_steps
    reference, half = (
        lg.differentiate(problem.criteria, problem.build, problem.parameters, integrator=exact, num_steps=n, **settings)
        for n in (steps, steps // 2)
    )
    off = lambda found, true, key: max(
        np.linalg.norm(ravel_pytree(a)[0] - ravel_pytree(b)[0]) / np.linalg.norm(ravel_pytree(b)[0])
        for a, b in ((found.value[key], true.value[key]), (found.gradient[key], true.gradient[key]))
    )
    worst = lambda found, true: max(off(found, true, key) for key in problem.criteria)
    known = worst(half, reference)
    assert known < 1e-8
    for accuracy in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        found = lg.differentiate(problem.criteria, problem.build, problem.parameters, accuracy=accuracy, **settings)
        assert worst(found, reference) <= accuracy + known
