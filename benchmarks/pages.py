"""The tables of the guide, from benchmarks/results: no figure stands there that a script has not written.

    python benchmarks/pages.py     # measures nothing

A page has marks, `<!-- name -->` and `<!-- end of name -->`; what stands between them is replaced by the table of that
name. The prose around them is written by hand.
"""

import importlib
import json
from collections.abc import Callable
from pathlib import Path

from benchmark import grid

HERE = Path(__file__).parent
GUIDE = HERE.parent / "notebooks"


def errors(row: dict, *quantities: str) -> list[str]:
    return [f"{row[f'error_of_{quantity}']:.1e}" for quantity in quantities]


def fidelity(found: dict) -> str:
    names = {"default": "default: every link a body, chassis on a slider"}
    rows = (
        (names.get(name, f"`{name}`"), row["unknowns"], row["equations"], f"{row['psi0']:.6f}", f"{row['step_us']:.0f}")
        for name, row in found["fidelity"].items()
    )
    return grid("`QuarterCar.load().model(…)` | unknowns | equations | Ψ₀ over 1 s | µs per step", rows)


def routes(found: dict) -> str:
    rows = [
        (scene, row["route"], row["num_steps"], *errors(row, "psi", "gradient"), f"{row['value_and_gradient_ms']:.1f}")
        for scene, of_scene in zip(("top", "quarter-car, 2 s"), found["routes"].values())
        for row in of_scene
    ]
    return grid("scene | route | steps | error of Ψ | error of dΨ/dp | Ψ and gradient [ms]", rows)


def recommended(found: dict) -> list[tuple]:
    """What `lgsens tradeoff` recommends on a scene, a row for each target."""
    rows = []
    for one in found["recommendations"]:
        if one["row"] is None:
            rows.append((found["scene"], f"{one['rtol']:.0e}", "none reaches it", "", "", "", ""))
            continue
        row = found["rows"][one["row"]]
        errors = (f"{row[f'{of}_error']:.0e}" for of in ("value", "gradient"))
        cost = f"{1e3 * row[found['by']]:.3g}"
        rows.append((found["scene"], f"{one['rtol']:.0e}", f"`{row['setting']}`", row["num_steps"], *errors, cost))
    return rows


def recommendations(*scenes: dict) -> str:
    head = "scene | error at most | setting | steps | error of Ψ | error of dΨ/dp | time [ms]"
    return grid(head, (row for found in scenes for row in recommended(found)))


def methods(found: dict) -> str:
    return importlib.import_module("methods").markdown(found["scenes"])


def choice(found: dict) -> str:
    """Which derivative, by what it costs and loses on the four-bar at the finer step."""
    scene, exact = found["scenes"]["four_bar"], "the numerical solution"
    spread = lambda key: "{:.0e} … {:.0e}".format(
        *sorted(scene["methods"][key]["errors"][-1])[:: len(scene["criteria"]) - 1]
    )
    same = lambda key: f"the same to {max(scene['difference_from_DDM'][key]):.0e}"
    cost = lambda key: f"{scene['methods'][key]['cost']:.1f}"
    direct, adjoint = "continuous DDM", "continuous AVM, state"
    few = "few parameters, many criteria or active constraints; nothing is stored"
    other = "to compare with the paper, §7; its other treatments of accelerations fall to order 1"
    rows = (
        ("`DirectDifferentiation()`", exact, spread("DDM"), 2, cost("DDM"), few),
        ("`AdjointVariable()`", exact, same("AVM"), 2, cost("AVM"), "many parameters, few criteria; keeps the states"),
        ("`ContinuousDirect()`", "the motion", spread(direct), 2, cost(direct), "to compare with the paper, §6.1"),
        ('`ContinuousAdjoint("state")`', "the motion", spread(adjoint), 2, cost(adjoint), other),
        ("`FiniteDifferences()`", exact, same("differences"), 2, "6 runs per parameter", "to check"),
        ("`IndexReduced()`", "the motion", "tolerance", 8, "–", "as a reference, by diffrax"),
    )
    return grid("`method=` | derivative of | error: terminal, ∫q, ∫v, ∫v̇, ∫λ | order | cost | choose it", rows)


def variable_steps(found: dict) -> str:
    keys = ("label", "steps", "rejected", "iterations")
    rows = (
        (*(row.get(key, 0) for key in keys), *errors(row, "psi", "rates", "hardpoints", "forces"), round(row["ms"]))
        for row in found["rows"]
    )
    left = "error of Ψ₀ | of its gradient by rates | by hardpoints | of forces"
    head = f"steps | number | rejected | iterations | {left} | ms"
    return grid(head, rows)


def references(found: dict) -> str:
    rows = []
    for name, record in found["problems"].items():
        for criterion, entry in record["criteria"].items():
            value, gradient = entry["value"], entry["gradient"]
            orders = ("–" if part["order"] is None else f"{part['order']:.2f}" for part in (value, gradient))
            errors = (f"{part['errors'][-1]:.1e}" for part in (value, gradient))
            cells = [cell for pair in zip(errors, orders) for cell in pair]
            left = (f"{part['extrapolated']:.0e}" for part in (value, gradient))
            rows.append((f"`{name}`", f"`{criterion}`", f"{record['step'][-1]:.1e}", *cells, *left))
    return grid("problem | Ψ | h [s] | error of Ψ | order | of dΨ/dp | order | extrapolated: Ψ | dΨ/dp", rows)


def published(found: dict) -> str:
    numbers = ("published", "ours", "exact")
    rows = (
        (row["source"], row["quantity"], *(f"{row[key]:.13g}" for key in numbers), f"{row['difference']:.1e}")
        for row in found["published"]
    )
    return grid("source | quantity | published | lgsens, extrapolated | independent reference | difference", rows)


def extremes(found: dict) -> str:
    rows = (
        (row["extreme"], row["measures"], f"{row['measured']:.1e}", f"{row['bound']:.1e}", row["verdict"], row["why"])
        for row in found["rows"]
    )
    return grid("extreme | of what | measured | bound | verdict | why this bound", rows)


def of(module: str, function: str, key: str | None = None) -> Callable[[dict], str]:
    """The table that the script of that name prints."""
    return lambda found: getattr(importlib.import_module(module), function)(found if key is None else found[key])


# By name of the marks: the page, the files of results, and the table.
TABLES: dict[str, tuple[str, tuple[str, ...], Callable[..., str]]] = {
    "formulations": ("concepts", ("formulations",), of("formulations", "table")),
    "fidelity": ("scenes", ("routes",), fidelity),
    "routes": ("choosing", ("routes",), routes),
    "recommendations": (
        "choosing",
        ("tradeoff_top", "tradeoff_quarter_car", "tradeoff_stiff_quarter_car"),
        recommendations,
    ),
    "choice": ("choosing", ("methods",), choice),
    "variable steps": ("choosing", ("variable_steps",), variable_steps),
    "steps for a criterion": ("choosing", ("steps_for",), of("steps_for", "table")),
    "reference problems": ("verification", ("references",), references),
    "published": ("verification", ("references",), published),
    "extremes": ("verification", ("extremes",), extremes),
    "heavy top": ("verification", ("heavy_top",), lambda found: f"```\n{of('heavy_top', 'table')(found)}\n```"),
    "methods": ("results/methods", ("methods",), methods),
    "work against precision": ("results/work_precision", ("work_precision",), of("precision_tables", "markdown")),
    "schemes": ("results/work_precision", ("schemes",), of("precision_tables", "markdown")),
    "compile time": ("results/compile_time", ("compile_time",), of("compile_time", "markdown")),
    "compile profile": ("results/compile_time", ("compile_profile",), of("compile_profile", "markdown")),
    "loops": ("results/loops", ("loops",), of("loops", "markdown")),
    "chains": ("results/chains", ("chain",), of("chain", "table")),
    "beams": ("flexible", ("beams",), of("beams", "table")),
    "memory": ("results/memory", ("memory",), of("memory", "table")),
    "precision": ("results/precision", ("precision",), of("precision", "table")),
    "design": ("results/optimizers", ("design",), of("design", "table", "methods")),
    "optimizers": ("results/optimizers", ("optimizers",), of("optimizers", "table", "problems")),
    "multi-start": ("results/optimizers", ("multi_start",), of("multi_start", "table")),
    "sweeps": ("results/sweeps", ("sweep",), of("sweep", "table")),
    "log depth": ("choosing", ("log_depth",), of("log_depth", "table")),
    "roofline": ("results/sweeps", ("roofline",), of("roofline", "table")),
    "batches": ("results/sweeps", ("batches",), of("batches", "table")),
    "rivals": ("results/rivals", ("rivals",), of("rival_tables", "markdown")),
}


def filled(page: str, text: str) -> str:
    """The text of a page with its tables."""
    for name, (where, files, table) in TABLES.items():
        if where == page:
            begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
            before, rest = text.split(begin)
            _, after = rest.split(end)
            found = (json.loads((HERE / "results" / f"{file}.json").read_text(encoding="utf-8")) for file in files)
            text = f"{before}{begin}\n\n{table(*found).strip()}\n\n{end}{after}"
    return text


def main() -> None:
    for page in dict.fromkeys(where for where, *_ in TABLES.values()):
        path = GUIDE / f"{page}.md"
        path.write_text(filled(page, path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
