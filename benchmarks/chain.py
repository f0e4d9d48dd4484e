"""How a step, its gradient, compilation and memory grow with the length of a chain.

    python benchmarks/chain.py [--links 8 64 512] [--solvers auto dense] [--schemes index3 stabilized radau explicit]
        [--out benchmarks/results]

The spatial chain of hinged links, 6 N coordinates and 5 N constraints, h = 1 ms, its end no faster than 8 m/s, by
generalized-α, index 3 and stabilized index 2, by Radau IIA (512 links take more than ten minutes, so only where
`--links` says so) and by `IndexReducedODE`, explicit steps of order 5. Time per step is the difference of runs of 20
and 100 steps over the 80 between them, so that the initial state does not count: medians of at least `--repeats` rounds
of all four programs after one that compiles. "gradient" is that of Ψ, the integral of the square of the last link's
height, by all numbers of the assembled system, in reverse mode. "auto" is the linear solver that the model chooses;
levels are those of index 3. The slope is that of log time over log N between two lengths. Writes chain.json and prints
a table.
"""

import dataclasses
import itertools
import json
import math
import os
import statistics
import time

from benchmark import SINGLE_THREAD, circumstances, environment, interleaved, options, write

SCHEMES = ("index3", "stabilized", "radau", "explicit")
LINKS = {scheme: (8, 64) if scheme == "radau" else (8, 64, 512) for scheme in SCHEMES}
STEPS = (20, 100)
H = 1e-3


def measure(links: int, solver: str, scheme: str, repeats: int) -> dict:
    import equinox as eqx
    import jax

    import lgsens as lg
    from lgsens.examples import spatial_chain

    integrator = dict(
        index3=lg.GeneralizedAlpha(),
        stabilized=lg.GeneralizedAlpha(stabilized=True),
        radau=lg.RadauIIA(),
        explicit=lg.IndexReducedODE(),
    )[scheme]
    started = time.perf_counter()
    system = spatial_chain(links, spin=min(3.0, 24.0 / links)).system()
    found: dict = {"links": links, "solver": solver, "scheme": scheme, "build_s": time.perf_counter() - started}
    if solver == "dense":
        system = dataclasses.replace(system, linear_solver=lg.DenseLU())
    plan = system.elimination
    found["levels"] = [] if plan is None else [[*level.own.shape, level.boundary.shape[1]] for level in plan.levels]
    found["looped"] = 0 if plan is None else plan.looped
    found["dense_rest"] = len(system.constraint_names) + system.group.dim if plan is None else len(plan.rest)
    calls: dict = {}
    for steps in STEPS:

        def psi(system, steps=steps):
            trajectory = lg.simulate(system, t1=steps * H, num_steps=steps, integrator=integrator, throw=False)
            height = trajectory.body(f"link{links - 1}").position[:, 2]
            return lg.time_integral(trajectory.t, height**2)

        for name, function in (("simulate", psi), ("gradient", eqx.filter_value_and_grad(psi))):
            started = time.perf_counter()
            compiled = eqx.filter_jit(function).lower(system).compile()
            found[f"{name}_compile_s"] = time.perf_counter() - started
            found[f"{name}_temporary_mb"] = compiled.compiled.memory_analysis().temp_size_in_bytes / 1e6
            calls[name, steps] = lambda compiled=compiled: jax.block_until_ready(compiled(system))
            calls[name, steps]()
    times = interleaved(calls, repeats, seconds=5.0)
    for name in ("simulate", "gradient"):
        for kind in ("wall", "cpu"):
            few, many = (getattr(times[name, steps], kind) for steps in STEPS)
            taken = statistics.median(long - short for short, long in zip(few, many))
            found[f"{name}_us_per_step" if kind == "wall" else f"{name}_cpu_us_per_step"] = (
                taken / (STEPS[1] - STEPS[0]) * 1e6
            )
    jax.clear_caches()
    return found


def slopes(rows: list[dict]) -> list[dict]:
    found = []
    of = lambda row: (row["solver"], row["scheme"])
    for solver, scheme in dict.fromkeys(map(of, rows)):
        own = sorted((row for row in rows if of(row) == (solver, scheme)), key=lambda row: row["links"])
        for short, long in itertools.pairwise(own):
            ratio = math.log(long["links"] / short["links"])
            slope = {
                name: math.log(long[f"{name}_us_per_step"] / short[f"{name}_us_per_step"]) / ratio
                for name in ("simulate", "gradient")
            }
            found.append({"solver": solver, "scheme": scheme, "from": short["links"], "to": long["links"]} | slope)
    return found


def table(document: dict) -> str:
    lines = [
        f"{circumstances(document['environment'])} Processor time in brackets.",
        "",
        "| links | solver | scheme | simulate [µs/step] | with gradient [µs/step] | compile: simulate, gradient [s] "
        "| temporary memory of the gradient [MB] | levels | dense rest |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in document["rows"]:
        looped = row.get("looped", 0)
        levels = f"{len(row['levels']) - looped}" + (f" and a loop of {looped}" if looped else "")
        lines.append(
            f"| {row['links']} | {row['solver']} | {row['scheme']} "
            f"| {row['simulate_us_per_step']:.0f} ({row['simulate_cpu_us_per_step']:.0f}) "
            f"| {row['gradient_us_per_step']:.0f} ({row['gradient_cpu_us_per_step']:.0f}) "
            f"| {row['simulate_compile_s']:.1f}, {row['gradient_compile_s']:.1f} | {row['gradient_temporary_mb']:.1f} "
            f"| {levels} | {row['dense_rest']} |"
        )
    for one in document["slopes"]:
        lines.append(
            f"\n{one['solver']}, {one['scheme']}: slope from {one['from']} to {one['to']} links: "
            f"simulate {one['simulate']:.2f}, with gradient {one['gradient']:.2f}."
        )
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--links", nargs="+", type=int)
    parser.add_argument("--solvers", nargs="+", choices=("auto", "dense"), default=["auto"])
    parser.add_argument("--schemes", nargs="+", choices=SCHEMES, default=list(SCHEMES))
    arguments = parser.parse_args()
    path = arguments.out / "chain.json"
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    import jax

    jax.config.update("jax_enable_x64", True)
    found, rows = environment(SINGLE_THREAD), []
    for solver, scheme in itertools.product(arguments.solvers, arguments.schemes):
        for links in arguments.links or LINKS[scheme]:
            rows.append(measure(links, solver, scheme, arguments.repeats))
            print(rows[-1], flush=True)
    write(path, {"environment": found, "rows": rows, "slopes": slopes(rows)})
    print(table(json.loads(path.read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
