"""The axle of `lgsens optimize FILE --vary … --keep …`: designed to bands of what the rig says, over the bump."""

import argparse
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from lgsens import plotting
from lgsens.cli._argument_types import DEFAULT_PARAMETERS
from lgsens.cli._kc import vehicle_options
from lgsens.cli._report import asking_for, suspension_file
from lgsens.cli._search import BUMP, Goal, Search, band_row, closing_rows, point_row, run_length, stages, table_lines
from lgsens.examples import Axle
from lgsens.rigs import CHARACTERISTICS, AxleDesign, rack_way, vehicle_of

DEGREE = float(np.degrees(1.0))


class Response(NamedTuple):
    """What is said of a design: the run over the bump, and by name what is kept, SI units."""

    t: Float[Array, " n"]
    acceleration: Float[Array, " n"]
    kept: dict[str, Float[Array, " m"]]


class AxleJob(NamedTuple):
    """The problem."""

    problem: AxleDesign
    goal: Goal = BUMP

    @staticmethod
    def of(arguments: argparse.Namespace) -> "AxleJob":
        """The problem that the arguments ask for."""
        for name in ("road", "speed", "limit"):
            if getattr(arguments, name):
                raise ValueError(f"--{name} is of a corner; an axle, with --vary, is designed over the bump alone")
        if arguments.parameters != DEFAULT_PARAMETERS:
            raise ValueError("--parameters is of a corner; of an axle, what is free is what --vary names")
        for name in ("camber", "toe"):
            if getattr(arguments, f"keep_{name}"):
                raise ValueError(f"--keep-{name} is of a corner; of an axle, with --vary, it is --keep {name}=DEG")
        keep = {name: _si(name, bound) for name, bound in arguments.keep or ()}
        axle = Axle.load(suspension_file(arguments))
        vehicle = vehicle_of(axle, **vehicle_options(arguments))
        settings = {"travel": arguments.travel, "rack": arguments.rack, "vehicle": vehicle} | run_length(arguments)
        with asking_for({"travel": arguments.travel, "rack": arguments.rack or rack_way(axle)}):
            return AxleJob(AxleDesign.of(axle, dict(arguments.vary), keep, **settings))

    def criteria(self, x):
        """Ψ₀ of a design, its response, and the result of its simulation."""
        run = self.problem.bump(x, throw=False)
        acceleration = run.body("chassis").acceleration[:, 2]
        return self.problem.objective(run), Response(run.t, acceleration, self.problem.outputs(x)), run.result

    @property
    def scale(self) -> dict[str, Any]:
        """Half of what is between the bounds is a large change of the design."""
        lower, upper = self.problem.bounds
        return {kind: (upper[kind] - lower[kind]) / 2 for kind in lower}

    def outcome(self, found: Search) -> "Outcome":
        """What was found."""
        return Outcome(self.problem, found)


class Outcome(NamedTuple):
    """What report and figures are made of."""

    problem: AxleDesign
    search: Search

    def document(self) -> dict[str, Any]:
        """What is particular to the axle, as JSON: SI units, axes of the file; what is kept in the units shown."""
        names = self.problem.numbers.names
        return {
            "problem": "axle",
            "suspension": self.problem.axle.name,
            "design": {
                kind: {label: dict(zip(names[kind], np.asarray(x[kind]).tolist())) for label, x in stages(self.search)}
                for kind in names
            },
            "constraints": [
                band_row(name, band, {label: end.kept[name] for label, end in self._ends.items()}, unit, factor)
                for name, band in self.problem.bands.items()
                for factor, unit in [_shown(name)]
            ],
        }

    def suspension(self, file: dict[str, Any]) -> dict[str, Any]:
        """The document of the file with the best design."""
        return self.problem.numbers.document(file, self.problem.axle, self.search.result.x)

    @property
    def _ends(self) -> dict[str, Response]:
        return {"before": self.search.before, "after": self.search.after}

    def figures(self) -> dict[str, Any]:
        """The chassis over the bump, and both mechanisms."""
        series = {label: end.acceleration for label, end in self._ends.items()}
        panels = [plotting.Panel("chassis acceleration\n[m/s²]", series, {})]
        title = f"Axle over a bump: {self.search.change}"
        axles = {"before": self.problem.axle, "after": self.problem.with_design(self.search.result.x)}
        models = {label: axle.model(links="rods", tyres=True) for label, axle in axles.items()}
        axes = ("x, forward", "y, left", "z, up")
        return {
            "response": plotting.time_histories(self.search.before.t, panels, title),
            "mechanism": plotting.mechanism(models, title=self.problem.axle.name, axes_names=axes),
        }

    def table(self, found: dict[str, Any]) -> list[str]:
        """The design, the objective, what is kept and the gradient check of a document, before and after."""
        rows = []
        for kind, design in found["design"].items():
            for name in design["before"]:
                before, after, lower, upper = (design[label][name] for label in ("before", "after", "lower", "upper"))
                if kind == "hardpoints":
                    rows.append(point_row(name, *(1e3 * end for end in (before, after, lower, upper))))
                elif kind == "angles":
                    rows.append((f"{name[:-4]} [deg]", before, after, f"{lower:.6g} .. {upper:.6g}", 3))
                else:
                    digits = max(0, 3 - math.floor(math.log10(before)))  # four that count
                    rows.append((name, before, after, f"{lower:.6g} .. {upper:.6g}", digits))
        return table_lines(found, rows + closing_rows(found))


def _shown(name: str) -> tuple[float, str]:
    """Factor and unit in which what is kept is shown."""
    return CHARACTERISTICS[name].shown if name in CHARACTERISTICS else (DEGREE, "deg")


def _si(name: str, bound: float | tuple[float, float]) -> float | tuple[float, float]:
    """A width, or two bounds, from the unit shown."""
    factor, _ = _shown(name)
    if not isinstance(bound, tuple):
        if not bound > 0:
            raise ValueError(f"--keep {name}={bound:g} must be a positive width, or two bounds LOWER:UPPER")
        return bound / factor
    if not bound[0] < bound[1]:
        raise ValueError(f"--keep {name}={bound[0]:g}:{bound[1]:g} must have its lower bound first")
    return bound[0] / factor, bound[1] / factor
