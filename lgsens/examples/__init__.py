"""Scenes with published or independently computed numbers, defined once for tests, notebooks, benchmarks."""

from lgsens.examples._four_bar import four_bar as four_bar
from lgsens.examples._quarter_car import QuarterCar as QuarterCar
from lgsens.examples._quarter_car_design import (
    PARAMETERS as PARAMETERS,
    DesignLimits as DesignLimits,
    Response as Response,
    SuspensionDesign as SuspensionDesign,
)
from lgsens.examples._top import spinning_top as spinning_top
