"""The linear and the five-link quarter-car against their reference numbers."""

import jax.numpy as jnp
import numpy as np
import pytest
from reference_runs import check_criteria, check_states, document, runs

from lgsens.examples import PROBLEMS

LINEAR = [name for name in PROBLEMS if name.startswith("quarter_car_linear")]
FIVE_LINK = [name for name in PROBLEMS if name.startswith("five_link_quarter_car")]


@pytest.mark.parametrize("name", LINEAR)
@pytest.mark.slow
def test_criteria_and_gradients_of_the_linear_car(name):
    check_criteria(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIVE_LINK)
def test_criteria_and_gradients_of_the_five_link_car(name):
    """tests/sensitivity has its mechanism, its motion and Ψ₀ at other steps."""
    check_criteria(name)


def observe_linear_car(trajectory):
    sprung, unsprung = trajectory.body("sprung"), trajectory.body("unsprung")
    return {
        "z": jnp.stack([sprung.position[:, 2], unsprung.position[:, 2]], axis=1),
        "v": jnp.stack([sprung.velocity[:, 2], unsprung.velocity[:, 2]], axis=1),
        "zs_acc": sprung.acceleration[:, 2],
        "stroke": trajectory.force("suspension").length - 1.0,
        "tire_dyn_force": trajectory.force("tyre"),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", LINEAR)
def test_motion_of_the_linear_quarter_car(name):
    """The matrix exponential, at those of its times that this run reaches on its grid."""

    def expect(state):
        return {
            "z": np.array([state["zs"], state["zu"]]),
            "v": np.array([state["vs"], state["vu"]]),
            **{key: np.array(state[key]) for key in ("zs_acc", "stroke", "tire_dyn_force")},
        }

    states = document("quarter_car_linear.json")["states"]
    steps = runs(name)[0].trajectory.t.size - 1
    on_grid = lambda t: abs(t / PROBLEMS[name].t1 * steps - round(t / PROBLEMS[name].t1 * steps)) < 1e-9
    check_states(name, [state for state in states if on_grid(state["t"])], observe_linear_car, expect)
