"""Speed or accuracy: the settings of `lgsens tradeoff` on the top and the quarter-car.

    python benchmarks/tradeoff.py [--scenes top quarter-car] [--cache FOLDER] [--out benchmarks/results]

Writes tradeoff_NAME.json and tradeoff_NAME.png, prints the tables, the recommendations, and those again as rows for
README. Most of the time is compilation: with `--cache` compiled programs are kept there, so that a second run
measures on a machine that is otherwise idle; it then keeps the compile times of the first one, which are in the files.
"""

import argparse
import json
import os
from pathlib import Path

from rivals import SINGLE_THREAD


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    parser.add_argument("--scenes", nargs="+", default=["top", "quarter-car"], help="(default: top quarter-car)")
    parser.add_argument("--rounds", type=int, default=5, help="timed calls (default: %(default)s)")
    parser.add_argument("--cache", help="folder for compiled programs (default: none)")
    parser.add_argument("--table", action="store_true", help="print the rows for README, measure nothing")
    arguments = parser.parse_args()
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    for name in arguments.scenes:
        path = arguments.out / f"tradeoff_{name.replace('-', '_')}.json"
        if not arguments.table:
            measure(name, path, arguments.rounds, arguments.cache)
        print("\n".join(markdown(json.loads(path.read_text(encoding="utf-8")))), end="\n\n")


def measure(name: str, path: Path, rounds: int, cache: str | None) -> None:
    """Measure a scene and write it to `path` and beside it."""
    import jax

    from lgsens import plotting
    from lgsens._cli_tradeoff import SCENES, TARGETS, document
    from lgsens.accuracy import plot, recommend, work_precision

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
    found = [recommend(table, target) for target in TARGETS]
    record = document(scene, table, found)
    for row in record["rows"]:
        row["compile_seconds"] = before.get((row["setting"], row["num_steps"]), row["compile_seconds"])
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
    plotting.save(plot(table, TARGETS, title=scene.title), path.with_suffix(".png"))
    print(table, *found, sep="\n\n")


def markdown(record: dict) -> list[str]:
    """The recommendations as rows of a table."""
    lines = []
    for found in record["recommendations"]:
        if found["row"] is None:
            lines.append(f"| {record['scene']} | {found['rtol']:.0e} | none | | | | |")
            continue
        row = record["rows"][found["row"]]
        errors = " | ".join(f"{row[key]:.0e}" for key in ("value_error", "gradient_error"))
        cells = f"`{row['setting']}` | {row['num_steps']} | {errors} | {1e3 * row['seconds']:.3g}"
        lines.append(f"| {record['scene']} | {found['rtol']:.0e} | {cells} |")
    return lines


if __name__ == "__main__":
    main()
