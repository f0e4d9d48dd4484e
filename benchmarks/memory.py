"""What a gradient in reverse mode keeps over a long run of the top, with and without checkpoints.

    python benchmarks/memory.py [--steps 1000 10000 100000] [--out benchmarks/results]

The gradient of the mean of x² with respect to the initial angle, h = 1 ms, through `simulate(…, save=…)`. Memory is
what the compiled program says of its temporaries; times are medians of `--repeats` calls after one that compiles, the
programs of a length in turns, in simulations of the same length. Writes memory.json and prints a table.
"""

import json
import os
import statistics

from benchmark import SINGLE_THREAD, circumstances, environment, interleaved, options, write


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
    calls = {name: lambda run=run: jax.block_until_ready(run(0.7)) for name, run in programs.items()}
    medians = {name: statistics.median(times.wall) for name, times in interleaved(calls, repeats).items()}
    for name, program in programs.items():
        memory = program.memory_analysis().temp_size_in_bytes / 1e6
        ratio = medians[name] / medians["simulate"]
        rows.append({"steps": steps, "program": name, "ms": medians[name] * 1e3, "simulations": ratio, "mb": memory})
    return rows


def table(document: dict) -> str:
    lines = [
        circumstances(document["environment"]),
        "",
        "| steps | program | ms | in simulations | temporary memory [MB] |",
        "|---|---|---|---|---|",
    ]
    for row in document["rows"]:
        lines.append(
            f"| {row['steps']} | `{row['program']}` | {row['ms']:.1f} | {row['simulations']:.2f} | {row['mb']:.2f} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--steps", nargs="+", type=int, default=[1_000, 10_000, 100_000])
    arguments = parser.parse_args()
    path = arguments.out / "memory.json"
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    import jax

    jax.config.update("jax_enable_x64", True)
    found = environment(SINGLE_THREAD)
    rows = [row for steps in arguments.steps for row in measure(steps, arguments.repeats)]
    write(path, {"environment": found, "rows": rows})
    print(table(json.loads(path.read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
