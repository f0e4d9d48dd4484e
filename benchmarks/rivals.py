"""lgsens beside its rivals: the same scenes and criteria, in one process, round by round.

    python benchmarks/rivals.py [--scenes top quarter_car …] [--rivals plain_jax exudyn …] [--out benchmarks/results]
    python benchmarks/rivals.py --references       # Ψ and its gradient of the motion itself, once for each scene
    python benchmarks/rivals.py --table            # the last run's tables as Markdown; measures nothing

The rivals are in benchmarks/requirements.txt; one that is not installed is left out. Every program is compiled or built
and called once; then the programs take turns, `--repeats` rounds, and medians count. All of them run on one thread,
those of JAX with loops as functions (`benchmark.WHOLE_LOOPS`). Ψ and its gradients are compared with the index-reduced
equations at a tolerance of 1e-12 where `--references` has been run, else with lgsens, so that nobody measures other
work. Writes rivals.json (scenes that are not run keep their numbers there) and prints the tables.

"equal step": the step of lgsens. "equal accuracy": steps that reach at least lgsens's accuracy in Ψ.
"""

import importlib
import json
import os

from benchmark import WHOLE_LOOPS, options

SCENES = ("top", "quarter_car", "stiff_quarter_car", *(f"chain_{n}" for n in (2, 8, 32, 128, 512)))
RIVALS = ("plain_jax", "exudyn", "casadi", "diffrax", "mujoco")


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=["top", "quarter_car"])
    parser.add_argument("--rivals", nargs="*", choices=RIVALS, default=list(RIVALS))
    parser.add_argument("--kinds", nargs="+", help="only this work, e.g. forward 'gradient, p' (default: all)")
    parser.add_argument("--references", action="store_true", help="compute the references of the scenes and compare")
    parser.add_argument("--table", action="store_true", help="print the tables of rivals.json, measure nothing")
    arguments = parser.parse_args()
    path = arguments.out / "rivals.json"
    os.environ.update(WHOLE_LOOPS)  # before jax and numpy are imported
    tables = importlib.import_module("rival_tables")
    if not arguments.table:
        run = importlib.import_module("rival_run")
        if arguments.references:
            run.find_references(arguments.scenes, path)
        else:
            run.run(arguments.scenes, arguments.rivals, arguments.kinds, arguments.repeats, path)
        run.compare_again(path)
    print(tables.markdown(json.loads(path.read_text(encoding="utf-8"))))


if __name__ == "__main__":
    main()
