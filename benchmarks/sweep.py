"""Designs per second of a sweep against the size of its batches: the top and the quarter-car, value and gradient.

`python benchmarks/sweep.py` writes benchmarks/results/sweep.json, scene by scene, and prints the table of
benchmarks/README.md. Each size is a compiled batch, run `REPEATS` times after a warm-up; medians, compilation apart.
`--devices 2` splits the processor into that many devices of JAX.
"""

import argparse
import importlib.metadata
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from tqdm import tqdm

import lgsens as lg
from lgsens._batches import compile_batch, trace
from lgsens.examples import QuarterCar, spinning_top

RESULTS = Path(__file__).parent / "results" / "sweep.json"
REPEATS = 5


class Scene(NamedTuple):
    """A criterion of one number, the numbers, the sizes of batches."""

    criterion: Callable
    low: float
    high: float
    steps: int
    sizes: tuple[int, ...]


def top(angle):
    trajectory = lg.simulate(spinning_top(angle), t1=0.2, num_steps=200)
    return lg.time_integral(trajectory.t, trajectory.body("top").position[:, 0] ** 2)


def quarter_car(damping):
    car = eqx.tree_at(lambda car: car.damper.rate, QuarterCar.load(), damping)
    trajectory = lg.simulate(car.model(), t1=0.1, num_steps=100)
    return lg.time_integral(trajectory.t, trajectory.body("chassis").acceleration[:, 2] ** 2)


SCENES = {
    "top": Scene(top, 0.5, 1.0, 200, (1, 16, 64, 128, 256, 1024)),
    "quarter_car": Scene(quarter_car, 2000.0, 8000.0, 100, (1, 16, 64, 128)),
}


KINDS = {"value": lambda criterion: criterion, "value and gradient": jax.value_and_grad}
UNITS = {"designs/s": "designs_per_second", "µs per step": "us_per_step", "kB per design": "kilobytes_per_design"}


def measure(scene: Scene, kind: str, devices) -> list[dict]:
    """One row for each size of a batch."""
    traced = trace(KINDS[kind](scene.criterion), np.ones(1))
    rows = []
    for size in tqdm(scene.sizes, desc=kind, disable=None):
        if size < len(devices):
            continue
        program = compile_batch(traced, np.ones(size), size, size, devices)
        designs = [np.linspace(scene.low, scene.high, program.size)]
        seconds = []
        for _ in range(1 + REPEATS):
            started = time.perf_counter()
            _, ok = program.run(designs)
            seconds.append(time.perf_counter() - started)
            assert ok.all()
        median = statistics.median(seconds[1:])
        rows.append(
            {
                "size": program.size,
                "designs_per_second": program.size / median,
                "us_per_step": 1e6 * median / program.size / scene.steps,
                "kilobytes_per_design": 1e-3 * program.memory * len(devices) / program.size,
                "compile_seconds": program.seconds,
                "seconds": seconds[1:],
            }
        )
    return rows


def table(scenes: dict) -> str:
    head = ("scene", "devices", "batch", *(f"{kind}: {unit}" for kind in KINDS for unit in UNITS))
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for scene in scenes.values():
        for value, gradient in zip(*scene["rows"].values()):
            cells = [f"{row[key]:.3g}" for row in (value, gradient) for key in UNITS.values()]
            lines.append(f"| {scene['name']} | {scene['devices']} | {value['size']} | {' | '.join(cells)} |")
    notes = [
        f"{scene['name']}, devices: {scene['devices']}: {scene['date']}, {scene['machine']}, {scene['cores']} cores, "
        f"load average {scene['load']:.1f}; jax {scene['jax']}, lgsens {scene['lgsens']}."
        for scene in scenes.values()
    ]
    return "\n".join([*lines, "", *notes])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--devices", type=int, default=1, help="devices of JAX on this processor")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--sizes", nargs="+", type=int, help="sizes of batches, in place of each scene's own")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", options.devices)
    scenes = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    for name in options.scenes:
        scene = SCENES[name]
        if options.sizes:
            scene = scene._replace(sizes=tuple(options.sizes))
        scenes[f"{name}, {options.devices}"] = {
            "name": name,
            "date": time.strftime("%Y-%m-%d"),
            "machine": platform.machine(),
            "cores": os.cpu_count(),
            "devices": options.devices,
            "load": os.getloadavg()[0],
            "python": platform.python_version(),
            **{package: importlib.metadata.version(package) for package in ("lgsens", "jax", "jaxlib", "numpy")},
            "repeats": REPEATS,
            "rows": {kind: measure(scene, kind, jax.devices()) for kind in KINDS},
        }
        RESULTS.write_text(json.dumps(scenes, indent=1), encoding="utf-8")
    print(table(scenes))


if __name__ == "__main__":
    main()
