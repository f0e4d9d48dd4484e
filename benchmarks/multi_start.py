"""Designs from many starts: `multi_start` in both modes, and SLSQP by itself.

    python benchmarks/multi_start.py [--problems k,c bands all] [--out benchmarks/results]

The suspensions of optimizers.py from 16 random designs, the same for all methods, in one run on one thread:

- multi_start: SLSQP with value and Jacobian in one program, ended by the conditions of an optimum, one after another;
- multi_start in reverse mode: all searches of a batch in one program, which lasts as long as the longest of them;
- SLSQP, one after another through one `scipy_problem`, ended by itself.

Counted are evaluations and seconds without compilation. A search is feasible with g ≤ 1e-3, and close with an f within
1e-3 of the least that any of them found. Writes multi_start.json, problem by problem, and prints a table.
"""

import json
import os
import time
from collections.abc import Callable
from typing import Any

import benchmark
import jax
import jax.numpy as jnp
import numpy as np
from optimizers import CLOSE, Counted, search, suspension

from lgsens.optimize import multi_start, scipy_problem

STARTS = 16
PROBLEMS = {
    "k,c": lambda: compare(*suspension("k,c", False), 100),
    "bands": lambda: compare(*suspension("k,c,hardpoints", True), 200),
    "all": lambda: compare(*suspension("k,c,hardpoints", False), 200),
}
Found = tuple[list, dict[str, Any]]  # the designs, None where a search has none, and figures


def by_multi_start(fun: Callable, starts: list, settings: dict[str, Any], num_steps: int, forward: bool) -> Found:
    found = multi_start(fun, starts, **settings, num_steps=num_steps, forward=forward, progress=False)
    return [jax.tree.map(lambda leaf, i=i: jnp.asarray(leaf[i]), found.x) for i in range(STARTS)], {
        "jacobians" if forward else "gradients": int(np.sum(found.steps)),
        "longest": int(np.max(found.steps)),
        "seconds": found.run_seconds,
        "compile_seconds": found.compile_seconds,
        "reasons": found.reason.tolist(),
    }


def slsqp(problem, zs: np.ndarray) -> Found:
    counted = Counted(problem)
    everything = np.arange(problem.constraints(problem.z0).size)
    ends, reasons, figures = [], [], {"simulations": 0, "jacobians": 0, "seconds": 0.0, "evaluating": 0.0}
    for z0 in zs:
        z, message = search(counted, z0, "SLSQP", everything)
        figures["seconds"] += time.perf_counter() - counted.begun
        figures["evaluating"] += counted.evaluating
        for kind, asked in counted.asked.items():
            figures[kind] += asked
        ends.append(None if z is None else problem.x(z))
        reasons.append(message)
    return ends, figures | {"reasons": reasons}


def compare(fun: Callable, x0, settings: dict[str, Any], num_steps: int) -> dict:
    """All methods from the same random designs, judged alike."""
    problem = scipy_problem(fun, x0, **settings)
    zs = np.random.default_rng(0).uniform(size=(STARTS, problem.z0.size))
    starts = [problem.x(z) for z in zs]
    evaluate, rows = jax.jit(lambda x: fun(x)), {}
    for name, method in {
        "multi_start": lambda: by_multi_start(fun, starts, settings, num_steps, True),
        "multi_start in reverse mode": lambda: by_multi_start(fun, starts, settings, num_steps, False),
        "SLSQP": lambda: slsqp(problem, zs),
    }.items():
        ends, figures = method()
        judged = [(np.nan, np.nan) if x is None else (float((f := evaluate(x))[0]), float(np.max(f[1]))) for x in ends]
        rows[name] = figures | {"objective": [f for f, _ in judged], "worst_constraint": [g for _, g in judged]}
        print(name, rows[name], flush=True)
        jax.clear_caches()
    return {"starts": STARTS, "methods": rows}


def table(problems: dict[str, dict]) -> str:
    head = ("problem", "method", "least f", "feasible", "close", "evaluations", "s")
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for problem, record in problems.items():
        feasible = {
            name: [f for f, g in zip(row["objective"], row["worst_constraint"]) if g <= CLOSE]
            for name, row in record["methods"].items()
        }
        least = min(min(found) for found in feasible.values() if found)
        for name, row in record["methods"].items():
            found = feasible[name]
            cells = [f"{min(found, default=np.nan):.6g}", f"{len(found)} of {record['starts']}"]
            cells += [str(sum(f <= (1 + CLOSE) * least for f in found))]
            cells += [
                ", ".join(f"{row[kind]} {kind}" for kind in ("simulations", "jacobians", "gradients") if kind in row)
            ]
            lines.append(f"| {problem} | {name} | {' | '.join(cells)} | {row['seconds']:.3g} |")
    notes = [f"{name}: {benchmark.circumstances(record['environment'])}" for name, record in problems.items()]
    return "\n".join([*lines, "", *notes])


def main() -> None:
    parser = benchmark.options(__doc__, repeats=False)
    parser.add_argument("--problems", nargs="*", choices=PROBLEMS, default=list(PROBLEMS))
    arguments = parser.parse_args()
    os.environ.update(benchmark.SINGLE_THREAD)  # before the first computation
    jax.config.update("jax_enable_x64", True)
    path = arguments.out / "multi_start.json"
    problems = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    for name in arguments.problems:
        problems[name] = PROBLEMS[name]() | {"environment": benchmark.environment(benchmark.SINGLE_THREAD)}
        benchmark.write(path, problems)
    print(table(problems))


if __name__ == "__main__":
    main()
