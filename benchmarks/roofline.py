"""What a step of a batch could cost at least: arithmetic and memory traffic of the quarter-car against the processor.

    python benchmarks/roofline.py [--out benchmarks/results]

One design's program, value and gradient, is run operation by operation, and what each one computes and touches is
added up: floating-point operations (a factorization by its formula, everything else by its outputs), and the bytes of
operands and results as if nothing were fused. Start and end cancel in the difference of two numbers of steps. Beside
them, on one core: the fastest arithmetic that XLA reaches, of a product of large matrices and of elementwise operations
that stay in the first cache, copies within the caches, and the time of a step in a batch. Writes roofline.json and
prints a table. Reads programs as JAX 0.10 writes them.
"""

import math
import os
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from benchmark import WHOLE_LOOPS, environment, options, write
from sweep import quarter_car

from lgsens.linear import many_runs
from lgsens.simulation import failures_by_callback
from lgsens.sweeps._one_by_one import bound, evaluated

LANES, STEPS = 26, 100  # those of `sweep`
COUNTED = (20, 60)  # steps of the runs that are counted
# Those that only move numbers.
_FREE = frozenset(
    (
        *("broadcast_in_dim", "concatenate", "convert_element_type", "copy", "dynamic_slice", "dynamic_update_slice"),
        *("expand_dims", "gather", "iota", "pad", "reshape", "rev", "select_n", "slice", "split", "squeeze"),
        *("stop_gradient", "transpose"),
    )
)


KINDS: dict[str, Callable] = {"value": quarter_car, "value and gradient": jax.value_and_grad(quarter_car)}


class Tally:
    """Floating-point operations and bytes of a program that is run."""

    def __init__(self):
        self.flops, self.bytes = 0.0, 0.0

    def run(self, program: Any, operands) -> list[Any]:
        return evaluated(program, operands, self._found)

    def _found(self, equation, operands) -> list[Any]:
        name, params = equation.primitive.name, equation.params
        if name == "scan":
            return self._scan(params, operands)
        if name == "while":
            first, last = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
            carry = operands[last:]
            while self.run(params["cond_jaxpr"], [*operands[:first], *carry])[0]:
                carry = self.run(params["body_jaxpr"], [*operands[first:last], *carry])
            return carry
        if name == "cond":
            return self.run(params["branches"][int(operands[0])], operands[1:])
        found = bound(equation.primitive, params, operands)
        self._add(equation, operands, found)
        return found

    def _scan(self, params, operands) -> list[Any]:
        first, last = params["num_consts"], params["num_consts"] + params["num_carry"]
        consts, carry, inputs = operands[:first], operands[first:last], operands[last:]
        rows: list[Any] = [None] * params["length"]
        order = range(params["length"])
        for i in reversed(order) if params["reverse"] else order:
            found = self.run(params["jaxpr"], [*consts, *carry, *(leaf[i] for leaf in inputs)])
            carry, rows[i] = found[: params["num_carry"]], found[params["num_carry"] :]
        return [*carry, *(jnp.stack(leaves) for leaves in zip(*rows))]

    def _add(self, equation, operands, found) -> None:
        name = equation.primitive.name
        if not jnp.issubdtype(found[0].dtype, jnp.floating):
            return
        self.bytes += sum(np.asarray(leaf).nbytes for leaf in (*operands, *found))
        if name == "dot_general":
            (summed, _), _ = equation.params["dimension_numbers"]
            terms = math.prod(operands[0].shape[axis] for axis in summed)
            self.flops += 2 * terms * found[0].size
        elif name == "lu":
            *many, rows, _ = operands[0].shape
            self.flops += math.prod(many) * 2 * rows**3 / 3
        elif name == "triangular_solve":
            self.flops += operands[0].shape[-1] * operands[1].size
        elif name.startswith(("reduce", "cum", "scatter")):
            self.flops += operands[-1 if name.startswith("scatter") else 0].size
        elif name not in _FREE:
            self.flops += found[0].size


def work(kind: Callable) -> dict[str, float]:
    """Per step of one design."""
    tallies = []
    for steps in COUNTED:
        with failures_by_callback(False), many_runs():
            program = jax.make_jaxpr(lambda damping, steps=steps: jax.tree.leaves(kind(damping, steps)))(4000.0)
        tallies.append(Tally())
        tallies[-1].run(program, [jnp.asarray(4000.0)])
    fewer, more = tallies
    count = COUNTED[1] - COUNTED[0]
    return {"flops": (more.flops - fewer.flops) / count, "bytes": (more.bytes - fewer.bytes) / count}


def median_time(call: Callable[[], Any], repeats: int) -> float:
    jax.block_until_ready(call())
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(call())
        seconds.append(time.perf_counter() - started)
    return statistics.median(seconds)


def processor(repeats: int) -> dict[str, float]:
    """What XLA reaches on one core: flops/s of products and of elementwise operations, bytes/s within the caches."""
    n, terms, turns = 512, 32, 2000
    a = jnp.ones((n, n)) / n
    product = jax.jit(lambda a: a @ a)
    x = jnp.linspace(0.0, 1.0, 1024)

    @jax.jit
    def polynomial(x):
        def turn(_, y):
            for _ in range(terms):
                y = y * x + x
            return y

        return jax.lax.fori_loop(0, turns, turn, x)

    long = jnp.ones(32 * 1024)  # 256 kB, read and written

    @jax.jit
    def moved(x):
        return jax.lax.fori_loop(0, turns, lambda _, y: y * 0.5 + 1.0, x)

    return {
        "product_flops": 2 * n**3 / median_time(lambda: product(a), repeats),
        "elementwise_flops": 2 * terms * turns * x.size / median_time(lambda: polynomial(x), repeats),
        "cache_bytes": 2 * turns * long.nbytes / median_time(lambda: moved(long), repeats),
    }


def measured(kind: Callable, repeats: int) -> float:
    """Seconds per step and design of a batch on one core."""
    with failures_by_callback(False), many_runs():
        batch = jax.jit(jax.vmap(lambda damping: kind(damping, STEPS)))
        designs = jnp.linspace(2000.0, 8000.0, LANES)
        program = batch.lower(designs).compile()
    return median_time(lambda: program(designs), repeats) / LANES / STEPS


def table(found: dict) -> str:
    peak = found["processor"]
    heads = ("a step of a design", "kflop", "as large products [µs]", "elementwise [µs]", "kB, nothing fused")
    heads = (*heads, "through the caches [µs]", "measured [µs]", "Gflop/s")
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for kind, row in found["work"].items():
        cells = [
            1e-3 * row["flops"],
            1e6 * row["flops"] / peak["product_flops"],
            1e6 * row["flops"] / peak["elementwise_flops"],
            1e-3 * row["bytes"],
            1e6 * row["bytes"] / peak["cache_bytes"],
            1e6 * row["seconds"],
            1e-9 * row["flops"] / row["seconds"],
        ]
        lines.append(f"| {kind} | " + " | ".join(f"{cell:.3g}" for cell in cells) + " |")
    speeds = ", ".join(f"{name.replace('_', ' ')} {1e-9 * value:.3g} G/s" for name, value in peak.items())
    return "\n".join([*lines, "", f"One core: {speeds}."])


def main() -> None:
    arguments = options(__doc__).parse_args()
    os.environ.update(WHOLE_LOOPS)  # before the first computation
    jax.config.update("jax_enable_x64", True)
    found = {"environment": environment(WHOLE_LOOPS), "lanes": LANES, "processor": processor(arguments.repeats)}
    found["work"] = {name: work(kind) | {"seconds": measured(kind, arguments.repeats)} for name, kind in KINDS.items()}
    write(arguments.out / "roofline.json", found)
    print(table(found))


if __name__ == "__main__":
    main()
