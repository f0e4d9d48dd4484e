"""The optimum of the quarter-car's design by `minimize`, by SciPy's methods and by a grid that zooms in.

`python benchmarks/design.py` writes benchmarks/results/design.json and prints its table.
Stiffness and damping are free, Ψ₀ is least under bounds on tyre force and spring length at every time step. SLSQP has
all of these constraints; trust-constr, whose slack variables are as many, those samples that come near their limit in
a design of the first grid that is nearly feasible. All are judged by all of them. The grid shares nothing with the
others but the simulation: no derivative, no multiplier.
"""

import argparse
import importlib.metadata
import json
import os
import platform
import time
from pathlib import Path

import jax
import numpy as np
import scipy.optimize

import lgsens as lg
from lgsens.examples import SuspensionDesign
from lgsens.optimize import minimize, scipy_problem

RESULTS = Path(__file__).parent / "results" / "design.json"
NEAR = -0.2  # of its scale: trust-constr is spared constraints that never come nearer than this
NEARLY = 0.1  # of the scale: the violation of designs that are nearly feasible
GRID = 9  # points along each axis of each grid
LEVELS = 5
ZOOM = 0.3  # of the width, around the best feasible point


def by_grid(design: SuspensionDesign) -> tuple[dict, np.ndarray]:
    """The best feasible point of grids in (log k, log c), each around the best of the one before.

    And for each constraint the worst g of the designs of the first grid that are nearly feasible.
    """
    lower, upper = ({name: float(value) for name, value in bound.items()} for bound in design.bounds)
    names = list(lower)
    low, high = (np.log([bound[name] for name in names]) for bound in (lower, upper))
    box_low, box_high = low, high
    count, best, nearest = 0, None, None
    for _ in range(LEVELS):
        axes = [np.linspace(a, b, GRID) for a, b in zip(low, high)]
        points = np.exp(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(names)))
        found = lg.sweep(design, {name: points[:, i] for i, name in enumerate(names)}, batch_size=32)
        objective, constraints = found.values
        worst = np.max(constraints, axis=1)
        nearest = np.max(constraints[worst < NEARLY], axis=0) if nearest is None else nearest
        feasible = found.ok & (worst <= 0)
        i = int(np.argmin(np.where(feasible, objective, np.inf)))
        count += len(points)
        if best is None or objective[i] < best["objective"]:
            best = {"x": found.design(i), "objective": float(objective[i])}
        half = ZOOM * (high - low) / 2
        centre = np.log([float(best["x"][name]) for name in names])
        low, high = np.maximum(centre - half, box_low), np.minimum(centre + half, box_high)
    return best | {"simulations": count}, nearest


def by_scipy(design: SuspensionDesign, method: str, samples: np.ndarray) -> dict:
    """SciPy's optimum under the constraints `samples`."""
    lower, upper = design.bounds
    problem = scipy_problem(design, design.start, lower=lower, upper=upper, log_scale=design.log_scale)
    scale = problem.fun(problem.z0)
    constraints, jacobian = (lambda z: problem.constraints(z)[samples]), (lambda z: problem.constraints_jac(z)[samples])
    if method == "SLSQP":
        given = {"type": "ineq", "fun": lambda z: -constraints(z), "jac": lambda z: -jacobian(z)}
        options = {"ftol": 1e-9}
    else:
        given = scipy.optimize.NonlinearConstraint(constraints, -np.inf, 0.0, jac=jacobian, hess=scipy.optimize.BFGS())
        options = {"gtol": 1e-6, "xtol": 1e-8, "barrier_tol": 1e-7, "maxiter": 60}
    started = time.perf_counter()
    found = scipy.optimize.minimize(
        lambda z: problem.fun(z) / scale,
        problem.z0,
        jac=lambda z: problem.jac(z) / scale,
        hess=scipy.optimize.BFGS() if method == "trust-constr" else None,
        bounds=problem.bounds,
        constraints=given,
        method=method,
        options=options,
    )
    return {
        "x": problem.x(found.x),
        "simulations": int(found.nfev),
        "jacobians": int(found.njev),
        "seconds": time.perf_counter() - started,
        "message": str(found.message),
    }


def by_minimize(design: SuspensionDesign, forward: bool) -> dict:
    lower, upper = design.bounds
    settings = {"lower": lower, "upper": upper, "log_scale": design.log_scale, "forward": forward}
    found = minimize(design, design.start, **settings, num_steps=200, tolerance=1e-6)
    return {
        "x": found.x,
        "jacobians" if forward else "gradients": len(found.history.objective),
        "seconds": found.run_seconds,
        "message": found.reason,
        "multiplier": float(np.sum(found.multipliers)),
    }


def table(methods: dict) -> str:
    head = ("method", "k [N/m]", "c [N s/m]", "Ψ₀ [m²/s³]", "Ψ₀ over SLSQP's − 1", "worst g", "evaluations")
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    reference = methods["SLSQP"]["objective"]
    for name, row in methods.items():
        kinds = ("gradients", "simulations", "jacobians")
        evaluations = ", ".join(f"{row[kind]} {kind}" for kind in kinds if kind in row)
        cells = [
            f"{row['x']['stiffness']:.1f}",
            f"{row['x']['damping']:.2f}",
            f"{row['objective']:.6f}",
            f"{row['objective'] / reference - 1:+.1e}",
            f"{row['worst_constraint']:+.1e}",
        ]
        lines.append(f"| {name} | {' | '.join(cells)} | {evaluations} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=400, help="of each simulation over 2 s")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    design = SuspensionDesign.load(num_steps=options.steps)
    evaluate = jax.jit(lambda x: design(x))  # a model is no key of a cache

    def judged(name: str, row: dict) -> dict:
        objective, constraints = evaluate(row["x"])
        row |= {"objective": float(objective), "worst_constraint": float(np.max(constraints))}
        row["x"] = {name: float(value) for name, value in row["x"].items()}
        print(name, row, flush=True)
        return {name: row}

    methods = judged("minimize", by_minimize(design, True))
    methods |= judged("minimize, augmented Lagrangian", by_minimize(design, False))
    grid, nearest = by_grid(design)
    methods |= judged("grid", grid)
    methods |= judged("SLSQP", by_scipy(design, "SLSQP", np.arange(nearest.size)))
    methods |= judged("trust-constr", by_scipy(design, "trust-constr", np.flatnonzero(nearest > NEAR)))
    packages = ("lgsens", "jax", "jaxlib", "numpy", "scipy", "optax")
    record = {
        "date": time.strftime("%Y-%m-%d"),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{package: importlib.metadata.version(package) for package in packages},
        "steps": options.steps,
        "constraints": int(nearest.size),
        "constraints of trust-constr": int(np.sum(nearest > NEAR)),
        "methods": methods,
    }
    RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(table(methods))


if __name__ == "__main__":
    main()
