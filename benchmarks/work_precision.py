"""Work against precision: Ψ and its gradient on the quarter-car, by lgsens and by its rivals.

    python benchmarks/work_precision.py [--scenes quarter_car …] [--cache FOLDER] [--out benchmarks/results]
    python benchmarks/work_precision.py --table     # table and plot again, from work_precision.json; measures nothing

The gradient is that of Ψ₀ with respect to stiffness, damping and the 30 coordinates of the hardpoints. Each family of
programs runs at several numbers of steps or tolerances; its error is that of the gradient against the motion itself
(the references of `rivals.py --references`), relative to the largest effect of a relative change of a parameter. For
each error asked for, the fastest program of a family that reaches it stands in the table. All of a scene run in one
process on one thread and take turns, `--repeats` rounds; medians count, compilation apart. Compiling takes many
minutes: `--cache` keeps compiled programs in a folder, so that a run that was ended goes on.
"""

import importlib
import json
import multiprocessing
import os

from benchmark import SINGLE_THREAD, options

SCENES = ("quarter_car", "stiff_quarter_car")


def measure(scene: str, *settings) -> None:
    importlib.import_module("precision_run").run([scene], *settings)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--families", nargs="+", help="only these families of programs, lgsens's always (default: all)")
    parser.add_argument("--cache", help="folder for compiled programs (default: none)")
    parser.add_argument("--table", action="store_true", help="print the table, draw the plot, measure nothing")
    arguments = parser.parse_args()
    path = arguments.out / "work_precision.json"
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    if not arguments.table:
        for scene in arguments.scenes:  # a process has memory maps for the programs of one of them
            process = multiprocessing.get_context("spawn").Process(
                target=measure, args=(scene, arguments.families, arguments.repeats, path, arguments.cache)
            )
            process.start()
            process.join()
            if process.exitcode:
                raise SystemExit(f"The measurement of {scene} ended with {process.exitcode}.")
    tables = importlib.import_module("precision_tables")
    document = json.loads(path.read_text(encoding="utf-8"))
    print(tables.markdown(document))
    for name in document["scenes"]:
        tables.plot(document["scenes"][name], arguments.out / f"work_precision_{name}.png")


if __name__ == "__main__":
    main()
