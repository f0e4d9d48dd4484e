"""What a gradient in reverse mode keeps over a long run of the top, with and without checkpoints.

    python benchmarks/memory.py [--steps 1000 10000 100000] [--out benchmarks/results]

The gradient of the mean of x² with respect to the initial angle, h = 1 ms, through `simulate(…, save=…)`. Memory is
what the compiled program says of its temporaries; times are medians of `--repeats` calls after one that compiles, the
programs of a length in turns, in simulations of the same length. Writes memory.json and prints a table.
"""

import argparse
import json
import os
import platform
import statistics
import time
from pathlib import Path


def measure(steps: int, repeats: int) -> list[dict]:
    import jax
    import jax.numpy as jnp

    import lgsens as lg
    from lgsens.examples import spinning_top

    side = lambda s: s.body("top").position[0] ** 2

    def mean(angle, sensitivity):
        saved = lg.simulate(
            spinning_top(angle), t1=steps * 1e-3, num_steps=steps, save=side, sensitivity=sensitivity, throw=False
        )
        return jnp.sum(saved.values) / steps

    methods = {
        "simulate": None,
        "DirectDifferentiation()": lg.DirectDifferentiation(),
        'DirectDifferentiation(checkpoints="sqrt")': lg.DirectDifferentiation(checkpoints="sqrt"),
        "AdjointVariable()": lg.AdjointVariable(),
        'AdjointVariable(checkpoints="sqrt")': lg.AdjointVariable(checkpoints="sqrt"),
    }
    programs, rows = {}, []
    for name, method in methods.items():
        function = lambda angle, method=method: mean(angle, method or lg.DirectDifferentiation())
        programs[name] = jax.jit(function if method is None else jax.grad(function)).lower(0.7).compile()
        jax.block_until_ready(programs[name](0.7))
    taken: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(repeats):
        for name, program in programs.items():
            started = time.perf_counter()
            jax.block_until_ready(program(0.7))
            taken[name].append(time.perf_counter() - started)
    medians = {name: statistics.median(times) for name, times in taken.items()}
    for name, program in programs.items():
        memory = program.memory_analysis().temp_size_in_bytes / 1e6
        ratio = medians[name] / medians["simulate"]
        rows.append({"steps": steps, "program": name, "ms": medians[name] * 1e3, "simulations": ratio, "mb": memory})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    parser.add_argument("--steps", nargs="+", type=int, default=[1_000, 10_000, 100_000])
    parser.add_argument("--repeats", type=int, default=5, help="timed calls, at least 5 (default: %(default)s)")
    arguments = parser.parse_args()
    if arguments.repeats < 5:
        parser.error("--repeats must be at least 5")
    import jax

    jax.config.update("jax_enable_x64", True)
    load = os.getloadavg()[0]
    rows = [row for steps in arguments.steps for row in measure(steps, arguments.repeats)]
    print("| steps | program | ms | in simulations | temporary memory [MB] |\n|---|---|---|---|---|")
    for row in rows:
        print(f"| {row['steps']} | `{row['program']}` | {row['ms']:.1f} | {row['simulations']:.2f} | {row['mb']:.2f} |")
    machine = {"python": platform.python_version(), "jax": jax.__version__, "cores": os.cpu_count(), "load": load}
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"machine": machine, "rows": rows}, indent=1)
    (arguments.out / "memory.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
