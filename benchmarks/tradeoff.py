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
    parser.add_argument("--by", default="cpu_seconds", help="what a setting costs (default: %(default)s)")
    parser.add_argument("--table", action="store_true", help="recommend and draw again from the JSON, measure nothing")
    arguments = parser.parse_args()
    os.environ.update(SINGLE_THREAD)  # before jax and numpy are imported
    for name in arguments.scenes:
        path = arguments.out / f"tradeoff_{name.replace('-', '_')}.json"
        if not arguments.table:
            measure(name, path, arguments.rounds, arguments.cache)
        report(path, arguments.by)


def measure(name: str, path: Path, rounds: int, cache: str | None) -> None:
    """Measure a scene and write it to `path`."""
    import jax

    from lgsens._cli_tradeoff import SCENES, document
    from lgsens.accuracy import work_precision

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


def write(record: dict, path: Path) -> None:
    text = json.dumps(record, indent=1, ensure_ascii=False, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def report(path: Path, by: str) -> None:
    """Recommend, write that too, draw, and print everything."""
    from lgsens import plotting
    from lgsens._cli_tradeoff import TARGETS, recommendations
    from lgsens.accuracy import Table, plot, recommend

    record = json.loads(path.read_text(encoding="utf-8"))
    table = Table.from_document(record)
    found = [recommend(table, target, by=by) for target in TARGETS]
    write(record | {"by": by, "recommendations": recommendations(table, found)}, path)
    plotting.save(plot(table, TARGETS, by=by, title=record["scene"]), path.with_suffix(".png"))
    print(table, *found, sep="\n\n", end="\n\n")
    for one in found:
        if one.row is None:
            print(f"| {record['scene']} | {one.rtol:.0e} | none | | | | |")
            continue
        row = one.row
        cells = (record["scene"], f"{one.rtol:.0e}", f"`{row.setting.label}`", str(row.setting.num_steps))
        numbers = (f"{row.value_error:.0e}", f"{row.gradient_error:.0e}", f"{1e3 * getattr(row, by):.3g}")
        print(f"| {' | '.join((*cells, *numbers))} |")


if __name__ == "__main__":
    main()
