"""The console script `lgsens`: arguments in, an exit status out; 2 and one line on stderr for bad input."""

import _thread
import argparse
import contextlib
import io
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import jax

from lgsens._xla import compilation_cache
from lgsens.cli import _curves, _doctor, _import, _kc, _optimize, _paper, _top, _tradeoff
from lgsens.cli._argument_types import DEFAULT_PARAMETERS, count, named, positive, relative, share, way
from lgsens.cli._report import INTERRUPTED, UNFINISHED, interrupted, version
from lgsens.examples import DEFAULT, PARAMETERS, shipped
from lgsens.model import ISO_8608
from lgsens.simulation import SimulationError

BAD_INPUT = 2


class _Parser(argparse.ArgumentParser):
    """One line for bad arguments; argparse would print the usage as well."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")

    def option(self, name: str, default: Any, meaning: str = "", **settings: Any) -> None:
        """An option whose help ends with its default."""
        self.add_argument(name, default=default, help=f"{meaning} (default: %(default)s)".lstrip(), **settings)

    def out(self, default: str, written: str) -> None:
        """`--out` and `--overwrite`."""
        self.option("--out", Path(default), f"new folder for {written}", type=Path, metavar="DIR")
        self.add_argument("--overwrite", action="store_true", help="write into --out even if it exists")

    def resume(self) -> None:
        """`--resume`."""
        self.add_argument(
            "--resume", action="store_true", help="go on where the same command was interrupted, in --out"
        )

    def hardpoints(self) -> None:
        """The suspension, and `--hardpoints`."""
        known = ", ".join([f"{DEFAULT} (five links)", *shipped()])
        self.add_argument(
            "suspension", metavar=f"{DEFAULT}|FILE", help=f"a file, or one that ships with lgsens: {known}"
        )
        self.add_argument("--hardpoints", metavar="FILE", help="the file of the quarter-car, TOML or JSON")

    def vehicle(self, of: str = "") -> None:
        """What the rig is told of the car."""
        known = "that of the file, else"
        self.add_argument("--axle", choices=["rear", "front"], help=f"{of}which it is (default: {known} rear)")
        for name, kind, default, meaning in (
            ("wheelbase", positive, f"{known} 2.7", "of the car [m], for anti-features and Ackermann"),
            ("centre-height", positive, f"{known} 0.55", "of the car's centre of mass [m]"),
            ("braking-share", share, f"{known} 0.5", "of this axle in the braking force"),
            ("traction-share", share, f"{known} 1", "of this axle in the traction"),
            ("rack", way, "its travel, or 0.06", "way of the rack [m]"),
        ):
            text, metavar = f"{of}{meaning} (default: {default})", "SHARE" if kind is share else "M"
            self.add_argument(f"--{name}", type=kind, metavar=metavar, help=text)

    def quiet(self, nothing: str) -> None:
        """`--quiet`."""
        self.add_argument("--quiet", action="store_true", help=nothing)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser("lgsens", description="Differentiable constrained multibody dynamics on Lie groups in JAX.")
    parser.add_argument("--version", action="version", version=f"lgsens {version()}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    optimize = commands.add_parser(
        "optimize",
        help="optimize a suspension",
        description="Find the suspension whose chassis accelerates least over a bump, or on a random road, its tyre on "
        "the road and its spring within its travel (Sonneville & Brüls 2014, §9).",
    )
    optimize.set_defaults(run=_optimize.run)
    optimize.hardpoints()
    optimize.out("out/quarter-car", "result.json, the file of the best design, suspension.json, and the figures")
    optimize.resume()
    optimize.option(
        "--parameters",
        DEFAULT_PARAMETERS,
        f"what to change, of stiffness k, damping c and chassis hardpoints: {' or '.join(PARAMETERS)}",
        choices=list(PARAMETERS),
        metavar="WHAT",
    )
    free = "of an axle: numbers that are free, by keys of its file, and how far: points either way [m], camber and toe"
    free += " [degree], rates by a share of their value, or any between LOWER:UPPER; as often as needed"
    optimize.add_argument("--vary", type=named, action="append", metavar="PATTERN=WIDTH", help=free)
    kept = (
        "of an axle: its toe or camber curve [degree], or a characteristic that `lgsens kc` shows, in its unit, that "
    )
    kept += "stays within a width of its start, or between LOWER:UPPER; as often as needed"
    optimize.add_argument("--keep", type=named, action="append", metavar="NAME=WIDTH", help=kept)
    road = (
        "minimize the RMS acceleration, weighted by ISO 2631, on a random road of this class of ISO 8608, in place of"
    )
    road += " the integral over the bump, whose limits stay (default: the bump alone)"
    optimize.add_argument("--road", choices=list(ISO_8608), help=road)
    optimize.add_argument("--speed", type=positive, metavar="V", help="on the random road [m/s] (default: 20)")
    limit = "most RMS tyre load and wheel travel on the random road, over those at the start (default: 1.1 each)"
    optimize.add_argument("--limit", type=named, action="append", metavar="tyre|travel=FACTOR", help=limit)
    optimize.option("--t1", 2.0, "duration [s]", type=positive)
    optimize.option("--dt", 2e-3, "step size [s]", type=positive)
    reached = "in place of --dt: as many steps as Psi_0 over the bump and its gradient at the start take to have this "
    reached += "relative error"
    optimize.add_argument("--accuracy", type=positive, metavar="ERROR", help=reached)
    optimize.option("--steps", 300, "most gradients that the optimizer takes", type=count)
    optimize.option("--wheel", "hinged", "whether the wheel turns on its hinge", choices=["hinged", "locked"])
    for angle in ("camber", "toe"):
        meaning = f"keep the {angle} curve within this of the one at the start [degree] (default: it may change)"
        optimize.add_argument(f"--keep-{angle}", type=positive, metavar="DEG", help=meaning)
    kept = "wheel travel up and down over which curves are kept and drawn [m]"
    optimize.option("--travel", 0.05, kept, type=way, metavar="M")
    optimize.vehicle("with --vary: ")
    optimize.quiet("no progress bar and no table")

    curves = commands.add_parser(
        "curves",
        help="draw the curves of a suspension",
        description="Camber, toe, track, wheelbase, motion ratio and roll centre of a suspension over wheel travel: a "
        "figure, a table, and a page on which it moves.",
    )
    curves.set_defaults(run=_curves.run)
    curves.hardpoints()
    curves.out("out/curves", "curves.png, curves.csv and travel.html")
    curves.add_argument("--axle", choices=["rear", "front"], help="(default: that of the file, else rear)")
    curves.option("--travel", 0.08, "up and down [m]", type=way, metavar="M")
    curves.option("--points", 41, "positions", type=count)
    curves.quiet("no table")

    kc = commands.add_parser(
        "kc",
        help="kinematics and compliance of an axle",
        description="An axle on the rig: its wheels are moved, steered and loaded in equilibrium with springs and "
        "bushings. A page with all curves, pictures, JSON and CSV.",
    )
    kc.set_defaults(run=_kc.run)
    kc.hardpoints()
    kc.out("out/kc", "kc.html, kc.json, kc.csv and a picture of each sweep")
    kc.add_argument(
        "--sweeps", metavar="NAME,…", help="parallel, opposite, single, steering, lateral, … (default: all)"
    )
    kc.add_argument(
        "--gradient", metavar="NAME,…|all", help="characteristics to differentiate by the hardpoints (default: none)"
    )
    kc.option("--points", 41, "of each sweep, odd", type=count)
    kc.add_argument("--rigid", action="store_true", help="ideal joints in place of bushings")
    for name, default, meaning in (
        ("travel", 0.08, "of both wheels [m]"),
        ("roll", 0.05, "of the wheels against each other [m]"),
        ("lateral", 3000.0, "force on each wheel [N]"),
        ("braking", 3000.0, "force on each wheel [N]"),
        ("traction", 2000.0, "force on each wheel [N]"),
        ("aligning", 150.0, "moment on each wheel [N m]"),
    ):
        kc.option(f"--{name}", default, meaning, type=way if meaning.endswith("[m]") else positive)
    kc.vehicle()
    kc.quiet("no table")

    top = commands.add_parser(
        "top",
        help="differentiate the spinning top",
        description="The sensitivity of the paper's spinning top (§8) by every method, beside its reference.",
    )
    top.set_defaults(run=_top.run)
    top.option("--h", 1e-3, "step size [s]", type=positive)

    paper = commands.add_parser(
        "paper",
        help="reproduce the paper's convergence figures",
        description="Errors of sensitivities against the step size by all four methods, beside references from an "
        "independent integrator: the spinning top (Sonneville & Brüls 2014, Fig. 2) and the quarter-car (Fig. 4). "
        "Most of the ten minutes is compilation.",
    )
    paper.set_defaults(run=_paper.run)
    paper.out("out/paper", "paper.json and the figures")
    paper.add_argument("--only", choices=list(_paper.STUDIES), help="one of the figures (default: all)")
    paper.add_argument("--coarse", action="store_true", help="two large steps instead of four or five: a quick look")
    paper.quiet("no progress bar and no tables")

    read = commands.add_parser(
        "import",
        help="read a model of another program",
        description="What an MJCF, URDF or Chrono suspension file has, what of it was not carried over, and with "
        "--simulate its free motion as a page on which it moves.",
    )
    read.set_defaults(run=_import.run)
    read.add_argument("file", metavar="FILE", help="MJCF or URDF (extra `mujoco`), or a suspension of Chrono, .json")
    written = "simulate T seconds, write motion.html and motion.csv"
    read.add_argument("--simulate", type=positive, metavar="T", help=written)
    read.option("--dt", 1e-3, "step size [s]", type=positive)
    read.out("out/import", "motion.html and motion.csv")
    read.quiet("no report and no progress bar")

    tradeoff = commands.add_parser(
        "tradeoff",
        help="measure speed against accuracy",
        description="What settings of the simulation cost on a scene, what they lose of a criterion and of its "
        "gradient, and the cheapest for each target. A program is compiled for every setting: minutes.",
    )
    tradeoff.set_defaults(run=_tradeoff.run)
    tradeoff.add_argument(
        "scene",
        metavar="SCENE",
        help=f"{', '.join(_tradeoff.SCENES)}, or FILE.py that defines `build(p)`, `criterion(trajectory)`, "
        "`parameters` and `t1`, and if it likes `settings`, `scale` and `t0`, as in lgsens.accuracy.work_precision",
    )
    tradeoff.out("out/tradeoff", "tradeoff.json and tradeoff.png")
    tradeoff.resume()
    targets = "relative errors for which to recommend a setting (default: 1e-2 1e-4 1e-6 1e-8)"
    tradeoff.add_argument("--targets", type=relative, nargs="+", default=list(_tradeoff.TARGETS), help=targets)
    tradeoff.option("--rounds", 5, "timed calls, at least 5", type=count)
    costs = ["seconds", "cpu_seconds"]
    tradeoff.option("--by", "seconds", "the cost: time of the clock or of the processor", choices=costs)
    tradeoff.quiet("no progress bar and no table")

    doctor = commands.add_parser(
        "doctor",
        help="which extremes a scene comes near to",
        description="Stiffness and spin against the step, mass ratios, inertias, units, redundant constraints, "
        "singular configurations, kinks, chaos: a number, a limit and a remedy each. Ends with 1 if one is near.",
    )
    doctor.set_defaults(run=_doctor.run)
    doctor.add_argument("scene", metavar="FILE|NAME", help="as in `lgsens tradeoff`, or a suspension as in `optimize`")
    doctor.add_argument("--t1", type=positive, help="duration [s] (default: that of the scene, 1 of a suspension)")
    doctor.option("--dt", 1e-3, "step size [s]", type=positive)
    doctor.quiet("no progress bar")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0 success, 1 no feasible design or setting, 2 bad input."""
    arguments = _parsed(argv)
    try:
        return _run(arguments)
    except KeyboardInterrupt:
        return _interrupted(arguments)


def console() -> NoReturn:
    """`main` as a program of its own, which Ctrl-C ends at any moment.

    In the middle of a compilation two things are different: XLA's callbacks, of which Python drops every exception, and
    what is then destroyed on the way out, which ends in a segmentation fault.
    """
    sys.unraisablehook = _once_more
    arguments = _parsed()
    try:
        status = _run(arguments)
    except KeyboardInterrupt:
        _leave(_interrupted(arguments))  # here, where nothing has been destroyed yet
    if status == INTERRUPTED:
        _leave(status)
    sys.exit(status)


def _leave(status: int) -> NoReturn:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


def _once_more(unraisable: Any) -> None:
    if unraisable.exc_type is KeyboardInterrupt:
        threading.Timer(0.1, _thread.interrupt_main).start()  # by then the callback has returned
    else:
        sys.__unraisablehook__(unraisable)


def _parsed(argv: Sequence[str] | None = None) -> argparse.Namespace:
    # Names and units are not ASCII; a terminal that cannot show them gets a question mark, not an exception.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    return _parser().parse_args(argv)


def _run(arguments: argparse.Namespace) -> int:
    jax.config.update("jax_enable_x64", True)  # an application may; the library never does
    with contextlib.suppress(ValueError):  # where nothing can be kept, all is compiled each time
        compilation_cache()
    try:
        return arguments.run(arguments)
    except (ValueError, OSError, ImportError, SimulationError) as error:
        print(f"lgsens {arguments.command}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT


def _interrupted(arguments: argparse.Namespace) -> int:
    kept = any((vars(arguments).get("out", Path()) / name).is_file() for name in UNFINISHED)
    return interrupted(arguments.command, "what was found is kept" if kept else None)
