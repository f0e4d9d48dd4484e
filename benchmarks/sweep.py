"""Designs per second of a sweep against the size of its batches: the top and the quarter-car, value and gradient.

    python benchmarks/sweep.py [--scenes …] [--sizes …] [--devices 2] [--out benchmarks/results]

Each size is a compiled batch, which runs until `--designs` are done; medians of `--repeats` rounds after a warm-up,
compilation apart. `--devices 2` splits the processor into that many devices of JAX; `--accelerator` is one device that
JAX finds, with sizes of its own. Writes sweep.json, scene by scene, and prints a table.
"""

import json
import os
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from benchmark import WHOLE_LOOPS, circumstances, environment, grid, options, write
from tqdm import tqdm

import lgsens as lg
from lgsens.examples import QuarterCar, spinning_top
from lgsens.sweeps._batches import compile_batch, trace


class Scene(NamedTuple):
    """A criterion of one number, the numbers, the sizes of batches on a processor and on an accelerator."""

    criterion: Callable
    low: float
    high: float
    steps: int
    sizes: tuple[int, ...]
    on_accelerator: tuple[int, ...]


def top(angle):
    trajectory = lg.simulate(spinning_top(angle), t1=0.2, num_steps=200)
    return lg.time_integral(trajectory.t, trajectory.body("top").position[:, 0] ** 2)


def quarter_car(damping, steps: int = 100):
    car = eqx.tree_at(lambda car: car.damper.rate, QuarterCar.load(), damping)
    trajectory = lg.simulate(car.model(), t1=1e-3 * steps, num_steps=steps)
    return lg.time_integral(trajectory.t, trajectory.body("chassis").acceleration[:, 2] ** 2)


SCENES = {
    "top": Scene(top, 0.5, 1.0, 200, (1, 16, 64, 128, 256, 1024), (256, 8192)),
    "quarter_car": Scene(quarter_car, 2000.0, 8000.0, 100, (1, 16, 26, 128, 1024), (64, 1024, 8192)),
}


KINDS = {"value": lambda criterion: criterion, "value and gradient": jax.value_and_grad}
UNITS = {
    "designs/s": "designs_per_second",
    "µs per step": "us_per_step",
    "kB per design": "kilobytes_per_design",
    "compile [s]": "compile_seconds",
}


def measure(scene: Scene, kind: str, devices, repeats: int, total: int) -> list[dict]:
    """One row for each size of a batch, of so many designs."""
    traced = trace(KINDS[kind](scene.criterion), np.ones(1))
    rows = []
    for size in tqdm(scene.sizes, desc=kind, disable=None):
        if size < len(devices):
            continue
        program = compile_batch(traced, np.ones(size), size, size, devices)
        count = size * max(1, total // size)
        batches = np.linspace(scene.low, scene.high, count).reshape(size, -1).T  # those of a batch far apart
        seconds = []
        for _ in range(1 + repeats):
            started = time.perf_counter()
            ok = [program.run([designs])[1].all() for designs in batches]
            seconds.append(time.perf_counter() - started)
            assert all(ok)
        median = statistics.median(seconds[1:])
        rows.append(
            {
                "size": program.size,
                "designs": count,
                "designs_per_second": count / median,
                "us_per_step": 1e6 * median / count / scene.steps,
                "kilobytes_per_design": 1e-3 * program.memory * len(devices) / program.size,
                "compile_seconds": program.seconds,
                "seconds": seconds[1:],
            }
        )
    return rows


def table(scenes: dict) -> str:
    head = ("scene", "JAX", "on", "batch", *(f"{kind}: {unit}" for kind in KINDS for unit in UNITS))
    rows = []
    for scene in scenes.values():
        on = scene.get("accelerator") or f"{scene['devices']} of a CPU"
        where = scene["name"], scene["environment"]["versions"]["jax"], on
        for value, gradient in zip(*scene["rows"].values()):
            cells = [f"{row[key]:.3g}" for row in (value, gradient) for key in UNITS.values()]
            rows.append((*where, value["size"], *cells))
    notes = [f"{name}: {circumstances(scene['environment'])}" for name, scene in scenes.items()]
    return "\n".join([grid(" | ".join(head), rows), "", *notes])


def main() -> None:
    parser = options(__doc__)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--devices", type=int, default=1, help="devices of JAX on this processor")
    where.add_argument("--accelerator", action="store_true", help="the first device that JAX finds, not a processor")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--sizes", nargs="+", type=int, help="sizes of batches, in place of each scene's own")
    parser.add_argument("--designs", type=int, default=1024, help="designs of each row (default: %(default)s)")
    arguments = parser.parse_args()
    path = arguments.out / "sweep.json"
    scenes = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    settings = {}
    jax.config.update("jax_enable_x64", True)
    if not arguments.accelerator:
        settings = WHOLE_LOOPS | {"PJRT_NPROC": str(arguments.devices)}  # a thread for each
        os.environ.update(settings)  # before the first computation
        jax.config.update("jax_platforms", "cpu")
        jax.config.update("jax_num_cpu_devices", arguments.devices)
    elif jax.default_backend() == "cpu":
        parser.error("--accelerator: JAX finds none, only a CPU")
    devices = jax.devices()[: arguments.devices]
    accelerator = devices[0].device_kind if arguments.accelerator else None
    for name in arguments.scenes:
        scene = SCENES[name]
        sizes = arguments.sizes or (scene.on_accelerator if accelerator else scene.sizes)
        scene = scene._replace(sizes=tuple(sizes))
        kinds = {kind: measure(scene, kind, devices, arguments.repeats, arguments.designs) for kind in KINDS}
        scenes[f"{name}, {accelerator or f'{arguments.devices} device(s)'}, JAX {jax.__version__}"] = {
            "name": name,
            "devices": arguments.devices,
            "accelerator": accelerator,
            "environment": environment(settings),
            "rows": kinds,
        }
        write(path, scenes)
    print(table(scenes))


if __name__ == "__main__":
    main()
