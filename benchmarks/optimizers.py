"""The optimizers of lgsens beside those of SciPy and optimistix, on the designs that ship.

    python benchmarks/optimizers.py [--out benchmarks/results] [--problems k,c bands all comfort four-bar]

Designs: the quarter-car's stiffness and damping under the limits of §9 of the paper at every step (`k,c`); its
hardpoints as well, with camber and toe within bands (`bands`), and without (`all`); stiffness, damping and hardpoints
within their box alone (`comfort`, with one gradient in reverse mode); and the four-bar that is identified from
accelerations (`four-bar`). `minimize` and SciPy have the same f, g, gradients and Jacobians. SLSQP gets all
constraints, and once more, like trust-constr, only those that come near their limits at the optimum of `minimize`,
which nobody knows before.

Counted are simulations, Jacobians or gradients, and seconds without compilation, of which `evaluating` in simulations;
`reached` is what it took to an f within 1e-3 of the least that any method found, with g ≤ 1e-3, whatever ends a method.
Writes optimizers.json (problems that are not run keep their numbers) and prints a table. Many starts: multi_start.py.
"""

import json
import time
from collections.abc import Callable
from typing import Any

import benchmark
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import scipy.optimize

from lgsens.examples import AccelerationTest, CurveBounds, QuarterCar, SuspensionDesign
from lgsens.optimize import Log, least_squares, minimize, scipy_least_squares, scipy_problem

CLOSE = 1e-3  # of f, and of g
NEAR = -0.3  # of the scale of a constraint
STEPS = 200  # of a suspension, over 1 s
LONGEST = 240.0  # s of one search
DATA_SETS = 5


class TimeIsUp(Exception):
    """`LONGEST` has passed."""


class Counted:
    """A problem of SciPy that keeps what was asked of it; an entry for each design simulated or differentiated."""

    def __init__(self, problem):
        self.problem = problem
        self.calls = {"simulations": (problem.fun, problem.constraints), "jacobians": (problem.jac,)}
        if problem.constraints(problem.z0).size:
            self.calls["jacobians"] += (problem.constraints_jac,)
        problem.jac(problem.z0)  # compiled
        self.restart(problem.z0)

    def restart(self, z0: np.ndarray) -> None:
        self.trace: list[tuple[float, float, int, int]] = []  # f, max g, simulations and Jacobians until then
        self.asked = {"simulations": 0, "jacobians": 0}
        self.last = {"simulations": b"", "jacobians": b""}
        self.evaluating, self.begun = 0.0, time.perf_counter()
        self.f0 = abs(self.problem.fun(z0))

    def ask(self, kind: str, z: np.ndarray) -> tuple[Any, ...]:
        if time.perf_counter() - self.begun > LONGEST:
            raise TimeIsUp
        started = time.perf_counter()
        found = tuple(call(z) for call in self.calls[kind])
        self.evaluating += time.perf_counter() - started
        if z.tobytes() != self.last[kind]:
            self.last[kind] = z.tobytes()
            self.asked[kind] += 1
            if kind == "simulations":
                self.trace.append((found[0], float(np.max(found[1], initial=-np.inf)), *self.asked.values()))
        return found


def by_minimize(fun: Callable, x0, settings: dict[str, Any], num_steps: int) -> tuple[dict, Any, list]:
    found = minimize(fun, x0, **settings, num_steps=num_steps, progress=False)
    h = found.history
    kind = "jacobians" if np.size(found.constraints) else "gradients"
    trace = [(float(f), float(g), {kind: i + 1}) for i, (f, g) in enumerate(zip(h.objective, h.worst_constraint))]
    return {kind: len(trace), "seconds": found.run_seconds, "message": found.reason}, found, trace


def search(counted: Counted, z0: np.ndarray, method: str, chosen: np.ndarray) -> tuple[np.ndarray | None, str]:
    """Where a search under the constraints `chosen` ends, and why."""
    counted.restart(z0)
    given: Any = ()
    fun = lambda z: counted.ask("simulations", z)[0] / counted.f0
    jac = lambda z: counted.ask("jacobians", z)[0] / counted.f0
    g, slope = (lambda z: counted.ask("simulations", z)[1][chosen]), (lambda z: counted.ask("jacobians", z)[1][chosen])
    options: dict[str, Any] = {"maxiter": 200}
    if method == "SLSQP":
        given = {"type": "ineq", "fun": lambda z: -g(z), "jac": lambda z: -slope(z)}
        options |= {"ftol": 1e-7}
    elif method == "trust-constr":
        given = scipy.optimize.NonlinearConstraint(g, -np.inf, 0.0, jac=slope, hess=scipy.optimize.BFGS())
        options |= {"gtol": 1e-5, "xtol": 1e-8, "barrier_tol": 1e-6}
    extra = {"hess": scipy.optimize.BFGS()} if method == "trust-constr" else {}
    try:
        found = scipy.optimize.minimize(
            fun, z0, jac=jac, bounds=counted.problem.bounds, constraints=given, method=method, options=options, **extra
        )
    except TimeIsUp:
        return None, f"ended after {LONGEST:.0f} s"
    return found.x, str(found.message)


def by_scipy(counted: Counted, method: str, chosen: np.ndarray, kind: str) -> tuple[dict, Any, list]:
    """A search under the constraints `chosen`."""
    seconds: list[float] = []
    evaluating: list[float] = []
    while not seconds or (len(seconds) < 5 and sum(seconds) < 10.0):
        z, message = search(counted, counted.problem.z0, method, chosen)
        seconds.append(time.perf_counter() - counted.begun)
        evaluating.append(counted.evaluating)
    row = dict(counted.asked) if kind == "jacobians" else {"simulations": counted.asked["simulations"]}
    if kind == "gradients":
        row["gradients"] = counted.asked["jacobians"]
    row |= {"seconds": float(np.median(seconds)), "evaluating": float(np.median(evaluating)), "message": message}
    trace = [(f, g, {"simulations": s, kind: j}) for f, g, s, j in counted.trace]
    return row, z, trace


def compare(fun: Callable, x0, settings: dict[str, Any], num_steps: int) -> dict[str, dict]:
    """All methods on one problem of `minimize`, judged alike."""
    own, found, trace = by_minimize(fun, x0, settings, num_steps)
    rows, traces, ends = {"minimize": own}, {"minimize": trace}, {"minimize": found.x}
    print("minimize", own, flush=True)
    jax.clear_caches()
    counted = Counted(scipy_problem(fun, x0, **settings))
    if found.constraints.size:
        everything = np.arange(found.constraints.size)
        near = np.flatnonzero(found.constraints.ravel() > NEAR)
        methods = {"SLSQP": ("SLSQP", everything)}
        methods |= {f"{method}, {near.size} constraints": (method, near) for method in ("SLSQP", "trust-constr")}
    else:
        methods = {"L-BFGS-B": ("L-BFGS-B", np.arange(0))}
    kind = next(kind for kind in ("jacobians", "gradients") if kind in own)
    for name, (method, chosen) in methods.items():
        rows[name], z, traces[name] = by_scipy(counted, method, chosen, kind)
        ends[name] = None if z is None else counted.problem.x(z)
        print(name, rows[name], flush=True)
    evaluate = jax.jit(lambda x: fun(x))
    for name, row in rows.items():
        if ends[name] is not None:
            f, g = evaluate(ends[name])
            row |= {"objective": float(f)} | ({"worst_constraint": float(np.max(g))} if g.size else {})
    feasible = [f for trace in traces.values() for f, g, _ in trace if g <= 1e-5]
    for name, row in rows.items():
        within = lambda f, g: g <= CLOSE and f <= (1 + CLOSE) * min(feasible)
        row["reached"] = next((asked for f, g, asked in traces[name] if within(f, g)), None)
    jax.clear_caches()
    return {"constraints": int(found.constraints.size), "methods": rows}


def suspension(parameters: str, keep: bool) -> tuple[Callable, dict, dict[str, Any]]:
    """The arguments of `minimize` but the steps."""
    bands = {"travel": 0.05, "camber": np.radians(0.3), "toe": np.radians(0.1)}
    kept = CurveBounds.around(QuarterCar.load(), **bands) if keep else None
    design = SuspensionDesign.load(parameters=parameters, keep=kept, t1=1.0, num_steps=STEPS)
    lower, upper = design.bounds
    return design, design.start, {"lower": lower, "upper": upper, "log_scale": design.log_scale}


def comfort() -> dict:
    design, start, settings = suspension("k,c,hardpoints", False)
    return compare(lambda x: (design(x)[0], jnp.zeros(0)), start, settings, 100)


def identification() -> dict:
    """Least squares of the four-bar: evaluations and ½ |r|² of all data sets, the median of their times."""
    test = AccelerationTest()
    data = [test.measure(jax.random.key(seed), test.truth) for seed in range(DATA_SETS)]
    logs = {name: Log() if name in ("m3", "m4", "k", "cd") else None for name in test.guess}
    solvers = {
        "LineSearchGaussNewton": None,
        "GaussNewton": optimistix.GaussNewton(1e-5, 1e-5),
        "LevenbergMarquardt": optimistix.LevenbergMarquardt(1e-5, 1e-5),
        "Dogleg": optimistix.Dogleg(1e-5, 1e-5),
    }
    bounds = {sign: {name: sign * abs(x) for name, x in test.guess.items()} for sign in (0.5, 2.0)}
    lower, upper = bounds[0.5], bounds[2.0]
    rows = {}
    for name, solver in solvers.items():
        solve = jax.jit(
            lambda readings, solver=solver: least_squares(
                lambda p: test.residual(p, readings), test.guess, parametrization=logs, solver=solver
            )
        )
        jax.block_until_ready(solve(data[0]))
        found, seconds = [], []
        for readings in data:
            begun = time.perf_counter()
            found.append(jax.block_until_ready(solve(readings)))
            seconds.append(time.perf_counter() - begun)
        rows[name] = {
            "steps": sum(int(each.steps) for each in found),
            "seconds": float(np.median(seconds)),
            "message": f"{sum(bool(each.converged) for each in found)} of {DATA_SETS} converged",
        }
        if all(each.converged for each in found):
            rows[name]["objective"] = sum(float(np.sum(each.residual**2)) for each in found) / 2
        print(name, rows[name], flush=True)
        jax.clear_caches()
    compiled = jax.jit(lambda p, readings: test.residual(p, readings))  # each problem compiles its own
    for method in ("trf", "lm"):
        row = {"simulations": 0, "jacobians": 0, "seconds": 0.0, "objective": 0.0, "message": ""}
        seconds = []
        for readings in data:
            problem = scipy_least_squares(lambda p, r=readings: compiled(p, r), test.guess, lower=lower, upper=upper)
            problem.fun(problem.z0), problem.jac(problem.z0)
            begun = time.perf_counter()
            found = scipy.optimize.least_squares(
                problem.fun, problem.z0, jac=problem.jac, method=method, xtol=1e-5, ftol=1e-10,
                **({} if method == "lm" else {"bounds": problem.bounds}),
            )  # fmt: skip
            seconds.append(time.perf_counter() - begun)
            row["simulations"] += int(found.nfev)
            row["jacobians"] += int(found.njev or 0)
            row["objective"] += float(found.cost)
            row["message"] = str(found.message)
        row["seconds"] = float(np.median(seconds))
        rows[f"SciPy {method}"] = row
        print(method, row, flush=True)
    return {"constraints": 0, "methods": rows}


PROBLEMS = {
    "k,c": lambda: compare(*suspension("k,c", False), 100),
    "bands": lambda: compare(*suspension("k,c,hardpoints", True), 200),
    "all": lambda: compare(*suspension("k,c,hardpoints", False), 200),
    "comfort": comfort,
    "four-bar": identification,
}


def table(problems: dict[str, dict]) -> str:
    head = (
        "problem",
        "method",
        "f",
        "over the least − 1",
        "worst g",
        "evaluations",
        "until 1e-3",
        "s",
        "of it simulating",
    )
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    kinds = ("simulations", "jacobians", "gradients", "steps")
    counts = lambda found: ", ".join(f"{found[kind]} {kind}" for kind in kinds if kind in found) if found else "–"
    for problem, record in problems.items():
        ended = [row for row in record["methods"].values() if "objective" in row]
        least = min(row["objective"] for row in ended if row.get("worst_constraint", 0.0) <= CLOSE)
        for method, row in record["methods"].items():
            f = row.get("objective", np.nan)
            cells = [f"{f:.6g}", f"{f / least - 1:+.1e}", f"{row.get('worst_constraint', np.nan):+.1e}", counts(row)]
            cells += [counts(row.get("reached")), f"{row['seconds']:.3g}", f"{row.get('evaluating', np.nan):.3g}"]
            lines.append(f"| {problem} | {method} | {' | '.join(cells)} |".replace("+nan", "–").replace("nan", "–"))
    return "\n".join(lines)


def main() -> None:
    parser = benchmark.options(__doc__, repeats=False)
    parser.add_argument("--problems", nargs="*", choices=PROBLEMS, default=list(PROBLEMS))
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    path = chosen.out / "optimizers.json"
    kept = lambda: json.loads(path.read_text(encoding="utf-8"))["problems"] if path.exists() else {}
    for name in chosen.problems:
        record = {name: PROBLEMS[name]() | benchmark.environment()}
        benchmark.write(path, {"steps": STEPS, "problems": kept() | record})
    found = kept()
    print(table({name: found[name] for name in PROBLEMS if name in found}))


if __name__ == "__main__":
    main()
