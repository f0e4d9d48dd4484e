"""What commands share, and what `lgsens optimize` says: the document of `result.json` and the table."""

import contextlib
import json
import platform
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from lgsens.examples import DEFAULT

# Name, quantity of the Response, limit of the DesignLimits, unit; in the order of `Response.constraints`.
CONSTRAINTS = (
    ("minimum tyre force", "tyre_force", "minimum_tyre_force", "N"),
    ("minimum spring length", "spring_length", "minimum_spring_length", "m"),
    ("maximum spring length", "spring_length", "maximum_spring_length", "m"),
)
ANEW = "the same command with --overwrite begins anew"
UNFINISHED = "search.npz", "tradeoff.json"  # from which --resume goes on
UNITS = {"stiffness": "N/m", "damping": "N s/m", "hardpoints": "m"}


@contextlib.contextmanager
def output_folder(out: Path, overwrite: bool) -> Iterator[Path]:
    """A new folder, or with `overwrite` one that may exist, and gone again after a failure."""
    if out.exists() and not (overwrite and out.is_dir()):
        remedy = "choose another --out DIR, or give --overwrite to replace the files in it"
        raise ValueError(f"output directory {str(out)!r} exists already: {remedy}")
    created = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out):  # asks for the right to write now, and not after minutes
        pass
    try:
        yield out
    except BaseException:
        if created:
            with contextlib.suppress(OSError):
                out.rmdir()
        raise


def suspension_file(arguments: Any) -> str:
    """The file or the name of the suspension that is asked for."""
    if arguments.hardpoints is not None and arguments.suspension != DEFAULT:
        raise ValueError(f"--hardpoints: {arguments.suspension!r} is a suspension already; leave one of them out")
    return arguments.hardpoints or arguments.suspension


def unfinished(out: Path, name: str, resume: bool) -> Path:
    """The file in a folder from which an interrupted command goes on. Raises `ValueError` where that has none."""
    path = out / name
    if resume and not path.is_file():
        raise ValueError(f"--resume: {str(path)!r}, from which to go on, is not there; leave --resume out")
    if not resume:
        path.unlink(missing_ok=True)
    return path


INTERRUPTED = 130  # the exit status that shells have for it


def interrupted(command: str, found: str | None, remedy: str = "the same command with --resume goes on") -> int:
    """Say so, what there is and how to go on."""
    more = f": {found}; {remedy}" if found else " before anything was found"
    print(f"\nlgsens {command}: interrupted{more}", file=sys.stderr)
    return INTERRUPTED


def write_all(command: str, files: Mapping[str, Callable[[Path], Any]], out: Path) -> int:
    """Each file by the function that writes it; an interrupt leaves whole ones only. The exit status, 0: all."""
    for i, (name, write) in enumerate(files.items()):
        try:
            write(out / name)
        except KeyboardInterrupt:
            (out / name).unlink(missing_ok=True)
            if not i:
                raise
            return interrupted(command, f"{' and '.join(list(files)[:i])} written", ANEW)
    return 0


def version(distribution: str = "lgsens") -> str:
    """The version of an installed distribution; "unknown" for a source tree that is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "unknown"


def versions(*names: str) -> dict[str, str]:
    """The versions of Python, of the libraries that every command uses, and of those named."""
    found = {name: version(name) for name in ("lgsens", "jax", "jaxlib", *names, "numpy")}
    return {"python": platform.python_version()} | found


def write_json(document: dict[str, Any], path: Path, **layout: Any) -> None:
    """A document as a file of finite numbers; `layout`: settings of `json.dumps`."""
    path.write_text(json.dumps(document, allow_nan=False, **layout) + "\n", encoding="utf-8")


def written(out: Path) -> str:
    """What the last line says."""
    return f"\nwritten to {out}: {', '.join(sorted(path.name for path in out.iterdir()))}"


def document(outcome: Any, settings: dict[str, Any], tolerance: float) -> dict[str, Any]:
    """Everything about an outcome, as JSON: SI units, finite numbers only."""
    design, result, before = outcome.design, outcome.result, outcome.before
    stages = dict(zip(("before", "after", "lower", "upper"), (design.start, result.x, *design.bounds)))
    return {
        "problem": "quarter-car",
        "suspension": design.car.name,
        "design": {
            name: {"unit": UNITS[name]} | {stage: _values(design, name, x[name]) for stage, x in stages.items()}
            for name in design.start
        },
        "objective": {
            "name": "Psi_0, integral of the squared vertical acceleration of the chassis",
            "unit": "m^2/s^3",
            "before": float(before.objective),
            "after": result.objective,
            "reduction": 1 - result.objective / float(before.objective),
        },
        "constraints": constraints(outcome, tolerance) + kept_curves(outcome, tolerance),
        "constraint_tolerance": tolerance,
        "curves": outcome.curves
        and {
            label: {member: np.asarray(values).tolist() for member, values in curves._asdict().items()}
            for label, curves in outcome.curves.items()
        },
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
            for where, check in outcome.checks.items()
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
        "seconds": outcome.seconds,
        "versions": versions("optax"),
    }


def constraints(outcome: Any, tolerance: float) -> list[dict[str, Any]]:
    """The worst moment of each path constraint before and after, and whether it is active at the end."""
    rows = []
    for i, (name, quantity, limit, unit) in enumerate(CONSTRAINTS):
        stages = {
            label: _worst(getattr(response, quantity), response.constraints[:, i], time=response.t)
            for label, response in (("before", outcome.before), ("after", outcome.after))
        }
        rows.append(_row(name, unit, getattr(outcome.design.limits, limit), stages, tolerance))
    return rows


def kept_curves(outcome: Any, tolerance: float) -> list[dict[str, Any]]:
    """How far each curve that is kept strays from its band's middle, before and after, at worst."""
    keep, rows = outcome.design.keep, []
    if keep is None:
        return rows
    cars = {"before": outcome.design.car, "after": outcome.design.with_design(outcome.result.x)}
    curves = {label: keep.curves(car) for label, car in cars.items()}
    for name, band in keep.bands.items():
        middle, half = np.asarray(band.lower + band.upper) / 2, np.asarray(band.upper - band.lower) / 2
        changes = {label: np.asarray(getattr(found, name)) - middle for label, found in curves.items()}
        stages = {label: _worst(c, np.abs(c) / half - 1, travel=keep.travel) for label, c in changes.items()}
        rows.append(_row(f"change of {name}", "rad", half[0], stages, tolerance))
    return rows


def _worst(values, violations, **places) -> dict[str, float]:
    """The value where a constraint is violated most, and the place, by the name of what it is a place in."""
    worst = int(np.argmax(violations))
    where = {name: float(place[worst]) for name, place in places.items()}
    return {"worst_value": float(values[worst]), **where, "violation_over_scale": float(violations[worst])}


def _row(name: str, unit: str, limit, stages: dict[str, dict[str, float]], tolerance: float) -> dict[str, Any]:
    active = abs(stages["after"]["violation_over_scale"]) <= tolerance
    return {"name": name, "unit": unit, "limit": float(limit), **stages, "active": active}


def _values(design: Any, name: str, value: Any) -> Any:
    if name != "hardpoints":
        return float(value)
    return {link: np.asarray(point).tolist() for link, point in zip(design.car.hardpoint_names, value)}


def table(found: dict[str, Any]) -> str:
    """The design, the objective, the constraints and the gradient check of a `document`, before and after."""
    lines = [f"{'':<36}{'before':>13}{'after':>13}   limits", "-" * 92]

    def line(name, before, after, note, digits):
        lines.append(f"{name:<36}{before:>13.{digits}f}{after:>13.{digits}f}   {note}")

    for name, row in found["design"].items():
        if name != "hardpoints":
            line(f"{name} [{row['unit']}]", row["before"], row["after"], f"{row['lower']:.0f} .. {row['upper']:.0f}", 0)
            continue
        for link in row["before"]:
            for i, axis in enumerate("xyz"):
                before, after, highest = (1e3 * row[stage][link][i] for stage in ("before", "after", "upper"))
                box = highest - before
                at_bound = ", at the bound" if box - abs(after - before) < 1e-3 * box else ""
                line(f"{link} {axis} [mm]", before, after, f"+-{box:.0f} mm{at_bound}", 1)
    objective, tolerance = found["objective"], found["constraint_tolerance"]
    line("Psi_0 [m^2/s^3]", objective["before"], objective["after"], f"{-100 * objective['reduction']:+.1f} %", 4)
    shown = {"m": (1e3, "mm"), "rad": (np.degrees(1.0), "deg")}
    for row in found["constraints"]:
        factor, unit = shown.get(row["unit"], (1.0, row["unit"]))
        before, after = (factor * row[stage]["worst_value"] for stage in ("before", "after"))
        violation = row["after"]["violation_over_scale"]
        state = "active" if row["active"] else "satisfied" if violation <= tolerance else "VIOLATED"
        note = f"{factor * row['limit']:g}, {state} ({violation:+.1e} of scale)"
        line(f"{row['name']} [{unit}]", before, after, note, 2)
    kept = [row["name"] for row in found["constraints"]]
    for name in ("camber", "toe"):
        if found["curves"] and f"change of {name}" not in kept:
            before, after = (np.degrees(found["curves"][stage][name]) for stage in ("before", "after"))
            change, travel = after - before, 1e3 * found["curves"]["before"]["travel"][-1]
            note = f"free, at worst over +-{travel:.0f} mm of travel"
            line(f"change of {name} [deg]", 0.0, change[np.argmax(np.abs(change))], note, 2)
    errors = (f"{max(check['relative_error']):.1e} at the {where}" for where, check in found["gradient_check"].items())
    seconds = (f"{name} {value:.2f} s" for name, value in found["seconds"].items())
    lines += ["-" * 92, f"gradient against central differences: relative error {', '.join(errors)}", ", ".join(seconds)]
    if not found["feasible"]:
        lines.append("No design satisfied the path constraints; this one violates them least. Try more --steps.")
    return "\n".join(lines)
