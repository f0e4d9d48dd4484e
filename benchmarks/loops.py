"""What is gained by the options that lgsens gives XLA (loops as functions), and where XLA has one thread.

    python benchmarks/loops.py [--scenes top four_bar …] [--out benchmarks/results]

Each program runs in three processes, one after the other: as JAX comes, with the options of `lgsens._xla`, and with one
thread, too. 100 steps, from an initial state that is computed with them; medians of 20 runs after a warm-up, wall
time, compilation apart. JAX 0.12 makes functions of small loops unasked. Writes loops.json.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

from benchmark import AS_JAX_COMES, SINGLE_THREAD, circumstances, environment, options, write
from compile_time import PROGRAMS, STEPS

SETTINGS = {
    "as JAX comes": {"XLA_FLAGS": AS_JAX_COMES},
    "lgsens's options": {"XLA_FLAGS": ""},
    "one thread too": SINGLE_THREAD,
}
SCENES = ("top", "four_bar", "reduced_car", "quarter_car", "chain_8")


def run(scene: str, program: str, settings: dict[str, str]) -> dict:
    command = [sys.executable, str(Path(__file__).with_name("compile_time.py")), "--one", scene, program]
    done = subprocess.run(command, env=os.environ | settings, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def markdown(document: dict) -> str:
    first, *others = document["settings"]
    lines = [
        circumstances(document["environment"]),
        "",
        f"| scene | program | {first} [µs/step] | {' | ratio | '.join(others)} | ratio | compile [s] |",
        "|---" * 8 + "|",
    ]
    for scene, programs in document["scenes"].items():
        for program, runs in programs.items():
            first, *times = [1e6 * found["run_wall_seconds"] / STEPS for found in runs]
            cells = [scene, program, f"{first:.1f}"]
            for time in times:
                cells += [f"{time:.1f}", f"{time / first:.2f}"]
            cells.append(", ".join(f"{found['seconds']:.1f}" for found in runs))
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, repeats=False)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    arguments = parser.parse_args()
    path = arguments.out / "loops.json"
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if document.get("settings") != list(SETTINGS):
        document = {"settings": list(SETTINGS), "scenes": {}}
    for scene in arguments.scenes:
        document["scenes"][scene] = {name: [run(scene, name, own) for own in SETTINGS.values()] for name in PROGRAMS}
        document["environment"] = environment({})
        write(path, document)
        print(scene, flush=True)
    print(markdown(document))


if __name__ == "__main__":
    main()
