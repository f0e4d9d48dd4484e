"""The extremes: each is right to a bound that is derived, or fails with a message; value and both derivatives.

    python benchmarks/extremes.py [--only NAME …] [--out benchmarks/results]

Prints a table (extreme, bound and why, measured, verdict) and writes it to extremes.json. The bounds and the references
(closed forms, SciPy, a Runge-Kutta scheme, differences) are in extremes_rotation.py, extremes_scales.py,
extremes_forces.py, extremes_elements.py and extremes_long.py; tests/extremes asks for the same rows. Some minutes. Ends
with 1 if a row is wrong.
"""

import argparse
import dataclasses
import json
import os
import platform
import sys
import time
from functools import partial
from pathlib import Path

import extremes_elements
import extremes_failures
import extremes_forces
import extremes_long
import extremes_rotation
import extremes_scales
import jax
import numpy as np

EXTREMES = {
    "rotation": extremes_rotation.rotation_per_step,
    "spin": extremes_rotation.fast_spin,
    **{f"steps_{rho:g}": partial(extremes_scales.step_sizes, rho) for rho in extremes_scales.DAMPINGS},
    "masses": extremes_scales.mass_ratios,
    "units": extremes_scales.units,
    "stiffness": extremes_forces.stiffness,
    "damping": extremes_forces.damping,
    "no_length": extremes_forces.no_length,
    "nothing": extremes_forces.nothing,
    "friction": extremes_forces.friction,
    "schemes": extremes_elements.schemes,
    "drivers": extremes_elements.drivers,
    "rolling": extremes_elements.rolling,
    "states": extremes_elements.states,
    "curves": extremes_elements.curves,
    "stops": extremes_elements.stops,
    "failures": extremes_failures.failures,
    "free_body": extremes_long.free_body,
    "reverse": extremes_long.reverse,
    "chaos": extremes_long.chaos,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only",
        nargs="+",
        choices=EXTREMES,
        metavar="NAME",
        help=f"the others stay as they are in the file; among {', '.join(EXTREMES)}",
    )
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    arguments = parser.parse_args()
    # before the first computation: else batched LAPACK of JAX 0.10 may wait for ever
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    jax.config.update("jax_enable_x64", True)
    file, chosen = arguments.out / "extremes.json", arguments.only or list(EXTREMES)
    kept = json.loads(file.read_text(encoding="utf-8"))["rows"] if arguments.only and file.exists() else []
    found = [row for row in kept if row["group"] not in chosen]
    print("| extreme | of what | bound | measured | verdict | why |\n|---|---|---|---|---|---|")
    for name in chosen:
        started = time.perf_counter()
        for row in EXTREMES[name]():
            numbers = f"{row.bound:.1e} | {row.measured:.1e}"
            print(f"| {row.extreme} | {row.measures} | {numbers} | {row.verdict} | {row.why} |", flush=True)
            found.append({"group": name} | dataclasses.asdict(row) | {"verdict": row.verdict})
        print(f"{name}: {time.perf_counter() - started:.0f} s with compilation", file=sys.stderr)
        jax.clear_caches()
    versions = {"python": platform.python_version(), "jax": jax.__version__, "numpy": np.__version__}
    machine = versions | {"processor": platform.machine(), "backend": jax.default_backend(), "cores": os.cpu_count()}
    arguments.out.mkdir(parents=True, exist_ok=True)
    found.sort(key=lambda row: list(EXTREMES).index(row["group"]))
    text = json.dumps({"machine": machine, "rows": found}, indent=1, ensure_ascii=False)
    file.write_text(text + "\n", encoding="utf-8")
    sys.exit(any(row["verdict"] == "WRONG" for row in found))


if __name__ == "__main__":
    main()
