"""The Bricard mechanism, IFToMM benchmark A04, over 10 s: redundant all the way, against two other solutions."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from test_redundant import CORNERS, bricard

import lgsens as lg

DATA = json.loads((Path(__file__).parent / "data" / "bricard_A04.json").read_text(encoding="utf-8"))


def motion(num_steps):
    """P3, 20 times in a second times `num_steps`/1000, and the largest change of the energy [J]."""
    run = lg.simulate(bricard(), t1=10.0, num_steps=num_steps)
    states, system = run.states, run.system
    height = sum(run.body(name).position[:, 1] for name in system.body_names)
    kinetic = 0.5 * jax.vmap(lambda v: v @ (system.mass_matrix() @ v))(states.v)
    energy = kinetic + DATA["params"]["mass"] * DATA["params"]["g"] * height
    return np.asarray(run.body("rod 1").point(CORNERS[2])), float(np.ptp(energy)), float(kinetic.max())


def test_the_two_solutions_of_the_data_agree():
    published = DATA["published"]
    at = np.searchsorted(DATA["t"], published["t"])
    assert np.abs(np.array(published["P3"]) - np.array(DATA["P3"])[at]).max() < published["error"]
    np.testing.assert_array_equal(DATA["P3"][0], CORNERS[2])


@pytest.mark.slow
def test_bricard_over_ten_seconds():
    """Of second order towards the minimal coordinates, in P3 and in energy, which these conserve."""
    errors, drifts = [], []
    for num_steps in (1000, 2000):
        path, drift, kinetic = motion(num_steps)
        errors.append(np.abs(path[:: num_steps // 20] - np.array(DATA["P3"])).max())
        drifts.append(drift / kinetic)
    published = DATA["published"]
    at = np.rint(np.array(published["t"]) * num_steps / 10.0).astype(int)
    assert np.abs(path[at] - np.array(published["P3"])).max() < published["error"] + errors[1]
    print(errors, drifts)
    assert errors[1] < 1e-3
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)
