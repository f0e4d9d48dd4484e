"""`lgsens import FILE`: what a model of another program has, what was not carried over, and its motion."""

import argparse
import re
from pathlib import Path

from lgsens import importers, plotting
from lgsens._progress import compiling
from lgsens.cli._report import output_folder, written
from lgsens.importers import Imported
from lgsens.simulation import simulate


def run(arguments: argparse.Namespace) -> int:
    """Print the report, and write `motion.html` and `motion.csv` of a free motion from the file's configuration."""
    imported = read(arguments.file)
    if not arguments.quiet:
        print(imported.report, imported.model.summary(), sep="\n\n")
    if not arguments.simulate:
        return 0
    with output_folder(arguments.out, arguments.overwrite) as out:
        steps = max(1, round(arguments.simulate / arguments.dt))
        with compiling("the motion", not arguments.quiet):
            trajectory = simulate(imported.model, t1=arguments.simulate, num_steps=steps)
        title = Path(arguments.file).stem
        plotting.animate(trajectory, out / "motion.html", title=title)
        trajectory.to_csv(out / "motion.csv")
        if not arguments.quiet:
            print(written(out, ("motion.html", "motion.csv")))
    return 0


def read(path: str) -> Imported:
    """By the suffix, and of XML by its first element."""
    if Path(path).suffix == ".json":
        return importers.chrono(path)
    with Path(path).open(encoding="utf-8", errors="replace") as file:
        elements = (re.search(r"<(mujoco|robot)\b", line) for line in file)
        root = next((found[1] for found in elements if found), None)
    if root is None:
        raise ValueError(f"{path!r} is no MJCF (<mujoco>), URDF (<robot>) or Chrono suspension (.json).")
    return importers.mjcf(path) if root == "mujoco" else importers.urdf(path)
