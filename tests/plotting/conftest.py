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
