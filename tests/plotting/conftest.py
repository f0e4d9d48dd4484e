"""Motions that several modules animate."""

import numpy as np
import pytest

import lgsens as lg
from lgsens.examples import QuarterCar, four_bar


@pytest.fixture(scope="session")
def linkage():
    return lg.simulate(four_bar(), t1=0.5, num_steps=50)


@pytest.fixture(scope="session")
def rig():
    return QuarterCar.load().travel(np.linspace(-0.06, 0.06, 13), links="bodies")


@pytest.fixture(scope="session")
def swinging():
    """A soft cantilever of three elements under gravity."""
    section = lg.BeamSection.rectangle(0.02, 0.01, young=2e8, poisson=0.3, density=7850.0, damping=1e-3)
    beam = lg.Beam("b", section, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], elements=3)
    clamp = {"clamp": lg.FixedJoint(None, "b.0", at=[0.0, 0.0, 0.0])}
    model = lg.Model(beam.bodies, clamp, beam.forces | {"gravity": lg.Gravity([0.0, 0.0, -9.81])})
    return lg.simulate(model, t1=0.3, num_steps=150)
