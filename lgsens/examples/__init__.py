"""Scenes with published or independently computed numbers, one definition for tests, notebooks and benchmarks."""

from lgsens.examples._quarter_car import QuarterCar as QuarterCar
from lgsens.examples._quarter_car_design import (
    PARAMETERS as PARAMETERS,
    DesignLimits as DesignLimits,
    SuspensionDesign as SuspensionDesign,
)
from lgsens.examples._top import spinning_top as spinning_top
