"""Bounds on the curves of a suspension, as constraints of its design."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, require
from lgsens.examples._quarter_car import QuarterCar
from lgsens.examples._suspension_curves import SuspensionCurves


class Band(eqx.Module):
    """Lower and upper bound of an angle [rad] at each travel, shape (n,)."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    @staticmethod
    def around(values: Float[Array, " n"], half_width: Float[Array, ""]) -> "Band":
        """As far as `half_width` either way."""
        return Band(values - half_width, values + half_width)

    def constraints(self, values: Float[Array, " n"]) -> Float[Array, " m"]:
        """≤ 0 where the values are within; in half widths of the band, so that 1 is a large violation."""
        half = (self.upper - self.lower) / 2
        return jnp.concatenate([(self.lower - values) / half, (values - self.upper) / half])


class CurveBounds(eqx.Module):
    """Bands in which camber and toe must stay over the travel of the wheel; None: no band.

    Attributes:
        travel: vertical displacements of the wheel centre [m], shape (n,).
        camber, toe: their bands, signs as in `SuspensionCurves`.
    """

    travel: Float[Array, " n"]
    camber: Band | None
    toe: Band | None

    @staticmethod
    def around(car: QuarterCar, *, travel, camber=None, toe=None, num_points: int = 9) -> "CurveBounds":
        """Bands around the curves of a suspension.

        Arguments:
            car: the suspension whose curves shall be kept.
            travel: how far the wheel moves up and down [m], shape (), positive.
            camber, toe: how far they may be off either way [rad], shape (), positive; None: as far as they like.
            num_points: at how many travels they are looked at.

        Raises `ValueError` for a travel or a width that is not positive, or out of the suspension's reach.
        """
        given = {"travel": travel, "camber": camber, "toe": toe}
        values = {name: as_float(value, (), f"`{name}`") for name, value in given.items() if value is not None}
        for name, value in values.items():
            require(lambda value: np.isfinite(value) and value > 0, f"`{name}` must be positive, got {value}.", value)
        at = jnp.linspace(-values["travel"], values["travel"], num_points)
        curves = car.curves(at)
        bands = {
            name: Band.around(getattr(curves, name), values[name]) if name in values else None
            for name in ("camber", "toe")
        }
        return CurveBounds(at, **bands)

    @property
    def bands(self) -> dict[str, Band]:
        """The bands that there are, by member of `SuspensionCurves`."""
        both = {"camber": self.camber, "toe": self.toe}
        return {name: band for name, band in both.items() if band is not None}

    def curves(self, car: QuarterCar) -> SuspensionCurves:
        """The curves of a car at the travels of the bounds; NaN where it cannot go."""
        return car.curves(self.travel, throw=False)

    def constraints(self, curves: SuspensionCurves) -> Float[Array, " m"]:
        """≤ 0 where the curves are within their bands, a vector."""
        parts = [band.constraints(getattr(curves, name)) for name, band in self.bands.items()]
        return jnp.concatenate(parts) if parts else jnp.zeros(0, self.travel.dtype)
