"""Accuracy and cost of the integrators, and of scenes with fewer unknowns.

    python benchmarks/routes.py [--out benchmarks/results] [--problems spinning_top_brulls.l_1.0_alpha0_0.785398 …]

First the quarter-car in its options: unknowns, equations, Ψ₀ over 1 s in 500 steps, time. Then, for the paper's top and
the quarter-car over 2 s, generalized-α, Richardson extrapolation and the index-reduced equations side by side: relative
errors of Ψ and of its gradient (the largest of p dΨ/dp, relative to the largest) against the independent numbers in
tests/data, wall time of Ψ with its gradient in reverse mode, compilation apart. Writes routes.json, prints the tables.
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path

import diffrax
import jax
import numpy as np
from tqdm import tqdm

import lgsens as lg
from lgsens.criteria._cost import median_seconds
from lgsens.examples import PROBLEMS, QuarterCar

DATA = Path(__file__).parents[1] / "tests" / "data"
FIDELITIES = {
    "default": {},
    'chassis="heave"': {"chassis": "heave"},
    'links="rods"': {"links": "rods"},
    'chassis="heave", links="rods"': {"chassis": "heave", "links": "rods"},
}
PROBLEM_NAMES = ("spinning_top_brulls.l_1.0_alpha0_0.785398", "five_link_quarter_car")
ALPHA = lg.GeneralizedAlpha(0.9)
ROUTES = {
    "spinning_top_brulls.l_1.0_alpha0_0.785398": [
        ("generalized-α", ALPHA, 400),
        ("generalized-α", ALPHA, 1000),
        ("Richardson", lg.Richardson(ALPHA), 50),
        ("Richardson", lg.Richardson(ALPHA), 200),
        ("Tsit5", lg.IndexReducedODE(), 50),
        ("Tsit5", lg.IndexReducedODE(), 100),
        ("Dopri8", lg.IndexReducedODE(diffrax.Dopri8()), 50),
    ],
    "five_link_quarter_car": [
        ("generalized-α", ALPHA, 1000),
        ("generalized-α", ALPHA, 2000),
        ("Richardson", lg.Richardson(ALPHA), 500),
        ("Richardson", lg.Richardson(ALPHA), 1000),
        ("Tsit5", lg.IndexReducedODE(), 400),
        ("Tsit5", lg.IndexReducedODE(), 800),
    ],
}


def compiled(function, *arguments):
    started = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - started


def fidelity(options) -> dict:
    """Size, Ψ₀ and time of one version of the quarter-car."""
    model = QuarterCar.load().model(**options)

    def comfort(model):
        trajectory = lg.simulate(model, t1=1.0, num_steps=500, throw=False)
        return lg.time_integral(trajectory.t, trajectory.body("chassis").acceleration[:, 2] ** 2)

    program, compile_time = compiled(comfort, model)
    summary = model.summary()
    return {
        "unknowns": summary.coordinates,
        "equations": summary.constraints,
        "psi0": float(program(model)),
        "step_us": 1e6 * median_seconds(lambda: program(model))[0] / 500,
        "compile_s": compile_time,
    }


def route(name: str, integrator, num_steps: int) -> dict:
    """Errors and time of one integrator on one problem, all its parameters, its first criterion."""
    problem = PROBLEMS[name]
    key, reference = next(iter(problem.reference(json.loads((DATA / problem.file).read_text())).items()))

    def psi(p):
        trajectory = lg.simulate(
            problem.build(p), t1=problem.t1, num_steps=num_steps, integrator=integrator, throw=False
        )
        return problem.criteria[key](trajectory, p)

    # Richardson's Ψ is the extrapolation of Ψ itself, which loses nothing to a kink of the road within a step
    if isinstance(integrator, lg.Richardson):
        of_steps = lambda p, n: problem.criteria[key](
            lg.simulate(problem.build(p), t1=problem.t1, num_steps=n, integrator=integrator.integrator, throw=False), p
        )
        function = lambda p: lg.richardson(lambda n: of_steps(p, n), num_steps).value
    else:
        function = psi
    p = jax.tree.map(jax.numpy.asarray, problem.parameters)
    program, compile_time = compiled(jax.value_and_grad(function), p)
    value, gradient = program(p)
    size = {name: abs(float(x)) for name, x in p.items()}
    exact = np.array([reference.gradient[name] * size[name] for name in reference.gradient])
    found = np.array([float(gradient[name]) * size[name] for name in reference.gradient])
    return {
        "num_steps": num_steps,
        "error_of_psi": abs(float(value) / reference.value - 1.0),
        "error_of_gradient": float(np.abs(found - exact).max() / np.abs(exact).max()),
        "value_and_gradient_ms": 1e3 * median_seconds(lambda: program(p))[0],
        "compile_s": compile_time,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    parser.add_argument("--problems", nargs="*", choices=PROBLEM_NAMES, default=PROBLEM_NAMES)
    arguments = parser.parse_args()
    out, problems = arguments.out, arguments.problems
    jax.config.update("jax_enable_x64", True)
    record = {"versions": {"python": platform.python_version(), "jax": jax.__version__}, "cores": os.cpu_count()}
    jobs = [(name, *case) for name in problems for case in ROUTES[name]]
    with tqdm(total=len(FIDELITIES) + len(jobs), desc="programs", disable=None) as progress:

        def done(result):
            jax.clear_caches()  # a process has only so many memory maps
            progress.update()
            return result

        record["fidelity"] = {name: done(fidelity(options)) for name, options in FIDELITIES.items()}
        record["routes"] = {name: [] for name in problems}
        for name, label, integrator, num_steps in jobs:
            record["routes"][name].append({"route": label} | done(route(name, integrator, num_steps)))
    out.mkdir(parents=True, exist_ok=True)
    (out / "routes.json").write_text(json.dumps(record, indent=1) + "\n")

    header(["quarter-car", "unknowns", "equations", "Ψ₀ over 1 s", "µs per step", "compilation [s]"])
    for name, row in record["fidelity"].items():
        cells = (row["unknowns"], row["equations"], f"{row['psi0']:.6f}", f"{row['step_us']:.0f}")
        line(name, *cells, f"{row['compile_s']:.1f}")
    for name, rows in record["routes"].items():
        header([name, "steps", "error of Ψ", "error of dΨ/dp", "Ψ and gradient [ms]", "compilation [s]"])
        for row in rows:
            errors = (f"{row[key]:.1e}" for key in ("error_of_psi", "error_of_gradient"))
            times = f"{row['value_and_gradient_ms']:.1f}", f"{row['compile_s']:.0f}"
            line(row["route"], row["num_steps"], *errors, *times)


def line(*cells) -> None:
    print("| " + " | ".join(map(str, cells)) + " |")


def header(names: list[str]) -> None:
    print()
    line(*names)
    line(*("---" for _ in names))


if __name__ == "__main__":
    main()
