"""`lgsens optimize quarter-car|FILE`: a suspension optimized, checked and drawn."""

import argparse

from lgsens import plotting
from lgsens.cli._optimize_axle import AxleJob
from lgsens.cli._optimize_quarter_car import QuarterCarJob
from lgsens.cli._report import (
    interrupted,
    output_folder,
    require_same,
    suspension_file,
    unfinished,
    write_json,
    written,
)
from lgsens.cli._search import TOLERANCE, at_accuracy, search, search_document
from lgsens.examples import suspension_document


def run(arguments: argparse.Namespace) -> int:
    """Optimize, write `result.json`, the best design's file and figures, print a table; 1 if none met the limits."""
    with output_folder(arguments.out, arguments.overwrite or arguments.resume) as out:
        plotting.figure()  # asks for matplotlib now, not after minutes
        checkpoint = unfinished(out, "search.npz", arguments.resume)
        settings = {name: value for name, value in vars(arguments).items() if name not in ("run", "command", "resume")}
        if arguments.resume:
            require_same(settings, out / "result.json")
        job = (AxleJob if arguments.vary else QuarterCarJob).of(arguments)
        if arguments.accuracy is not None:
            job, reached = at_accuracy(job, arguments.accuracy, progress=not arguments.quiet)
            settings |= {"dt": arguments.t1 / reached.num_steps, "error": reached.error}
        found = search(job, arguments.steps, checkpoint, progress=not arguments.quiet)
        outcome = job.outcome(found)
        document = outcome.document() | search_document(found, settings)
        write_json(document, out / "result.json", indent=2, default=str)
        file = suspension_document(suspension_file(arguments))
        write_json(outcome.suspension(file), out / "suspension.json", indent=2)
        figures = outcome.figures()
        objective = f"{found.goal.label} [{found.goal.shown}]"
        marked = {"tolerance": TOLERANCE, "best": found.result.step, "objective": objective}
        figures["convergence"] = plotting.convergence(found.result.history, **marked)
        for name, figure in figures.items():
            plotting.save(figure, out / f"{name}.png")
        if found.result.reason != "interrupted":
            checkpoint.unlink()
        names = ["result.json", "suspension.json", *(f"{name}.png" for name in figures)]
        if not arguments.quiet:
            print("\n".join(outcome.table(document)), written(out, names), sep="\n")
    if found.result.reason == "interrupted":
        return interrupted("optimize", f"this is the best of {len(found.result.history.objective)} designs so far")
    return 0 if found.result.feasible else 1
