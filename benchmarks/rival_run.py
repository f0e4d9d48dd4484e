"""One run of the benchmark: builds the programs of a scene, measures them together, compares, and writes the JSON."""

import datetime
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import rival_lgsens
from rival_scenes import SCENES, Scene
from rival_timing import measure

PACKAGES = ("lgsens", "jax", "jaxlib", "numpy", "diffrax", "exudyn", "casadi", "mujoco")
LARGEST_REFERENCE = 8  # bodies
NEEDS = {"exudyn": "exudyn", "casadi": "casadi", "mujoco": "mujoco"}


def run(scenes: Iterable[str], rivals: Iterable[str], repeats: int, path: Path, settings: Mapping[str, str]) -> None:
    """Measure the scenes and write them to `path`, each as soon as it is done."""
    jax.config.update("jax_enable_x64", True)
    document = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"scenes": {}}
    document["what"] = "lgsens beside its rivals: one run of each scene, programs in turns, medians in seconds"
    present = [name for name in rivals if importlib.util.find_spec(NEEDS.get(name, "jax")) is not None]
    for name in scenes:
        scene = SCENES[name]()
        found = _scene(scene, present, repeats)
        found["environment"] = _environment(settings)
        document["scenes"][name] = found
        path.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        jax.clear_caches()


def _environment(settings: Mapping[str, str]) -> dict[str, Any]:
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "versions": versions,
        "machine": {"architecture": platform.machine(), "system": platform.system(), "cores": os.cpu_count()},
        "threads": dict(settings),
        "load_average": round(os.getloadavg()[0], 1),
    }


def _scene(scene: Scene, rivals: Iterable[str], repeats: int) -> dict[str, Any]:
    print(f"{scene.name}: reference", flush=True)
    # of a long chain the reference would take longer than all the rest
    value, gradient = rival_lgsens.reference(scene) if len(scene.bodies) <= LARGEST_REFERENCE else (None, None)
    jax.clear_caches()
    programs = []
    for name in ("lgsens", *rivals):
        print(f"{scene.name}: {name} is built", flush=True)
        programs += importlib.import_module(f"rival_{name}").programs(scene)
    print(f"{scene.name}: {len(programs)} programs, {repeats} rounds", flush=True)
    records = measure(programs, repeats)
    _compare(scene, records, value, gradient)
    return {
        "t1": scene.t1,
        "bodies": len(scene.bodies),
        "parameters": list(scene.names),
        "criterion": "integral of the square of " + " ".join(map(str, scene.observed)),
        "repeats": repeats,
        "reference": {"value": value, "gradient": gradient},
        "programs": records,
    }


def _compare(scene: Scene, records: list[dict[str, Any]], value: float | None, gradient: list[float] | None) -> None:
    """Errors against the reference and ratios to lgsens's program of the same kind.

    Where there is no reference (gradients with respect to all numbers, long chains) the comparison is with lgsens.
    Errors of a gradient are relative to the largest effect of a relative change of a parameter.
    """
    own = {record["kind"]: record for record in records if record["rival"] == "lgsens"}
    parts = {"gradient, p": slice(None), f"gradient, p, batch of {scene.batch}": slice(None)}
    parts |= {f"gradient, {name}": list(where) for name, where in scene.subsets}
    for record in records:
        kind = record["kind"]
        lgsens = own.get(kind)
        if record["value"] is not None and value is not None:
            record["value_error"] = abs(record["value"] / value - 1)
        elif record["value"] is not None and lgsens is not None:
            record["value_difference_from_lgsens"] = abs(record["value"] / lgsens["value"] - 1)
        if record["gradient"] is not None:
            found = np.array(record["gradient"])
            if kind in parts and gradient is not None:
                wanted, scale = np.asarray(gradient)[parts[kind]], scene.scale[parts[kind]]
                worst = np.max(np.abs((found - wanted) * scale))
                record["gradient_error"] = float(worst / np.max(np.abs(wanted * scale)))
            elif lgsens is not None:
                wanted = np.array(lgsens["gradient"])
                record["gradient_difference_from_lgsens"] = float(np.max(np.abs(found / wanted - 1)))
        if lgsens is not None:
            record["ratio_to_lgsens"] = record["seconds"] / lgsens["seconds"]
            record["cpu_ratio_to_lgsens"] = record["cpu_seconds"] / lgsens["cpu_seconds"]
