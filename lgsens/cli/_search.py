"""What is common to all that `lgsens optimize` takes: search, gradients against differences, and what is said."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from lgsens._progress import compiling
from lgsens.cli._report import versions
from lgsens.dynamics import RESULTS
from lgsens.optimize import GradientCheck, OptimizationResult, check_gradient, minimize

TOLERANCE = 1e-3  # of the scale of a constraint
CHECKED_DIRECTIONS = 4
NAMES = 36  # columns of the table for them, at least
SHOWN = {"m": (1e3, "mm"), "rad": (float(np.degrees(1.0)), "deg")}
CHECK_STEP = 3e-5  # accelerations carry the round-off of positions over βh², too much for a smaller step


class Search(NamedTuple):
    """A search and its two ends; `before` and `after` are responses, of NumPy arrays, with a member `objective`."""

    start: dict[str, Any]
    bounds: tuple[dict[str, Any], dict[str, Any]]
    result: OptimizationResult
    before: Any
    after: Any
    checks: dict[str, GradientCheck]
    seconds: dict[str, float]

    @property
    def change(self) -> str:
        """Of the objective, for a title."""
        before, after = float(self.before.objective), self.result.objective
        return f"$\\Psi_0$ from {before:.3f} to {after:.3f} m²/s³ (−{100 * (1 - after / before):.0f} %)"


def run_length(arguments: Any) -> dict[str, Any]:
    """`t1` and `num_steps` of the run over the bump that `--t1` and `--dt` ask for."""
    t1, dt = arguments.t1, arguments.dt
    num_steps = round(t1 / dt)
    if num_steps < 1 or abs(num_steps * dt / t1 - 1) > 1e-6:
        raise ValueError(f"--t1 must be a whole number of steps --dt, got t1 = {t1} s and dt = {dt} s")
    return {"t1": t1, "num_steps": num_steps}


def stages(found: Search) -> Iterator[tuple[str, dict[str, Any]]]:
    """The design before and after, and its bounds."""
    return zip(("before", "after", "lower", "upper"), (found.start, found.result.x, *found.bounds))


def search(
    problem: Any, criteria: Callable, scale: dict[str, Any], steps: int, checkpoint: Path, progress: bool
) -> Search:
    """The start design, the search, the best design, and the gradients at both against differences.

    Arguments:
        problem: for `minimize`, with `start` and `bounds`, and `log_scale` if it likes.
        criteria: design ↦ its response, which has an `objective`, and the result of its simulation.
        scale: what is a large change of the design.
        steps: most gradients of the search.
        checkpoint: the file from which it goes on.
        progress: whether it says what it does.
    """

    def objective(x):
        response, result = criteria(x)
        return response.objective, (response, result)

    started = time.perf_counter()
    with compiling("the gradient", progress):
        evaluate = jax.jit(jax.value_and_grad(objective, has_aux=True)).lower(problem.start).compile()
    compiled = time.perf_counter()

    def objective_and_gradient(x):
        (value, _), gradient = evaluate(x)
        return value, gradient

    def respond(x) -> tuple[Any, GradientCheck]:
        (_, (response, result)), _ = evaluate(x)
        if int(result) != RESULTS.successful:
            raise ValueError(f"the suspension cannot be simulated: {RESULTS(int(result)).message}")
        checked = {"step": CHECK_STEP, "max_directions": CHECKED_DIRECTIONS, "value_and_grad": objective_and_gradient}
        return jax.tree.map(np.asarray, response), check_gradient(
            lambda x: evaluate(x)[0][0], x, scale=scale, **checked
        )

    before, check_before = respond(problem.start)
    lower, upper = problem.bounds
    settings = {"log_scale": getattr(problem, "log_scale", False), "constraint_tolerance": TOLERANCE}
    result = minimize(
        problem,
        problem.start,
        lower=lower,
        upper=upper,
        num_steps=steps,
        progress=progress,
        checkpoint=checkpoint,
        **settings,
    )
    after, check_after = respond(result.x)
    seconds = {
        "compilation": compiled - started + result.compile_seconds,
        "optimization": result.run_seconds,
        "one gradient": result.run_seconds / len(result.history.objective),
        "total": time.perf_counter() - started,
    }
    checks = {"start": check_before, "optimum": check_after}
    return Search(problem.start, (lower, upper), result, before, after, checks, seconds)


def search_document(found: Search, settings: dict[str, Any]) -> dict[str, Any]:
    """What is said of every search, as JSON: SI units, finite numbers only."""
    result, before = found.result, float(found.before.objective)
    return {
        "objective": {
            "name": "Psi_0, integral of the squared vertical acceleration of the chassis",
            "unit": "m^2/s^3",
            "before": before,
            "after": result.objective,
            "reduction": 1 - result.objective / before,
        },
        "constraint_tolerance": TOLERANCE,
        "feasible": result.feasible,
        "gradient_check": {
            where: {
                "what": "dPsi_0 per change of the design by its scale: adjoint method and differences",
                "directions": list(check.directions),
                "gradient": check.exact.tolist(),
                "central_differences": check.difference.tolist(),
                "relative_error": check.error.tolist(),
                "step": check.step,
            }
            for where, check in found.checks.items()
        },
        "history": {
            "kept_step": result.step,
            "ended": result.reason,
            # JSON has no NaN; a step whose simulation failed is null
            **{
                name: [float(value) if np.isfinite(value) else None for value in getattr(result.history, name)]
                for name in ("objective", "worst_constraint", "gradient_norm")
            },
        },
        "settings": settings,
        "seconds": found.seconds,
        "versions": versions("optax"),
    }


def constraint_row(name: str, unit: str, limit: Any, stages: dict[str, dict[str, float]]) -> dict[str, Any]:
    """A constraint before and after, and whether it is active at the end."""
    active = abs(stages["after"]["violation_over_scale"]) <= TOLERANCE
    return {"name": name, "unit": unit, "limit": limit, **stages, "active": active}


def worst(values: Any, violations: Any, **places: Any) -> dict[str, float]:
    """The value where a constraint is violated most, and the place, by the name of what it is a place in."""
    most = int(np.argmax(violations))
    where = {name: float(place[most]) for name, place in places.items()}
    return {"worst_value": float(values[most]), **where, "violation_over_scale": float(violations[most])}


def band_row(
    name: str, band: Any, values: dict[str, Any], unit: str = "rad", factor: float = 1.0, **places: Any
) -> dict[str, Any]:
    """How far what is kept strays from the middle of its band, before and after, at worst; in `unit`."""
    middle, half = np.asarray(band.lower + band.upper) / 2, np.asarray(band.upper - band.lower) / 2
    changes = {label: np.asarray(found) - middle for label, found in values.items()}
    ends = {label: worst(factor * c, np.abs(c) / half - 1, **places) for label, c in changes.items()}
    return constraint_row(f"change of {name}", unit, abs(factor) * float(half[0]), ends)


def closing_rows(found: dict[str, Any]) -> list[tuple[str, float, float, str, int]]:
    """Of a document's table the objective and the constraints, in the units shown."""
    objective = found["objective"]
    change = f"{-100 * objective['reduction']:+.1f} %"
    rows = [("Psi_0 [m^2/s^3]", objective["before"], objective["after"], change, 4)]
    for row in found["constraints"]:
        factor, unit = SHOWN.get(row["unit"], (1.0, row["unit"]))
        before, after = (factor * row[label]["worst_value"] for label in ("before", "after"))
        violation = row["after"]["violation_over_scale"]
        state = "active" if row["active"] else "satisfied" if violation <= TOLERANCE else "VIOLATED"
        note = f"{factor * row['limit']:g}, {state} ({violation:+.1e} of scale)"
        rows.append((f"{row['name']} [{unit}]", before, after, note, 2 if factor * row["limit"] >= 0.1 else 4))
    return rows


def point_row(name: str, before: float, after: float, lower: float, upper: float) -> tuple[str, float, float, str, int]:
    """A coordinate [mm] in a table."""
    half = (upper - lower) / 2
    at_bound = ", at the bound" if half - abs(after - (lower + upper) / 2) < 1e-3 * half else ""
    return f"{name} [mm]", before, after, f"+-{half:.0f} mm{at_bound}", 1


def table_lines(found: dict[str, Any], rows: list[tuple[str, float, float, str, int]]) -> list[str]:
    """A table of rows: name, before, after, a note and how many decimals; then the gradient check, seconds, advice."""
    width = max(NAMES, *(len(name) + 2 for name, *_ in rows))
    rule = "-" * (width + 56)
    lines = [f"{'':<{width}}{'before':>13}{'after':>13}   limits", rule]
    for name, before, after, note, digits in rows:
        lines.append(f"{name:<{width}}{before:>13.{digits}f}{after:>13.{digits}f}   {note}")
    errors = (f"{max(check['relative_error']):.1e} at the {where}" for where, check in found["gradient_check"].items())
    seconds = (f"{name} {value:.2f} s" for name, value in found["seconds"].items())
    lines += [rule, f"gradient against central differences: relative error {', '.join(errors)}", ", ".join(seconds)]
    if not found["feasible"]:
        lines.append("No design satisfied the constraints; this one violates them least. Try more --steps.")
    return lines
