"""`lgsens curves quarter-car|FILE`: what a suspension does with its wheel as it travels, drawn, listed and animated."""

import argparse
import csv
from pathlib import Path

import numpy as np

from lgsens import plotting
from lgsens._progress import compiling
from lgsens.cli._report import asking_for, output_folder, suspension_file, write_all, written
from lgsens.examples import QuarterCar, SuspensionCurves, suspension_document

# Heading, member of SuspensionCurves, factor to the unit shown, decimals.
COLUMNS = (
    ("travel [mm]", "travel", 1e3, 1),
    ("camber [deg]", "camber", np.degrees(1.0), 4),
    ("toe [deg]", "toe", np.degrees(1.0), 4),
    ("track [mm]", "track_change", 1e3, 3),
    ("wheelbase [mm]", "wheelbase_change", 1e3, 3),
    ("spring ratio", "spring_motion_ratio", 1.0, 4),
    ("damper ratio", "damper_motion_ratio", 1.0, 4),
    ("roll centre [mm]", "roll_centre_height", 1e3, 2),
)
SHOWN = 9  # rows of the table on the screen


def run(arguments: argparse.Namespace) -> int:
    """Write `curves.png`, `curves.csv` and `travel.html`, and print a table."""
    if arguments.points < 2:
        raise ValueError(f"argument --points: must be at least 2, got {arguments.points}")
    with output_folder(arguments.out, arguments.overwrite) as out:
        plotting.figure()  # asks for matplotlib now
        file = suspension_file(arguments)
        car = QuarterCar.load(file)
        axle = arguments.axle or axle_of(file)
        travel = np.linspace(-arguments.travel, arguments.travel, arguments.points)
        quiet = arguments.quiet
        with asking_for({"travel": arguments.travel}), compiling("the positions of the wheel", not quiet):
            curves = car.curves(travel, axle=axle)
        files = {
            "curves.csv": lambda path: write_table(curves, path),
            "curves.png": lambda path: plotting.save(
                plotting.suspension_curves({car.name: curves}, title=car.name), path
            ),
            "travel.html": lambda path: plotting.animate(car.travel(travel, links="bodies"), path, title=car.name),
        }
        if status := write_all("curves", files, out):
            return status
        if not quiet:
            print(table(curves), written(out, files), sep="\n")
    return 0


def axle_of(file: str | Path | None) -> str:
    """Which axle the suspension of a file is of, "front" or "rear", as far as it says."""
    return suspension_document(file).get("vehicle", {}).get("axle", "rear")


def write_table(curves: SuspensionCurves, path: Path) -> None:
    """Every member of the curves as a column of a CSV file, SI units, all digits."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(curves._fields)
        writer.writerows(np.stack([np.asarray(column) for column in curves], axis=1).tolist())


def table(curves: SuspensionCurves) -> str:
    """A few rows of the curves, ISO 8855 signs."""
    n = len(curves.travel)
    rows = np.unique(np.linspace(0, n - 1, min(n, SHOWN)).round().astype(int))
    lines = ["".join(f"{heading:>17}" for heading, *_ in COLUMNS)]
    for i in rows:
        cells = [f"{factor * float(getattr(curves, member)[i]):>17.{d}f}" for _, member, factor, d in COLUMNS]
        lines.append("".join(cells))
    return "\n".join(lines)
