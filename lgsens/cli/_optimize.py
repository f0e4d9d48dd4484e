"""`lgsens optimize quarter-car|FILE`: the suspension of the paper's §9, optimized, checked and drawn."""

import argparse
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from lgsens import plotting
from lgsens._progress import compiling
from lgsens.cli._report import (
    document,
    interrupted,
    output_folder,
    suspension_file,
    table,
    unfinished,
    write_json,
    written,
)
from lgsens.dynamics import RESULTS
from lgsens.examples import CurveBounds, QuarterCar, Response, SuspensionCurves, SuspensionDesign
from lgsens.optimize import GradientCheck, OptimizationResult, check_gradient, minimize

TOLERANCE = 1e-3  # of the scale of a constraint
CHECKED_DIRECTIONS = 4
CURVE_POINTS = 41  # of the figure
CHECK_STEP = 3e-5  # accelerations carry the round-off of positions over βh², too much for a smaller step


class Outcome(NamedTuple):
    """What report and figures are made of; `before` and `after` are of the start and the best design."""

    design: SuspensionDesign
    result: OptimizationResult
    before: Response
    after: Response
    checks: dict[str, GradientCheck]
    seconds: dict[str, float]
    curves: dict[str, SuspensionCurves] | None = None  # before and after, where hardpoints were free

    @property
    def cars(self) -> dict[str, QuarterCar]:
        """The suspension before and after."""
        return {"before": self.design.car, "after": self.design.with_design(self.result.x)}


def run(arguments: argparse.Namespace) -> int:
    """Optimize, write `result.json` and the figures, print a table; 1 if no design met the constraints."""
    with output_folder(arguments.out, arguments.overwrite or arguments.resume) as out:
        plotting.figure()  # asks for matplotlib now, not after minutes
        search = unfinished(out, "search.npz", arguments.resume)
        outcome = _optimize(_design(arguments), arguments.steps, search, progress=not arguments.quiet)
        if "hardpoints" in outcome.design.start:
            travel = np.linspace(-arguments.travel, arguments.travel, CURVE_POINTS)
            curves = {label: car.curves(travel) for label, car in outcome.cars.items()}
            outcome = outcome._replace(curves=curves)
        settings = {name: value for name, value in vars(arguments).items() if name not in ("run", "command", "resume")}
        found = document(outcome, settings, TOLERANCE)
        write_json(found, out / "result.json", indent=2, default=str)
        _figures(outcome, out)
        if outcome.result.reason != "interrupted":
            search.unlink()
        if not arguments.quiet:
            print(table(found), written(out), sep="\n")
    if outcome.result.reason == "interrupted":
        return interrupted("optimize", f"this is the best of {len(outcome.result.history.objective)} designs so far")
    return 0 if outcome.result.feasible else 1


def _design(arguments: argparse.Namespace) -> SuspensionDesign:
    """The problem that the arguments ask for."""
    t1, dt, path = arguments.t1, arguments.dt, suspension_file(arguments)
    num_steps = round(t1 / dt)
    if num_steps < 1 or abs(num_steps * dt / t1 - 1) > 1e-6:
        raise ValueError(f"--t1 must be a whole number of steps --dt, got t1 = {t1} s and dt = {dt} s")
    kept = {name: np.radians(width) for name in ("camber", "toe") if (width := getattr(arguments, f"keep_{name}"))}
    if kept and "hardpoints" not in arguments.parameters:
        names = " and ".join(f"--keep-{name}" for name in kept)
        raise ValueError(f"{names} is about hardpoints, which --parameters {arguments.parameters} does not move")
    keep = CurveBounds.around(QuarterCar.load(path), travel=arguments.travel, **kept) if kept else None
    settings = {"parameters": arguments.parameters, "wheel": arguments.wheel, "t1": t1, "num_steps": num_steps}
    return SuspensionDesign.load(path, keep=keep, **settings)


def _optimize(design: SuspensionDesign, steps: int, search: Path, progress: bool) -> Outcome:
    """The start design, the search, the best design, and the gradients at both against differences."""

    def criteria(x):
        trajectory = design.simulate(x, throw=False)
        response = design.response(trajectory)
        return response.objective, (response, trajectory.result)

    started = time.perf_counter()
    with compiling("the gradient", progress):
        evaluate = jax.jit(jax.value_and_grad(criteria, has_aux=True)).lower(design.start).compile()
    compiled = time.perf_counter()
    # A move of one box or one magnitude is a large change of the design.
    scale = {name: abs(value) for name, value in design.start.items() if name != "hardpoints"}
    if "hardpoints" in design.start:
        scale["hardpoints"] = design.limits.hardpoint_box

    def objective_and_gradient(x):
        (objective, _), gradient = evaluate(x)
        return objective, gradient

    def respond(x) -> tuple[Response, GradientCheck]:
        (_, (response, result)), _ = evaluate(x)
        if int(result) != RESULTS.successful:
            raise ValueError(f"the suspension cannot be simulated: {RESULTS(int(result)).message}")
        checked = {"step": CHECK_STEP, "max_directions": CHECKED_DIRECTIONS, "value_and_grad": objective_and_gradient}
        return jax.tree.map(np.asarray, response), check_gradient(lambda x: design(x)[0], x, scale=scale, **checked)

    before, check_before = respond(design.start)
    lower, upper = design.bounds
    bounds = {"lower": lower, "upper": upper, "log_scale": design.log_scale, "constraint_tolerance": TOLERANCE}
    result = minimize(design, design.start, **bounds, num_steps=steps, progress=progress, checkpoint=search)
    after, check_after = respond(result.x)
    seconds = {
        "compilation": compiled - started + result.compile_seconds,
        "optimization": result.run_seconds,
        "one gradient": result.run_seconds / len(result.history.objective),
        "total": time.perf_counter() - started,
    }
    return Outcome(design, result, before, after, {"start": check_before, "optimum": check_after}, seconds)


def _figures(outcome: Outcome, out: Path) -> None:
    """Responses, convergence and mechanism as PNG files in `out`."""
    design, before, after = outcome.design, outcome.before, outcome.after
    limits = design.limits

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
    reduction = 100 * (1 - outcome.result.objective / float(before.objective))
    change = f"{float(before.objective):.3f} to {outcome.result.objective:.3f} m²/s³ (−{reduction:.0f} %)"
    title = f"Quarter-car over a bump: $\\Psi_0$ from {change}"
    plotting.save(plotting.time_histories(before.t, panels, title), out / "response.png")
    marked = {"tolerance": TOLERANCE, "best": outcome.result.step, "objective": "$\\Psi_0$ [m²/s³]"}
    plotting.save(plotting.convergence(outcome.result.history, **marked), out / "convergence.png")
    cars = {"before": design.car}
    if outcome.curves is not None:  # k and c do not show
        cars = outcome.cars
        keep = design.keep
        bounds = {} if keep is None else {name: (keep.travel, b.lower, b.upper) for name, b in keep.bands.items()}
        fig = plotting.suspension_curves(outcome.curves, bounds, title=design.car.name)
        plotting.save(fig, out / "curves.png")
    # Preloads do not show either; with any free length they are not computed.
    models = {name: car.model(wheel=design.wheel, free_length=1.0, free_radius=1.0) for name, car in cars.items()}
    plotting.save(
        plotting.mechanism(models, title=design.car.name, axes_names=("x, forward", "y, left", "z, up")),
        out / "mechanism.png",
    )
