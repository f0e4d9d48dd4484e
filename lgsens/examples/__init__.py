"""Scenes with published or independently computed numbers, defined once for tests, notebooks, benchmarks."""

from lgsens.examples._axle import Axle as Axle
from lgsens.examples._axle_numbers import AxleNumbers as AxleNumbers
from lgsens.examples._comparison import COMPARISON as COMPARISON
from lgsens.examples._curve_bounds import Band as Band, CurveBounds as CurveBounds
from lgsens.examples._hardpoint_file import (
    DEFAULT as DEFAULT,
    shipped as shipped,
    suspension_document as suspension_document,
)
from lgsens.examples._identification import AccelerationTest as AccelerationTest
from lgsens.examples._leaf_pack import LeafPack as LeafPack
from lgsens.examples._leaf_spring import leaf_spring as leaf_spring
from lgsens.examples._link_beam import SectionShape as SectionShape
from lgsens.examples._mechanisms import (
    four_bar as four_bar,
    linear_quarter_car as linear_quarter_car,
    simple_pendulum as simple_pendulum,
    slider_crank as slider_crank,
    spatial_chain as spatial_chain,
)
from lgsens.examples._misaligned_four_bar import misaligned_four_bar as misaligned_four_bar
from lgsens.examples._problems import (
    PROBLEMS as PROBLEMS,
    Evaluation as Evaluation,
    Problem as Problem,
    Reference as Reference,
)
from lgsens.examples._quarter_car import (
    QuarterCar as QuarterCar,
    stiff_quarter_car as stiff_quarter_car,
)
from lgsens.examples._quarter_car_design import (
    PARAMETERS as PARAMETERS,
    DesignLimits as DesignLimits,
    Response as Response,
    SuspensionDesign as SuspensionDesign,
)
from lgsens.examples._road_limits import RoadLimits as RoadLimits
from lgsens.examples._road_response import RoadResponse as RoadResponse
from lgsens.examples._solid_axle import LIVE as LIVE, SolidAxle as SolidAxle
from lgsens.examples._suspension_curves import SuspensionCurves as SuspensionCurves
from lgsens.examples._tops import (
    free_rigid_body as free_rigid_body,
    heavy_top as heavy_top,
    lagrange_top as lagrange_top,
    spinning_top as spinning_top,
)
from lgsens.examples._wheel import (
    Stance as Stance,
    Wheel as Wheel,
    WheelPlane as WheelPlane,
    wheel_plane as wheel_plane,
)
