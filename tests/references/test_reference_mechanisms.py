"""Pendulum, slider-crank and four-bar against their reference numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from reference_runs import check_criteria, check_invariants, check_states, document, extrapolated, runs, turned

from lgsens.examples import PROBLEMS, four_bar, slider_crank


@pytest.mark.slow
@pytest.mark.parametrize("name", ["simple_pendulum_A01", "slider_crank_sundials", "four_bar_spring"])
def test_criteria_and_gradients(name):
    check_criteria(name)


@pytest.mark.slow
def test_motion_of_the_pendulum():
    """Elliptic functions; the multiplier is the tension of the rod, m (l θ̇² + g cos θ)."""
    p = PROBLEMS["simple_pendulum_A01"].parameters

    def observe(trajectory):
        body = trajectory.body("mass")
        return {"x": body.position[:, :2], "speed": body.velocity[:, :2], "lam": trajectory.multiplier("rod")[:, 0]}

    def expect(state):
        angle, rate = state["theta_from_downward"], state["thetadot"]
        return {
            "x": np.array([state["x"], state["y"]]),
            "speed": p["l"] * rate * np.array([-np.cos(angle), np.sin(angle)]),
            "lam": np.array(p["m"] * (p["l"] * rate**2 + p["g"] * np.cos(angle))),
        }

    def energy(trajectory):
        body = trajectory.body("mass")
        return {"energy": p["m"] * (jnp.sum(body.velocity**2, axis=1) / 2 + p["g"] * body.position[:, 1])}

    check_states("simple_pendulum_A01", document("simple_pendulum_A01.json")["states"], observe, expect)
    check_invariants("simple_pendulum_A01", energy, {"energy": 0.0})
    for run in runs("simple_pendulum_A01"):
        body = run.trajectory.body("mass")
        # z is never excited, and the rod keeps its length to the tolerance of Newton
        assert float(jnp.abs(body.position[:, 2]).max()) == 0.0
        np.testing.assert_allclose(jnp.linalg.norm(body.position, axis=1), p["l"], rtol=1e-12)


def observe_slider_crank(trajectory):
    """(q, x, p) of the source, its rates and its two multipliers, which are the force in the crank's pin."""
    crank, rod, slider = (trajectory.body(name) for name in ("crank", "conrod", "slider"))
    start = -jnp.arcsin(PROBLEMS["slider_crank_sundials"].parameters["a"])
    angles = (jnp.pi / 2 + turned(crank.orientation), start + turned(rod.orientation))
    return {
        "q": jnp.stack([angles[0], slider.position[:, 0], angles[1]], axis=1),
        "qd": jnp.stack([crank.angular_velocity[:, 2], slider.velocity[:, 0], rod.angular_velocity[:, 2]], axis=1),
        "qdd": jnp.stack(
            [crank.angular_acceleration[:, 2], slider.acceleration[:, 0], rod.angular_acceleration[:, 2]], axis=1
        ),
        "lam": trajectory.multiplier("crank_pin")[:, :2],
    }


def expect_slider_crank(state):
    return {name: np.array(state[name]) for name in ("q", "qd", "qdd", "lam")}


@pytest.mark.slow
def test_motion_of_the_slider_crank():
    states = document("slider_crank_sundials.json")["states"]
    check_states("slider_crank_sundials", states, observe_slider_crank, expect_slider_crank)
    # at t = 0 nothing is discretized: the forces, F cos p on the slider and −F sin p on the rod among them, and λ
    for run in runs("slider_crank_sundials"):
        observed, expected = observe_slider_crank(run.trajectory), expect_slider_crank(states[0])
        for key in ("q", "qdd", "lam"):
            np.testing.assert_allclose(observed[key][0], expected[key], rtol=0, atol=1e-13)


@pytest.mark.slow
def test_the_slider_crank_moves_in_its_plane():
    """One degree of freedom, 17 independent equations; nothing leaves the plane or turns out of it."""
    system = slider_crank().system()
    jacobian = np.asarray(system.constraint_jacobian(system.reference()[0], 0.0))
    assert jacobian.shape == (17, 18)
    assert np.linalg.matrix_rank(jacobian) == 17
    trajectory = runs("slider_crank_sundials")[1].trajectory
    for name in ("crank", "conrod", "slider"):
        body = trajectory.body(name)
        # Newton leaves the square of its tolerance of 1e-10; round-off of 1000 steps is what there is
        assert float(jnp.abs(body.position[:, 2]).max()) <= 1e-13
        assert float(jnp.abs(body.orientation[:, :2, 2]).max()) <= 1e-13
    jacobians = jax.vmap(trajectory.system.constraint_jacobian)(trajectory.states.q, trajectory.t)
    # far from a singular configuration all the way: the crank is shorter than the rod
    assert float(jnp.linalg.svd(jacobians, compute_uv=False)[:, -1].min()) > 0.1


@pytest.mark.slow
def test_published_output_of_idas():
    """G, dG/dk and dG/dc as IDAS prints them, at its tolerance of 1e-6 on states, sensitivities and quadratures."""
    published = document("slider_crank_sundials.json")["published"]
    coarse, fine = runs("slider_crank_sundials")
    value = float(extrapolated(coarse.values["G"], fine.values["G"]))
    # Its two examples, with the same tolerance, print G = 3.3366155 and 3.3366160; a tolerance per step becomes a few
    # times as much at the end of a run: 1e-5. The sensitivities are printed as 0.33346 and −0.36375, to 5e-6.
    np.testing.assert_allclose(value, [published["G"], published["G_other_run"]], rtol=1e-5)
    for name in ("k", "c"):
        slope = extrapolated(coarse.gradients["G"][name], fine.gradients["G"][name])
        np.testing.assert_allclose(slope, published[f"dG_d{name}"], rtol=1e-5 * value, atol=5e-6)


@pytest.mark.slow
def test_motion_of_the_four_bar():
    p = PROBLEMS["four_bar_spring"].parameters

    def pins(trajectory):
        """Path, velocity and acceleration of the pins B and C, by the coupler's motion."""
        coupler = trajectory.body("coupler")
        crank_end = jnp.array([p["a"] * np.cos(p["th0"]), p["a"] * np.sin(p["th0"]), 0.0])
        other_end = 2 * coupler.position[0] - crank_end
        rate, change = coupler.angular_velocity[:, 2:], coupler.angular_acceleration[:, 2:]
        found = []
        for at in (crank_end, other_end):
            path = coupler.point(at)[:, :2]
            arm = path - coupler.position[:, :2]
            across = jnp.stack([-arm[:, 1], arm[:, 0]], axis=1)
            velocity = coupler.velocity[:, :2] + rate * across
            found.append((path, velocity, coupler.acceleration[:, :2] + change * across - rate**2 * arm))
        return [jnp.concatenate(parts, axis=1) for parts in zip(*found)]

    def observe(trajectory):
        path, velocity, acceleration = pins(trajectory)
        return {
            "B_C": path,
            "vel": velocity,
            "acc": acceleration,
            "crank_angle": p["th0"] + turned(trajectory.body("crank").orientation),
            "spring_length": trajectory.force("spring").length,
        }

    def expect(state):
        return {name: np.array(state[name]) for name in ("B_C", "vel", "acc", "crank_angle", "spring_length")}

    check_states("four_bar_spring", document("four_bar_spring.json")["states"], observe, expect)
    system = four_bar().system()
    jacobian = np.asarray(system.constraint_jacobian(system.reference()[0], 0.0))
    assert jacobian.shape == (17, 18)
    assert np.linalg.matrix_rank(jacobian) == 17
