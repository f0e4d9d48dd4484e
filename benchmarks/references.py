"""Convergence of every reference problem: values and gradients over the step, against independent numbers.

    python benchmarks/references.py [--out DIR] [--quick]

Each problem of `lgsens.examples` runs at four steps, each half of the one before, and is compared with its file in
tests/data. The table, `references.json` and `references.png` show

- value: |Ψ_h − Ψ|/|Ψ|,
- gradient: the largest p |dΨ_h/dp − dΨ/dp| over the largest p |dΨ/dp|, by reverse mode,
- order: log2 of the last two errors,
- extrapolated: what Richardson's extrapolation of the last two steps leaves,

and the figures that others have published, beside ours extrapolated.
"""

import argparse
import json
import math
import os
import platform
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from lgsens.examples import PROBLEMS, Evaluation, Problem
from lgsens.plotting import figure, save

HERE = Path(__file__).parent
DATA = HERE.parent / "tests" / "data"
FACTORS = (0.5, 1, 2, 4)  # of the problem's number of steps; with --quick the first two


def document(problem: Problem) -> dict[str, Any]:
    return json.loads((DATA / problem.file).read_text(encoding="utf-8"))


def families() -> list[list[Problem]]:
    """The problems, those that share a program together."""
    found = {id(problem.family[0].build): problem.family for problem in PROBLEMS.values()}
    return list(found.values())


def run_family(job: tuple[list[Problem], float]) -> dict[str, Evaluation]:
    """The problems of a family at one step, from one compilation."""
    members, factor = job
    first = members[0]
    settings = {"num_steps": round(factor * max(problem.num_steps for problem in members))}
    program = jax.jit(lambda p, t1: first.differentiate(p, t1=t1, **settings))
    found = {}
    for problem in members:
        parameters = {name: jnp.asarray(value) for name, value in problem.parameters.items()}
        found[problem.name] = jax.device_get(program(parameters, jnp.asarray(problem.t1)))
    return found


def run_all(factors) -> dict[str, list[Evaluation]]:
    """Every problem at every step, coarse to fine; compilations, which take nearly all the time, side by side."""
    runs: dict[str, list[Evaluation]] = {name: [] for name in PROBLEMS}
    jobs = [(members, factor) for members in families() for factor in factors]
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        for found in tqdm(pool.map(run_family, jobs), total=len(jobs), desc="simulations", disable=None):
            for name, evaluation in found.items():
                runs[name].append(evaluation)
    return runs


def extrapolated(coarse, fine):
    """Richardson: the h² parts cancel."""
    return (4 * np.asarray(fine) - np.asarray(coarse)) / 3


def order(errors) -> float | None:
    """The observed order of the last halving; None where an error is zero or round-off."""
    coarse, fine = errors[-2:]
    return math.log2(coarse / fine) if fine > 1e-13 else None


def compare(problem: Problem, evaluations: list[Evaluation]) -> dict[str, Any]:
    """Errors and orders of each criterion of a problem."""
    num_steps = [evaluation.trajectory.t.size - 1 for evaluation in evaluations]
    record: dict[str, Any] = {"num_steps": num_steps, "step": [problem.t1 / n for n in num_steps], "criteria": {}}
    for name, reference in problem.reference(document(problem)).items():
        names = list(reference.gradient)
        sizes = np.array([problem.parameters[p] for p in names])
        exact = sizes * np.array([reference.gradient[p] for p in names])
        values = np.array([evaluation.values[name] for evaluation in evaluations], float)
        slopes = np.array([[e.gradients[name][p] for p in names] for e in evaluations], float) * sizes
        value_errors = np.abs(values / reference.value - 1.0)
        slope_errors = np.abs(slopes - exact) / np.abs(exact).max()
        gradient_errors = slope_errors.max(axis=1)
        left_value = abs(float(extrapolated(*values[-2:])) / reference.value - 1.0)
        left_gradient = float((np.abs(extrapolated(*slopes[-2:]) - exact) / np.abs(exact).max()).max())
        record["criteria"][name] = {
            "reference": reference.value,
            "values": values.tolist(),
            "value": {
                "errors": value_errors.tolist(),
                "order": order(value_errors),
                "extrapolated": left_value,
            },
            "gradient": {
                "errors": gradient_errors.tolist(),
                "order": order(gradient_errors),
                "extrapolated": left_gradient,
                "worst_parameter": names[int(slope_errors[-1].argmax())],
            },
        }
    return record


def published(runs: dict[str, list[Evaluation]]) -> list[dict[str, Any]]:
    """The published figures, ours from the last two steps, and the exact ones."""
    found = []

    def add(source: str, quantity: str, figure, read, name: str, exact):
        ours = float(extrapolated(*(read(evaluation) for evaluation in runs[name][-2:])))
        entry = {"source": source, "quantity": quantity, "published": figure, "ours": ours, "exact": exact}
        found.append(entry | {"difference": ours - figure, "difference_of_exact": exact - figure})

    top = "spinning_top_brulls.l_1.0_alpha0_0.785398"
    contents = document(PROBLEMS[top])
    exact = contents["gradient"]["l_1.0_alpha0_0.785398"]["alpha0"]
    slope = lambda evaluation: evaluation.gradients["Psi"]["alpha0"]
    add("Sonneville & Brüls 2014, §8.4", "dΨ/dα₀", contents["published"]["value"], slope, top, exact)

    crank = "slider_crank_sundials"
    contents = document(PROBLEMS[crank])
    figures = contents["published"]
    source = "SUNDIALS, IDAS slider-crank"
    add(source, "G", figures["G"], lambda evaluation: evaluation.values["G"], crank, contents["value"]["G"])
    for p in ("k", "c"):
        slope = lambda evaluation, p=p: evaluation.gradients["G"][p]
        add(source, f"dG/d{p}", figures[f"dG_d{p}"], slope, crank, contents["gradient"]["G"][p])

    heavy = "heavy_top_bruls2012.to_2s"
    contents = document(PROBLEMS[heavy])
    for i, axis in enumerate("xyz"):
        place = contents["published"][0]["u"][i] + contents["states"][0]["x"][i]
        position = lambda evaluation, i=i: evaluation.trajectory.body("top").position[-1, i]
        add("Kynema, heavy top, h = 2e-6 s", f"{axis}(2 s)", place, position, heavy, contents["states"][-1]["x"][i])
    return found


def print_tables(records: dict[str, Any], figures: list[dict[str, Any]]) -> None:
    for name, record in records.items():
        steps = "".join(f"{step:>11.2e}" for step in record["step"])
        print(f"\n{name:<58}h [s]{steps}   order  extrapolated")
        for criterion, entry in record["criteria"].items():
            rows = {
                f"{criterion}": entry["value"],
                f"gradient, worst d/d {entry['gradient']['worst_parameter']}": entry["gradient"],
            }
            for label, row in rows.items():
                errors = "".join(f"{error:>11.2e}" for error in row["errors"])
                observed = "     –" if row["order"] is None else f"{row['order']:>6.3f}"
                print(f"  {label:<61}{errors}  {observed}  {row['extrapolated']:>12.1e}")
    print(f"\n{'published':<34}{'':<10}{'figure':>20}{'ours':>20}{'difference':>13}{'of the exact':>14}")
    for row in figures:
        numbers = f"{row['published']:>20.13g}{row['ours']:>20.13g}"
        print(
            f"{row['source']:<34}{row['quantity']:<10}{numbers}{row['difference']:>13.1e}"
            f"{row['difference_of_exact']:>14.1e}"
        )


def draw(records: dict[str, Any]):
    """One panel for each file: errors of values (full) and of gradients (dashed) over the step.

    Steps relative to the largest h₀ of each problem, so that problems of milliseconds and of seconds share an axis.
    """
    files = sorted({name.partition(".")[0] for name in records})
    columns = 3
    fig = figure(4.6 * columns, 3.6 * math.ceil(len(files) / columns))
    panels = fig.subplots(math.ceil(len(files) / columns), columns, squeeze=False, sharex=True).ravel()
    for axes, file in zip(panels, files):
        lines = [
            (name.partition(".")[2], criterion, np.array(record["step"]), entry)
            for name, record in records.items()
            if name.partition(".")[0] == file
            for criterion, entry in record["criteria"].items()
        ]
        for i, (case, criterion, steps, entry) in enumerate(lines):
            label = f"{criterion} {case}" if case and criterion == "Psi" else criterion
            style = {"color": f"C{i}", "marker": "o", "markersize": 3, "linewidth": 1.3}
            axes.loglog(steps / steps[0], entry["value"]["errors"], label=f"{label}, h₀ = {steps[0]:.1e} s", **style)
            axes.loglog(steps / steps[0], entry["gradient"]["errors"], linestyle=(0, (4, 2)), **style)
        relative = lines[0][2] / lines[0][2][0]
        lowest = min(entry["value"]["errors"][-1] for *_, entry in lines)
        line = lowest / 4 * (relative / relative[-1]) ** 2
        axes.loglog(relative, line, color="#8c8c8c", linewidth=1, zorder=0)
        axes.annotate("h²", (1.0, line[0]), color="#606060", ha="right", va="bottom", fontsize=9)
        axes.set_title(file, fontsize=10)
        axes.set_ylim(top=axes.get_ylim()[1] * 10 ** (0.3 * len(lines)))  # room for the legend
        axes.legend(frameon=False, fontsize=6.5, loc="upper left")
        axes.grid(True, which="major", color="#e4e4e4", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xticks(relative, ["h₀"] + [f"h₀/{round(1 / x)}" for x in relative[1:]])
        axes.minorticks_off()
    for axes in panels[len(files) :]:
        axes.set_visible(False)
    for axes in panels[::columns]:
        axes.set_ylabel("relative error")
    fig.suptitle("Errors of the criteria (full) and of their gradients (dashed) against independent numbers")
    return fig


def main() -> None:
    parser = argparse.ArgumentParser(description="Convergence of the reference problems of lgsens.")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder of the results")
    parser.add_argument("--quick", action="store_true", help="two steps instead of four")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_disable_most_optimizations", True)  # accuracy is measured here, and compilation dominates
    runs = run_all(FACTORS[:2] if arguments.quick else FACTORS)
    records = {name: compare(PROBLEMS[name], evaluations) for name, evaluations in runs.items()}
    figures = published(runs)
    print_tables(records, figures)
    results = {
        "versions": {"python": platform.python_version(), "jax": jax.__version__, "numpy": np.__version__},
        "machine": {"type": platform.machine(), "cpus": os.cpu_count(), "backend": jax.default_backend()},
        "problems": records,
        "published": figures,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(results, indent=1, ensure_ascii=False)
    (arguments.out / "references.json").write_text(text + "\n", encoding="utf-8")
    save(draw(records), arguments.out / "references.png", dpi=110)


if __name__ == "__main__":
    main()
