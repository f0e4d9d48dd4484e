"""Derivatives of the trajectory, derived by hand (paper, §6–7)."""

from lgsens.sensitivity._criterion_terms import Functional as Functional
from lgsens.sensitivity._failed import Sound as Sound
from lgsens.sensitivity._known_run import Given as Given, KnownRun as KnownRun
from lgsens.sensitivity._linearization import (
    Parameters as Parameters,
    configuration_cotangent as configuration_cotangent,
    to_ambient as to_ambient,
)
from lgsens.sensitivity._linearized_steps import LinearStep as LinearStep
from lgsens.sensitivity._methods import (
    AbstractSensitivity as AbstractSensitivity,
    AdjointVariable as AdjointVariable,
    AssociativeScan as AssociativeScan,
    Autodiff as Autodiff,
    ContinuousAdjoint as ContinuousAdjoint,
    ContinuousDirect as ContinuousDirect,
    DirectDifferentiation as DirectDifferentiation,
)
from lgsens.sensitivity._on_the_fly import direct_on_the_fly as direct_on_the_fly
from lgsens.sensitivity._rules import linearized_trajectory as linearized_trajectory
from lgsens.sensitivity._saved import SavedRun as SavedRun, saved_run as saved_run
from lgsens.sensitivity._sweeps import direct_sweep as direct_sweep
