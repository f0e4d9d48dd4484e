"""Programs to be timed, and how: compiled or built first, warmed up, then interleaved, round by round."""

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from benchmark import interleaved


@dataclasses.dataclass
class Program:
    """One program of one rival on one scene.

    `call` runs it to the end; `show` makes Ψ and the gradient of what it returns (None: it has none; Ψ may be NaN where
    only the gradient is computed). `prepare` compiles it first, if that is not done. `basis`: "equal step" or "equal
    accuracy". `details`: what else the JSON should say.
    """

    rival: str
    program: str
    kind: str  # "forward" or "gradient, …"; programs of one kind do the same work
    num_steps: int
    basis: str
    call: Callable[[], Any] | None = None
    show: Callable[[Any], tuple[Any, Any]] = lambda found: found
    prepare: Callable[["Program"], None] | None = None
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

    def prepare(program: Program) -> None:
        started = time.perf_counter()
        executable = jax.jit(lambda *given: function(*given)).lower(*arguments).compile()
        program.build_seconds = time.perf_counter() - started
        program.temporary_bytes = int(executable.memory_analysis().temp_size_in_bytes)
        program.call = lambda: jax.block_until_ready(executable(*arguments))

    def show(found):
        if not isinstance(found, tuple):
            return float(found), None
        value, gradient = (leaf[0] for leaf in found) if first else found
        return float(value), np.ravel(np.asarray(select(gradient)))

    return Program(prepare=prepare, show=show, **members)


def measure(programs: Sequence[Program], repeats: int) -> list[dict[str, Any]]:
    """Medians of `repeats` rounds, in each of which every program runs once, after a warm-up of each.

    Wall time, and the processor time of the process, which other load on the machine changes less.
    """
    shown = [program.show(program.call()) for program in programs]
    taken = interleaved({index: program.call for index, program in enumerate(programs)}, repeats)
    records = []
    for program, (times, cpu_times), (value, gradient) in zip(programs, taken.values(), shown):
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
