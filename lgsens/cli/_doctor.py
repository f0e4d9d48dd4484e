"""`lgsens doctor FILE|NAME`: which extremes a scene comes near to."""

import argparse
from pathlib import Path

from lgsens._progress import compiling
from lgsens.accuracy import doctor
from lgsens.cli._tradeoff import SCENES, from_file
from lgsens.examples import DEFAULT, QuarterCar, shipped


def run(arguments: argparse.Namespace) -> int:
    """Print the diagnosis; 1 where something is near."""
    model, t1 = read(arguments.scene)
    t1 = arguments.t1 or t1
    steps = max(1, round(t1 / arguments.dt))
    with compiling("a run and its growth", not arguments.quiet):
        found = doctor(model, t1=t1, num_steps=steps)
    print(found)
    return 1 if found.near else 0


def read(scene: str):
    """The model, and how long it runs [s]."""
    if scene in SCENES or Path(scene).suffix == ".py":
        of = SCENES[scene]() if scene in SCENES else from_file(Path(scene))
        return of.build(of.parameters), float(of.t1)
    known = scene in shipped() or Path(scene).is_file()
    if not known:
        raise ValueError(f"{scene!r} is neither a file nor one of {sorted({*SCENES, *shipped(), DEFAULT})}")
    return QuarterCar.load(scene).model(), 1.0
