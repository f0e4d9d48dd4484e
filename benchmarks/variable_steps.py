"""Steps under error control beside equal steps: the quarter-car on its bump, Ψ₀ and its gradient by hardpoints.

    python benchmarks/variable_steps.py [--out benchmarks/results] [--seconds 2]

The gradient is that by stiffness, damping, height of the bump and 30 coordinates of hardpoints, in reverse mode. All
errors are relative to an independent integrator (index-reduced equations, Dopri8, 800 steps): that of Ψ₀; the largest
of p dΨ₀/dp of the first three, relative to the largest; the largest of dΨ₀/dp of the hardpoints, relative to the
largest; that of the multipliers of all joints at all times, relative to the largest. Prints the table and writes
variable_steps.json. With JAX_COMPILATION_CACHE_DIR a second run compiles nothing.
"""

import argparse
import json
import os
import platform
import time
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import numpy as np
from scipy.interpolate import CubicSpline

import lgsens as lg
from lgsens.criteria._cost import median_seconds
from lgsens.examples import QuarterCar

ALPHA = lg.GeneralizedAlpha(0.9)
REFERENCE = (lg.IndexReducedODE(diffrax.Dopri8()), 800)
CASES = [
    ("equal", ALPHA, 250),
    ("equal", ALPHA, 500),
    ("equal", ALPHA, 1000),
    *((f"tolerance {tolerance:g}", lg.AdaptiveSteps(ALPHA, tolerance=tolerance), n) for tolerance, n in (
        (1e-4, 200), (1e-5, 320), (1e-6, 600),
    )),
    ("aligned", lg.AlignedSteps(ALPHA), 500),
    ("given, equal", lg.GivenSteps(np.ones(500), ALPHA), 500),
    ("given, equal, fixed", lg.GivenSteps(np.ones(500), ALPHA, fixed=True), 500),
]  # fmt: skip
COMFORT = lg.Criterion(integrand=lambda s, p: s.body("chassis").acceleration[2] ** 2)
RATES = ("stiffness", "damping", "bump")


def parameters(car: QuarterCar) -> dict:
    points = {"chassis": lambda link: link.chassis, "knuckle": lambda link: link.knuckle}
    hardpoints = {end: {name: of(link) for name, link in car.links.items()} for end, of in points.items()}
    return {"stiffness": car.spring.rate, "damping": car.damper.rate, "bump": car.bump_height, "points": hardpoints}


def build(car: QuarterCar, p: dict) -> lg.Model:
    names = sorted(car.links)

    def leaves(car):
        ends = [getattr(car.links[name], end) for end in ("chassis", "knuckle") for name in names]
        return [car.spring.rate, car.damper.rate, car.bump_height, *ends]

    ends = [p["points"][end][name] for end in ("chassis", "knuckle") for name in names]
    return eqx.tree_at(leaves, car, [*(p[name] for name in RATES), *ends]).model()


def evaluate(integrator, num_steps: int, seconds: float) -> tuple[dict, tuple[np.ndarray, np.ndarray]]:
    """Numbers of a run, and its times and multipliers."""
    car = QuarterCar.load()

    def psi(p):
        run = lg.simulate(build(car, p), t1=seconds, num_steps=num_steps, integrator=integrator, throw=False)
        return COMFORT(run), (run.stats, run.result, run.t, run.states.lam)

    p, started = parameters(car), time.perf_counter()
    program = jax.jit(jax.value_and_grad(psi, has_aux=True)).lower(p).compile()
    compiled = time.perf_counter() - started
    (value, (stats, result, t, multipliers)), gradient = program(p)
    if result != lg.RESULTS.successful:
        raise RuntimeError(lg.RESULTS(int(result)).message)
    sizes = np.diff(t)
    found = {
        "capacity": num_steps,
        "steps": int(np.sum(sizes > 0)),
        "shortest": float(sizes[sizes > 0].min()),
        "longest": float(sizes.max()),
        "psi": float(value),
        "rates": [float(gradient[name] * p[name]) for name in RATES],
        "hardpoints": np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(gradient["points"])]).tolist(),
        "ms": 1e3 * median_seconds(lambda: program(p), repeats=9)[0],
        "compile_s": compiled,
    }
    if hasattr(stats, "rejected"):
        found["rejected"] = int(stats.rejected.sum())
    if hasattr(stats, "increment"):
        found["iterations"] = int(stats.iterations.sum())
    jax.clear_caches()  # a process has only so many memory maps
    last = found["steps"] + 1
    return found, (np.asarray(t)[:last], np.asarray(multipliers)[:last])


def largest(found, exact) -> float:
    return float(np.abs(np.subtract(found, exact)).max() / np.abs(exact).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=2.0, help="t1 (default: %(default)s)")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    exact, (times, forces) = evaluate(*REFERENCE, arguments.seconds)
    of_time, most = CubicSpline(times, forces), np.abs(forces).max()
    errors = "error of Ψ₀ | of its gradient by rates | by hardpoints | of forces"
    print(f"| steps | number | rejected | iterations | {errors} | ms |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    rows = []
    for label, integrator, num_steps in CASES:
        found, (t, multipliers) = evaluate(integrator, num_steps, arguments.seconds)
        row = {"label": label, "error_of_forces": float(np.abs(multipliers - of_time(t)).max() / most)} | found
        row["error_of_psi"] = abs(row["psi"] / exact["psi"] - 1.0)
        row |= {f"error_of_{name}": largest(row[name], exact[name]) for name in ("rates", "hardpoints")}
        rows.append(row)
        cells = [label, row["steps"], row.get("rejected", 0), row["iterations"]]
        cells += [f"{row[f'error_of_{name}']:.1e}" for name in ("psi", "rates", "hardpoints", "forces")]
        print("|", " | ".join(map(str, [*cells, round(row["ms"])])), "|", flush=True)
    versions = {"python": platform.python_version(), "jax": jax.__version__}
    record = {
        "versions": versions,
        "cores": os.cpu_count(),
        "seconds": arguments.seconds,
        "reference": exact,
        "rows": rows,
    }
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "variable_steps.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
