"""What is common to all that `lgsens optimize` takes: search, gradients against differences, and what is said."""

import dataclasses
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from lgsens._progress import compiling
from lgsens.cli._report import versions
from lgsens.criteria import Criterion, differentiate, differentiate_to
from lgsens.dynamics import RESULTS
from lgsens.integrate import GeneralizedAlpha
from lgsens.optimize import GradientCheck, Minimization, OptimizationResult, check_gradient
from lgsens.simulation import Reached, check_accuracy

TOLERANCE = 1e-3  # of the scale of a constraint
CHECKED_DIRECTIONS = 4
NAMES = 36  # columns of the table for them, at least
SHOWN = {"m": (1e3, "mm"), "rad": (float(np.degrees(1.0)), "deg")}
COMFORT = Criterion(integrand=lambda instant, x: instant.body("chassis").acceleration[2] ** 2)  # Ψ₀
FEWEST = 62  # steps in a second: a bump of 0.1 s is six of them
CHECK_STEP = 3e-5  # accelerations carry the round-off of positions over βh², too much for a smaller step


class Goal(NamedTuple):
    """What is minimized: its symbol and what it is, its unit, and both for figures."""

    name: str
    unit: str
    label: str
    shown: str


BUMP = Goal("Psi_0, integral of the squared vertical acceleration of the chassis", "m^2/s^3", "$\\Psi_0$", "m²/s³")


class Search(NamedTuple):
    """A search for less of a goal, and its two ends; `before` and `after` are responses, of NumPy arrays."""

    goal: Goal
    start: dict[str, Any]
    bounds: tuple[dict[str, Any], dict[str, Any]]
    result: OptimizationResult
    objective: float  # at the start
    before: Any
    after: Any
    checks: dict[str, GradientCheck]
    seconds: dict[str, float]

    @property
    def change(self) -> str:
        """Of the objective, for a title."""
        before, after, goal = self.objective, self.result.objective, self.goal
        return f"{goal.label} from {before:.3f} to {after:.3f} {goal.shown} (−{100 * (1 - after / before):.0f} %)"


def run_length(arguments: Any) -> dict[str, Any]:
    """`t1` and `num_steps` of the run over the bump that `--t1` and `--dt` ask for."""
    t1, dt = arguments.t1, arguments.dt
    num_steps = round(t1 / dt)
    if num_steps < 1 or abs(num_steps * dt / t1 - 1) > 1e-6:
        raise ValueError(f"--t1 must be a whole number of steps --dt, got t1 = {t1} s and dt = {dt} s")
    return {"t1": t1, "num_steps": num_steps}


def at_accuracy(job: Any, accuracy: float, progress: bool) -> tuple[Any, Reached]:
    """The job in as many steps as Ψ₀ over the bump and its gradient at the start take to have a relative error."""
    problem, fewest = job.problem, max(1, round(FEWEST * float(job.problem.t1)))
    check_accuracy(accuracy, fewest, GeneralizedAlpha(), problem.start)
    build = lambda x: problem.scene(x)  # a key of compiled programs, which a method of a pytree is not
    gradient = partial(differentiate, COMFORT, build, problem.start, t1=problem.t1)
    run = lambda n, throw: gradient(num_steps=n, throw=throw)
    with compiling("the gradient for the number of steps", progress):
        reached = differentiate_to(run, accuracy, GeneralizedAlpha(), fewest, extrapolate=False).reached
    if progress:
        print(f"Psi_0 and its gradient at the start: {reached.brief}", file=sys.stderr, flush=True)
    return job._replace(problem=dataclasses.replace(problem, num_steps=reached.num_steps)), reached


def stages(found: Search) -> Iterator[tuple[str, dict[str, Any]]]:
    """The design before and after, and its bounds."""
    return zip(("before", "after", "lower", "upper"), (found.start, found.result.x, *found.bounds))


def search(job: Any, steps: int, checkpoint: Path, progress: bool) -> Search:
    """The start design, the search, the best design, and the gradients at both against differences.

    Arguments:
        job: has `problem` for `minimize`, with `start` and `bounds`, and `log_scale` if it likes; `goal`; `scale`, a
            large change of the design; and `criteria`, design ↦ objective, response and result of its simulation.
        steps: most gradients of the search.
        checkpoint: the file from which it goes on.
        progress: whether it says what it does.
    """

    problem = job.problem
    lower, upper = problem.bounds
    log_scale = getattr(problem, "log_scale", False)
    started = time.perf_counter()
    with compiling("the simulation", progress):
        evaluate = jax.jit(job.criteria).lower(problem.start).compile()
    compiled = time.perf_counter()

    def simulated(x):
        value, response, result = evaluate(x)
        if int(result) != RESULTS.successful:
            raise ValueError(f"the suspension cannot be simulated: {RESULTS(int(result)).message}")
        return value, response

    first = simulated(problem.start)  # before more is compiled
    program = Minimization(
        problem,
        problem.start,
        lower=lower,
        upper=upper,
        log_scale=log_scale,
        constraint_tolerance=TOLERANCE,
        progress=progress,
    )

    def respond(x, value, response) -> tuple[float, Any, GradientCheck]:
        _, gradient = program.value_and_grad(x)  # that by which the search goes; of its neighbours values do
        settings = {"scale": job.scale, "step": CHECK_STEP, "max_directions": CHECKED_DIRECTIONS}
        check = check_gradient(problem, x, value_and_grad=lambda x: (evaluate(x)[0], gradient), **settings)
        return float(value), jax.tree.map(np.asarray, response), check

    at_start, before, check_before = respond(problem.start, *first)
    result = program(steps, progress=progress, checkpoint=checkpoint)
    _, after, check_after = respond(result.x, *simulated(result.x))
    seconds = {
        "compilation": compiled - started + result.compile_seconds,
        "optimization": result.run_seconds,
        "one gradient": result.run_seconds / len(result.history.objective),
        "total": time.perf_counter() - started,
    }
    checks = {"start": check_before, "optimum": check_after}
    return Search(job.goal, problem.start, (lower, upper), result, at_start, before, after, checks, seconds)


def search_document(found: Search, settings: dict[str, Any]) -> dict[str, Any]:
    """What is said of every search, as JSON: SI units, finite numbers only."""
    result, before, goal = found.result, found.objective, found.goal
    return {
        "objective": {
            "name": goal.name,
            "unit": goal.unit,
            "before": before,
            "after": result.objective,
            "reduction": 1 - result.objective / before,
        },
        "constraint_tolerance": TOLERANCE,
        "feasible": result.feasible,
        "gradient_check": {
            where: {
                "what": f"d{_symbol(goal.name)} per change of the design by its scale: the search's, and differences",
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


def _symbol(name: str) -> str:
    """Of a goal, for a table."""
    return name.partition(",")[0]


def objective_row(row: dict[str, Any], note: str) -> tuple[str, float, float, str, int]:
    """An objective in a table."""
    return f"{_symbol(row['name'])} [{row['unit']}]", row["before"], row["after"], note, 4


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
    """What is kept in a band, before and after, at worst; in `unit`: of a curve that is kept near that at the start how
    far it strays from there, else its value."""
    lower, upper = np.asarray(band.lower), np.asarray(band.upper)
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    changes = {label: np.asarray(found) - middle for label, found in values.items()}
    level = np.ptp(middle) == 0.0
    shown = lambda change: factor * (change + middle if level else change)
    ends = {label: worst(shown(c), np.abs(c) / half - 1, **places) for label, c in changes.items()}
    if level:
        return constraint_row(name, unit, [factor * float(lower[0]), factor * float(upper[0])], ends)
    return constraint_row(f"change of {name}", unit, factor * float(half[0]), ends)


def closing_rows(found: dict[str, Any]) -> list[tuple[str, float, float, str, int]]:
    """Of a document's table the objective and the constraints, in the units shown."""
    objective = found["objective"]
    change = f"{-100 * objective['reduction']:+.1f} %"
    rows = [objective_row(objective, change)]
    for row in found["constraints"]:
        factor, unit = SHOWN.get(row["unit"], (1.0, row["unit"]))
        before, after = (factor * row[label]["worst_value"] for label in ("before", "after"))
        violation = row["after"]["violation_over_scale"]
        state = "active" if row["active"] else "satisfied" if violation <= TOLERANCE else "VIOLATED"
        limits = factor * np.atleast_1d(row["limit"])
        note = f"{' .. '.join(f'{limit:.6g}' for limit in limits)}, {state} ({violation:+.1e} of scale)"
        rows.append((f"{row['name']} [{unit}]", before, after, note, 2 if np.abs(limits).max() >= 0.1 else 4))
    return rows


def point_row(name: str, before: float, after: float, lower: float, upper: float) -> tuple[str, float, float, str, int]:
    """A coordinate [mm] in a table."""
    half = (upper - lower) / 2
    at_bound = ", at the bound" if half - abs(after - (lower + upper) / 2) < 1e-3 * half else ""
    alike = abs(upper - before - half) < 1e-3 * half
    limits = f"+-{half:.0f} mm" if alike else f"{lower:.6g} .. {upper:.6g}"
    return f"{name} [mm]", before, after, limits + at_bound, 1


# why no step is left, by why the search ended
_UNSATISFIED = {
    "infeasible": "No design near it does better: widen what is varied, free more of it, or relax a limit.",
    "stalled": "The search found no step that helps: begin elsewhere, widen what is varied, or relax a limit.",
}


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
        advice = _UNSATISFIED.get(found["history"]["ended"], "Try more --steps.")
        lines.append(f"No design satisfied the constraints; this one violates them least. {advice}")
    return lines
