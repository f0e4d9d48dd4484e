"""A random road in the design of a suspension: comfort on it, under limits of tyre load and travel."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, number_field, require, require_positive
from lgsens.examples._quarter_car import QuarterCar, RoadResponse
from lgsens.model import road_roughness


class RoadLimits(eqx.Module):
    """A random road of ISO 8608, and the most that a suspension may do on it.

        σ_tyre/σ_tyre,max − 1 ≤ 0,     σ_travel/σ_travel,max − 1 ≤ 0

    Attributes:
        roughness: G_d(0.1 cycles/m) [m³], shape ().
        speed: V [m/s], shape ().
        tyre: σ_tyre,max, standard deviation of the load of the tyre [N], shape ().
        travel: σ_travel,max, that of the wheel to the chassis [m], shape ().

    Raises `ValueError` for numbers that are not positive.
    """

    roughness: Float[Array, ""] = number_field("roughness")
    speed: Float[Array, ""] = number_field("speed")
    tyre: Float[Array, ""] = number_field("tyre")
    travel: Float[Array, ""] = number_field("travel")

    def __check_init__(self):
        require_positive(self, "roughness", "speed", "tyre", "travel")

    @staticmethod
    def around(car: QuarterCar, *, roughness, speed, tyre=1.1, travel=1.1) -> "RoadLimits":
        """Limits by what a suspension does on the road.

        Arguments:
            car: the suspension.
            roughness, speed: as in `QuarterCar.random_road`.
            tyre, travel: the limits over the standard deviations of `car` [–], shape (), positive.

        Raises `ValueError` for a factor that is not positive, and as `QuarterCar.random_road`.
        """
        factors = {name: as_float(value, (), f"`{name}`") for name, value in (("tyre", tyre), ("travel", travel))}
        for name, value in factors.items():
            require(lambda value: 0.0 < value < np.inf, f"`{name}` must be positive, got {value}.", value)
        own = car.random_road(roughness=roughness, speed=speed)
        limits = {name: factor * getattr(own, name) for name, factor in factors.items()}
        return RoadLimits(roughness=road_roughness(roughness), speed=speed, **limits)

    def response(self, car: QuarterCar) -> RoadResponse:
        """What the road does to a car; the acceleration weighted by ISO 2631, Wk."""
        return car.random_road(roughness=self.roughness, speed=self.speed)

    def constraints(self, response: RoadResponse) -> Float[Array, "2"]:
        """≤ 0 where tyre load and travel are within their limits, over these."""
        return jnp.stack([response.tyre / self.tyre, response.travel / self.travel]) - 1.0
