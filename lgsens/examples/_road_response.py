"""What a random road does to a quarter-car."""

from typing import Any, NamedTuple

from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens.analysis import FrequencyWeighting, linearize, random_road


class RoadResponse(NamedTuple):
    """A quarter-car on a random road: standard deviations (RMS about the equilibrium), shape () each.

    Attributes:
        acceleration: of the chassis, vertical [m/s²], weighted by frequency.
        tyre: of the load of the tyre [N].
        travel: of the centre of the wheel to the chassis, vertical [m].
    """

    acceleration: Float[Array, ""]
    tyre: Float[Array, ""]
    travel: Float[Array, ""]

    __repr__ = brief


def road_response(car: Any, *, roughness, speed, weighting: str | None) -> RoadResponse:
    """See `QuarterCar.random_road`."""
    linear = linearize(car.model(wheel="locked", chassis="heave"), inputs=("tyre",), outputs=_ON_ROAD)
    weighted = {} if weighting is None else {"acceleration": FrequencyWeighting(weighting)}
    return RoadResponse(**random_road(linear, roughness=roughness, speed=speed, weighting=weighted))


def _travel(instant) -> Float[Array, ""]:
    return instant.body("wheel").position[2] - instant.body("chassis").position[2]


_ON_ROAD = {
    "acceleration": lambda instant: instant.body("chassis").acceleration[2],
    "tyre": lambda instant: instant.force("tyre"),
    "travel": _travel,
}
