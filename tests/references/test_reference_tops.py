"""Tops and free bodies against their reference numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_runs import (
    check_criteria,
    check_invariants,
    check_states,
    document,
    extrapolated,
    first_quarter,
    rotation,
    runs,
)

import lgsens as lg
from lgsens.examples import PROBLEMS, free_rigid_body, heavy_top

SPINNING = {case["label"]: case for case in document("spinning_top_brulls.json")["details_full_digits"]["cases"]}
HEAVY = document("heavy_top_bruls2012.json")
LAGRANGE = document("lagrange_top_analytic.json")
FREE = document("free_rigid_body.json")
FILES = ("spinning_top_brulls.", "heavy_top_bruls2012.", "lagrange_top_analytic.", "free_rigid_body.")


LONG = (  # as others, at other numbers
    "spinning_top_brulls.as_printed_l_0.5",
    "heavy_top_bruls2012.to_1s",
    "heavy_top_bruls2012.to_2s",
    "lagrange_top_analytic.nutating",
    "lagrange_top_analytic.simo_wong",
    "free_rigid_body.asymmetric",
    "free_rigid_body.dzhanibekov",
    "free_rigid_body.symmetric_kynema",
)


def in_part(first, *others):
    """Cases of a motion, and whether of its first quarter: that of the first ones in the quick run."""
    return [*((case, True) for case in first), *(pytest.param(c, False, marks=pytest.mark.slow) for c in others)]


@pytest.mark.slow  # README has its gradient in the quick run
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in LONG else name
        for name in PROBLEMS
        if name.startswith(FILES)
    ],
)
def test_criteria_and_gradients(name):
    check_criteria(name)


def observe_top(trajectory):
    body = trajectory.body("top")
    return {
        "x": body.position,
        "xdot": body.velocity,
        "R": body.orientation,
        "Omega": body.angular_velocity,
        "Omegadot": body.angular_acceleration,
        "lam": trajectory.multiplier("pivot"),
    }


def expect_top(state):
    names = ("x", "xdot", "Omega", "Omegadot", "lam")
    return {name: np.array(state[name], float) for name in names} | {"R": rotation(state["quat_wxyz"])}


def energy_of_top(p):
    """Of a top with principal moments J11, J22, J33."""
    inertia = jnp.array([p["J11"], p["J22"], p["J33"]])

    def observe(trajectory):
        body = trajectory.body("top")
        twice = p["m"] * jnp.sum(body.velocity**2, axis=1) + body.angular_velocity**2 @ inertia
        return {"energy": twice / 2 + p["m"] * p["g"] * body.position[:, 2]}

    return observe


@pytest.mark.slow  # criteria of its motion and their gradients are in the quick run
@pytest.mark.parametrize("case", SPINNING)
def test_motion_of_the_spinning_top(case):
    name = f"spinning_top_brulls.{case}"
    states = SPINNING[case]["states"]
    check_states(name, states, observe_top, expect_top)
    check_invariants(name, energy_of_top(PROBLEMS[name].parameters), {"energy": float(states[0]["energy"])})


@pytest.mark.slow  # its published position is below
def test_motion_of_the_heavy_top():
    name = "heavy_top_bruls2012.to_2s"
    check_states(name, HEAVY["states"], observe_top, expect_top)
    check_invariants(name, energy_of_top(PROBLEMS[name].parameters), {"energy": HEAVY["states"][0]["energy"]})


@pytest.mark.parametrize(("case", "quarter"), in_part(["simo_wong"], "nutating", "simo_wong"))
def test_motion_of_the_lagrange_top(case, quarter):
    """The closed form, and its three integrals: energy, vertical angular momentum, spin."""
    name = f"lagrange_top_analytic.{case}"
    p, trajectories = PROBLEMS[name].parameters, first_quarter(name) if quarter else None
    about_pivot = p["J1"] + p["m"] * p["l"] ** 2  # A

    def observe(trajectory):
        body = trajectory.body("top")
        return {"x_cm": p["l"] * body.orientation[:, :, 2], "R": body.orientation, "Omega": body.angular_velocity}

    def expect(state):
        return {
            "x_cm": np.array(state["x_cm"]),
            "R": rotation(state["quat_wxyz"]),
            "Omega": np.array(state["Omega"]),
        }

    def integrals(trajectory):
        body = trajectory.body("top")
        momentum = body.angular_velocity * jnp.array([[about_pivot, about_pivot, p["J3"]]])
        height = p["l"] * body.orientation[:, 2, 2]
        return {
            "energy": jnp.sum(momentum * body.angular_velocity, axis=1) / 2 + p["m"] * p["g"] * height,
            "vertical momentum": jnp.sum(body.orientation[:, 2] * momentum, axis=1),
        }

    check_states(name, LAGRANGE["states"][case], observe, expect, trajectories)
    vertical, potential = np.cos(p["theta0"]), p["m"] * p["g"] * p["l"] * np.cos(p["theta0"])
    wanted = {"energy": p["J3"] * p["w3"] ** 2 / 2 + potential, "vertical momentum": p["J3"] * p["w3"] * vertical}
    check_invariants(name, integrals, wanted, trajectories)


@pytest.mark.parametrize(
    ("case", "quarter"), in_part(["asymmetric", "symmetric_kynema"], "asymmetric", "dzhanibekov", "symmetric_kynema")
)
def test_motion_of_the_free_body(case, quarter):
    """The closed form of Euler's equations; spatial angular momentum and energy are tested with the integrator."""

    def observe(trajectory):
        body = trajectory.body("body")
        return {"R": body.orientation, "Omega": body.angular_velocity}

    def expect(state):
        return {"R": np.array(state["R"]), "Omega": np.array(state["Omega_closed_form"])}

    name = f"free_rigid_body.{case}"
    check_states(name, FREE["states"][case], observe, expect, first_quarter(name) if quarter else None)


def test_published_sensitivity_of_the_paper():
    """The paper prints −0.002131825283595 for α₀ = 0.785398, by differences of fourth order at h = 1e-5 s."""
    name = "spinning_top_brulls.l_1.0_alpha0_0.785398"
    coarse, fine = (float(run.gradients["Psi"]["alpha0"]) for run in runs(name))
    published = document("spinning_top_brulls.json")["published"]["value"]
    # second order from h = 4e-3 s here to h = 1e-5 s there, and ours after extrapolation: h⁴
    their_error = abs(fine - coarse) * 4 / 3 * (1e-5 / 4e-3) ** 2
    our_error = 4 * (fine / coarse - 1) ** 2 * abs(published)
    assert their_error + our_error < 1e-5 * abs(published)  # five digits can be compared
    assert abs(extrapolated(coarse, fine) - published) <= their_error + our_error


def started_with(state, accelerations):
    """The state with other first accelerations, v̇₀ = a₀."""
    return eqx.tree_at(lambda s: (s.vdot, s.a), state, (accelerations, accelerations))


def test_published_precession_of_kynema():
    """Kynema's regression value at h = 0.01 s, ρ∞ = 1: its bodies start with zero accelerations.

    That is an error of first order, 1.5e-3 here, which our scheme makes too when it starts so.
    """
    model = free_rigid_body(**PROBLEMS["free_rigid_body.symmetric_kynema"].parameters)
    exact = rotation(FREE["states"]["symmetric_kynema"][-1]["quat_wxyz"])
    _, _, text = FREE["published"][0]["source"].partition("q=(")
    published = rotation([float(entry) for entry in text.rstrip(")").split(",")])
    state = lg.initial_state(model)
    integrator = lg.GeneralizedAlpha(1.0 - 1e-9)
    run = jax.jit(lambda s: lg.simulate(model, t1=5.0, num_steps=500, integrator=integrator, state0=s))
    ours = run(started_with(state, jnp.zeros_like(state.a))).body("body").orientation[-1]
    # Both have the error of second order of their schemes on top, theirs in the inertial frame, ours in the body's: in
    # the angle (h ω)²/12 of what is travelled, ω = |Ω|.
    speed = np.sqrt(1.5)
    allowed = 2 * (0.01 * speed) ** 2 / 12 * (5.0 * speed)
    assert np.abs(published - exact).max() > 10 * allowed
    np.testing.assert_allclose(ours, published, rtol=0, atol=allowed)


@pytest.fixture(scope="module")
def heavy_runs():
    """Position at 2 s for two ways to start, at h = 2e-4 and 1e-4 s."""
    model = heavy_top()
    state = lg.initial_state(model)
    theirs = jnp.array([0.0, 0.0, -0.654, -692.307, 0.0, 0.0])  # dynamic_heavy_top.cpp
    # one program: 20,000 steps, of which the first half at twice the step
    run = jax.jit(lambda s, t1: lg.simulate(model, t1=t1, num_steps=20000, state0=s).body("top").position)
    starts = (started_with(state, theirs), state)
    return np.array([[np.asarray(run(start, t1)[n]) for start in starts] for t1, n in ((4.0, 10000), (2.0, 20000))])


def test_published_position_of_the_heavy_top(heavy_runs):
    """Kynema's benchmark value: the scheme of Brüls, Cardona & Arnold at h = 2e-6 s, 1.2e-6 from the exact solution.

    Its test starts with accelerations that the joint does not allow, an error of first order. Ours with the same start,
    taken to h = 2e-6 s, is the published one.
    """
    published = np.array(HEAVY["published"][0]["u"]) + np.array([0.0, 1.0, 0.0])
    exact = np.array(HEAVY["states"][-1]["x"])
    coarse, fine = heavy_runs[:, 0] - heavy_runs[:, 1]
    first_order = (4 * fine - coarse) / 2e-4  # m/s, the part of second order cancels
    second_order = np.abs(heavy_runs[1, 1] - exact).max() * (2e-6 / 1e-4) ** 2
    # the rest of the first-order fit is its h³, (h Ω)² = 9e-4 of it at h = 2e-4 s times a coefficient; 5e-2 is allowed
    allowed = second_order + 0.05 * np.abs(first_order).max() * 2e-6
    assert np.abs(published - exact).max() > 10 * allowed
    np.testing.assert_allclose(published - exact, first_order * 2e-6, rtol=0, atol=allowed)


@pytest.mark.slow  # its published position is in the quick run
def test_published_orientation_of_the_heavy_top():
    """EXUDYN's index-2 solution with Euler parameters at 0.2 s, known to 5.3e-5 and to the file."""
    published = HEAVY["published"][1]
    coarse, fine = (
        run.trajectory.body("top").orientation[round(0.1 * (run.trajectory.t.size - 1))]
        for run in runs("heavy_top_bruls2012.to_2s")
    )
    # R is quadratic in q: δR ≤ 4 |q| δq, four components each; ours is exact to 5e-8 after extrapolation
    np.testing.assert_allclose(
        extrapolated(coarse, fine), rotation(published["q_wxyz"]), rtol=0, atol=4 * published["max_abs_diff"]
    )
