"""Speed or accuracy: the settings of `lgsens tradeoff` on the top and the quarter-car.

    python benchmarks/tradeoff.py [--scenes top quarter-car …] [--cache FOLDER] [--out benchmarks/results]
    python benchmarks/tradeoff.py --check [--scenes quarter-car …]   # with benchmarks/requirements.txt installed

Writes tradeoff_NAME.json and tradeoff_NAME.png, prints the tables and the recommendations. Most of the time is
compilation: with `--cache` compiled programs are kept there, so that a second run measures on a machine that is
otherwise idle; it then keeps the compile times of the first one, which are in the files.

`--check` compares what was recommended, for the quarter-cars, with Ψ and dΨ/dp of another program: the equations of
motion written by hand in CasADi (`rival_casadi.py`), RK4 in generated C and its adjoint, in as many steps as leave it
errors far below the least target.
"""

import argparse
import json
import os
from pathlib import Path

from benchmark import SINGLE_THREAD

CHECK = {"quarter-car": 4000, "stiff-quarter-car": 20_000}  # steps of RK4: 160 leave 2e-5, so 4000 leave 5e-11


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    parser.add_argument("--scenes", nargs="+", default=["top", "quarter-car"], help="(default: top quarter-car)")
    parser.add_argument("--rounds", type=int, default=5, help="timed calls (default: %(default)s)")
    parser.add_argument("--cache", help="folder for compiled programs (default: none)")
    parser.add_argument("--by", default="cpu_seconds", help="what a setting costs (default: %(default)s)")
    parser.add_argument("--check", action="store_true", help="compare recommendations with CasADi, measure nothing")
    parser.add_argument("--table", action="store_true", help="recommend and draw again from the JSON, measure nothing")
    arguments = parser.parse_args()
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    for name in arguments.scenes:
        path = arguments.out / f"tradeoff_{name.replace('-', '_')}.json"
        if arguments.check:
            check(name, path)
            continue
        if not arguments.table:
            measure(name, path, arguments.rounds, arguments.cache)
        report(path, arguments.by)


def measure(name: str, path: Path, rounds: int, cache: str | None) -> None:
    """Measure a scene and write it to `path`."""
    import jax

    from lgsens.accuracy import work_precision
    from lgsens.cli._tradeoff import SCENES, document

    jax.config.update("jax_enable_x64", True)
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    before = {}
    if cache is not None and path.exists():
        rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
        before = {(row["setting"], row["num_steps"]): row["compile_seconds"] for row in rows}
    scene = SCENES[name]()
    table = work_precision(
        *(scene.criterion, scene.build, scene.parameters, scene.settings), t0=scene.t0, t1=scene.t1, rounds=rounds
    )
    record = document(scene, table, [])
    for row in record["rows"]:
        row["compile_seconds"] = before.get((row["setting"], row["num_steps"]), row["compile_seconds"])
    path.parent.mkdir(parents=True, exist_ok=True)
    write(record, path)


def check(name: str, path: Path) -> None:
    """Compare the recommended rows with an independent program; into the file too."""
    import jax
    import numpy as np
    import rival_casadi
    from rival_scenes import SCENES

    jax.config.update("jax_enable_x64", True)
    record, scene = json.loads(path.read_text(encoding="utf-8")), SCENES[name.replace("-", "_")]()
    programs = rival_casadi.programs(scene, {CHECK[name]: ""})
    value, gradient = next(program for program in programs if program.kind == "gradient, p").call()
    # there: stiffness, damping, hardpoints of chassis and knuckle; here: damping, hardpoints of the chassis, stiffness
    p = record["parameters"]
    sizes = {key: np.max(np.abs(p[key])) for key in p}
    parts = {"damping": gradient[1:2], "hardpoints": gradient[2:17], "stiffness": gradient[:1]}
    wanted = np.concatenate([sizes[key] * parts[key] for key in sorted(p)])

    def errors(found) -> dict:
        slopes = np.abs(np.asarray(found["gradient"]) - wanted).max() / np.abs(wanted).max()
        return {"value_error": float(abs(found["value"] / value - 1)), "gradient_error": float(slopes)}

    rows = [(one["rtol"], record["rows"][one["row"]]) for one in record["recommendations"]]
    found = [
        {"rtol": rtol, "setting": row["setting"], "num_steps": row["num_steps"]} | errors(row) for rtol, row in rows
    ]
    record["check"] = {"steps": CHECK[name], "value": value, "reference": errors(record["reference"]), "rows": found}
    write(record, path)
    print(f"{record['scene']}: reference and RK4 in {CHECK[name]} steps differ by", record["check"]["reference"])
    for row in found:
        print(row, "meets it" if max(row["value_error"], row["gradient_error"]) <= row["rtol"] else "MISSES IT")


def write(record: dict, path: Path) -> None:
    text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def report(path: Path, by: str) -> None:
    """Recommend, write that too, draw, and print everything."""
    from lgsens import plotting
    from lgsens.accuracy import Table, plot, recommend
    from lgsens.cli._tradeoff import TARGETS, recommendations

    record = json.loads(path.read_text(encoding="utf-8"))
    table = Table.from_document(record)
    found = [recommend(table, target, by=by) for target in TARGETS]
    write(record | {"by": by, "recommendations": recommendations(table, found)}, path)
    plotting.save(plot(table, TARGETS, by=by, title=record["scene"]), path.with_suffix(".png"))
    print(table, *found, sep="\n\n")


if __name__ == "__main__":
    main()
