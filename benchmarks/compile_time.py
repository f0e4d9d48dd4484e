"""Compile time of `simulate` and of a gradient, with and without JAX's persistent compilation cache.

    python benchmarks/compile_time.py [--out benchmarks/results] [--scenes top four_bar …]
    python benchmarks/compile_time.py --table     # the table again, from compile_time.json; measures nothing

Each program is traced and compiled in a process of its own, as a session meets it: first with an empty cache, which it
fills, then again with what the first has left. The gradient is that of Ψ, the integral of the square of an
acceleration, by all numbers of the model. Processor time stands beside wall time: other load on the machine changes it
least. "trace" is what no cache saves: Python that makes the program. With jaxlib 0.10 a third process
compiles without the options that lgsens gives XLA (`lgsens._xla`), as JAX comes. The last one compiles for few calls,
without most of XLA's optimizations (`jax_disable_most_optimizations`). "runs" is the median of 20 runs of 100 steps.

"anew" is the processor time of a second call in one process, outside of `jit`, with one thing changed, relative to the
first: another criterion, number of steps, tolerance or ρ∞, for `jax.value_and_grad` and for `differentiate`. Writes
compile_time.json.
"""

import importlib.metadata
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmark import AS_JAX_COMES, SINGLE_THREAD, circumstances, environment, interleaved, options, write

SCENES = ("top", "four_bar", "quarter_car", "chain_2", "chain_8", "chain_32")
PROGRAMS = ("simulate", "value_and_grad")
ANEW = ("top", "quarter_car")
STEPS = 100  # a scan: compile time does not depend on it


def model_of(scene: str):
    """The model of a scene."""
    from lgsens.examples import QuarterCar, four_bar, spatial_chain, spinning_top

    if scene == "top":
        return spinning_top(0.7)
    if scene == "four_bar":
        return four_bar()
    if scene == "quarter_car":
        return QuarterCar.load().model()
    if scene == "reduced_car":
        return QuarterCar.load().model(wheel="locked", chassis="heave", links="rods")
    return spatial_chain(int(scene.removeprefix("chain_")))


def compile_once(scene: str, program: str) -> dict:
    """Seconds to trace and to compile, in this process."""
    import jax
    import jax.numpy as jnp

    import lgsens as lg

    jax.config.update("jax_enable_x64", True)
    model = model_of(scene)
    observed = sorted(model.bodies)[0]

    def simulate(model):
        return lg.simulate(model, t1=0.1, num_steps=STEPS, throw=False).states

    def psi(model):
        trajectory = lg.simulate(model, t1=0.1, num_steps=STEPS, throw=False)
        return lg.time_integral(trajectory.t, jnp.sum(trajectory.body(observed).acceleration ** 2, axis=1))

    function = simulate if program == "simulate" else jax.value_and_grad(psi)
    begin, cpu_begin = time.perf_counter(), time.process_time()
    lowered = jax.jit(function).lower(model)
    traced = time.perf_counter()
    compiled = lowered.compile()
    found = {
        "trace_seconds": traced - begin,
        "seconds": time.perf_counter() - begin,
        "cpu_seconds": time.process_time() - cpu_begin,
    }
    jax.block_until_ready(compiled(model))
    times = interleaved({program: lambda: jax.block_until_ready(compiled(model))}, 20)[program]
    return found | {"run_seconds": statistics.median(times.cpu), "run_wall_seconds": statistics.median(times.wall)}


OTHERS = {"for_few_calls": "for few calls", "as_jax_comes": "as JAX comes"}
CALLS = ("value_and_grad", "differentiate")
CHANGES = {
    "criterion": {"criterion": "velocity"},
    "num_steps": {"num_steps": 3 * STEPS // 2},
    "tolerance": {"tolerance": 1e-7},
    "rho_inf": {"rho_inf": 0.6},
}


def compile_anew(scene: str, program: str) -> dict:
    """Seconds of processor of value and gradient for the first time, and again with one thing changed."""
    import jax
    import jax.numpy as jnp

    import lgsens as lg

    jax.config.update("jax_enable_x64", True)
    model = model_of(scene)
    observed = sorted(model.bodies)[0]
    criteria = {
        name: lg.Criterion(integrand=lambda s, p, name=name: jnp.sum(getattr(s.body(observed), name) ** 2))
        for name in ("acceleration", "velocity")
    }

    def call(criterion="acceleration", num_steps=STEPS, **numbers):
        integrator = lg.GeneralizedAlpha(**numbers)
        settings = {"t1": 0.1, "num_steps": num_steps, "integrator": integrator}
        begin = time.process_time()
        if program == "differentiate":
            method = lg.AdjointVariable()
            found = lg.differentiate(criteria[criterion], itself, model, method=method, **settings)[:2]
        else:
            found = jax.value_and_grad(lambda model: criteria[criterion](lg.simulate(model, **settings)))(model)
        jax.block_until_ready(found)
        return time.process_time() - begin

    first = call()
    return {"first": first, "anew": {name: call(**change) / first for name, change in CHANGES.items()}}


def itself(model):
    """The scene of `differentiate`: the same function in each call."""
    return model


def measure(scene: str) -> dict:
    """The programs of a scene, each in two processes that share a cache, in one as JAX comes, in one for few calls."""
    found = {}
    for program in PROGRAMS:

        def run(settings: dict[str, str], program=program) -> str:
            command = [sys.executable, __file__, "--one", scene, program]
            own = os.environ | SINGLE_THREAD | settings
            return subprocess.run(command, env=own, check=True, capture_output=True, text=True).stdout

        with tempfile.TemporaryDirectory() as cache:
            settings = {
                "JAX_COMPILATION_CACHE_DIR": cache,
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
                "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
            }
            runs = [run(settings) for _ in range(2)]
            size = sum(path.stat().st_size for path in Path(cache).rglob("*") if path.is_file())
        runs.append(run({"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}))
        if importlib.metadata.version("jaxlib").startswith("0.10."):
            runs.append(run({"XLA_FLAGS": f"{SINGLE_THREAD['XLA_FLAGS']} {AS_JAX_COMES}"}))
        first, again, *other = (json.loads(text.splitlines()[-1]) for text in runs)
        found[program] = {"first": first, "again": again, "cache_bytes": size}
        found[program] |= dict(zip(OTHERS, other))
        print(f"{scene}, {program}: {first['seconds']:.1f} s, again {again['seconds']:.1f} s", flush=True)
    return found


def measure_anew(scene: str) -> dict:
    """What changes cost in one process, for each way to call."""
    found = {}
    for program in CALLS:
        command = [sys.executable, __file__, "--anew", scene, program]
        text = subprocess.run(
            command, env=os.environ | SINGLE_THREAD, check=True, capture_output=True, text=True
        ).stdout
        found[program] = json.loads(text.splitlines()[-1])
        ratios = ", ".join(f"{name} {ratio:.3f}" for name, ratio in found[program]["anew"].items())
        print(f"{scene}, {program}: {found[program]['first']:.1f} s; anew {ratios}", flush=True)
    return found


def markdown(document: dict) -> str:
    head = ("scene", "program", "compile [s] (CPU)", "of it trace [s]", "cached [s] (CPU)", "ratio", "cache [MB]")
    head = (*head, "runs [ms]", *(text for kind in OTHERS.values() for text in (f"{kind} [s] (CPU)", "runs [ms]")))
    lines = [circumstances(document["environment"]), "", f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for scene, programs in document["scenes"].items():
        for program, found in programs.items():
            first, again = found["first"], found["again"]
            cells = (
                scene,
                program,
                *(f"{run['seconds']:.1f} ({run['cpu_seconds']:.1f})" for run in (first,)),
                f"{first['trace_seconds']:.1f}",
                f"{again['seconds']:.1f} ({again['cpu_seconds']:.1f})",
                f"{first['seconds'] / again['seconds']:.1f}",
                f"{found['cache_bytes'] / 1e6:.1f}",
                f"{1e3 * first['run_seconds']:.2f}",
            )
            for other in map(found.get, OTHERS):
                took = f"{other['seconds']:.1f} ({other['cpu_seconds']:.1f})" if other else "–"
                cells = (*cells, took, f"{1e3 * other['run_seconds']:.2f}" if other else "–")
            lines.append("| " + " | ".join(cells) + " |")
    lines += [
        "",
        f"| scene | outside of `jit` | first [s of CPU] | {' | '.join(CHANGES)} |",
        "|---" * (3 + len(CHANGES)) + "|",
    ]
    for scene, programs in document.get("anew", {}).items():
        for program, found in programs.items():
            ratios = " | ".join(f"{found['anew'][name]:.3f}" for name in CHANGES)
            lines.append(f"| {scene} | {program} | {found['first']:.1f} | {ratios} |")
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, repeats=False)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--table", action="store_true", help="print the table of compile_time.json, measure nothing")
    parser.add_argument("--anew", nargs="*", metavar="SCENE", help="second calls only; with a program: in this process")
    parser.add_argument("--one", nargs=2, metavar=("SCENE", "PROGRAM"), help="one program in this process, as JSON")
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(compile_once(*arguments.one)))
        return
    if arguments.anew and arguments.anew[-1] in CALLS:
        print(json.dumps(compile_anew(*arguments.anew)))
        return
    path = arguments.out / "compile_time.json"
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"scenes": {}}
    if not arguments.table:
        for scene in arguments.anew if arguments.anew is not None else ANEW:
            document["anew"] = document.get("anew", {}) | {scene: measure_anew(scene)}
            write(path, document)
    if not (arguments.table or arguments.anew is not None):
        for scene in arguments.scenes:
            document["scenes"][scene] = measure(scene)
            document["environment"] = environment(SINGLE_THREAD)
            write(path, document)
    print(markdown(document))


if __name__ == "__main__":
    main()
