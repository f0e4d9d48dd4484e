"""What precision costs and what it loses: mixed precision beside double, and single precision over the step.

    python benchmarks/precision.py [--parts kernels mixed single] [--cache FOLDER] [--out benchmarks/results]

kernels: what a step does with its matrix, of 9 unknowns (the top), 35 and 94 (the quarter-car, reduced and whole) and
208, random ones of condition 5e2: factors and one solution, one more solution, 32 columns, and the product with the
inverse that an iteration of modified Newton is (with its share of an inverse made every 50); the fastest of many rounds
of 50 in a scan, and medians.

mixed: simulations and gradients by all numbers of the assembled system, in reverse mode, with factors in single
precision (`DenseLU(mixed=True)`, `BlockSparse(mixed=True)`) and in double. Ψ is an integral of height and squared
speed: derivatives of accelerations by places that joints must meet carry the round-off of constraints over βh² twice,
and differ by more than 1e-9 between any two programs in double precision. The programs of a scene take turns; medians
of `--repeats` rounds or more. The difference is the largest of all entries of the gradient, relative to the largest.

single: value and gradient of the top's and the four-bar's criteria without 64-bit floats, against the independent
numbers of tests/data, at steps from 0.1 s to 0.4 ms. To the logarithms of errors C h² + ε/h^p is fitted, the error of
the scheme and what round-off makes of it, from the step on whose half lowers the error by 2 to 32; the optimum, where
they add up to least, is h = (p ε/(2C))^(1/(p+2)).

Writes what it measured into precision.json beside what other runs left there, and draws precision.png.
"""

import dataclasses
import json
import os
import statistics
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

from benchmark import SINGLE_THREAD, circumstances, environment, interleaved, options, write

PARTS = ("kernels", "mixed", "single")
LOOPS = 50
STEPS = (10, 20, 40, 80, 160, 320, 640, 1280, 2560)  # per second
PROBLEMS = {"top": "spinning_top_brulls.l_1.0_reproduces_published_number", "four-bar": "four_bar_spring"}


def scenes() -> dict:
    """Scene and solver: the model, a body whose acceleration is observed, steps of 1 ms."""
    import lgsens as lg
    from lgsens.examples import QuarterCar, spatial_chain, spinning_top

    car = QuarterCar.load().model(wheel="locked")
    return {
        ("top", lg.DenseLU): (spinning_top(0.7), "top", 1000),
        ("quarter-car", lg.DenseLU): (car, "chassis", 500),
        ("chain of 64", lg.BlockSparse): (spatial_chain(64, spin=24.0 / 64), "link63", 100),
    }


def measure_kernels(repeats: int) -> Iterator[dict]:
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax import lax

    from lgsens.linear import LU, Inverse
    from lgsens.linear._mixed import factors_of

    def looped(solve, rhs):
        """`solve(rhs)` again and again, each waiting for the one before."""
        again = lambda last, _: (solve(rhs + 1e-13 * last).ravel()[0], None)
        return lax.scan(again, jnp.zeros(()), None, length=LOOPS)[0]

    def once(matrix, rhs, mixed):
        return looped(lambda rhs: factors_of(matrix + 1e-13 * rhs[0], LU, mixed=mixed).solve(rhs), rhs)

    def more(kind):
        return lambda matrix, rhs, mixed: looped(factors_of(matrix, kind, mixed=mixed).solve, rhs)

    works = {
        "factors and a solution": (once, ()),
        "one more solution": (more(LU), ()),
        "32 columns more": (more(LU), (32,)),
        "product with the inverse": (more(Inverse), ()),
    }
    rng = np.random.default_rng(0)
    for unknowns in (9, 35, 94, 208):
        left, right = (np.linalg.qr(rng.normal(size=(unknowns, unknowns)))[0] for _ in range(2))
        matrix, calls = jnp.asarray(left * np.geomspace(1.0, 1.0 / 5e2, unknowns) @ right), {}
        for work, (function, columns) in works.items():
            rhs = jnp.asarray(rng.normal(size=(unknowns, *columns)))
            for mixed in (False, True):
                program = jax.jit(function, static_argnums=2).lower(matrix, rhs, mixed).compile()
                calls[work, mixed] = lambda run=program, given=(matrix, rhs): jax.block_until_ready(run(*given))
                calls[work, mixed]()
        times = interleaved(calls, repeats, seconds=1.0)
        for work in works:
            row: dict = {"unknowns": unknowns, "work": work}
            for mixed, name in ((False, "double"), (True, "mixed")):
                taken = times[work, mixed].wall
                row[f"{name}_us"] = statistics.median(taken) / LOOPS * 1e6
                row[f"{name}_fastest_us"] = min(taken) / LOOPS * 1e6
            yield row


def measure_mixed(repeats: int) -> Iterator[dict]:
    import equinox as eqx
    import jax
    import numpy as np

    import lgsens as lg

    for (scene, solver), (model, body, num_steps) in scenes().items():

        def psi(system, num_steps=num_steps, body=body):
            trajectory = lg.simulate(system, t1=num_steps * 1e-3, num_steps=num_steps, throw=False)
            motion = trajectory.body(body)
            return lg.time_integral(trajectory.t, motion.position[:, 2] + motion.velocity[:, 2] ** 2)

        works = {"simulate": psi, "gradient": eqx.filter_value_and_grad(psi)}
        calls, records = {}, {}
        for work, function in works.items():
            for mixed in (False, True):
                system = dataclasses.replace(model.system(), linear_solver=solver(mixed=mixed))
                started = time.perf_counter()
                program = eqx.filter_jit(function).lower(system).compile()
                compiled = time.perf_counter() - started
                memory = program.compiled.memory_analysis().temp_size_in_bytes / 1e6
                run = lambda program=program, system=system: jax.block_until_ready(program(system))
                numbers = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(run())])
                calls[work, mixed], records[work, mixed] = run, (numbers, compiled, memory)
        times = interleaved(calls, repeats, seconds=4.0)
        for work in works:
            row = {"scene": scene, "solver": solver.__name__, "work": work, "num_steps": num_steps}
            for mixed, name in ((False, "double"), (True, "mixed")):
                _, row[f"{name}_compile_s"], row[f"{name}_temporary_mb"] = records[work, mixed]
                for kind in ("wall", "cpu"):
                    median = statistics.median(getattr(times[work, mixed], kind))
                    row[f"{name}_{kind}_us_per_step"] = median / num_steps * 1e6
            double, mixed = (records[work, own][0] for own in (False, True))
            row["difference"] = float(np.abs(mixed - double).max() / np.abs(double).max())
            yield row
        jax.clear_caches()


def measure_single() -> Iterator[dict]:
    import jax
    import jax.numpy as jnp
    from references import compare

    from lgsens.examples import PROBLEMS as KNOWN

    for scene, name in PROBLEMS.items():
        problem, counts, found = KNOWN[name], [round(KNOWN[name].t1 * n) for n in STEPS], []
        with jax.enable_x64(False), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that says what this measures
            for n in counts:
                run = jax.jit(lambda p, n=n, problem=problem: problem.differentiate(p, num_steps=n, throw=False))
                parameters = {key: jnp.asarray(value, jnp.float32) for key, value in problem.parameters.items()}
                found.append(jax.device_get(run(parameters)))
        steps = [problem.t1 / n for n in counts]
        for criterion, record in compare(problem, found)["criteria"].items():
            for what in ("value", "gradient"):
                errors = record[what]["errors"]
                row = {"scene": scene, "criterion": criterion, "what": what, "step": steps}
                yield row | {"error": errors}


def fit(steps: list[float], errors: list[float]) -> dict:
    """C, ε and p of C h² + ε/h^p, by least squares of logarithms; the optimal step and the least error."""
    import numpy as np
    from scipy.optimize import least_squares

    h, e = np.array(steps), np.array(errors)
    falling = (e[:-1] > 2 * e[1:]) & (e[:-1] < 32 * e[1:])  # before, the steps are too coarse for h²
    h, e = h[np.argmax(falling) :], e[np.argmax(falling) :]
    model = lambda z: np.exp(z[0]) * h**2 + np.exp(z[1]) / h ** z[2]
    start = [np.log(e[0] / h[0] ** 2), np.log(e[-1] * h[-1]), 1.0]
    limits = ([-np.inf, -np.inf, 0.1], [np.inf, np.inf, 6.0])
    z = least_squares(lambda z: np.log(model(z) / e), start, bounds=limits, loss="soft_l1").x
    c, eps, p = np.exp(z[0]), np.exp(z[1]), z[2]
    optimum = (p * eps / (2 * c)) ** (1 / (p + 2))
    least = c * optimum**2 + eps / optimum**p
    return {"C": float(c), "epsilon": float(eps), "p": float(p), "optimum": float(optimum), "least": float(least)}


def measure(part: str, repeats: int) -> Iterator[dict]:
    if part == "kernels":
        return measure_kernels(repeats)
    return measure_mixed(repeats) if part == "mixed" else measure_single()


def plot(rows: list[dict], path: Path) -> None:
    from lgsens.plotting import ErrorPanel, errors, save

    def panel(scene: str) -> ErrorPanel:
        own = [row for row in rows if row["scene"] == scene]
        series = {f"{row['criterion']}, {row['what']}": (row["step"], row["error"]) for row in own}
        return ErrorPanel(scene, "relative error [–]", series)

    save(errors([panel(name) for name in dict.fromkeys(row["scene"] for row in rows)], "Single precision"), path)


def table(document: dict) -> str:
    lines = []
    if "kernels" in document:
        part = document["kernels"]
        lines += [
            f"{circumstances(part['environment'])} The fastest of many rounds, medians in brackets.",
            "",
            "| unknowns | work | double [µs] | mixed [µs] | mixed / double |",
            "|---|---|---|---|---|",
        ]
        for row in part["rows"]:
            cells = [f"{row[f'{name}_fastest_us']:.2f} ({row[f'{name}_us']:.2f})" for name in ("double", "mixed")]
            ratios = [row[f"mixed{kind}_us"] / row[f"double{kind}_us"] for kind in ("_fastest", "")]
            lines.append(
                f"| {row['unknowns']} | {row['work']} | {' | '.join(cells)} | {ratios[0]:.2f} ({ratios[1]:.2f}) |"
            )
        lines.append("")
    if "mixed" in document:
        part = document["mixed"]
        lines += [
            f"{circumstances(part['environment'])} Processor time in brackets.",
            "",
            "| scene | solver | work | double [µs/step] | mixed [µs/step] | mixed / double | temporary memory [MB] "
            "| difference |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for row in part["rows"]:
            time_of = lambda name, kind, row=row: row[f"{name}_{kind}_us_per_step"]
            cells = [f"{time_of(name, 'wall'):.1f} ({time_of(name, 'cpu'):.1f})" for name in ("double", "mixed")]
            ratios = [time_of("mixed", kind) / time_of("double", kind) for kind in ("wall", "cpu")]
            lines.append(
                f"| {row['scene']} | `{row['solver']}` | {row['work']} | {' | '.join(cells)} "
                f"| {ratios[0]:.2f} ({ratios[1]:.2f}) "
                f"| {row['double_temporary_mb']:.2f} → {row['mixed_temporary_mb']:.2f} | {row['difference']:.0e} |"
            )
    if "single" in document:
        lines += [
            "",
            "| scene | criterion | error of | C [1/s²] | ε | p | optimal h [ms] | error there |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for row in document["single"]["rows"]:
            lines.append(
                f"| {row['scene']} | {row['criterion']} | {row['what']} | {row['C']:.2g} | {row['epsilon']:.1e} "
                f"| {row['p']:.1f} | {1e3 * row['optimum']:.1f} | {row['least']:.0e} |"
            )
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--cache", help="folder for compiled programs (default: none)")
    arguments = parser.parse_args()
    path = arguments.out / "precision.json"
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    import jax

    jax.config.update("jax_enable_x64", True)
    if arguments.cache:
        jax.config.update("jax_compilation_cache_dir", arguments.cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    for part in arguments.parts:
        document[part] = {"environment": environment(SINGLE_THREAD), "rows": []}
        for row in measure(part, arguments.repeats):
            print(row, flush=True)
            document[part]["rows"].append(row)
            write(path, document)
    if "single" in document:
        for row in document["single"]["rows"]:
            row |= fit(row["step"], row["error"])
        write(path, document)
        plot(document["single"]["rows"], arguments.out / "precision.png")
    print(table(document))


if __name__ == "__main__":
    main()
