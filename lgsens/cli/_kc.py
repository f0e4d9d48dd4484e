"""`lgsens kc FILE`: kinematics and compliance of an axle, on a page, in pictures and in tables."""

import argparse
import csv
import html
import io
import math
from operator import attrgetter
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lgsens import plotting, rigs
from lgsens._progress import compiling
from lgsens._validate import suggestion
from lgsens.cli._report import (
    asking_for,
    finite,
    output_folder,
    suspension_file,
    versions,
    write_all,
    write_json,
    written,
)
from lgsens.dynamics import RESULTS
from lgsens.examples import Axle

# By unit of a sweep's number the factor and the unit shown.
SHOWN = {"m": (1e3, "mm"), "N": (1e-3, "kN"), "N m": (1.0, "N m")}
STYLE = """body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 82rem; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; } td, th { padding: .15rem .8rem; text-align: left; }
td.n { text-align: right; font-variant-numeric: tabular-nums; } tr:nth-child(even) { background: #f6f7f9; }
.columns { columns: 2; column-gap: 2rem; } .columns table { break-inside: avoid; width: 100%; }
svg { width: 100%; height: auto; } nav a { margin-right: .9rem; } p.note { color: #555; max-width: 60rem; }"""
NOTE = (
    "Chassis held, pads without friction under both wheels, springs and bushings in equilibrium at every point. Axes "
    "and signs of ISO 8855: x forward, y left, z up; toe-in, camber with the top outward, caster with the top rearward "
    "and forces of the tyre on the wheel in tyre axes are positive. Lateral, braking and aligning loads act at the "
    "contact centre, traction at the wheel centre, of a live axle at the contact centre too; rates and compliances are "
    "exact derivatives at the design position."
)


def run(arguments: argparse.Namespace) -> int:
    """Write `kc.html`, `kc.json`, `kc.csv` and a picture of each sweep, and print the characteristics."""
    with output_folder(arguments.out, arguments.overwrite) as out:
        plotting.figure()  # asks for matplotlib now
        axle = Axle.load(suspension_file(arguments))
        sweeps = _sweeps(arguments, axle)
        chosen = _chosen(arguments.gradient, sweeps, axle)
        vehicle = rigs.vehicle_of(axle, **vehicle_options(arguments))
        model = axle.model(links="rods", compliant=not arguments.rigid)
        # the options are those of `standard_sweeps`
        own = {"parallel": "travel", "single": "travel", "opposite": "roll", "steering": "rack"}
        options = {name: own.get(name, name.removesuffix("_opposed")) for name in sweeps}
        settings = {"sweeps": sweeps, "points": arguments.points, "vehicle": vehicle}
        with compiling("the equilibria of the axle", not arguments.quiet):
            test = rigs.kc(model, axle.wheel_centres, **settings, throw=False)
        if int(test.result) != RESULTS.successful:  # which raises, and names the options of the sweeps that failed
            failed = [name for name, found in test.sweeps.items() if not np.isfinite(found.wheels.travel).all()]
            with asking_for({options[name]: sweeps[name].amplitude for name in failed or sweeps}):
                rigs.kc(model, axle.wheel_centres, **settings)
        numbers = {name: float(value) for name, value in rigs.characteristics(test).items()}
        gradients = {}
        if arguments.gradient == "all":
            chosen = list(numbers)
        for name in chosen:
            if name not in numbers:
                raise ValueError(f"argument --gradient: this axle has no {name!r}; it has {', '.join(numbers)}")
        if chosen:
            with compiling("their gradients by the hardpoints", not arguments.quiet):
                gradients = _gradients(axle, chosen, sweeps, vehicle, compliant=not arguments.rigid)
        figures = {name: _figure(test, name, sweep, axle.name) for name, sweep in sweeps.items()}
        files: dict[str, Any] = {
            "kc.json": lambda path: write_json(_document(axle, test, sweeps, numbers, gradients), path),
            "kc.csv": lambda path: _write_table(test, sweeps, path),
            "kc.html": lambda path: path.write_text(_page(axle, sweeps, numbers, gradients, figures), encoding="utf-8"),
        }
        for name, figure in figures.items():
            files[f"{name}.png"] = lambda path, figure=figure: plotting.save(figure, path, dpi=110)
        if status := write_all("kc", files, out):
            return status
        if not arguments.quiet:
            shown = [table(numbers), *([_of_gradients(axle, gradients)] if gradients else []), written(out, files)]
            print(*shown, sep="\n")
    return 0


def _sweeps(arguments: argparse.Namespace, axle: Axle) -> dict[str, rigs.Sweep]:
    amplitudes = {name: getattr(arguments, name) for name in ("travel", "roll", "lateral", "braking", "traction")}
    rack = arguments.rack or rigs.rack_way(axle)
    known = rigs.standard_sweeps(**amplitudes, rack=rack, aligning=arguments.aligning)
    if axle.rack is None:
        del known["steering"]
    names = _list(arguments.sweeps) if arguments.sweeps else list(known)
    for name in names:
        if name not in known:
            more = "; this axle has no rack" if name == "steering" else ""
            raise ValueError(f"argument --sweeps: {suggestion(name, known)}{more}")
    if arguments.points < 3 or not arguments.points % 2:
        raise ValueError(f"argument --points: must be odd and at least 3, got {arguments.points}")
    return {name: known[name] for name in names}


def _list(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def vehicle_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Of the car those numbers that are given."""
    names = ("wheelbase", "centre_height", "braking_share", "traction_share")
    given = {name: value for name in names if (value := getattr(arguments, name)) is not None}
    return given if arguments.axle is None else given | {"rear": arguments.axle == "rear"}


def _chosen(asked: str | None, sweeps: dict[str, rigs.Sweep], axle: Axle) -> list[str]:
    """The characteristics whose gradients are asked for."""
    known = [name for name, one in rigs.CHARACTERISTICS.items() if one.sweep in sweeps]
    names = [] if not asked else known if asked == "all" else _list(asked)
    for name in names:
        if name in rigs.CHARACTERISTICS and name not in known:
            sweep = rigs.CHARACTERISTICS[name].sweep
            raise ValueError(f"argument --gradient: {name!r} is of the sweep {sweep!r}, which --sweeps leaves out")
        if name not in known:
            raise ValueError(f"argument --gradient: {suggestion(name, known)}, or all of them: all")
    if names and not axle.hardpoint_names:
        raise ValueError("argument --gradient: no link or joint of this axle holds on to the chassis")
    return names


def _gradients(axle: Axle, names: list[str], sweeps: dict[str, rigs.Sweep], vehicle: rigs.Vehicle, *, compliant: bool):
    """By characteristic its derivatives by the hardpoints, alike on both sides, in the axes of the file, (n, 3), SI."""
    needed = {rigs.CHARACTERISTICS[name].sweep: sweeps[rigs.CHARACTERISTICS[name].sweep] for name in names}

    def of(points):
        moved = axle.with_hardpoints(points)
        model = moved.model(links="rods", compliant=compliant)
        found = rigs.characteristics(
            rigs.kc(model, moved.wheel_centres, needed, points=3, vehicle=vehicle, throw=False)
        )
        return {name: value for name, value in found.items() if name in names}

    slopes = jax.jit(jax.jacfwd(of))(axle.hardpoints)
    return {name: axle.hardpoint_signs * np.asarray(slopes[name]) for name in names}


def _members(curves: rigs.AxleCurves) -> dict[str, np.ndarray]:
    """All outputs of a sweep by name, those of the wheels as "wheels.toe" and "rates.toe"."""
    inner = [f"{group}.{name}" for group in ("wheels", "rates") for name in rigs.WheelCurves._fields]
    names = [name for name in curves._fields if name not in ("wheels", "rates")] + inner
    found = {name: attrgetter(name)(curves) for name in names}
    return {name: np.asarray(values) for name, values in found.items() if values is not None}


def _document(axle: Axle, test: rigs.KC, sweeps, numbers: dict[str, float], gradients) -> dict[str, Any]:
    """Everything, as JSON: SI units."""
    return {
        "axle": axle.name,
        "characteristics": {
            name: {"value": finite(value), "sweep": rigs.CHARACTERISTICS[name].sweep, "label": _label(name)}
            for name, value in numbers.items()
        },
        "gradients": {
            name: dict(zip(axle.hardpoint_names, finite(found.tolist()))) for name, found in gradients.items()
        },
        "sweeps": {
            name: {"unit": sweep.unit, "shares": dict(sweep.shares)}
            | {member: finite(values.tolist()) for member, values in _members(test.sweeps[name]).items()}
            for name, sweep in sweeps.items()
        },
        "versions": versions(),
    }


def _write_table(test: rigs.KC, sweeps: dict[str, rigs.Sweep], path: Path) -> None:
    """A line for each point of each sweep, a column for each number, SI units, all digits."""
    tables = {}
    for name in sweeps:
        tables[name] = columns = {}
        for member, values in _members(test.sweeps[name]).items():
            sides = {"": values} if values.ndim == 1 else {".left": values[:, 0], ".right": values[:, 1]}
            columns |= {member + side: one for side, one in sides.items()}
    heads = list(dict.fromkeys(head for columns in tables.values() for head in columns))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["sweep", *heads])
        for name, columns in tables.items():
            for i in range(len(columns["value"])):
                cells = [float(columns[head][i]) if head in columns else math.nan for head in heads]
                writer.writerow([name, *("" if math.isnan(cell) else cell for cell in cells)])


def _label(name: str) -> str:
    return rigs.CHARACTERISTICS[name].label


def _cell(value: float, factor: float) -> str:
    """Four significant digits, and zero where only round-off is left."""
    shown = factor * value
    return "0" if abs(shown) < 5e-7 else f"{shown:.4g}"


def table(numbers: dict[str, float]) -> str:
    """The characteristics in the units in which they are shown."""
    rows = ((rigs.CHARACTERISTICS[name], value) for name, value in numbers.items())
    lines = [f"{one.label:<58}{_cell(value, one.shown[0]):>12}  {one.shown[1]}" for one, value in rows]
    return "\n".join(lines)


def _figure(test: rigs.KC, name: str, sweep: rigs.Sweep, axle: str) -> Any:
    factor, unit = SHOWN[sweep.unit]
    return plotting.kc_curves(
        test.sweeps[name], title=f"{axle}: {_title(name)}", along=f"{_title(name)} [{unit}]", factor=factor
    )


def _title(name: str) -> str:
    return name.replace("_", ", ")


def _page(axle: Axle, sweeps, numbers: dict[str, float], gradients, figures) -> str:
    """One file without anything from elsewhere."""
    parts = [f"<h1>K&amp;C of {html.escape(axle.name)}</h1>", f'<p class="note">{NOTE}</p>']
    links = {name: _title(name) for name in sweeps}
    parts.append("<nav>" + "".join(f'<a href="#{name}">{title}</a>' for name, title in links.items()) + "</nav>")
    parts.append('<h2>At the design position</h2><div class="columns">')
    for sweep in sweeps:
        rows = [(name, value) for name, value in numbers.items() if rigs.CHARACTERISTICS[name].sweep == sweep]
        if rows:
            cells = "".join(_row(rigs.CHARACTERISTICS[name], value) for name, value in rows)
            parts.append(f"<table><tr><th colspan=3>{_title(sweep)}</th></tr>{cells}</table>")
    parts.append("</div>")
    if gradients:
        parts.append("<h2>Gradients by hardpoints, per mm, both sides alike</h2>" + _gradient_table(axle, gradients))
    for name, figure in figures.items():
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg")
        picture = buffer.getvalue()
        parts.append(f'<h2 id="{name}">{_title(name)}</h2>{picture[picture.index("<svg") :]}')
    head = f'<meta charset="utf-8"><title>K&amp;C of {html.escape(axle.name)}</title><style>{STYLE}</style>'
    return f'<!doctype html><html lang="en"><head>{head}</head><body>{"".join(parts)}</body></html>\n'


def _row(one: rigs.Characteristic, value: float) -> str:
    factor, unit = one.shown
    return f'<tr><td>{html.escape(one.label)}</td><td class="n">{_cell(value, factor)}</td><td>{unit}</td></tr>'


def _largest(axle: Axle, gradients: dict[str, np.ndarray], count: int):
    """Of each characteristic what it is, with the unit, and its largest derivatives per mm with their coordinates."""
    places = [f"{name} {axis}" for name in axle.hardpoint_names for axis in "xyz"]
    for name, found in gradients.items():
        factor, unit = rigs.CHARACTERISTICS[name].shown
        flat = found.ravel()
        most = np.argsort(-np.abs(np.nan_to_num(flat)))[:count]
        yield f"{_label(name)} [{unit}]", [f"{places[i]} {1e-3 * factor * flat[i]:+.3g}" for i in most]


def _gradient_table(axle: Axle, gradients: dict[str, np.ndarray]) -> str:
    """The five largest of each characteristic, largest first."""
    cell = lambda text: f"<td>{html.escape(text)}</td>"
    rows = _largest(axle, gradients, 5)
    return "<table>" + "".join(f"<tr>{''.join(map(cell, (label, *most)))}</tr>" for label, most in rows) + "</table>"


def _of_gradients(axle: Axle, gradients: dict[str, np.ndarray]) -> str:
    """The three largest of each characteristic, as lines."""
    lines = [f"{label:<58}{', '.join(most)}" for label, most in _largest(axle, gradients, 3)]
    return "\n".join(["", "largest derivatives by hardpoints, per mm, both sides alike:", *lines])
