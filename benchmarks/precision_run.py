"""One run of `work_precision.py`: families of programs at several steps or tolerances, measured together."""

import importlib
import importlib.util
import json
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import rival_casadi
import rival_diffrax
import rival_sundials
from benchmark import SINGLE_THREAD, environment, write
from rival_run import difference
from rival_scenes import SCENES, Scene
from rival_timing import Program, compiled, measure

import lgsens as lg

LEVELS = (1e-2, 1e-3, 1e-4, 1e-6)
KIND = "gradient, p"


class Point(NamedTuple):
    """An lgsens route: a title for its settings, the integrator, the number of steps n, settings of the model."""

    title: str
    integrator: Any
    num_steps: int
    model: tuple[tuple[str, str], ...] = ()
    runs: int = 1  # extrapolated, with n, 2n, 4n, … steps


def heaving(*points: Point) -> list[Point]:
    """With a chassis that has one coordinate instead of six and a slider: the same mechanism."""
    return [point._replace(title=f"{point.title}, `chassis=heave`", model=(("chassis", "heave"),)) for point in points]


def alpha(num_steps: int, tolerance: float, rho: float = 0.9) -> Point:
    return Point(f"ρ∞ = {rho}, Newton to {tolerance:.0e}", lg.GeneralizedAlpha(rho, tolerance=tolerance), num_steps)


def richardson(num_steps: int, tolerance: float, runs: int = 2) -> Point:
    scheme = lg.GeneralizedAlpha(tolerance=tolerance)
    numbers = ("n", "2n", "4n")[:runs]
    title = f"{', '.join(numbers[:-1])} and {numbers[-1]} steps, ρ∞ = 0.9, Newton to {tolerance:.0e}"
    return Point(title, scheme, num_steps, runs=runs)


def explicit(scheme, num_steps: int) -> Point:
    return Point(f"{type(scheme).__name__}, equal steps", lg.IndexReducedODE(scheme), num_steps)


LGSENS = {
    "quarter_car": {
        "lgsens, generalized-α": [alpha(n, 1e-5) for n in (32, 76)],
        "lgsens, generalized-α, heave": heaving(*(alpha(n, 1e-5) for n in (32, 76))),
        "lgsens, Richardson": [richardson(52, 1e-6), richardson(40, 1e-6, runs=3)],
        "lgsens, Richardson, heave": heaving(richardson(52, 1e-6), richardson(40, 1e-6, runs=3)),
        "lgsens, IndexReducedODE": [explicit(diffrax.Dopri8(), n) for n in (24, 40)],
        "lgsens, IndexReducedODE, heave": heaving(*(explicit(diffrax.Dopri8(), n) for n in (24, 40))),
    },
    # Bushings of 1e8 N/m: explicit steps are stable up to about 0.2 ms.
    "stiff_quarter_car": {
        "lgsens, generalized-α": [alpha(n, 1e-5) for n in (32, 76)],
        "lgsens, Richardson": [richardson(52, 1e-6), richardson(40, 1e-7, runs=3), richardson(200, 1e-8)],
        "lgsens, IndexReducedODE": [explicit(diffrax.Dopri8(), 5000)],
    },
}
CASADI_STEPS = {"quarter_car": (44, 68, 104, 288), "stiff_quarter_car": (5000, 6000, 8000)}
SUNDIALS = {
    "quarter_car": {
        "Adams": (1e-2, 3e-3, 3e-4, 5e-5, 3e-6, 5e-8),
        "IDAS": (6e-5, 5e-8),
    },
    "stiff_quarter_car": {"IDAS": (1e-3,)},
}


def lgsens_program(family: str, scene: Scene, point: Point) -> Program:
    """Ψ and dΨ/dp of one route, by the public interface alone."""
    body, quantity, axis = scene.observed
    rate = lambda s: getattr(s.body(body), quantity)[..., axis] ** 2

    def psi(p, num_steps=point.num_steps):
        model = scene.model(p, **dict(point.model))
        trajectory = lg.simulate(model, t1=scene.t1, num_steps=num_steps, integrator=point.integrator, throw=False)
        if trajectory.stages is not None:
            return lg.Criterion(integrand=lambda s, _: rate(s))(trajectory)
        return lg.time_integral(trajectory.t, rate(trajectory), order=trajectory.order)

    function = psi
    if point.runs > 1:
        function = lambda p: lg.richardson(lambda n: psi(p, n), point.num_steps, point.runs).value
    return compiled(
        jax.value_and_grad(function),
        (jnp.asarray(scene.start),),
        rival=family,
        program=point.title,
        kind=KIND,
        num_steps=point.num_steps,
        basis="",
    )


def diffrax_program(
    family: str, scene: Scene, scheme, num_steps: int | None, tolerance: float, longest: float
) -> Program:
    """Plain JAX and diffrax: equal steps, or error control (`num_steps` None); every step is kept for reverse mode."""
    if num_steps is None:
        control, dt0, count = rival_diffrax.controller(scene, tolerance, longest), None, 512
        title = f"{scheme.__name__}, tolerance {tolerance:.0e}, steps of at most {1e3 * longest:g} ms"
    else:
        control, dt0, count = diffrax.ConstantStepSize(), scene.t1 / num_steps, num_steps + 1
        title = f"{scheme.__name__}, equal steps"
    adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=count)
    psi = lambda p: rival_diffrax.criterion(scene, scheme, control, adjoint, scene.numbers(p), dt0, count)
    p = jnp.asarray(scene.start)
    program = compiled(
        jax.value_and_grad(psi, has_aux=True), (p,), rival=family, program=title, kind=KIND, num_steps=0, basis=""
    )
    prepare = program.prepare
    assert prepare is not None

    def show(found):
        (value, _), gradient = found
        return float(value), jnp.ravel(gradient)

    def count_steps(program: Program) -> None:
        prepare(program)
        assert program.call is not None
        program.num_steps = int(program.call()[0][1])

    program.show, program.prepare = show, count_steps
    return program


DIFFRAX: dict[str, list[tuple]] = {
    "quarter_car": [
        (diffrax.Tsit5, None, 1e-5, 5e-3),
        *((diffrax.Tsit5, n, 0.0, 0.0) for n in (44,)),
        *((diffrax.Dopri8, n, 0.0, 0.0) for n in (24, 40)),
    ],
    "stiff_quarter_car": [(diffrax.Tsit5, 8000, 0.0, 0.0), (diffrax.Dopri8, 5000, 0.0, 0.0)],
}


def families(scene: Scene) -> dict[str, Callable[[], list[Program]]]:
    """All families of programs for a scene, each made when it is called."""
    found: dict[str, Callable[[], list[Program]]] = {}
    for family, points in LGSENS[scene.name].items():
        found[family] = lambda family=family, points=points: [lgsens_program(family, scene, point) for point in points]
    for family, plain in (("diffrax", False), ("diffrax, error control", True)):
        points = [point for point in DIFFRAX[scene.name] if (point[1] is None) == plain]
        found[family] = lambda family=family, points=points: [
            diffrax_program(family, scene, *point) for point in points
        ]
    if importlib.util.find_spec("casadi") is not None:
        found["CasADi, RK4 in C"] = partial(_casadi, scene)
        found["CasADi, SUNDIALS"] = lambda: rival_sundials.programs(scene, SUNDIALS[scene.name])
    return found


def _casadi(scene: Scene) -> list[Program]:
    programs = rival_casadi.programs(scene, dict.fromkeys(CASADI_STEPS[scene.name], ""))
    chosen = [program for program in programs if program.kind == KIND]
    for program in chosen:
        program.rival = "CasADi, RK4 in C"
    return chosen


def run(scenes: Iterable[str], chosen: Sequence[str] | None, repeats: int, path: Path, cache: str | None) -> None:
    """Measure the scenes and write them to `path`; families that are not in `chosen` are left out (None: all)."""
    jax.config.update("jax_enable_x64", True)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    document: dict[str, Any] = {"what": "Ψ and its gradient by p: error against time", "scenes": {}}
    if path.exists():
        document = json.loads(path.read_text(encoding="utf-8"))
    references = json.loads((Path(__file__).parent / "results" / "rivals.json").read_text(encoding="utf-8"))[
        "references"
    ]
    for name in scenes:
        scene, reference = SCENES[name](), references[name]
        programs, failed = [], []
        for family, make in families(scene).items():
            if chosen is not None and not family.startswith(("lgsens", *chosen)):
                continue
            for program in make():
                print(f"{name}: {family}, {program.program}, {program.num_steps or ''}", flush=True)
                if program.prepare is not None:
                    program.prepare(program)
                assert program.call is not None
                try:
                    value, _ = program.show(program.call())
                except RuntimeError as error:  # SUNDIALS gives up: the others are measured nevertheless
                    failed.append(f"{family}, {program.program}")
                    print(f"{failed[-1]}: {error}", flush=True)
                    continue
                if np.isfinite(value):
                    programs.append(program)
                else:
                    failed.append(f"{family}, {program.program}, {program.num_steps} steps")
                    print(f"{failed[-1]}: not finite", flush=True)
        records = measure(programs, repeats)
        for record in records:
            record["value_error"] = abs(record["value"] / reference["value"] - 1)
            record["gradient_error"] = difference(record["gradient"], jnp.asarray(reference["gradient"]), scene.scale)
            for key in ("gradient", "kind", "basis", "microseconds_per_step"):
                del record[key]
        document["scenes"][name] = {
            "levels": LEVELS,
            "repeats": repeats,
            "parameters": len(scene.names),
            "failed": failed,
            "programs": records,
            "environment": environment(SINGLE_THREAD),
        }
        write(path, document)
