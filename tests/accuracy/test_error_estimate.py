"""The error of one run, estimated from that run, against errors that are known otherwise."""

import dataclasses
import functools
import json
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import some_quick
from oscillator import T1, P, V, build
from scipy.integrate import solve_ivp

import lgsens as lg
from lgsens.accuracy import corrected, error_estimate
from lgsens.examples import PROBLEMS, spinning_top

DATA = Path(__file__).parents[1] / "data"


@pytest.mark.parametrize("rho_inf", [pytest.param(0.9, marks=pytest.mark.slow), 0.2])
def test_a_linear_oscillator(rho_inf):
    """The leading error of z, v and v̇, in closed form: what remains is O(h) of it, ωh = 0.045 here.

    v̇ of the second half only: with ρ∞ = 0.9 transients last twenty steps.
    """
    scheme = lg.GeneralizedAlpha(rho_inf)
    trajectory = lg.simulate(build(P), t1=T1, num_steps=100, integrator=scheme)
    estimate, w = error_estimate(trajectory, scheme), np.sqrt(P["k"] / P["m"])
    z, t = trajectory.body("mass").position[:, 2] - 1.0, trajectory.t
    states = trajectory.states
    true = {
        "w": V / w * np.sin(w * t) - z,
        "v": V * np.cos(w * t) - states.v[:, 0],
        "vdot": -V * w * np.sin(w * t) - states.vdot[:, 0],
    }
    for name, error in true.items():
        left = np.abs(getattr(estimate, name)[:, 0] - error)[50:]
        assert left.max() < 0.1 * np.abs(error).max(), name


@functools.cache
def compared(name: str, rho_inf: float, num_steps: int):
    """Errors of a reference problem's run, true and estimated, and of its criteria."""
    problem = PROBLEMS[name]
    scheme = lg.GeneralizedAlpha(rho_inf)
    trajectory = problem.simulate(problem.parameters, num_steps=num_steps, integrator=scheme)
    estimate = error_estimate(trajectory, scheme)
    exact = explicit(name)
    stride = (exact.t.shape[0] - 1) // num_steps
    states, group = jax.tree.map(lambda leaf: leaf[::stride], exact.states), trajectory.system.group
    w = jax.vmap(lambda q, exact: group.log(group.compose(group.inverse(q), exact)))(trajectory.states.q, states.q)
    true = {"w": w} | {key: getattr(states, key) - getattr(trajectory.states, key) for key in ("v", "vdot", "lam")}
    values = problem.evaluate(trajectory, problem.parameters)
    better = problem.evaluate(corrected(trajectory, estimate), problem.parameters)
    reference = problem.reference(json.loads((DATA / problem.file).read_text(encoding="utf-8")))
    criteria = {key: (reference[key].value - value, better[key] - value) for key, value in values.items()}
    return true, estimate, criteria


@functools.cache
def explicit(name: str):
    """The motion by another method, of order 8: at these steps it is exact beside errors of 1e-4."""
    problem = PROBLEMS[name]
    integrator = lg.IndexReducedODE(diffrax.Dopri8())
    return problem.simulate(problem.parameters, num_steps=400, integrator=integrator)


def check(name, rho_inf, num_steps, part):
    """The estimate leaves less than this part of the errors of states, and falls by four with half the step.

    Errors of criteria are integrals in which errors of both signs cancel: they are told within a factor of two.
    """
    sizes = {}
    for n in (num_steps, 2 * num_steps):
        true, estimate, criteria = compared(name, rho_inf, n)
        for key, error in true.items():
            found = getattr(estimate, key)
            assert np.abs(found - error).max() < part * np.abs(error).max(), (n, key)
            sizes.setdefault(key, []).append(np.abs(found).max())
        for key, (error, found) in criteria.items():
            assert 0.5 < found / error < 2.0, (n, key)
    for key, (coarse, fine) in sizes.items():
        assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.3), key  # c₃h³ beside c₂h²


@pytest.mark.slow
def test_the_top():
    check("spinning_top_brulls.l_1.0_alpha0_0.785398", 0.5, 50, 0.3)


@pytest.mark.slow  # a closed loop: three more programs
def test_the_four_bar():
    check("four_bar_spring", 0.5, 200, 0.3)


G, ROD, WEIGHT = np.array([0.0, 0.0, -9.81]), np.array([0.54, 0.0, -0.72]), 0.7
TURN = np.array([0.4, 1.0, 0.3])  # normal to the rod


def on_a_rod(x, v, t):
    """v̇ and the tension at some times of a point mass on a rod from the origin, without multipliers."""
    rate = lambda x, v: G - x * (v @ v + G @ x) / (x @ x)
    ode = lambda _, y: np.concatenate([y[3:], rate(y[:3], y[3:])])
    found = solve_ivp(ode, (t[0], t[-1]), np.concatenate([x, v]), t_eval=t, rtol=1e-11, atol=1e-12).y.T
    return np.array([[*rate(y[:3], y[3:]), WEIGHT * (y[3:] @ y[3:] + G @ y[:3]) / np.sqrt(x @ x)] for y in found])


@pytest.mark.slow  # `test_a_linear_oscillator` is in the quick run
@pytest.mark.parametrize(
    ("case", "rho_inf"), some_quick([("run", 0.9), ("run", 0.3), ("continued", 0.9), ("first order", 0.9)])
)
def test_accelerations_and_forces_of_a_pendulum_from_the_first_step_on(case, rho_inf):
    """Transients (−ρ∞)ⁿ included, which for 0.9 last as long as the run. What an estimate leaves is O(h) of the error,
    amplified like them, n² ρ∞ⁿ: a fifth where a run goes on, which falls with h, and a tenth else."""
    scheme = lg.GeneralizedAlpha(rho_inf, second_order_start=case != "first order")
    rod = lg.DistanceJoint(None, "b", at_a=(0.0, 0.0, 0.0), at_b=ROD)
    body = lg.RigidBody(WEIGHT, None, position=ROD, velocity=TURN)
    model = lg.Model({"b": body}, {"rod": rod}, {"g": lg.Gravity(G)})
    run = lambda **more: lg.simulate(model, num_steps=96, integrator=scheme, **more)
    trajectory, x, v = run(t1=0.3), ROD, TURN
    if case == "continued":
        begun = trajectory.state(-1)
        trajectory = run(t0=0.3, t1=0.6, state0=begun)
        x, v = np.asarray(begun.q.position[0]), np.asarray(begun.v)
        v = v - x * (x @ v) / (x @ x)  # on the sphere: under way it is off by O(h²)
    estimate, force = error_estimate(trajectory, scheme), np.asarray(trajectory.multiplier("rod"))[:, 0]
    true = on_a_rod(x, v, np.asarray(trajectory.t))
    sign = np.sign(force[0] * true[0, 3])
    for error, told in (
        (true[:, :3] - np.asarray(trajectory.body("b").acceleration), estimate.vdot),
        (sign * true[:, 3] - force, estimate.lam[:, 0]),
    ):
        assert np.abs(told - error).max() < 0.25 * np.abs(error).max()


def test_what_rings_is_told():
    """A damper that steps do not resolve, d h/m = 50, by an initial velocity: v̇ rings as (−0.9)ⁿ, and no mean of it may
    hide that. Its size is told within a factor of three, though steps so long have no expansion in h."""
    body = lg.RigidBody(1.0, None, velocity=(1.0, 0.0, 0.0), free="x")
    damper = lg.SpringDamper(None, "b", at_a=(-1.0, 0.0, 0.0), at_b=(0.0, 0.0, 0.0), stiffness=0.0, damping=5e3)
    run = lg.simulate(lg.Model({"b": body}, {}, {"damper": damper}), t1=1.0, num_steps=100)
    size = lambda rows: np.abs(rows[10:30]).max()  # of v̇, which is zero there
    assert size(run.states.vdot) / 3.0 < size(error_estimate(run).vdot) < 3.0 * size(run.states.vdot)


NUM_STEPS = 24
FRACTIONS = 1.0 + 0.3 * np.sin(np.arange(NUM_STEPS) / 4.0)
DAMPED = lg.GeneralizedAlpha(0.5, tolerance=1e-12)
STABILIZED = lg.GeneralizedAlpha(0.5, stabilized=True, tolerance=1e-12)
OTHERS = {
    "given": lg.GivenSteps(FRACTIONS, DAMPED),
    "stabilized": STABILIZED,
    "given, stabilized": lg.GivenSteps(FRACTIONS, STABILIZED),
    "adaptive": lg.AdaptiveSteps(DAMPED, tolerance=1e-5, longest=0.1),
    "order 3": lg.IndexReducedODE(diffrax.Bosh3()),
    "given, order 5": lg.GivenSteps(FRACTIONS, lg.IndexReducedODE()),
}


@pytest.mark.slow  # two programs each; an oscillator is above
@pytest.mark.parametrize("name", OTHERS)
def test_other_steps_and_schemes(name):
    """By a second run that divides each step: what is left is O(h) of the error, from explicit steps of order 8.

    v̇ and λ of the second half: transients of ρ∞ = 0.5 last some steps more.
    """
    integrator = OTHERS[name]
    run = lg.simulate(spinning_top(0.7, length=1.0), t1=0.12, num_steps=NUM_STEPS, integrator=integrator)
    taken = np.concatenate([[True], np.diff(run.t) > 0.0])
    order_8 = lg.GivenSteps.of(run, lg.IndexReducedODE(diffrax.Dopri8()))
    exact = lg.simulate(run.system, t1=0.12, num_steps=order_8.num_steps, integrator=order_8).states
    estimate, group = error_estimate(run, integrator), run.system.group
    q = jax.tree.map(lambda leaf: leaf[taken], run.states.q)
    true = {"w": jax.vmap(lambda q, other: group.log(group.compose(group.inverse(q), other)))(q, exact.q)}
    true |= {key: getattr(exact, key) - getattr(run.states, key)[taken] for key in ("v", "vdot", "lam")}
    for key, error in true.items():
        left = np.abs(getattr(estimate, key)[taken] - error)
        start, part = (len(error) // 2, 0.2) if key in ("vdot", "lam") else (0, 0.1)
        assert left[start:].max() < part * np.abs(error[start:]).max(), key


def test_an_estimate_that_is_there_is_kept():
    trajectory = lg.simulate(build(P), t1=T1, num_steps=5, integrator=lg.Richardson())
    assert error_estimate(trajectory) is trajectory.error


def test_bad_input():
    trajectory = lg.simulate(build(P), t1=T1, num_steps=5, integrator=lg.GeneralizedAlpha(0.5))
    with pytest.raises(
        ValueError, match=r"not one of GeneralizedAlpha\(\) in equal steps; give the one that it is from"
    ):
        error_estimate(trajectory)
    for other in (lg.IndexReducedODE(), lg.GeneralizedAlpha(stabilized=True), lg.GivenSteps(jnp.ones(5))):
        with pytest.raises(ValueError, match="`integrator`: the trajectory is not one of"):
            error_estimate(trajectory, other)
    with pytest.raises(ValueError, match="`integrator` must be a GeneralizedAlpha or another"):
        error_estimate(trajectory, "alpha")
    with pytest.raises(ValueError, match="with `rtol` = 1e-06 diffrax chooses the steps"):
        error_estimate(trajectory, lg.IndexReducedODE(rtol=1e-6))
    with pytest.raises(ValueError, match="at least 3 steps, got 2"):
        error_estimate(lg.simulate(build(P), t1=T1, num_steps=2))
    failed = dataclasses.replace(trajectory, result=jnp.asarray(lg.RESULTS.newton_failed))
    with pytest.raises(ValueError, match=r"`error_estimate`: the trajectory has failed"):
        error_estimate(failed, lg.GeneralizedAlpha(0.5))


def in_steps(*sizes):
    return lg.simulate(build(P), t1=T1, num_steps=4, integrator=lg.GivenSteps(jnp.asarray(sizes)))


@pytest.mark.slow
def test_what_is_not_by_the_scheme_is_nan_under_jit():
    equal, uneven = in_steps(1.0, 1.0, 1.0, 1.0), in_steps(2.0, 3.0, 2.0, 3.0)
    traced = jax.jit(error_estimate)
    for found, expected in zip(jax.tree.leaves(traced(equal)), jax.tree.leaves(error_estimate(equal))):
        np.testing.assert_allclose(found, expected, rtol=1e-12)  # the same operations, fused otherwise
    assert all(jnp.isnan(leaf).all() for leaf in jax.tree.leaves(traced(uneven)))
    with pytest.raises(ValueError, match="in equal steps"):
        error_estimate(uneven)
    given = error_estimate(uneven, lg.GivenSteps.of(uneven))
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(given))


@pytest.mark.slow  # small version: test_what_is_not_by_the_scheme_is_nan_under_jit
def test_steps_that_are_given_under_jit():
    uneven = in_steps(2.0, 3.0, 2.0, 3.0)
    grid = lg.GivenSteps.of(uneven)
    found = jax.jit(lambda run: error_estimate(run, grid))(uneven)
    for traced, expected in zip(jax.tree.leaves(found), jax.tree.leaves(error_estimate(uneven, grid))):
        np.testing.assert_allclose(traced, expected, rtol=1e-9)  # differences of values 1e3 times as large


@pytest.mark.slow  # derivatives of a linearization, in both modes
def test_it_is_traced_like_everything_else():
    """jit, vmap, and a derivative in both modes: of what is estimated, by the stiffness."""

    def size(k):
        trajectory = lg.simulate(build({"k": k, "m": 2.0}), t1=T1, num_steps=5)
        return jnp.sum(error_estimate(trajectory).w ** 2)

    stiffnesses = jnp.array([40.0, 50.0])
    forward, reverse = (jax.jit(jax.vmap(mode(size)))(stiffnesses) for mode in (jax.jacfwd, jax.grad))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9)  # round-off over h³, twice
    step = 1e-2
    difference = (size(40.0 + step) - size(40.0 - step)) / (2 * step)
    np.testing.assert_allclose(forward[0], difference, rtol=1e-5)  # (step/k)² and round-off over the step
