"""The quarter-car of `lgsens optimize`: the problem of the paper's §9, and what is said and drawn of it."""

import argparse
import dataclasses
from typing import Any, NamedTuple

import numpy as np

from lgsens import plotting
from lgsens.cli._report import finite, suspension_file
from lgsens.cli._search import (
    BUMP,
    Goal,
    Search,
    band_row,
    closing_rows,
    constraint_row,
    objective_row,
    point_row,
    run_length,
    stages,
    table_lines,
    worst,
)
from lgsens.examples import (
    CurveBounds,
    QuarterCar,
    Response,
    RoadLimits,
    RoadResponse,
    SuspensionCurves,
    SuspensionDesign,
)

CURVE_POINTS = 41  # of the figure
# Name, quantity of the Response, limit of the DesignLimits, unit; in the order of `Response.constraints`.
CONSTRAINTS = (
    ("minimum tyre force", "tyre_force", "minimum_tyre_force", "N"),
    ("minimum spring length", "spring_length", "minimum_spring_length", "m"),
    ("maximum spring length", "spring_length", "maximum_spring_length", "m"),
)
# Name, quantity of RoadResponse and of RoadLimits, unit; in the order of `RoadLimits.constraints`.
ROAD_CONSTRAINTS = (("RMS tyre load on the road", "tyre", "N"), ("RMS wheel travel on the road", "travel", "m"))
ROAD = Goal(
    "sigma_w, RMS of the vertical acceleration of the chassis on the random road, weighted by ISO 2631, Wk",
    *("m/s^2", "$\\sigma_w$", "m/s²"),
)
SPEED, FACTOR = 20.0, 1.1  # m/s, and of what the start does
UNITS = {"stiffness": "N/m", "damping": "N s/m", "hardpoints": "m"}


class Responses(NamedTuple):
    """What is said of a design: over the bump, and on the random road."""

    bump: Response
    road: RoadResponse | None


def road_limits(arguments: argparse.Namespace, car: QuarterCar) -> RoadLimits | None:
    """The random road that the arguments ask for."""
    limits = dict(arguments.limit or ())
    if arguments.road is None:
        given = [f"--{name}" for name in ("speed", "limit") if getattr(arguments, name)]
        if given:
            raise ValueError(f"{' and '.join(given)} is of a random road; give its class as well, --road C")
        return None
    for name, factor in limits.items():
        if name not in ("tyre", "travel") or isinstance(factor, tuple) or factor <= 0:
            raise ValueError(f"--limit must be tyre=FACTOR or travel=FACTOR, positive, got {name}={factor}")
    factors = {"tyre": FACTOR, "travel": FACTOR} | limits
    return RoadLimits.around(car, roughness=arguments.road, speed=arguments.speed or SPEED, **factors)


class QuarterCarJob(NamedTuple):
    """The problem, and over which travel curves are drawn."""

    problem: SuspensionDesign
    travel: float

    @staticmethod
    def of(arguments: argparse.Namespace) -> "QuarterCarJob":
        """The problem that the arguments ask for."""
        path = suspension_file(arguments)
        for name in ("axle", "wheelbase", "centre_height", "braking_share", "traction_share", "rack"):
            if getattr(arguments, name) is not None:
                raise ValueError(f"--{name.replace('_', '-')} is of an axle, with --vary; leave it out")
        if arguments.keep:
            raise ValueError("--keep is of an axle, with --vary; of a corner, there are --keep-camber and --keep-toe")
        kept = {name: np.radians(width) for name in ("camber", "toe") if (width := getattr(arguments, f"keep_{name}"))}
        if kept and "hardpoints" not in arguments.parameters:
            names = " and ".join(f"--keep-{name}" for name in kept)
            raise ValueError(f"{names} is about hardpoints, which --parameters {arguments.parameters} does not move")
        settings = {"parameters": arguments.parameters, "wheel": arguments.wheel} | run_length(arguments)
        design = SuspensionDesign.load(path, **settings)
        keep = CurveBounds.around(design.car, travel=arguments.travel, **kept) if kept else None
        road = road_limits(arguments, design.car)
        return QuarterCarJob(dataclasses.replace(design, keep=keep, road=road), arguments.travel)

    @property
    def goal(self) -> Goal:
        """What is minimized."""
        return BUMP if self.problem.road is None else ROAD

    def criteria(self, x):
        """The objective of a design, its response, and the result of its simulation."""
        trajectory, road = self.problem.simulate(x, throw=False), self.problem.road
        bump = self.problem.response(trajectory)
        if road is None:
            return bump.objective, Responses(bump, None), trajectory.result
        on_road = road.response(self.problem.with_design(x))
        return on_road.acceleration, Responses(bump, on_road), trajectory.result

    @property
    def scale(self) -> dict[str, Any]:
        """A move of one box or one magnitude is a large change of the design."""
        start = self.problem.start
        boxes = {"hardpoints": self.problem.limits.hardpoint_box} if "hardpoints" in start else {}
        return {name: abs(value) for name, value in start.items()} | boxes

    def outcome(self, found: Search) -> "Outcome":
        """What was found, with the curves before and after where hardpoints were free."""
        outcome = Outcome(self.problem, found)
        if "hardpoints" not in self.problem.start:
            return outcome
        travel = np.linspace(-self.travel, self.travel, CURVE_POINTS)
        return outcome._replace(curves={label: car.curves(travel) for label, car in outcome.cars.items()})


class Outcome(NamedTuple):
    """What report and figures are made of."""

    problem: SuspensionDesign
    search: Search
    curves: dict[str, SuspensionCurves] | None = None

    @property
    def cars(self) -> dict[str, QuarterCar]:
        """The suspension before and after."""
        return {"before": self.problem.car, "after": self.problem.with_design(self.search.result.x)}

    def document(self) -> dict[str, Any]:
        """What is particular to the quarter-car, as JSON: SI units, points in the axes of the file."""
        return {
            "problem": "quarter-car",
            "suspension": self.problem.car.name,
            "design": {
                name: {"unit": UNITS[name]} | {label: self._values(name, x[name]) for label, x in stages(self.search)}
                for name in self.problem.start
            },
            "constraints": self._path_constraints() + self.kept_curves() + self._road_constraints(),
            "road": self._road(),
            "curves": self.curves
            and {
                label: {member: finite(np.asarray(values).tolist()) for member, values in curves._asdict().items()}
                for label, curves in self.curves.items()
            },
        }

    def _values(self, name: str, value: Any) -> Any:
        if name != "hardpoints":
            return float(value)
        car = self.problem.car
        points = car.axes.signs * np.asarray(value) + car.axes.offset
        return dict(zip(car.hardpoint_names, points.tolist()))

    def suspension(self, file: dict[str, Any]) -> dict[str, Any]:
        """The document of the file with the best design."""
        return self.problem.document(file, self.search.result.x)

    def _path_constraints(self) -> list[dict[str, Any]]:
        """The worst moment of each path constraint before and after, and whether it is active at the end."""
        rows = []
        for i, (name, quantity, limit, unit) in enumerate(CONSTRAINTS):
            ends = {
                label: worst(getattr(run.bump, quantity), run.bump.constraints[:, i], time=run.bump.t)
                for label, run in self._ends.items()
            }
            rows.append(constraint_row(name, unit, float(getattr(self.problem.limits, limit)), ends))
        return rows

    @property
    def _ends(self) -> dict[str, Responses]:
        return {"before": self.search.before, "after": self.search.after}

    def _road_constraints(self) -> list[dict[str, Any]]:
        """Tyre load and travel on the random road, before and after."""
        road = self.problem.road
        if road is None:
            return []
        rows, runs = [], {label: run.road for label, run in self._ends.items() if run.road is not None}
        for i, (name, quantity, unit) in enumerate(ROAD_CONSTRAINTS):
            ends = {
                label: worst([getattr(run, quantity)], road.constraints(run)[i : i + 1]) for label, run in runs.items()
            }
            rows.append(constraint_row(name, unit, float(getattr(road, quantity)), ends))
        return rows

    def _road(self) -> dict[str, Any] | None:
        """The random road, and next to the objective Ψ₀ over the bump."""
        road = self.problem.road
        if road is None:
            return None
        bump = {label: float(run.bump.objective) for label, run in self._ends.items()}
        return {
            "roughness": float(road.roughness),
            "speed": float(road.speed),
            "bump": {"name": BUMP.name, "unit": BUMP.unit} | bump,
        }

    def kept_curves(self) -> list[dict[str, Any]]:
        """How far each curve that is kept strays from its band's middle, before and after, at worst."""
        keep = self.problem.keep
        if keep is None:
            return []
        curves = {label: keep.curves(car) for label, car in self.cars.items()}
        return [
            band_row(name, band, {label: getattr(found, name) for label, found in curves.items()}, travel=keep.travel)
            for name, band in keep.bands.items()
        ]

    def figures(self) -> dict[str, Any]:
        """Responses, curves and mechanism."""
        before, after, limits = self.search.before.bump, self.search.after.bump, self.problem.limits

        def panel(label: str, member: str, factor: float, **limit) -> plotting.Panel:
            series = {"before": factor * getattr(before, member), "after": factor * getattr(after, member)}
            lines = {f"${name}$": factor * float(value) for name, value in limit.items()}
            return plotting.Panel(label, series, lines)

        lengths = {"l_{min}": limits.minimum_spring_length, "l_{max}": limits.maximum_spring_length}
        panels = [
            panel("chassis acceleration\n[m/s²]", "acceleration", 1.0),
            panel("suspension length\n[mm]", "spring_length", 1e3, **lengths),
            panel("tyre force\n[kN]", "tyre_force", 1e-3, **{"F_{min}": limits.minimum_tyre_force}),
        ]
        where = "a bump" if self.problem.road is None else "a bump, designed for a random road"
        title = f"Quarter-car over {where}: {self.search.change}"
        figures = {"response": plotting.time_histories(before.t, panels, title)}
        cars = {"before": self.problem.car}
        if self.curves is not None:  # k and c do not show
            cars, keep = self.cars, self.problem.keep
            bounds = {} if keep is None else {name: (keep.travel, b.lower, b.upper) for name, b in keep.bands.items()}
            figures["curves"] = plotting.suspension_curves(self.curves, bounds, title=self.problem.car.name)
        # Preloads do not show either; with any free length they are not computed.
        drawn = {"wheel": self.problem.wheel, "free_length": 1.0, "free_radius": 1.0}
        models = {name: car.model(**drawn) for name, car in cars.items()}
        axes = ("x, forward", "y, left", "z, up")
        return figures | {"mechanism": plotting.mechanism(models, title=self.problem.car.name, axes_names=axes)}

    def table(self, found: dict[str, Any]) -> list[str]:
        """The design, the objective, the constraints and the gradient check of a document, before and after."""
        rows = []
        for name, row in found["design"].items():
            if name != "hardpoints":
                limits = f"{row['lower']:.0f} .. {row['upper']:.0f}"
                rows.append((f"{name} [{row['unit']}]", row["before"], row["after"], limits, 0))
                continue
            for link in row["before"]:
                for i, axis in enumerate("xyz"):
                    ends = (1e3 * row[label][link][i] for label in ("before", "after", "lower", "upper"))
                    rows.append(point_row(f"{link} {axis}", *ends))
        rows += closing_rows(found)
        if found["road"]:
            rows.append(objective_row(found["road"]["bump"], "over the bump"))
        kept = [row["name"] for row in found["constraints"]]
        for name in ("camber", "toe"):
            if found["curves"] and f"change of {name}" not in kept:
                before, after = (np.degrees(found["curves"][label][name]) for label in ("before", "after"))
                change, travel = after - before, 1e3 * found["curves"]["before"]["travel"][-1]
                note = f"free, at worst over +-{travel:.0f} mm of travel"
                rows.append((f"change of {name} [deg]", 0.0, change[np.argmax(np.abs(change))], note, 2))
        return table_lines(found, rows)
