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
    """The path of P3, and the largest change of the energy relative to the kinetic one."""
    run = lg.simulate(bricard(), t1=10.0, num_steps=num_steps)
    states, system = run.states, run.system
    height = sum(run.body(name).position[:, 1] for name in system.body_names)
    kinetic = 0.5 * jax.vmap(lambda v: v @ (system.mass_matrix() @ v))(states.v)
    energy = kinetic + DATA["params"]["mass"] * DATA["params"]["g"] * height
    return np.asarray(run.body("rod 1").point(CORNERS[2])), float(np.ptp(energy) / kinetic.max())


def test_the_two_solutions_of_the_data_agree():
    published = DATA["published"]
    at = np.searchsorted(DATA["t"], published["t"])
    assert np.abs(np.array(published["P3"]) - np.array(DATA["P3"])[at]).max() < published["error"]
    np.testing.assert_array_equal(DATA["P3"][0], CORNERS[2])


@pytest.mark.slow
def test_bricard_over_ten_seconds():
    """Of second order towards the minimal coordinates, and in the energy."""
    paths, drifts = zip(*(motion(num_steps) for num_steps in (1000, 2000)))
    errors = [np.abs(path[:: len(path) // 20] - np.array(DATA["P3"])).max() for path in paths]
    for coarse, fine in (errors, drifts):
        assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.05)  # the next order is (hω)² = 1e-4 of it
    published = DATA["published"]
    at = np.rint(np.array(published["t"]) * 200.0).astype(int)
    assert np.abs(paths[1][at] - np.array(published["P3"])).max() < published["error"] + errors[1]
