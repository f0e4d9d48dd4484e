"""What is gained where XLA makes functions of loops, README's "Small scenes on a CPU".

    python benchmarks/loops.py [--scenes top four_bar …] [--out benchmarks/results]
    python benchmarks/loops.py --readme       # the table of loops.json, into benchmarks/README.md; measures nothing

Each program runs in two processes, without and with the option, one after the other: 100 steps, from an initial state
that is computed with them; medians of 20 runs after a warm-up, processor time, one thread, compilation apart. JAX 0.12
makes functions of small loops unasked. Writes loops.json.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

from benchmark import SINGLE_THREAD, WHOLE_LOOPS, circumstances, environment, options, write
from compile_time import PROGRAMS, STEPS

SCENES = ("top", "four_bar", "reduced_car", "quarter_car", "chain_8")


def run(scene: str, program: str, settings: dict[str, str]) -> dict:
    command = [sys.executable, str(Path(__file__).with_name("compile_time.py")), "--one", scene, program]
    done = subprocess.run(command, env=os.environ | settings, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def markdown(document: dict) -> str:
    lines = [
        circumstances(document["environment"]),
        "",
        "| scene | program | µs per step | with the option | ratio | compile [s] | with the option [s] |",
        "|---" * 7 + "|",
    ]
    for scene, programs in document["scenes"].items():
        for program, (without, asked) in programs.items():
            times = [1e6 * found["run_seconds"] / STEPS for found in (without, asked)]
            cells = [f"{times[0]:.1f}", f"{times[1]:.1f}", f"{times[1] / times[0]:.2f}"]
            cells += [f"{found['seconds']:.1f}" for found in (without, asked)]
            lines.append("| " + " | ".join([scene, program, *cells]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = options(__doc__, repeats=False)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--readme", action="store_true", help="put the table of loops.json into benchmarks/README.md")
    arguments = parser.parse_args()
    path = arguments.out / "loops.json"
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"scenes": {}}
    if not arguments.readme:
        for scene in arguments.scenes:
            both = (SINGLE_THREAD, WHOLE_LOOPS)
            document["scenes"][scene] = {name: [run(scene, name, own) for own in both] for name in PROGRAMS}
            document["environment"] = environment(SINGLE_THREAD)
            write(path, document)
            print(scene, flush=True)
    text = markdown(document)
    if arguments.readme:
        from rival_tables import put_into

        put_into(Path(__file__).parent / "README.md", text, "loops")
    print(text)


if __name__ == "__main__":
    main()
