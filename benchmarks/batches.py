"""Batches of designs of the quarter-car on two cores: lgsens beside CasADi's generated C and Exudyn in two processes.

    python benchmarks/batches.py [--designs 60] [--repeats 5] [--cores 2] [--out benchmarks/results]

The designs are `rivals.py`'s quarter-car, p its 32 numbers, with dampers of 2000 … 8000 N s/m; Ψ = ∫ z̈² dt of the
chassis over 1 s. Everyone is given p and returns Ψ, or Ψ and dΨ/dp, of every design, by the programs of `rivals.py`:

- lgsens: batches as `lg.sweep` makes them, on a device of JAX for each core. "equal step": 1000 steps. "equal
  accuracy": extrapolated from the fewest steps (a multiple of 20) that are as accurate over these dampers.
- CasADi: RK4 of the index-reduced equations and its adjoint in generated C, `Function.map` over threads. y₀ and θ are
  made of p, and dΨ/dp of dΨ/dy₀ and dΨ/dθ, by batches of JAX on the same cores. Of what runs on two cores: "thread" of
  an external does; "openmp" does not, the wheels being compiled without it: CasADi warns and goes on in one thread.
- Exudyn: a process for each core, which take designs from one list, build and solve them; its fastest program of
  rivals.json, 1000 steps. It has no derivatives.

Programs take turns, `--repeats` rounds after a warm-up; medians of wall time. Not in it, and said apart: compilation,
and the start of processes (with their imports, JAX among them). In it, and said too: what the model takes, from p to a
program's numbers or mechanism, and from its gradient back to p. lgsens takes at most 60 gradients at once on two cores,
as `lg.sweep` does.

Errors are the largest over the designs, against CasADi's C at 500 steps, of order four, which itself is compared with
the reference of rivals.json at the shipped damper. The run fails if an error is larger than `BOUND`. Needs
benchmarks/requirements.txt and gcc. Writes batches.json and prints a table.
"""

import json
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import rival_casadi
import rival_exudyn
import rival_lgsens
from benchmark import WHOLE_LOOPS, circumstances, environment, grid, interleaved, options, write
from rival_run import difference
from rival_scenes import SCENES, Scene

from lgsens.sweeps._batches import compile_batch, trace

SCENE = "quarter_car"
DAMPERS = (2000.0, 8000.0)
EXTRAPOLATED = 80  # steps, and twice as many
FINE = 500  # steps of the reference
VALUE, GRADIENT = "value", "value and gradient"
STEP, ACCURACY = "equal step", "equal accuracy"
# Errors are 2e-5 … 3e-5 in Ψ, and this is three times as much. A damper of 1 % more moves Ψ by 9e-4 at 2000 N s/m and
# by 1e-2 at 8000: whoever stays below computes these designs. Errors of gradients are relative to the largest effect of
# a relative change of a number, and as large.
BOUND = 1e-4


class Run(NamedTuple):
    """What a call found: Ψ (n,), dΨ/dp (n, p) or None, and the seconds that the models took."""

    values: np.ndarray
    gradients: np.ndarray | None = None
    model_seconds: float | None = None


class Program(NamedTuple):
    """A program for all designs. `details`: what else the JSON should say."""

    rival: str
    program: str
    kind: str
    basis: str
    num_steps: int
    call: Callable[[], Run]
    details: dict[str, Any]
    build_seconds: float | None = None


def spread(function: Callable[..., Any], designs: Any) -> tuple[Callable[[Any], Any], int, float]:
    """A function of one design for all of them, as `lg.sweep` has it; the size of its batches; seconds to compile."""
    traced = trace(function, designs)
    count = len(jax.tree.leaves(designs)[0])
    program = compile_batch(traced, designs, count, None, jax.devices())
    filled = np.minimum(np.arange(-(-count // program.size) * program.size), count - 1).reshape(-1, program.size)

    def call(designs):
        found = []
        for rows in filled:
            values, ok = program.run([np.asarray(leaf)[rows] for leaf in jax.tree.leaves(designs)])
            assert ok.all()
            found.append(values)
        leaves = [np.concatenate(parts)[:count] for parts in zip(*found)]
        return jax.tree.unflatten(jax.tree.structure(traced.shapes), leaves)

    return call, program.size, traced.seconds + program.seconds


def lgsens_programs(scene: Scene, designs: np.ndarray) -> list[Program]:
    """Ψ and its gradient in steps of 1 ms, and extrapolated."""
    found = []
    for basis, title, num_steps, criterion in (
        (STEP, "simulate", scene.num_steps, partial(rival_lgsens.criterion, scene)),
        (ACCURACY, "richardson", 3 * EXTRAPOLATED, partial(rival_lgsens.extrapolated, scene, EXTRAPOLATED)),
    ):
        psi = lambda p, criterion=criterion: criterion(scene.model(p))
        for kind, function in ((VALUE, psi), (GRADIENT, jax.value_and_grad(psi))):
            print(f"lgsens, {title}: {kind}", flush=True)
            run, size, seconds = spread(function, designs)
            call = lambda run=run, kind=kind: Run(*run(designs)) if kind == GRADIENT else Run(run(designs))
            details = {"batch": size}
            found.append(Program("lgsens", title, kind, basis, num_steps, call, details, seconds))
    return found


class Generated:
    """CasADi's C for Ψ, and for Ψ and its gradient, in given numbers of steps, mapped over threads."""

    def __init__(self, scene: Scene, designs: np.ndarray, counts: Sequence[int], cores: int):
        print(f"CasADi: steps {counts}", flush=True)
        self.scene, self.designs, self.cores = scene, designs, cores
        rate = rival_casadi.Equations(scene).function()
        functions = rival_casadi.functions(scene, rate, counts)
        with tempfile.TemporaryDirectory() as folder:
            found, self.seconds, _ = rival_casadi.built(functions, Path(folder))
        self.functions = dict(zip([(n, kind) for n in counts for kind in (VALUE, GRADIENT)], found))
        self.to_numbers, _, seconds = spread(partial(rival_casadi.arguments, scene), designs)
        given = (designs, self.to_numbers(designs))
        self.back, _, more = spread(lambda given: rival_casadi.pulled_back(scene, *given), given)
        self.numbers_seconds = seconds + more

    def calls(self, num_steps: int) -> dict[str, Callable[[], Run]]:
        mapped = {
            kind: self.functions[num_steps, kind].map(len(self.designs), "thread", self.cores)
            for kind in (VALUE, GRADIENT)
        }

        def value() -> Run:
            started = time.perf_counter()
            numbers = [leaf.T for leaf in self.to_numbers(self.designs)]
            model = time.perf_counter() - started
            return Run(np.asarray(mapped[VALUE](*numbers)).ravel(), None, model)

        def gradient() -> Run:
            times = [time.perf_counter()]
            numbers = [leaf.T for leaf in self.to_numbers(self.designs)]
            times.append(time.perf_counter())
            psi, *bars = mapped[GRADIENT](*numbers)
            times.append(time.perf_counter())
            found = self.back((self.designs, tuple(np.asarray(bar).T for bar in bars)))
            times.append(time.perf_counter())
            return Run(np.asarray(psi).ravel(), found, times[1] - times[0] + times[3] - times[2])

        return {VALUE: value, GRADIENT: gradient}

    def programs(self, num_steps: int) -> list[Program]:
        titles = {VALUE: "generated C, RK4", GRADIENT: "generated C, adjoint of RK4"}
        details = {"mapped": "thread", "numbers_build_seconds": self.numbers_seconds}
        return [
            Program("CasADi", titles[kind], kind, ACCURACY, num_steps, call, details, self.seconds)
            for kind, call in self.calls(num_steps).items()
        ]

    def reference(self, num_steps: int) -> dict[str, Any]:
        """Ψ and gradients of all designs in many steps, and the errors of this at the shipped damper."""
        found, numbers = self.calls(num_steps)[GRADIENT](), self.scene.arrays()
        start = (rival_casadi.initial(numbers), rival_casadi.parameters(numbers))
        value, *bars = self.functions[num_steps, GRADIENT](*map(np.asarray, start))
        gradient = rival_casadi.puller(self.scene)(bars)
        known = json.loads((Path(__file__).parent / "results" / "rivals.json").read_text(encoding="utf-8"))
        known = known["references"][SCENE]
        assert np.array_equal(known["p"], self.scene.start)
        return {
            "num_steps": num_steps,
            "value_error": abs(float(value) / known["value"] - 1),
            "gradient_error": difference(gradient, np.asarray(known["gradient"]), self.scene.scale),
            "values": found.values.tolist(),
            "gradients": found.gradients.tolist(),
        }


@contextmanager
def exudyn_programs(scene: Scene, designs: np.ndarray, cores: int) -> Iterator[list[Program]]:
    """Ψ by processes that wait for designs as long as the context lasts."""
    print(f"Exudyn: {cores} processes", flush=True)
    to_numbers, _, seconds = spread(scene.numbers, designs)
    context = multiprocessing.get_context("spawn")
    ready = context.Barrier(cores + 1)
    started = time.perf_counter()
    with context.Pool(cores, rival_exudyn.begin, (scene.name, ready)) as pool:
        ready.wait()
        start = time.perf_counter() - started

        def call() -> Run:
            started = time.perf_counter()
            numbers = to_numbers(designs)
            each = [jax.tree.map(lambda leaf, i=i: leaf[i], numbers) for i in range(len(designs))]
            model = time.perf_counter() - started
            values, building = np.transpose(pool.map(rival_exudyn.solved, each, chunksize=1))
            return Run(values, None, model + building.sum() / cores)

        details = {"processes": cores, "start_seconds": start, "numbers_build_seconds": seconds}
        options = rival_exudyn.FASTEST
        nodes = options.nodes.removeprefix("NodeRigidBody")
        title = f"{options.solver}, {options.linear}, {options.newton}, {nodes}, {options.tolerances[0]:.0e}"
        yield [Program("Exudyn", title, VALUE, STEP, scene.num_steps, call, details)]


def record(program: Program, runs: list[Run], seconds: list[float], scene: Scene, wanted: dict[str, Any]) -> dict:
    """The numbers of a program from its rounds."""
    last, count, median = runs[-1], len(runs[-1].values), statistics.median(seconds)
    gradient_error = None
    if last.gradients is not None:
        pairs = zip(last.gradients, np.asarray(wanted["gradients"]))
        gradient_error = max(difference(one, other, scene.scale) for one, other in pairs)
    model = None if last.model_seconds is None else statistics.median(run.model_seconds for run in runs)
    return {
        **{name: value for name, value in program._asdict().items() if name != "call"},
        "designs": count,
        "seconds": seconds,
        "designs_per_second": count / median,
        "microseconds_per_design": 1e6 * median / count,
        "microseconds_per_second_of_motion": 1e6 * median / count / scene.t1,
        "microseconds_per_step": 1e6 * median / count / program.num_steps,
        "model_microseconds_per_design": None if model is None else 1e6 * model / count,
        "value_error": float(np.max(np.abs(last.values / np.asarray(wanted["values"]) - 1))),
        "gradient_error": gradient_error,
    }


def compare(records: list[dict[str, Any]]) -> None:
    """Adds the ratios to lgsens, equal step and equal accuracy."""
    times = {(r["kind"], r["basis"]): r["microseconds_per_design"] for r in records if r["rival"] == "lgsens"}
    for one in records:
        ratios = {basis: one["microseconds_per_design"] / times[one["kind"], basis] for basis in (STEP, ACCURACY)}
        one["ratio_to_lgsens"] = ratios


def run(count: int, repeats: int, cores: int) -> dict[str, Any]:
    scene = SCENES[SCENE]()
    designs = np.tile(scene.start, (count, 1))
    designs[:, scene.names.index("damping")] = np.linspace(*DAMPERS, count)
    steps = rival_casadi.COARSE[SCENE]
    generated = Generated(scene, designs, (steps, FINE), cores)
    wanted = generated.reference(FINE)
    programs = [*lgsens_programs(scene, designs), *generated.programs(steps)]
    with exudyn_programs(scene, designs, cores) as more:
        programs += more
        print(f"{len(programs)} programs, {repeats} rounds of {count} designs", flush=True)
        runs: list[list[Run]] = [[program.call()] for program in programs]
        calls = {i: lambda i=i: runs[i].append(programs[i].call()) for i in range(len(programs))}
        taken = interleaved(calls, repeats)
    rows = [record(one, runs[i][1:], taken[i].wall, scene, wanted) for i, one in enumerate(programs)]
    compare(rows)
    agreement = {"bound": BOUND}
    for key in ("value_error", "gradient_error"):
        agreement[key] = max(row[key] for row in rows if row[key] is not None)
        assert agreement[key] < BOUND, (key, rows)
    values = np.stack([of_one[-1].values for of_one in runs])
    agreement["values_differ_by"] = float(np.max(np.ptp(values, axis=0) / np.asarray(wanted["values"])))
    return {
        "what": "Ψ and dΨ/dp of designs of the quarter-car on cores, medians of rounds of all designs",
        "t1": scene.t1,
        "parameters": len(scene.names),
        "dampers": DAMPERS,
        "designs": count,
        "cores": cores,
        "repeats": repeats,
        "reference": wanted,
        "agreement": agreement,
        "programs": rows,
    }


HEAD = (
    "rival | program | basis | steps | designs/s | µs per design and s of motion | of it the model | µs per step | "
    "time / lgsens's of equal step | / lgsens's of equal accuracy | build [s] | error of Ψ | error of gradient"
)


def _cells(row: dict[str, Any]) -> list[str]:
    form = lambda key, how: "–" if row[key] is None else format(row[key], how)
    return [
        *(str(row[key]) for key in ("rival", "program", "basis", "num_steps")),
        form("designs_per_second", ".3g"),
        *(form(key, ".0f") for key in ("microseconds_per_second_of_motion", "model_microseconds_per_design")),
        form("microseconds_per_step", ".3g"),
        *(f"{row['ratio_to_lgsens'][basis]:.2f}" for basis in (STEP, ACCURACY)),
        form("build_seconds", ".0f"),
        *(form(key, ".1e") for key in ("value_error", "gradient_error")),
    ]


def table(found: dict[str, Any]) -> str:
    lines = []
    for kind in (VALUE, GRADIENT):
        lines += [f"**{kind}**", ""]
        lines += [grid(HEAD, (_cells(row) for row in found["programs"] if row["kind"] == kind)), ""]
    reference, agreement = found["reference"], found["agreement"]
    exudyn = next(row for row in found["programs"] if row["rival"] == "Exudyn")
    sizes = [str(row["details"]["batch"]) for row in found["programs"] if row["rival"] == "lgsens"]
    runs = 2 * found["parameters"]
    lines += [
        f"{found['designs']} designs, dampers of {found['dampers'][0]:.0f} … {found['dampers'][1]:.0f} N s/m, "
        f"{found['cores']} cores; lgsens's batches, row by row: {', '.join(sizes)}. All values agree to "
        f"{agreement['values_differ_by']:.1e}. The reference's own errors at the shipped damper: "
        f"{reference['value_error']:.0e} of Ψ, {reference['gradient_error']:.0e} of dΨ/dp. Exudyn's processes start in "
        f"{exudyn['details']['start_seconds']:.1f} s. Central differences of {found['parameters']} numbers would take "
        f"it {runs} runs, by arithmetic {1e-6 * runs * exudyn['microseconds_per_design']:.2g} s per design (not "
        "measured).",
        "",
        circumstances(found["environment"]),
    ]
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--designs", type=int, default=60, help="designs of a round (default: %(default)s)")
    parser.add_argument(
        "--cores", type=int, default=2, help="devices of JAX, threads, processes (default: %(default)s)"
    )
    arguments = parser.parse_args()
    settings = WHOLE_LOOPS | {"PJRT_NPROC": str(arguments.cores)}  # a thread for each
    os.environ.update(settings)  # before the first computation, and before the processes of Exudyn
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", arguments.cores)
    found = run(arguments.designs, arguments.repeats, arguments.cores)
    found["environment"] = environment(settings)
    write(arguments.out / "batches.json", found)
    print(table(found))


if __name__ == "__main__":
    main()
