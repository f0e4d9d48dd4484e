"""Scenes with published or independently computed numbers, defined once for tests, notebooks, benchmarks."""

from lgsens.examples._chain import spatial_chain as spatial_chain
from lgsens.examples._comparison import COMPARISON as COMPARISON
from lgsens.examples._curve_bounds import Band as Band, CurveBounds as CurveBounds
from lgsens.examples._four_bar import four_bar as four_bar
from lgsens.examples._free_rigid_body import free_rigid_body as free_rigid_body
from lgsens.examples._heavy_top import heavy_top as heavy_top
from lgsens.examples._identification import AccelerationTest as AccelerationTest
from lgsens.examples._lagrange_top import lagrange_top as lagrange_top
from lgsens.examples._linear_quarter_car import linear_quarter_car as linear_quarter_car
from lgsens.examples._problems import (
    PROBLEMS as PROBLEMS,
    Evaluation as Evaluation,
    Problem as Problem,
    Reference as Reference,
)
from lgsens.examples._quarter_car import QuarterCar as QuarterCar, stiff_quarter_car as stiff_quarter_car
from lgsens.examples._quarter_car_design import (
    PARAMETERS as PARAMETERS,
    DesignLimits as DesignLimits,
    Response as Response,
    SuspensionDesign as SuspensionDesign,
)
from lgsens.examples._simple_pendulum import simple_pendulum as simple_pendulum
from lgsens.examples._slider_crank import slider_crank as slider_crank
from lgsens.examples._suspension_curves import SuspensionCurves as SuspensionCurves
from lgsens.examples._top import spinning_top as spinning_top
