"""The design of an axle: numbers of its file, bands on what the rig measures, and the bump."""

from collections.abc import Iterable, Mapping
from operator import attrgetter
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_count, as_float, suggestion
from lgsens.criteria import time_integral
from lgsens.examples import Axle, AxleNumbers, Band
from lgsens.model import Model
from lgsens.rigs._characteristics import CHARACTERISTICS
from lgsens.rigs._curves import Vehicle
from lgsens.rigs._kc import KC, kc
from lgsens.rigs._sweeps import RACK, Sweep, standard_sweeps
from lgsens.simulation import Trajectory, simulate

Design = dict[str, Float[Array, " n"]]
# Curves over the travel of both wheels, of the left one: toe inward, camber outward.
CURVES = {"toe": ("parallel", "wheels.toe"), "camber": ("parallel", "wheels.camber")}


class AxleDesign(eqx.Module):
    """Least acceleration of the chassis over the bump, with what the rig measures kept in bands.

        min ∫ z̈² dt [m²/s³] over hardpoints, rates, camber and toe;  lower ≤ outputs of `kc` ≤ upper

    The car goes over the bump of the file with both wheels at once (`Axle.half`). A problem for `optimize.minimize` and
    `optimize.scipy_problem`: a function of `start`, between `lower` and `upper`, with its constraints in half widths of
    the bands.

    Attributes:
        axle: the axle at the start.
        numbers: which numbers of it are free, and their bounds.
        bands: what is kept, by name of a curve or characteristic, SI units.
        sweeps: of the rig, those that the bands ask for; `points` of each.
        vehicle: the car, of which this is an axle.
        t1, num_steps: end and steps of the run over the bump.
    """

    axle: Axle
    numbers: AxleNumbers
    bands: dict[str, Band]
    t1: Float[Array, ""]
    vehicle: Vehicle
    sweeps: tuple[tuple[str, Sweep], ...] = eqx.field(static=True)
    points: int = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)

    @staticmethod
    def of(
        axle: Axle,
        vary: Mapping[str, Any],
        keep: Mapping[str, Any],
        *,
        travel=0.05,
        points: int = 5,
        t1=0.5,
        num_steps: int = 250,
        vehicle: Vehicle | None = None,
        rack=None,
    ) -> "AxleDesign":
        """The problem of an axle.

        Arguments:
            axle: the axle at the start, both sides alike.
            vary: which numbers are free and how far, by patterns of their names (`AxleNumbers.select`).
            keep: by name of a curve, "toe" or "camber" over parallel travel [rad], or of a characteristic
                (`CHARACTERISTICS`, SI units): how far it may be off its value at the start, or its bounds, a pair.
                Empty: the numbers have their bounds alone, and no rig is asked.
            travel: how far the wheels travel up and down on the rig [m], shape ().
            points: of each sweep, odd.
            t1: end of the run over the bump [s], shape ().
            num_steps: of it, static.
            vehicle: the car, as of `kc`; None: `vehicle_of(axle)`.
            rack: way of the rack in sweeps that steer [m], a Python float; None: `rack_way(axle)`.

        Raises `ValueError` for names that there are not, widths that are not positive, an output that the axle does not
        have, and as `AxleNumbers.select`, `Axle.half` and `kc`.
        """
        numbers, bands = AxleNumbers.select(axle, vary), {}
        vehicle = vehicle_of(axle) if vehicle is None else vehicle
        way = rack_way(axle) if rack is None else rack
        known, every = (*CURVES, *CHARACTERISTICS), standard_sweeps(travel=travel, rack=way)
        for name in keep:
            if name not in known:
                raise ValueError(f"`keep`: {suggestion(name, known)}.")
        used = {_sweep_of(name) for name in keep}
        if axle.rack is None and (steered := [name for name in keep if _sweep_of(name) == RACK]):
            raise ValueError(f"`keep`: {steered} need a rack that steers, and the axle {axle.name!r} has none.")
        sweeps = tuple((name, every[name]) for name in every if name in used)
        t1, num_steps = as_float(t1, (), "`t1`"), as_count(num_steps, "num_steps", " (it is static)")
        now = _outputs(_test(axle, sweeps, points, vehicle), keep) if keep else {}
        for name, bound in keep.items():
            ends = [as_float(end, (), f"`keep[{name!r}]`") for end in (bound if np.ndim(bound) else (bound,))]
            band = Band.around(now[name], ends[0]) if len(ends) == 1 else Band(*(0.0 * now[name] + end for end in ends))
            if not bool(jnp.all(band.lower < band.upper)):
                raise ValueError(f"`keep[{name!r}]` must be a positive width or a pair (lower, upper), got {bound!r}.")
            bands[name] = band
        return AxleDesign(axle, numbers, bands, t1, vehicle, sweeps, points, num_steps)

    @property
    def start(self) -> Design:
        """The numbers of the axle as it is."""
        return self.numbers.of(self.axle)

    @property
    def bounds(self) -> tuple[Design, Design]:
        """The least and the greatest numbers."""
        return self.numbers.lower, self.numbers.upper

    def with_design(self, x: Design) -> Axle:
        """The axle with other numbers."""
        return self.numbers.replaced(self.axle, x)

    def test(self, x: Design, *, throw: bool = True) -> KC:
        """The sweeps of the rig that the bands ask for."""
        return _test(self.with_design(x), self.sweeps, self.points, self.vehicle, throw=throw)

    def scene(self, x: Design) -> Model:
        """The left half, which runs over the bump."""
        return self.with_design(x).half()

    def bump(self, x: Design, *, throw: bool = True) -> Trajectory:
        """The run of the left half over the bump."""
        return simulate(self.scene(x), t1=self.t1, num_steps=self.num_steps, throw=throw)

    def outputs(self, x: Design) -> dict[str, Float[Array, " n"]]:
        """What is kept in bands, SI units; NaN where the rig finds no equilibrium."""
        return _outputs(self.test(x, throw=False), self.bands) if self.bands else {}

    def objective(self, trajectory: Trajectory) -> Float[Array, ""]:
        """∫ z̈² dt of the chassis."""
        return time_integral(trajectory.t, trajectory.body("chassis").acceleration[:, 2] ** 2)

    def __call__(self, x: Design) -> tuple[Float[Array, ""], Float[Array, " m"]]:
        found = self.outputs(x)
        rows = [band.constraints(found[name]) for name, band in self.bands.items()]
        return self.objective(self.bump(x, throw=False)), jnp.concatenate([jnp.zeros(0, self.t1.dtype), *rows])


def vehicle_of(axle: Axle, **numbers: Any) -> Vehicle:
    """The car of an axle, as its file says, with the ratio of its rack.

    Arguments:
        axle: the axle.
        numbers: arguments of `Vehicle`, which go before those.

    Raises `ValueError` as `Vehicle`.
    """
    known = {"rear": axle.rear, "rack_ratio": None if axle.rack is None else axle.rack.ratio, **axle.vehicle}
    return Vehicle(**(known | numbers))


def rack_way(axle: Axle) -> float:
    """How far its rack goes in a sweep that steers [m]: its travel, if that is known."""
    travel = None if axle.rack is None else axle.rack.travel
    return 0.06 if travel is None else float(travel)


def _sweep_of(name: str) -> str:
    """The sweep that a curve or a characteristic is of."""
    return CURVES[name][0] if name in CURVES else CHARACTERISTICS[name].sweep


def _test(
    axle: Axle, sweeps: tuple[tuple[str, Sweep], ...], points: int, vehicle: Vehicle, *, throw: bool = True
) -> KC:
    return kc(axle.model(links="rods"), axle.wheel_centres, dict(sweeps), points=points, vehicle=vehicle, throw=throw)


def _outputs(test: KC, names: Iterable[str]) -> dict[str, Float[Array, " n"]]:
    """What a test says of the outputs of these names, each a vector."""
    found: dict[str, Any] = {}
    for name in names:
        if name in CURVES:
            sweep, member = CURVES[name]
            found[name] = attrgetter(member)(test.sweeps[sweep])[:, 0]
            continue
        value = CHARACTERISTICS[name].of(test.sweeps[CHARACTERISTICS[name].sweep])
        if value is None:
            raise ValueError(f"`keep`: the axle has no {name!r}: {CHARACTERISTICS[name].label}.")
        found[name] = value[None]
    return found
