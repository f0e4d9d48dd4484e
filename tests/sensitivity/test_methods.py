"""Every method against every other, through `differentiate`: four scenes, five kinds of criteria on each.

The whole table, with costs, is printed by `benchmarks/methods.py`.
"""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.examples import COMPARISON

# Five criteria by one method compile for five seconds on the small scenes, for half a minute on the quarter-car.
SCENES = ["four_bar", *(pytest.param(name, marks=pytest.mark.slow) for name in ("top", "chain", "quarter_car"))]
REFERENCE = -0.0021318254254500  # dΨ/dα₀ of the paper's top, l = 1 m, converged by three routes


def gradients(name, method, factor=1.0, **settings):
    """p dΨ/dp of the five criteria, one row each; the problem's own number of steps times `factor`."""
    problem = COMPARISON[name]
    settings = {"num_steps": round(problem.num_steps * factor), "t1": problem.t1} | settings
    found = lg.differentiate(problem.criteria, problem.build, problem.parameters, method=method, **settings)
    assert found.method == method
    size = {p: abs(value) or 0.01 for p, value in problem.parameters.items()}  # a hardpoint at 0: 10 mm
    return np.array([[found.gradient[c][p] * size[p] for p in problem.parameters] for c in problem.criteria])


def error(found, wanted):
    """Of each criterion, relative to its largest effect."""
    return np.abs(found - wanted).max(axis=1) / np.abs(wanted).max(axis=1)


@pytest.mark.parametrize("name", [pytest.param("four_bar", marks=pytest.mark.slow), *SCENES[1:]])
def test_discrete_methods_are_the_derivative_of_the_scheme(name):
    """DDM on the fly, AVM, autodiff of the loops, and sixth-order differences: one derivative."""
    direct = gradients(name, lg.DirectDifferentiation(), 0.2)
    # Round-off 2e-16 × 100 steps × condition 5e2 of the iteration matrix is 1e-11.
    assert np.all(error(gradients(name, lg.AdjointVariable(), 0.2), direct) <= 1e-10)
    # Newton's derivative is exact up to its last increment, and multipliers carry round-off / h².
    exact = lg.GeneralizedAlpha(tolerance=1e-13)
    assert np.all(error(gradients(name, lg.Autodiff(), 0.2, integrator=exact), direct) <= 1e-9)
    # δ⁶ = 1e-18 of truncation, and 1e-14/δ of round-off in Ψ: 1e-11 of Ψ, which is up to 100 × its derivative
    assert np.all(error(gradients(name, lg.FiniteDifferences(), 0.2), direct) <= 1e-9)


@pytest.fixture(scope="module")
def limits():
    """The derivatives of the motion itself, by the index-reduced equations."""
    found = {}

    def of(name):
        if name not in found:
            breaks = (0.25,) if name == "quarter_car" else ()
            found[name] = gradients(name, lg.IndexReduced(rtol=1e-11, breaks=breaks))
        return found[name]

    return of


@pytest.mark.slow  # the paper's top, below, is not
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("method", [lg.ContinuousDirect(), lg.ContinuousAdjoint()], ids=["direct", "adjoint"])
def test_continuous_methods_converge_to_the_motions_derivative(name, method, limits):
    """Slope 2 ± 0.1 for all five kinds of criteria, with respect to hardpoints and lengths, too.

    A criterion of velocities, the terminal term and a length: without the multipliers η₁, η₂ of the final conditions,
    which the paper's (42)–(43) do not have, these would not converge.
    """
    errors = [error(gradients(name, method, factor), limits(name)) for factor in (1.0, 2.0)]
    # (ω h)² of the fastest motion: the car's wheel hop, 80 rad/s × 1e-3 s; derivatives cancel by another digit at most
    assert np.all(errors[1] <= 6e-3)
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 2.0, atol=0.1)


@pytest.mark.slow
def test_final_conditions_as_printed_do_not_converge(monkeypatch, limits):
    """Without η₁ᵀ(Φ̇)_p + η₂ᵀΦ_p an error remains that no step size removes, but for a criterion of positions."""
    module = importlib.import_module("lgsens.sensitivity._continuous_adjoint")
    original = module.final_cotangents

    def as_printed(functional, p, system, point, eta1, eta2):
        return original(functional, p, system, point, jnp.zeros_like(eta1), jnp.zeros_like(eta2))

    monkeypatch.setattr(module, "final_cotangents", as_printed)
    jax.clear_caches()
    errors = [error(gradients("four_bar", lg.ContinuousAdjoint(), factor), limits("four_bar")) for factor in (1.0, 2.0)]
    jax.clear_caches()
    criteria = list(COMPARISON["four_bar"].criteria)
    for name, coarse, fine in zip(criteria, *errors):
        if name == "q":
            assert abs(np.log2(coarse / fine) - 2.0) <= 0.1
        else:
            assert fine > 1e-2 and abs(fine / coarse - 1.0) <= 0.1, name


def top_gradient(method, num_steps, **settings):
    criterion = COMPARISON["top"].criteria["q"]
    return lg.differentiate(
        criterion, lg.examples.spinning_top, np.pi / 4, t1=1.0, num_steps=num_steps, method=method, **settings
    ).gradient


@pytest.mark.slow
def test_continuous_adjoint_on_the_papers_top():
    """Fig. 2: 1.2e-4, 2.9e-5, 7.3e-6 at h = 2e-3, 1e-3, 5e-4; all of it through π and ρ and the constraint's ν."""
    method = lg.ContinuousAdjoint(None)
    found = [abs(float(top_gradient(method, n)) / REFERENCE - 1.0) for n in (500, 1000, 2000)]
    np.testing.assert_allclose(found, [1.2e-4, 2.9e-5, 7.3e-6], rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("treatment", ["derivatives", "first_order"])
def test_other_treatments_of_accelerations(treatment):
    """The extra differential equations and the first-order formulation reach the same limit, but not at second order.

    Both differentiate v̇_n and λ_n twice, and the start's transient, O(h²) (−ρ)^n, is O(1) then: an O(h) beside O(h²).
    ρ∞ = 0.2, so that it is over after few steps; with 0.9 it hides the order (`benchmarks/methods.py`).
    """
    problem = COMPARISON["top"]
    criteria = {name: problem.criteria[name] for name in ("vdot", "lam")}

    def found(method, num_steps):
        gradient = lg.differentiate(
            criteria,
            problem.build,
            problem.parameters,
            t1=problem.t1,
            num_steps=num_steps,
            integrator=lg.GeneralizedAlpha(0.2),
            method=method,
        ).gradient
        return np.array([[gradient[c][p] * v for p, v in problem.parameters.items()] for c in criteria])

    wanted = found(lg.IndexReduced(rtol=1e-11), 1)
    coarse, fine = (error(found(lg.ContinuousAdjoint(treatment), n), wanted) for n in (500, 1000))
    assert np.all(fine <= 1e-3)  # (10 rad/s × 1e-3 s)² × 10
    assert np.all(np.log2(coarse / fine) >= 1.0 - 0.1)


def shaken(f):
    """A slider that a driver moves by 0.2 sin 2πft."""
    value = lg.Harmonic(amplitude=0.2, frequency=f)
    drive = lg.TranslationDriver(None, "b", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), value=value)
    return lg.Model({"b": lg.RigidBody(2.0, None, free="x")}, {"drive": drive})


SPEED_AND_FORCE = {
    "speed": lg.Criterion(terminal=lambda s, p: s.body("b").velocity[0]),
    "force": lg.Criterion(terminal=lambda s, p: s.multiplier("drive")[0]),
    "effort": lg.Criterion(integrand=lambda s, p: s.multiplier("drive")[0] ** 2),
}


@pytest.mark.slow
def test_by_the_signal_of_a_driver():
    """Closed forms of ẋ, −m ẍ and ∫ m² ẍ²: Φ̇ has the part Φ_t, and Φ̈ its derivatives, which depend on f."""
    f, t1, w = 1.5, 0.3, 2.0 * np.pi * 1.5
    found = lg.differentiate(SPEED_AND_FORCE, shaken, f, t1=t1, num_steps=64, method=lg.ContinuousAdjoint()).gradient
    phase, per_f = w * t1, 2.0 * np.pi
    np.testing.assert_allclose(found["speed"], 0.2 * per_f * (np.cos(phase) - phase * np.sin(phase)), rtol=1e-10)
    of_force = 2.0 * 0.2 * w * per_f * (2.0 * np.sin(phase) + phase * np.cos(phase))
    np.testing.assert_allclose(found["force"], of_force, rtol=1e-10)  # a prescribed motion: nothing is integrated
    # ∫ 0.16 w⁴ sin² wt dt = 0.16 (w⁴ t₁/2 − w³ sin(2wt₁)/4)
    of_effort = 0.16 * per_f * (2 * w**3 * t1 - 0.75 * w**2 * np.sin(2 * phase) - 0.5 * w**3 * t1 * np.cos(2 * phase))
    np.testing.assert_allclose(found["effort"], of_effort, rtol=1e-3)  # the trapezoidal rule, (wh)²/12 and more


def screw(p):
    """A body that falls in a screw whose pitch grows, on a spring."""
    pitch = lg.Ramp(start=0.5, end=3.0, duration=1.0)
    spring = {"at_a": (-1.0, 0.0, 0.0), "at_b": (0.0, 0.0, 0.0), "free_length": 1.0}
    return lg.Model(
        {"b": lg.RigidBody(p["m"], (0.1, 0.1, 0.1))},
        {"s": lg.ScrewJoint(None, "b", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.0), pitch=pitch)},
        {"g": lg.Gravity((9.81, 0.0, 0.0)), "spring": lg.SpringDamper(None, "b", stiffness=p["k"], **spring)},
    )


@pytest.mark.slow  # `test_by_the_signal_of_a_driver` is in the quick run
@pytest.mark.parametrize("accelerations", ["state", "first_order"])
def test_joints_that_change_with_time(accelerations):
    """Ḃ has the part ∂B/∂t: the derivatives of the end's velocity come together at second order."""
    criteria, p = {"speed": SPEED_AND_FORCE["speed"]}, {"m": 2.0, "k": 30.0}
    apart = []
    for num_steps in (100, 200):
        run = lambda method, n=num_steps: lg.differentiate(criteria, screw, p, t1=0.5, num_steps=n, method=method)
        one, other = run(lg.ContinuousAdjoint(accelerations)).gradient, run(lg.AdjointVariable()).gradient
        apart.append([float(one["speed"][key] / other["speed"][key] - 1.0) for key in p])
    np.testing.assert_allclose(apart[1], 0.0, atol=2e-3)
    assert np.all(np.abs(apart[1]) < 0.35 * np.abs(apart[0]))


@pytest.mark.slow  # as that of "state"
@pytest.mark.parametrize("accelerations", ["derivatives", "first_order"])
def test_by_the_signal_of_a_driver_otherwise(accelerations):
    criteria = {name: SPEED_AND_FORCE[name] for name in ("speed", "effort")}
    settings = {"t1": 0.3, "num_steps": 256}
    found = lg.differentiate(criteria, shaken, 1.5, method=lg.ContinuousAdjoint(accelerations), **settings).gradient
    exact = lg.differentiate(criteria, shaken, 1.5, method=lg.ContinuousAdjoint(), **settings).gradient
    np.testing.assert_allclose(found["speed"], exact["speed"], rtol=1e-10)
    np.testing.assert_allclose(found["effort"], exact["effort"], rtol=1e-3)  # second order, 2e-4 here


def off_by_times(num_steps):
    """Of the top half way, relative: §6.1 beside the derivative of the scheme, by t0, t1 and the sizes of steps."""
    problem = COMPARISON["top"]
    top = problem.build(problem.parameters)

    def run(times, sensitivity):
        fractions = 1.0 + 0.2 * times[2] * jnp.sin(jnp.linspace(0.0, 6.0, num_steps))
        steps = {"integrator": lg.GivenSteps(fractions), "num_steps": num_steps, "t0": times[0], "t1": times[1]}
        found = lg.simulate(top, sensitivity=sensitivity, **steps)
        body, half = found.body("top"), num_steps // 2
        return jnp.concatenate([body.position[half], body.velocity[half], found.states.lam[half] / 100.0])

    of = lambda method: jax.jit(jax.jacfwd(lambda times: run(times, method)))(jnp.array([0.0, 0.5, 1.0]))
    exact = of(lg.DirectDifferentiation())
    return np.abs(of(lg.ContinuousDirect()) - exact).max(axis=0) / np.abs(exact).max(axis=0)


@pytest.mark.slow  # two derivatives of the top
def test_continuous_direct_by_the_times_of_steps():
    """A state moves with its time, and the top's bracket ad(v) is not zero."""
    assert np.all(off_by_times(200) < 3e-4)  # some (ωh)²/12 with h = 2.5 ms and the spin of 10 to 20 rad/s, 2e-4


@pytest.mark.slow
def test_continuous_direct_by_times_is_of_second_order():
    np.testing.assert_allclose(off_by_times(200) / off_by_times(400), 4.0, rtol=0.3)  # the order, and h³
