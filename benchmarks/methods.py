"""Every method against every other: four scenes, five criteria on each; accuracy, order, cost.

    python benchmarks/methods.py [--out benchmarks/results] [--scenes top four_bar chain quarter_car]

For each scene: what the discrete methods (DDM, AVM, autodiff of the loops, finite differences) differ by at one step
size; the error of each method against the index-reduced equations (diffrax) at three step sizes, with its slope; the
wall time of value and gradient of all five criteria, compiled, as a ratio to one simulation. Errors are relative to the
largest effect of a relative change of a parameter on the criterion. Writes methods.json (scenes that are not run keep
their numbers there) and prints the tables.
"""

import argparse
import json
import os
import platform
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

import lgsens as lg
from lgsens.criteria._cost import median_seconds
from lgsens.examples import COMPARISON

FACTORS = (1, 2)  # step counts, as multiples of the problem's
DISCRETE = {
    "AVM": (lg.AdjointVariable(), lg.GeneralizedAlpha()),
    "autodiff": (lg.Autodiff(), lg.GeneralizedAlpha(tolerance=1e-13)),  # exact up to Newton's last increment
    "differences": (lg.FiniteDifferences(), lg.GeneralizedAlpha()),
}
CONVERGENT = {
    "DDM": (lg.DirectDifferentiation(), 0.9),
    "continuous DDM": (lg.ContinuousDirect(), 0.9),
    "continuous AVM, state": (lg.ContinuousAdjoint("state"), 0.9),
    "continuous AVM, derivatives": (lg.ContinuousAdjoint("derivatives"), 0.9),
    "continuous AVM, first_order": (lg.ContinuousAdjoint("first_order"), 0.9),
    # damped, so that the start's transients in accelerations and multipliers die out
    "continuous AVM, derivatives, rho 0.2": (lg.ContinuousAdjoint("derivatives"), 0.2),
    "continuous AVM, first_order, rho 0.2": (lg.ContinuousAdjoint("first_order"), 0.2),
}


class Scene:
    """One problem: gradients, errors and times of the methods on it."""

    def __init__(self, name: str):
        self.problem = COMPARISON[name]
        self.scale = np.array([abs(value) or 0.01 for value in self.problem.parameters.values()])  # at 0: 10 mm
        self.breaks = (0.25,) if name == "quarter_car" else ()

    def run(self, method, num_steps: int, integrator=None):
        problem = self.problem
        return lg.differentiate(
            problem.criteria,
            problem.build,
            problem.parameters,
            t1=problem.t1,
            num_steps=num_steps,
            integrator=lg.GeneralizedAlpha() if integrator is None else integrator,
            method=method,
        )

    def gradient(self, method, num_steps: int, integrator=None) -> np.ndarray:
        """p dΨ/dp, a row for each criterion."""
        found = self.run(method, num_steps, integrator).gradient
        return np.array([[found[c][p] for p in self.problem.parameters] for c in self.problem.criteria]) * self.scale

    def error(self, found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        return np.abs(found - wanted).max(axis=1) / np.abs(wanted).max(axis=1)

    def simulation_seconds(self) -> float:
        problem = self.problem
        forward = jax.jit(
            lambda p: lg.simulate(problem.build(p), t1=problem.t1, num_steps=problem.num_steps, throw=False).states
        )
        p = jax.tree.map(np.float64, problem.parameters)
        return median_seconds(lambda: forward(p))[0]


def compare(name: str, progress) -> dict:
    """All numbers of one scene."""
    scene = Scene(name)
    base = scene.problem.num_steps
    unit = scene.simulation_seconds()
    limit = scene.gradient(lg.IndexReduced(breaks=scene.breaks), base)
    progress.update()
    direct = scene.gradient(lg.DirectDifferentiation(), base)
    record = {
        "num_steps": [base * factor for factor in FACTORS],
        "t1": scene.problem.t1,
        "parameters": list(scene.problem.parameters),
        "criteria": list(scene.problem.criteria),
        "simulation_seconds": unit,
        "difference_from_DDM": {},
        "methods": {},
    }
    for label, (method, integrator) in DISCRETE.items():
        record["difference_from_DDM"][label] = scene.error(scene.gradient(method, base, integrator), direct).tolist()
        if label != "differences":
            record["methods"][label] = {"cost": cost(scene, method, base, integrator, unit)}
        jax.clear_caches()
        progress.update()
    for label, (method, rho) in CONVERGENT.items():
        integrator = lg.GeneralizedAlpha(rho)
        errors = []
        for factor in FACTORS:
            errors.append(scene.error(scene.gradient(method, base * factor, integrator), limit))
            if factor == 1:
                seconds = cost(scene, method, base, integrator, unit)
            jax.clear_caches()
            progress.update()
        errors = np.array(errors)
        record["methods"][label] = {
            "cost": seconds,
            "errors": errors.tolist(),
            "slopes": np.log2(errors[:-1] / errors[1:]).tolist(),
        }
    record["costs"] = lg.measure_costs(
        scene.problem.criteria, scene.problem.build, scene.problem.parameters, t1=scene.problem.t1, num_steps=base
    )._asdict()
    jax.clear_caches()
    progress.update()
    return record


def cost(scene: Scene, method, num_steps: int, integrator, unit: float) -> float:
    """Of value and gradient of all criteria, in simulations."""
    return median_seconds(lambda: scene.run(method, num_steps, integrator).gradient)[0] / unit


def markdown(scenes: dict) -> str:
    """The tables of all scenes."""
    lines = []
    for name, record in scenes.items():
        criteria, finest = record["criteria"], record["t1"] / record["num_steps"][-1]
        lines += [f"## {name}: {len(record['parameters'])} parameters, {len(criteria)} criteria", ""]
        lines += ["| discrete methods, difference from DDM | " + " | ".join(criteria) + " | cost |"]
        lines += ["|---" * (len(criteria) + 2) + "|"]
        for label, differences in record["difference_from_DDM"].items():
            seconds = record["methods"].get(label, {}).get("cost")
            cells = [f"{value:.1e}" for value in differences] + ["–" if seconds is None else f"{seconds:.1f}"]
            lines.append(f"| {label} | " + " | ".join(cells) + " |")
        lines += ["", f"| error at h = {finest:g} s (slope) | " + " | ".join(criteria) + " | cost |"]
        lines += ["|---" * (len(criteria) + 2) + "|"]
        for label, found in record["methods"].items():
            if "errors" in found:
                cells = [f"{e:.1e} ({s:.2f})" for e, s in zip(found["errors"][-1], found["slopes"][-1])]
                lines.append(f"| {label} | " + " | ".join(cells) + f" | {found['cost']:.1f} |")
        costs = ", ".join(f"{key} {value:.2f}" for key, value in record["costs"].items())
        lines += ["", f"costs in simulations: {costs}", ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    parser.add_argument("--scenes", nargs="+", choices=list(COMPARISON), default=list(COMPARISON))
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    total = len(arguments.scenes) * (2 + len(DISCRETE) + len(FACTORS) * len(CONVERGENT))
    path = arguments.out / "methods.json"
    document = {
        "what": "All methods on all comparison scenes; errors relative to the largest effect on each criterion",
        "versions": {"python": platform.python_version(), "jax": jax.__version__, "numpy": np.__version__},
        "machine": {"architecture": platform.machine(), "cores": os.cpu_count()},
        "scenes": json.loads(path.read_text(encoding="utf-8"))["scenes"] if path.exists() else {},
    }
    with tqdm(total=total) as progress:
        for name in arguments.scenes:
            progress.set_description(name)
            document["scenes"][name] = compare(name, progress)
            path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(markdown({name: document["scenes"][name] for name in arguments.scenes}))


if __name__ == "__main__":
    main()
