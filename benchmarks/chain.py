"""How a step, its gradient, compilation and memory grow with the length of a chain.

    python benchmarks/chain.py [--links 8 64 512] [--solvers auto dense] [--out benchmarks/results]

The spatial chain of hinged links, 6 N coordinates and 5 N constraints, h = 1 ms, its end no faster than 8 m/s. Time per
step is the difference of runs of 20 and 100 steps over the 80 between them, medians of `--repeats` calls after one that
compiles, so that the initial state does not count; "gradient" is that of Ψ, the integral of the square of the last
link's height, by all numbers of the assembled system, in reverse mode. "auto" is the linear solver that the model
chooses. The slope is that of log time over log N between the last two lengths. Writes chain.json and prints a table.
"""

import argparse
import dataclasses
import itertools
import json
import math
import os
import platform
import time
from pathlib import Path

STEPS = (20, 100)
H = 1e-3


def measure(links: int, solver: str, repeats: int) -> dict:
    import equinox as eqx
    import jax

    import lgsens as lg
    from lgsens._cost import median_seconds
    from lgsens.examples import spatial_chain

    started = time.perf_counter()
    system = spatial_chain(links, spin=min(3.0, 24.0 / links)).system()
    found: dict = {"links": links, "solver": solver, "build_s": time.perf_counter() - started}
    if solver == "dense":
        system = dataclasses.replace(system, linear_solver=lg.DenseLU())
    plan = system.elimination
    found["levels"] = [] if plan is None else [[*level.own.shape, level.boundary.shape[1]] for level in plan.levels]
    found["dense_rest"] = len(system.constraint_names) + system.group.dim if plan is None else len(plan.rest)
    seconds: dict = {}
    for steps in STEPS:

        def psi(system, steps=steps):
            trajectory = lg.simulate(system, t1=steps * H, num_steps=steps, throw=False)
            height = trajectory.body(f"link{links - 1}").position[:, 2]
            return lg.time_integral(trajectory.t, height**2)

        for name, function in (("simulate", psi), ("gradient", eqx.filter_value_and_grad(psi))):
            started = time.perf_counter()
            compiled = eqx.filter_jit(function).lower(system).compile()
            found[f"{name}_compile_s"] = time.perf_counter() - started
            found[f"{name}_temporary_mb"] = compiled.compiled.memory_analysis().temp_size_in_bytes / 1e6
            seconds[name, steps] = median_seconds(lambda compiled=compiled: compiled(system), repeats)
            jax.clear_caches()
    for name in ("simulate", "gradient"):
        few, many = (seconds[name, steps] for steps in STEPS)
        found[f"{name}_us_per_step"] = (many - few) / (STEPS[1] - STEPS[0]) * 1e6
    return found


def slopes(rows: list[dict]) -> list[dict]:
    found = []
    for solver in sorted({row["solver"] for row in rows}):
        own = sorted((row for row in rows if row["solver"] == solver), key=lambda row: row["links"])
        for short, long in itertools.pairwise(own):
            ratio = math.log(long["links"] / short["links"])
            slope = {
                name: math.log(long[f"{name}_us_per_step"] / short[f"{name}_us_per_step"]) / ratio
                for name in ("simulate", "gradient")
            }
            found.append({"solver": solver, "from": short["links"], "to": long["links"]} | slope)
    return found


def table(rows: list[dict], found: list[dict]) -> str:
    lines = [
        "| links | solver | simulate [µs/step] | with gradient [µs/step] | compile: simulate, gradient [s] "
        "| temporary memory of the gradient [MB] | levels | dense rest |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['links']} | {row['solver']} "
            f"| {row['simulate_us_per_step']:.0f} | {row['gradient_us_per_step']:.0f} "
            f"| {row['simulate_compile_s']:.1f}, {row['gradient_compile_s']:.1f} | {row['gradient_temporary_mb']:.1f} "
            f"| {len(row['levels'])} | {row['dense_rest']} |"
        )
    for one in found:
        lines.append(
            f"\n{one['solver']}: slope from {one['from']} to {one['to']} links: simulate {one['simulate']:.2f}, "
            f"with gradient {one['gradient']:.2f}."
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    parser.add_argument("--links", nargs="+", type=int, default=[8, 64, 512])
    parser.add_argument("--solvers", nargs="+", choices=("auto", "dense"), default=["auto"])
    parser.add_argument("--repeats", type=int, default=5, help="timed calls, at least 5 (default: %(default)s)")
    arguments = parser.parse_args()
    if arguments.repeats < 5:
        parser.error("--repeats must be at least 5")
    import jax

    jax.config.update("jax_enable_x64", True)
    load = os.getloadavg()[0]
    rows = []
    for solver in arguments.solvers:
        for links in arguments.links:
            rows.append(measure(links, solver, arguments.repeats))
            print(rows[-1], flush=True)
    found = slopes(rows)
    machine = {"python": platform.python_version(), "jax": jax.__version__, "cores": os.cpu_count(), "load": load}
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"machine": machine, "rows": rows, "slopes": found}, indent=1)
    (arguments.out / "chain.json").write_text(text + "\n", encoding="utf-8")
    print(table(rows, found))


if __name__ == "__main__":
    main()
