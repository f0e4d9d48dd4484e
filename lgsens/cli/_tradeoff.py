"""`lgsens tradeoff`: what settings cost and lose on a scene, and which to take for how many digits."""

import argparse
import json
import os
import runpy
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lgsens import plotting
from lgsens.accuracy import Recommendation, Setting, Table, grid, ladder, plot, recommend, work_precision
from lgsens.cli._report import interrupted, output_folder, unfinished, versions, write_json
from lgsens.criteria import Criterion
from lgsens.examples import PROBLEMS, QuarterCar
from lgsens.integrate import GeneralizedAlpha, IndexReducedODE

TARGETS = (1e-2, 1e-4, 1e-6, 1e-8)
NAMES = {
    "build": "a function p ↦ Model",
    "criterion": "a function of a trajectory, or a Criterion",
    "parameters": "p, a pytree of floats",
    "t1": "the final time [s]",
}
OPTIONAL = ("settings", "scale", "t0")


class Scene(NamedTuple):
    """What `work_precision` is given."""

    title: str
    build: Callable[..., Any]
    criterion: Any
    parameters: Any
    t1: float
    settings: tuple[Setting, ...]
    scale: Any = None
    t0: float = 0.0

    def model(self) -> Any:
        """Of the parameters. Raises `ValueError` for a `build` that fails."""
        try:
            return self.build(self.parameters)
        except Exception as error:  # whatever a user's function may raise
            raise ValueError(f"{self.title}: `build(parameters)` fails: {type(error).__name__}: {error}") from error


def top() -> Scene:
    """The paper's top, §8: Ψ = ∫ x² dt with respect to its eight numbers."""
    import diffrax  # takes its time to import

    problem = PROBLEMS["spinning_top_brulls.l_1.0_alpha0_0.785398"]
    alpha, dopri8 = GeneralizedAlpha(0.9), IndexReducedODE(diffrax.Dopri8())
    settings = (
        *grid((25, 100, 400, 1600, 102_400), alpha),
        *grid((400,), GeneralizedAlpha(0.5)),
        *grid((25, 100, 400), alpha, extrapolate=True),
        *grid((25, 100), IndexReducedODE()),
        *grid((10, 15, 20, 30, 50), dopri8),
    )
    return Scene("spinning top", problem.build, problem.criteria["Psi"], problem.parameters, problem.t1, settings)


def quarter_car(bushings: Sequence[str] = ()) -> Scene:
    """The five-link quarter-car over its bump: Ψ₀ with respect to k, c and the chassis hardpoints.

    The wheel is locked, and the chassis a body that heaves: the motion of one on a slider, in fewer equations.
    With `bushings` of 1e8 N/m in place of the ball joints of those links explicit routes need steps of 0.2 ms.
    """
    import diffrax  # takes its time to import

    car = QuarterCar.load()
    assert car.spring is not None  # that of the car that ships
    parameters = {"stiffness": car.spring.rate, "damping": car.damper.rate, "hardpoints": car.hardpoints}

    def build(p, **options):
        return car.with_values(**p).model(**({"wheel": "locked", "chassis": "heave", "bushings": bushings} | options))

    comfort = Criterion(integrand=lambda s, p: s.body("chassis").acceleration[2] ** 2)
    # The bump ends at 0.25 s: a fourth of the steps, so that the kink is between two of them.
    loose, alpha, dopri8 = GeneralizedAlpha(tolerance=1e-5), GeneralizedAlpha(), IndexReducedODE(diffrax.Dopri8())
    extrapolated = (
        *grid((28, 52), GeneralizedAlpha(tolerance=1e-6), extrapolate=True),
        *grid((40,), GeneralizedAlpha(tolerance=1e-7), extrapolate=3),
    )
    if bushings:
        settings = (
            *grid((28, 76, 200), loose),
            *grid((52, 76), loose, pilot=80),
            *grid((400, 1600, 6400), alpha),
            *extrapolated,
            *grid((200, 800), alpha, extrapolate=True),
            *grid((8000,), IndexReducedODE()),
            *grid((5000,), dopri8),
        )
    else:  # three pairs of scene and scheme, in at most 256 steps: three programs forward and backward, and the placed
        settings = (
            *grid((28, 52, 76), loose),
            *grid((52, 76), loose, pilot=80),
            *grid((200,), alpha),
            *grid((28, 52, 76), loose, model={"links": "rods"}),
            *extrapolated,
            *grid((16, 20, 40, 80), dopri8),
        )
    return Scene(f"{'stiff ' if bushings else ''}five-link quarter-car", build, comfort, parameters, 1.0, settings)


# What the command knows by name.
SCENES: dict[str, Callable[[], Scene]] = {
    "top": top,
    "quarter-car": quarter_car,
    "stiff-quarter-car": lambda: quarter_car(("wishbone", "guide_link")),
}


def from_file(path: Path) -> Scene:
    """The scene of a Python file. Raises `ValueError` naming the file and what is wrong with it."""
    if not path.is_file():
        raise ValueError(f"{str(path)!r} is neither a file nor one of {sorted(SCENES)}")
    if path.suffix != ".py":
        raise ValueError(
            f"file {str(path)!r} must be a Python file, ….py, that builds a scene; for a suspension's file there are "
            "`lgsens doctor` and `lgsens optimize`"
        )
    try:
        found: Mapping[str, Any] = runpy.run_path(str(path))
    except Exception as error:  # whatever a user's file may raise
        raise ValueError(f"file {str(path)!r} cannot be run: {type(error).__name__}: {error}") from error
    missing = [f"`{name}`, {what}" for name, what in NAMES.items() if name not in found]
    if missing:
        raise ValueError(f"file {str(path)!r} must define {'; '.join(missing)}")
    given = {name: found[name] for name in OPTIONAL if name in found}
    settings = tuple(given.pop("settings", None) or ladder())
    build, criterion, parameters, t1 = (found[name] for name in NAMES)
    return Scene(path.stem, build, criterion, parameters, t1, settings, **given)


def run(arguments: argparse.Namespace) -> int:
    """Measure a scene, print the table and the recommendations, write `tradeoff.json` and `tradeoff.png`."""
    plotting.figure()  # asks for matplotlib now, not after minutes
    scene = SCENES[arguments.scene]() if arguments.scene in SCENES else from_file(Path(arguments.scene))
    scene.model()
    with output_folder(arguments.out, arguments.overwrite or arguments.resume) as out:
        path = unfinished(out, "tradeoff.json", arguments.resume)
        known = Table.from_document(json.loads(path.read_text(encoding="utf-8"))) if arguments.resume else None
        kept = [] if known is None else [known]
        what = {"t0": scene.t0, "t1": scene.t1, "scale": scene.scale, "known": known, "keep": kept.append}
        how = {"rounds": arguments.rounds, "progress": not arguments.quiet}
        stopped = False
        try:
            table = work_precision(scene.criterion, scene.build, scene.parameters, scene.settings, **what, **how)
        except KeyboardInterrupt:
            if not kept:
                raise
            table, stopped = kept[-1], True
        found = [recommend(table, target, by=arguments.by) for target in arguments.targets]
        write_json(document(scene, table, found), out / "tradeoff.json", indent=1, ensure_ascii=False)
        plotting.save(plot(table, arguments.targets, by=arguments.by, title=scene.title), out / "tradeoff.png")
    if not arguments.quiet:
        print(table, *found, f"written to {out}: tradeoff.json, tradeoff.png", sep="\n\n")
    if stopped:
        return interrupted("tradeoff", f"these are {len(table)} of {len(scene.settings)} settings")
    return 0 if all(found) else 1


def recommendations(table: Table, found: list[Recommendation]) -> list[dict[str, Any]]:
    """Recommendations as JSON, with the places of their settings in the table."""

    def place(row) -> int | None:
        return None if row is None else next(i for i, other in enumerate(table) if other is row)

    places = lambda one: {"row": place(one.row), "cheaper": place(one.cheaper)}
    return [{"rtol": one.rtol, **places(one), "margin": one.margin, "reason": one.reason} for one in found]


def document(scene: Scene, table: Table, found: list[Recommendation]) -> dict[str, Any]:
    """Table and recommendations, with what they were measured on, as JSON."""
    return {
        "scene": scene.title,
        "t0": scene.t0,
        "t1": scene.t1,
        "parameters": jax.tree.map(lambda leaf: jnp.asarray(leaf).tolist(), scene.parameters),
        **table.document(),
        "recommendations": recommendations(table, found),
        "cores": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 1),
        "device": jax.devices()[0].platform,
        "versions": versions("diffrax"),
    }
