"""The console script `lgsens`: arguments in, an exit status out; 2 and one line on stderr for bad input."""

import argparse
import io
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import jax

from lgsens.cli import _curves, _optimize, _paper, _top, _tradeoff
from lgsens.cli._report import version
from lgsens.examples import PARAMETERS
from lgsens.simulation import SimulationError

BAD_INPUT = 2


class _Parser(argparse.ArgumentParser):
    """One line for bad arguments; argparse would print the usage as well."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def _add_out(parser: argparse.ArgumentParser, default: str, what: str) -> None:
    """`--out` and `--overwrite`."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(default),
        metavar="DIR",
        help=f"new folder for {what} (default: %(default)s)",
    )
    parser.add_argument("--overwrite", action="store_true", help="write into --out even if it exists")


def _positive(text: str) -> float:
    value = float(text)
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"must be positive, got {text}")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {text}")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = _Parser("lgsens", description="Differentiable constrained multibody dynamics on Lie groups in JAX.")
    parser.add_argument("--version", action="version", version=f"lgsens {version()}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    optimize = commands.add_parser(
        "optimize",
        help="optimize a suspension",
        description="Find the suspension whose chassis accelerates least over a bump, its tyre on the "
        "road and its spring within its travel (Sonneville & Brüls 2014, §9).",
    )
    optimize.add_argument("problem", choices=["quarter-car"], help="what to optimize")
    _add_out(optimize, "out/quarter-car", "result.json and the figures")
    optimize.add_argument(
        "--hardpoints",
        type=Path,
        metavar="FILE.toml",
        help="a suspension of your own (default: the one that ships with lgsens)",
    )
    optimize.add_argument(
        "--parameters",
        choices=list(PARAMETERS),
        default="k,c",
        help="what to change: stiffness k and damping c, chassis hardpoints, or all (default: %(default)s)",
    )
    optimize.add_argument("--t1", type=_positive, default=2.0, help="duration [s] (default: %(default)s)")
    optimize.add_argument("--dt", type=_positive, default=2e-3, help="step size [s] (default: %(default)s)")
    optimize.add_argument(
        "--steps", type=_count, default=300, help="most gradients that the optimizer takes (default: %(default)s)"
    )
    optimize.add_argument(
        "--wheel",
        choices=["hinged", "locked"],
        default="hinged",
        help="whether the wheel turns on its hinge (default: %(default)s)",
    )
    for angle in ("camber", "toe"):
        optimize.add_argument(
            f"--keep-{angle}",
            type=_positive,
            metavar="DEG",
            help=f"keep the {angle} curve within this of the one at the start [degree] (default: it may change)",
        )
    optimize.add_argument(
        "--travel",
        type=_positive,
        default=0.05,
        metavar="M",
        help="wheel travel up and down over which curves are kept and drawn [m] (default: %(default)s)",
    )
    optimize.add_argument("--quiet", action="store_true", help="no progress bar and no table")
    optimize.set_defaults(run=_optimize.run)

    curves = commands.add_parser(
        "curves",
        help="draw the curves of a suspension",
        description="Camber, toe, track, wheelbase, motion ratio and roll centre of a suspension over wheel travel: a "
        "figure, a table, and a page on which it moves.",
    )
    curves.add_argument("suspension", choices=["quarter-car"], help="which suspension")
    _add_out(curves, "out/curves", "curves.png, curves.csv and travel.html")
    curves.add_argument(
        "--hardpoints",
        type=Path,
        metavar="FILE.toml",
        help="a suspension of your own (default: the one that ships with lgsens)",
    )
    curves.add_argument("--axle", choices=["rear", "front"], default="rear", help="(default: %(default)s)")
    curves.add_argument(
        "--travel", type=_positive, default=0.08, metavar="M", help="up and down [m] (default: %(default)s)"
    )
    curves.add_argument("--points", type=_count, default=41, help="positions (default: %(default)s)")
    curves.add_argument("--quiet", action="store_true", help="no table")
    curves.set_defaults(run=_curves.run)

    top = commands.add_parser(
        "top",
        help="differentiate the spinning top",
        description="The sensitivity of the paper's spinning top (§8) by every method, beside its reference.",
    )
    top.add_argument("--h", type=_positive, default=1e-3, help="step size [s] (default: %(default)s)")
    top.set_defaults(run=_top.run)

    paper = commands.add_parser(
        "paper",
        help="reproduce the paper's convergence figures",
        description="Errors of sensitivities against the step size by all four methods, beside references from an "
        "independent integrator: the spinning top (Sonneville & Brüls 2014, Fig. 2) and the quarter-car (Fig. 4). "
        "Most of the ten minutes is compilation.",
    )
    _add_out(paper, "out/paper", "paper.json and the figures")
    paper.add_argument("--only", choices=list(_paper.STUDIES), help="one of the figures (default: all)")
    paper.add_argument("--coarse", action="store_true", help="two large steps instead of four or five: a quick look")
    paper.add_argument("--quiet", action="store_true", help="no progress bar and no tables")
    paper.set_defaults(run=_paper.run)

    tradeoff = commands.add_parser(
        "tradeoff",
        help="measure speed against accuracy",
        description="What settings of the simulation cost on a scene, what they lose of a criterion and of its "
        "gradient, and the cheapest for each target. A program is compiled for every setting: minutes.",
    )
    tradeoff.add_argument(
        "scene",
        metavar="SCENE",
        help=f"{', '.join(_tradeoff.SCENES)}, or FILE.py that defines `build(p)`, `criterion(trajectory)`, "
        "`parameters` and `t1`, and if it likes `settings`, `scale` and `t0`, as in lgsens.accuracy.work_precision",
    )
    _add_out(tradeoff, "out/tradeoff", "tradeoff.json and tradeoff.png")
    tradeoff.add_argument(
        "--targets",
        type=_positive,
        nargs="+",
        default=list(_tradeoff.TARGETS),
        help="relative errors for which to recommend a setting (default: 1e-2 1e-4 1e-6 1e-8)",
    )
    tradeoff.add_argument("--rounds", type=_count, default=5, help="timed calls, at least 5 (default: %(default)s)")
    tradeoff.add_argument(
        "--by",
        choices=["seconds", "cpu_seconds"],
        default="seconds",
        help="the cost: time of the clock or of the processor (default: %(default)s)",
    )
    tradeoff.add_argument("--quiet", action="store_true", help="no progress bar and no table")
    tradeoff.set_defaults(run=_tradeoff.run)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status: 0 success, 1 no feasible design or setting, 2 bad input."""
    # Names and units are not ASCII; a terminal that cannot show them gets a question mark, not an exception.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    arguments = _parser().parse_args(argv)
    jax.config.update("jax_enable_x64", True)  # an application may; the library never does
    try:
        return arguments.run(arguments)
    except (ValueError, OSError, ImportError, SimulationError) as error:
        print(f"lgsens {arguments.command}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
