"""The quarter-car of `lgsens optimize`: the problem of the paper's §9, and what is said and drawn of it."""

import argparse
from typing import Any, NamedTuple

import numpy as np

from lgsens import plotting
from lgsens.cli._report import suspension_file
from lgsens.cli._search import (
    Search,
    band_row,
    closing_rows,
    constraint_row,
    point_row,
    run_length,
    stages,
    table_lines,
    worst,
)
from lgsens.examples import CurveBounds, QuarterCar, SuspensionCurves, SuspensionDesign

CURVE_POINTS = 41  # of the figure
# Name, quantity of the Response, limit of the DesignLimits, unit; in the order of `Response.constraints`.
CONSTRAINTS = (
    ("minimum tyre force", "tyre_force", "minimum_tyre_force", "N"),
    ("minimum spring length", "spring_length", "minimum_spring_length", "m"),
    ("maximum spring length", "spring_length", "maximum_spring_length", "m"),
)
UNITS = {"stiffness": "N/m", "damping": "N s/m", "hardpoints": "m"}


class QuarterCarJob(NamedTuple):
    """The problem, and over which travel curves are drawn."""

    problem: SuspensionDesign
    travel: float

    @staticmethod
    def of(arguments: argparse.Namespace) -> "QuarterCarJob":
        """The problem that the arguments ask for."""
        path = suspension_file(arguments)
        if arguments.keep:
            raise ValueError("--keep is of an axle, with --vary; of a corner, there are --keep-camber and --keep-toe")
        kept = {name: np.radians(width) for name in ("camber", "toe") if (width := getattr(arguments, f"keep_{name}"))}
        if kept and "hardpoints" not in arguments.parameters:
            names = " and ".join(f"--keep-{name}" for name in kept)
            raise ValueError(f"{names} is about hardpoints, which --parameters {arguments.parameters} does not move")
        keep = CurveBounds.around(QuarterCar.load(path), travel=arguments.travel, **kept) if kept else None
        settings = {"parameters": arguments.parameters, "wheel": arguments.wheel} | run_length(arguments)
        return QuarterCarJob(SuspensionDesign.load(path, keep=keep, **settings), arguments.travel)

    def criteria(self, x):
        """The response of a design, and the result of its simulation."""
        trajectory = self.problem.simulate(x, throw=False)
        return self.problem.response(trajectory), trajectory.result

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
        """What is particular to the quarter-car, as JSON: SI units, finite numbers only."""
        return {
            "problem": "quarter-car",
            "suspension": self.problem.car.name,
            "design": {
                name: {"unit": UNITS[name]} | {label: self._values(name, x[name]) for label, x in stages(self.search)}
                for name in self.problem.start
            },
            "constraints": self._path_constraints() + self.kept_curves(),
            "curves": self.curves
            and {
                label: {member: np.asarray(values).tolist() for member, values in curves._asdict().items()}
                for label, curves in self.curves.items()
            },
        }

    def _values(self, name: str, value: Any) -> Any:
        if name != "hardpoints":
            return float(value)
        return {link: np.asarray(point).tolist() for link, point in zip(self.problem.car.hardpoint_names, value)}

    def _path_constraints(self) -> list[dict[str, Any]]:
        """The worst moment of each path constraint before and after, and whether it is active at the end."""
        rows = []
        for i, (name, quantity, limit, unit) in enumerate(CONSTRAINTS):
            ends = {
                label: worst(getattr(response, quantity), response.constraints[:, i], time=response.t)
                for label, response in (("before", self.search.before), ("after", self.search.after))
            }
            rows.append(constraint_row(name, unit, float(getattr(self.problem.limits, limit)), ends))
        return rows

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
        before, after, limits = self.search.before, self.search.after, self.problem.limits

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
        title = f"Quarter-car over a bump: {self.search.change}"
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
        kept = [row["name"] for row in found["constraints"]]
        for name in ("camber", "toe"):
            if found["curves"] and f"change of {name}" not in kept:
                before, after = (np.degrees(found["curves"][label][name]) for label in ("before", "after"))
                change, travel = after - before, 1e3 * found["curves"]["before"]["travel"][-1]
                note = f"free, at worst over +-{travel:.0f} mm of travel"
                rows.append((f"change of {name} [deg]", 0.0, change[np.argmax(np.abs(change))], note, 2))
        return table_lines(found, rows)
