"""The suspension design problem of the paper's §9: comfort, under bounds on tyre force and spring length."""

import dataclasses
import functools
import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens._validate import suggestion
from lgsens.criteria import time_integral
from lgsens.examples._curve_bounds import CurveBounds
from lgsens.examples._file_axes import rewritten
from lgsens.examples._hardpoint_file import Reader, read
from lgsens.examples._quarter_car import GRAVITY, QuarterCar
from lgsens.examples._road_limits import RoadLimits
from lgsens.model import Model
from lgsens.simulation import Trajectory, simulate

# What the user may ask for, and the members of the design that it frees.
PARAMETERS = {
    "k,c": ("stiffness", "damping"),
    "hardpoints": ("hardpoints",),
    "k,c,hardpoints": ("stiffness", "damping", "hardpoints"),
}


def rates_of(car: QuarterCar) -> dict[str, Array]:
    """Stiffness of the spring [N/m] and damping of the damper [N s/m], shape (); without a spring a `ValueError`."""
    if car.spring is None:
        raise ValueError(
            f"Suspension {car.name!r} is on leaf springs, and the design problem looks at the length of a spring: take "
            "that of an axle, `rigs.AxleDesign` or `lgsens optimize FILE --vary …`."
        )
    return {"stiffness": car.spring.rate, "damping": car.damper.rate}


class DesignLimits(eqx.Module):
    """The limits of a suspension design, the table `[design]` of a hardpoint file; `DesignLimits.load()`.

    Attributes:
        minimum_tyre_force: F_min of eq. (48) [N].
        minimum_spring_length, maximum_spring_length: l_min and l_max of eqs. (49)–(50) [m].
        stiffness, damping: lower and upper bound of k [N/m] and of c [N s/m].
        hardpoint_box: how far a hardpoint may move either way along each axis [m].
    """

    minimum_tyre_force: Float[Array, ""]
    minimum_spring_length: Float[Array, ""]
    maximum_spring_length: Float[Array, ""]
    stiffness: tuple[Float[Array, ""], Float[Array, ""]]
    damping: tuple[Float[Array, ""], Float[Array, ""]]
    hardpoint_box: Float[Array, ""]

    @staticmethod
    def load(path: str | Path | None = None) -> "DesignLimits":
        """Read the limits from a TOML file; None: the one that ships with lgsens.

        Raises `ValueError` naming the file and the key for a table that is missing, incomplete or contradictory.
        """
        document, name = read(path)
        table = Reader(document, name).table("design")
        table.only([field.name for field in dataclasses.fields(DesignLimits)])
        shortest, longest = (table.metres(f"{which}_spring_length", 3.0) for which in ("minimum", "maximum"))
        if not shortest < longest:
            raise ValueError(
                f"Hardpoint file {name!r}, key 'design.maximum_spring_length': must exceed "
                f"minimum_spring_length = {float(shortest)}, got {float(longest)}."
            )
        return DesignLimits(
            table.number("minimum_tyre_force", positive=False),
            shortest,
            longest,
            table.interval("stiffness"),
            table.interval("damping"),
            table.metres("hardpoint_box", 1.0),
        )


class Response(NamedTuple):
    """What the design problem looks at; every array but `objective` has a leading axis over the n + 1 times.

    Attributes:
        t: times [s].
        acceleration: vertical acceleration of the chassis [m/s²].
        spring_length: l [m].
        tyre_force: F, the normal force of the tyre on the road [N].
        objective: Ψ₀ of eq. (47) [m²/s³], shape ().
        constraints: Ψ₁, Ψ₂, Ψ₃ of eqs. (48)–(50) over their scales [–], ≤ 0 where they hold, shape (n+1, 3).
    """

    t: Float[Array, " n"]
    acceleration: Float[Array, " n"]
    spring_length: Float[Array, " n"]
    tyre_force: Float[Array, " n"]
    objective: Float[Array, ""]
    constraints: Float[Array, "n 3"]

    __repr__ = brief


class SuspensionDesign(eqx.Module):
    """The most comfortable quarter-car over a bump that keeps its tyre on the road and within its travel.

        min Ψ₀ = ∫ v̇_z² dt of the chassis                    (47)
        Ψ₁(t) = F_min − F(t) ≤ 0   over the static tyre force  (48)
        Ψ₂(t) = l_min − l(t) ≤ 0   over l_max − l_min          (49)
        Ψ₃(t) = l(t) − l_max ≤ 0   over l_max − l_min          (50)

    at every time step; with `keep`, camber and toe within bands over the travel of the wheel. With `road` the objective
    is the weighted RMS of v̇_z on that random road in place of Ψ₀, under its limits and those over the bump. The design
    is a dict: `stiffness` k [N/m] and `damping` c [N s/m] of shape (), `hardpoints` [m] of shape (n, 3), those of
    `QuarterCar.hardpoints`, or all three. Whatever the design, the preloads of spring and tyre are
    those that hold the car at rest at the design position.

    Arguments:
        car: the suspension to start from.
        limits: bounds and limits.
        parameters: a key of `PARAMETERS`.
        wheel: "hinged" or "locked".
        t1: duration [s]. num_steps: its number of steps, static.
        keep: bands for the curves of the suspension, `CurveBounds`; None: the curves may change.
        road: a random road and its limits, `RoadLimits`, on which the wheel is locked; None: the bump alone.

    The limits that ship with lgsens, and why:
      - the start (k = 109 kN/m, c = 4.9 kN s/m, as in the source) is a firm production set-up: motion ratios
        0.60 and 0.89 give 40 N/mm at the wheel, the body at 1.4 Hz with 0.49 of critical damping;
      - F_min = 650 N is 15 % of the static 4,428 N: some grip is left on the far side of the bump;
      - l_min = 254 mm is 35 mm of wheel travel over the design position (275 mm), where a jounce bumper begins, which a
        bump as common as this one should not touch; l_max = 300 mm is 41 mm of travel down to the rebound stop;
      - k from 50 to 200 kN/m is the body at 1.0 to 1.8 Hz: below, 100 kg over this corner sink it by more
        than 5 cm and need levelling; above lie sports cars;
      - c from 1.5 to 10 kN s/m is 0.15 to 1 of critical damping at the start's stiffness;
      - ±30 mm is the room that a subframe usually leaves around a link's bush.

    Hardpoints change the motion ratios too, and by them the rates at the wheel: with the paper's constraints
    alone that is what their optimum uses. Links keep their masses.

    Raises `ValueError` for unknown parameters. Source: Sonneville & Brüls (2014), §9.
    """

    car: QuarterCar
    limits: DesignLimits
    parameters: str = eqx.field(static=True, default="k,c")
    wheel: str = eqx.field(static=True, default="hinged")
    t1: float = eqx.field(static=True, default=2.0)
    num_steps: int = eqx.field(static=True, default=1000)
    keep: CurveBounds | None = None
    road: RoadLimits | None = None

    def __check_init__(self):
        if self.parameters not in PARAMETERS:
            raise ValueError(f"`parameters`: {suggestion(self.parameters, PARAMETERS)}.")

    @staticmethod
    def load(path: str | Path | None = None, **settings: Any) -> "SuspensionDesign":
        """The design problem of a hardpoint file; None: the one that ships with lgsens.

        Arguments:
            path: the TOML file.
            settings: `parameters`, `wheel`, `t1`, `num_steps`, `keep`, `road` as above.

        Raises `ValueError` naming the file and the key for a file that cannot be read, is incomplete, or
        starts outside its own bounds.
        """
        car = QuarterCar.load(path)
        rates = rates_of(car)
        limits = DesignLimits.load(path)
        for key, value in rates.items():
            lower, upper = map(float, getattr(limits, key))
            if not lower <= float(value) <= upper:
                raise ValueError(
                    f"Hardpoint file {read(path)[1]!r}, key 'design.{key}': the start, {float(value)}, lies "
                    f"outside [{lower}, {upper}]."
                )
        return SuspensionDesign(car, limits, **settings)

    @property
    def start(self) -> dict[str, Array]:
        """The design of the hardpoint file."""
        every = {**rates_of(self.car), "hardpoints": self.car.hardpoints}
        return {name: every[name] for name in PARAMETERS[self.parameters]}

    @property
    def bounds(self) -> tuple[dict[str, Array], dict[str, Array]]:
        """The lower and the upper bound of the design."""
        limits, points, box = self.limits, self.car.hardpoints, self.limits.hardpoint_box
        every = {"stiffness": limits.stiffness, "damping": limits.damping, "hardpoints": (points - box, points + box)}
        lower, upper = ({name: every[name][i] for name in PARAMETERS[self.parameters]} for i in (0, 1))
        return lower, upper

    @property
    def log_scale(self) -> dict[str, bool]:
        """Which members are searched by their logarithm: the rates, which are positive and span a decade."""
        return {name: name != "hardpoints" for name in PARAMETERS[self.parameters]}

    def with_design(self, design: dict[str, Array]) -> QuarterCar:
        """The car with the values of a design."""
        return self.car.with_values(**design)

    def document(self, file: Mapping[str, Any], design: dict[str, Array]) -> dict[str, Any]:
        """The document of the car's file with the values of a design."""
        car, points, metre = self.with_design(design), {}, file["units"]["length"]
        of = {"stiffness": "spring", "damping": "damper"}
        every = rates_of(self.car).items()
        rates = {f"{of[key]}.{key}": (float(old), float(design[key])) for key, old in every if key in design}
        for name, new in car.on_chassis.items() if "hardpoints" in design else ():
            if name in car.links:
                path = ["links", name, dict(car.carriers).get(f"links.{name}", "chassis")]
                path = path if name in file["links"] else ["solid_axle", *path]
            else:
                path = ["joints", name, "at"]
            # a corner has a hinge of a solid axle as a point
            given = metre * np.asarray(functools.reduce(operator.getitem, path, file), float)
            moved = given + car.axes.signs * np.asarray(new - self.car.on_chassis[name])
            for index in np.ndindex(moved.shape):
                keys = [*path, *(str(i + 1) for i in index[:-1]), "xyz"[index[-1]]]
                points[".".join(keys)] = float(moved[index])
        return rewritten(file, points, rates)

    def scene(self, design: dict[str, Array]) -> Model:
        """What runs over the bump."""
        return self.with_design(design).model(wheel=self.wheel)

    def simulate(self, design: dict[str, Array], throw: bool = True) -> Trajectory:
        """The motion of a design over the bump; `throw` as in `lgsens.simulate`."""
        return simulate(self.scene(design), t1=self.t1, num_steps=self.num_steps, throw=throw)

    def response(self, trajectory: Trajectory) -> Response:
        """The objective and the path constraints of a motion."""
        limits = self.limits
        acceleration = trajectory.body("chassis").acceleration[:, 2]
        length, force = trajectory.force("spring").length, trajectory.force("tyre")
        static_force = GRAVITY * self.car.mass
        travel = limits.maximum_spring_length - limits.minimum_spring_length
        constraints = (
            (limits.minimum_tyre_force - force) / static_force,  # Ψ₁
            (limits.minimum_spring_length - length) / travel,  # Ψ₂
            (length - limits.maximum_spring_length) / travel,  # Ψ₃
        )
        objective = time_integral(trajectory.t, acceleration**2)
        return Response(trajectory.t, acceleration, length, force, objective, jnp.stack(constraints, axis=1))

    def __call__(self, design: dict[str, Array]) -> tuple[Float[Array, ""], Float[Array, " m"]]:
        """Ψ₀ [m²/s³], or the RMS on the road [m/s²], and the scaled constraints in a row: of path, curves and road.

        As `lgsens.optimize.minimize` wants them: a step that does not converge makes them NaN from there on, which
        `minimize` steps back from.
        """
        response = self.response(self.simulate(design, throw=False))
        objective, constraints = response.objective, [response.constraints.ravel()]
        if self.keep is not None:
            constraints.append(self.keep.constraints(self.keep.curves(self.with_design(design))))
        if self.road is not None:
            on_road = self.road.response(self.with_design(design))
            objective = on_road.acceleration
            constraints.append(self.road.constraints(on_road))
        return objective, jnp.concatenate(constraints)
