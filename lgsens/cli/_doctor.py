"""`lgsens doctor FILE|NAME`: which extremes a scene comes near to."""

import argparse
from pathlib import Path

from lgsens._progress import compiling
from lgsens.accuracy import doctor
from lgsens.cli._tradeoff import SCENES, from_file
from lgsens.examples import DEFAULT, QuarterCar, shipped


def run(arguments: argparse.Namespace) -> int:
    """Print the diagnosis; 1 where something is near."""
    model, t0, duration = read(arguments.scene)
    duration = arguments.t1 or duration
    steps = max(1, round(duration / arguments.dt))
    with compiling("a run and its growth", not arguments.quiet):
        found = doctor(model, t0=t0, t1=t0 + duration, num_steps=steps)
    print(found)
    return 1 if found.near else 0


def read(scene: str):
    """The model, when its run begins, and how long it lasts [s]."""
    if scene in SCENES or Path(scene).suffix == ".py":
        of = SCENES[scene]() if scene in SCENES else from_file(Path(scene))
        return of.model(), float(of.t0), float(of.t1) - float(of.t0)
    known = scene in shipped() or Path(scene).is_file()
    if not known:
        raise ValueError(f"{scene!r} is neither a file nor one of {sorted({*SCENES, *shipped(), DEFAULT})}")
    return QuarterCar.load(scene).model(), 0.0, 1.0
