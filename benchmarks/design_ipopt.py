"""The quarter-car's optimal stiffness and damping by CasADi and IPOPT, from equations and derivatives of their own.

`python benchmarks/design_ipopt.py` (with benchmarks/requirements.txt) writes benchmarks/results/design_ipopt.json. The
problem is that of `design.py` with the wheel locked, as the equations of `rival_casadi.py` have it; single shooting by
RK4, derivatives by CasADi, constraints at every step, Hessians by limited memory. What it finds is compared with
`lgsens.optimize.minimize` on the same problem, and judged by lgsens at fine steps.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np
from rival_casadi import Equations, casadi, initial, parameters, version
from rival_scenes import quarter_car

from lgsens.examples import SuspensionDesign
from lgsens.optimize import minimize

RESULTS = Path(__file__).parent / "results" / "design_ipopt.json"
FINE = 2000  # steps of the judge


def problem(design: SuspensionDesign, num_steps: int) -> tuple[dict, np.ndarray]:
    """CasADi's nonlinear program in the scaled logarithms of k and c, and its start."""
    ca, scene = casadi(), quarter_car()
    equations = Equations(scene)
    rate, h = equations.function(), design.t1 / num_steps
    y, theta = equations.state, equations.theta
    k1 = rate(y, theta)
    k2 = rate(y + h / 2 * k1, theta)
    k3 = rate(y + h / 2 * k2, theta)
    k4 = rate(y + h * k3, theta)
    wheel, (a, b) = scene.topology.wheel, scene.topology.springs[0]
    ends = [equations.x[i] + equations.r[i] @ equations.vector(f"springs{j}") for j, i in enumerate((a, b))]
    stiffness, radius, preload, height, duration = (equations.number(f"tyre{j}") for j in range(5))
    phase = equations.t / duration
    road = ca.if_else(phase <= 1, height * ca.sin(np.pi * phase) ** 2, 0)
    watched = ca.vertcat(
        preload + stiffness * (road + radius - equations.x[wheel][2]), ca.norm_2(ends[1] - ends[0])
    )  # tyre force and spring length
    step = ca.Function("step", [y, theta], [y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    watch = ca.Function("watch", [y, theta], [watched])

    start = np.asarray(scene.start)
    of_rates = lambda rates: parameters(scene.numbers(jax.numpy.concatenate([rates, start[2:]])))
    theta0, slope = np.asarray(of_rates(start[:2])), np.asarray(jax.jacfwd(of_rates)(start[:2]))
    other = 1.3 * start[:2]  # the preloads do not depend on the rates, so θ is affine in them
    np.testing.assert_allclose(of_rates(other), theta0 + slope @ (other - start[:2]), rtol=1e-9, atol=1e-9)

    lower, upper = (np.log([float(bound[name]) for name in ("stiffness", "damping")]) for bound in design.bounds)
    z = ca.MX.sym("z", 2)
    rates = ca.exp(lower + z * (upper - lower))
    numbers = ca.repmat(theta0 + slope @ (rates - start[:2]), 1, num_steps)
    y0 = np.asarray(initial(scene.arrays()))
    states = step.mapaccum("motion", num_steps)(y0, numbers)
    seen = watch.map(num_steps)(states, numbers)
    limits = design.limits
    span = float(limits.maximum_spring_length - limits.minimum_spring_length)
    weight = 9.81 * float(np.sum(scene.arrays().mass))
    g = ca.horzcat(
        (float(limits.minimum_tyre_force) - seen[0, :]) / weight,
        (float(limits.minimum_spring_length) - seen[1, :]) / span,
        (seen[1, :] - float(limits.maximum_spring_length)) / span,
    ).T
    psi = states[-1, -1]
    z0 = (np.log(start[:2]) - lower) / (upper - lower)
    return {"x": z, "f": psi, "g": g, "rates": ca.Function("rates", [z], [rates])}, z0


def by_ipopt(design: SuspensionDesign, num_steps: int) -> dict:
    ca = casadi()
    nlp, z0 = problem(design, num_steps)
    rates = nlp.pop("rates")
    options = {
        "print_time": False,
        "ipopt": {"hessian_approximation": "limited-memory", "tol": 1e-7, "print_level": 0, "max_iter": 100},
    }
    solver = ca.nlpsol("solver", "ipopt", nlp, options)
    started = time.perf_counter()
    found = solver(x0=z0, lbx=0, ubx=1, ubg=0)
    seconds = time.perf_counter() - started
    k, c = np.asarray(rates(found["x"])).ravel()
    return {
        "x": {"stiffness": float(k), "damping": float(c)},
        "own objective": float(found["f"]),
        "own worst constraint": float(np.max(np.asarray(found["g"]))),
        "iterations": int(solver.stats()["iter_count"]),
        "message": solver.stats()["return_status"],
        "seconds": seconds,
    }


def by_augmented_lagrangian(design: SuspensionDesign) -> dict:
    lower, upper = design.bounds
    bounds = {"lower": lower, "upper": upper, "log_scale": design.log_scale}
    found = minimize(design, design.start, **bounds, num_steps=100, tolerance=1e-6, progress=False)
    return {
        "x": {name: float(value) for name, value in found.x.items()},
        "own objective": found.objective,
        "own worst constraint": float(np.max(found.constraints)),
        "evaluations": len(found.history.objective),
        "message": found.reason,
        "seconds": found.run_seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=400, help="of RK4 over 2 s")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    design = SuspensionDesign.load(wheel="locked", num_steps=FINE)
    methods = {
        "CasADi, IPOPT": by_ipopt(design, options.steps),
        "augmented Lagrangian": by_augmented_lagrangian(design),
    }
    judge = jax.jit(design)
    for name, row in methods.items():
        objective, constraints = judge({key: jax.numpy.asarray(value) for key, value in row["x"].items()})
        row |= {"objective": float(objective), "worst_constraint": float(np.max(constraints))}
        print(name, row, flush=True)
    record = {
        "date": time.strftime("%Y-%m-%d"),
        "casadi": version(),
        "jax": jax.__version__,
        "RK4 steps": options.steps,
        "lgsens steps": FINE,
        "methods": methods,
    }
    RESULTS.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
