"""Derivatives of the trajectory, derived by hand (paper, §6–7)."""

from lgsens.sensitivity._linearization import Parameters as Parameters
from lgsens.sensitivity._methods import (
    AbstractSensitivity as AbstractSensitivity,
    AdjointVariable as AdjointVariable,
    DirectDifferentiation as DirectDifferentiation,
)
