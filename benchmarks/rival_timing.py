"""Programs to be timed, and how: compiled or built first, warmed up, then interleaved, round by round."""

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np


@dataclasses.dataclass
class Program:
    """One program of one rival on one scene.

    `call` runs it and returns Ψ and the gradient (None: it has none), complete; Ψ may be NaN where only the gradient is
    computed. `basis`: "equal step" or "equal accuracy". `details`: what else the table should say.
    """

    rival: str
    program: str
    kind: str  # "forward" or "gradient, …"; programs of one kind do the same work
    num_steps: int
    basis: str
    call: Callable[[], tuple[Any, Any]]
    build_seconds: float | None = None
    temporary_bytes: int | None = None
    details: dict[str, Any] = dataclasses.field(default_factory=dict)


def compiled(
    function: Callable[..., Any],
    arguments: Sequence[Any],
    *,
    select: Callable[[Any], Any] = lambda gradient: gradient,
    first: bool = False,
    **members: Any,
) -> Program:
    """A program of a JAX function that returns Ψ, or Ψ and a gradient of which `select` takes what is compared.

    `first`: the function returns a batch, of which the first is compared.
    """
    import jax

    started = time.perf_counter()
    executable = jax.jit(lambda *given: function(*given)).lower(*arguments).compile()
    build = time.perf_counter() - started
    memory = executable.memory_analysis()

    def call():
        found = jax.block_until_ready(executable(*arguments))
        return found if isinstance(found, tuple) else (found, None)

    def shown(found):
        value, gradient = (leaf[0] for leaf in found) if first else found
        return float(value), None if gradient is None else np.ravel(np.asarray(select(gradient)))

    program = Program(call=call, build_seconds=build, temporary_bytes=int(memory.temp_size_in_bytes), **members)
    program.details["shown"] = shown
    return program


def measure(programs: Sequence[Program], repeats: int) -> list[dict[str, Any]]:
    """Medians of `repeats` rounds, in each of which every program runs once, after a warm-up of each.

    Wall time, and the processor time of the process, which other load on the machine changes less.
    """
    shown, taken, busy = [], [[] for _ in programs], [[] for _ in programs]
    for program in programs:
        show = program.details.pop("shown", lambda found: found)
        shown.append(show(program.call()))
    for _ in range(repeats):
        for program, times, cpu_times in zip(programs, taken, busy):
            started, cpu_started = time.perf_counter(), time.process_time()
            program.call()
            times.append(time.perf_counter() - started)
            cpu_times.append(time.process_time() - cpu_started)
    records = []
    for program, times, cpu_times, (value, gradient) in zip(programs, taken, busy, shown):
        seconds = statistics.median(times)
        records.append(
            {
                "rival": program.rival,
                "program": program.program,
                "kind": program.kind,
                "num_steps": program.num_steps,
                "basis": program.basis,
                "seconds": seconds,
                "fastest_seconds": min(times),
                "cpu_seconds": statistics.median(cpu_times),
                "microseconds_per_step": 1e6 * seconds / program.num_steps,
                "build_seconds": program.build_seconds,
                "temporary_bytes": program.temporary_bytes,
                "value": None if value is None or np.isnan(value) else float(value),
                "gradient": None if gradient is None else np.asarray(gradient, float).tolist(),
                **program.details,
            }
        )
    return records
