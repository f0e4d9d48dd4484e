"""Scenes with published or independently computed numbers, one definition for tests, notebooks and benchmarks."""

from lgsens.examples._quarter_car import QuarterCar as QuarterCar
from lgsens.examples._top import spinning_top as spinning_top
