"""One run of the benchmark: builds the programs of a scene, measures them together, compares, and writes the JSON."""

import importlib
import importlib.metadata
import importlib.util
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import rival_lgsens
from benchmark import WHOLE_LOOPS, environment, write
from rival_scenes import SCENES, Scene
from rival_timing import measure

NEEDS = {"exudyn": "exudyn", "casadi": "casadi", "mujoco": "mujoco"}


def _read(path: Path) -> dict[str, Any]:
    what = "lgsens beside its rivals: one run of each scene, programs in turns, medians in seconds"
    empty = {"what": what, "references": {}, "scenes": {}}
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else empty


def find_references(scenes: Iterable[str], path: Path) -> None:
    """Compute the references of the scenes."""
    jax.config.update("jax_enable_x64", True)
    for name in scenes:
        scene = SCENES[name]()
        value, gradient = rival_lgsens.reference(scene)
        document = _read(path)
        document["references"][name] = {"p": scene.start.tolist(), "value": value, "gradient": gradient}
        write(path, document)


def run(
    scenes: Iterable[str],
    rivals: Iterable[str],
    kinds: Sequence[str] | None,
    repeats: int,
    path: Path,
) -> None:
    """Measure the scenes and write them to `path`, each as soon as it is done. `kinds`: None for all."""
    jax.config.update("jax_enable_x64", True)
    present = [name for name in rivals if importlib.util.find_spec(NEEDS.get(name, "jax")) is not None]
    for name in scenes:
        scene = SCENES[name]()
        found = _scene(scene, present, kinds, repeats)
        found["environment"] = environment(WHOLE_LOOPS)
        document = _read(path)
        document["scenes"][name] = found
        write(path, document)
        jax.clear_caches()


def _scene(scene: Scene, rivals: Iterable[str], kinds: Sequence[str] | None, repeats: int) -> dict[str, Any]:
    programs, failed = [], {}
    for name in ("lgsens", *rivals):
        try:
            mine = importlib.import_module(f"rival_{name}").programs(scene)
            mine = [program for program in mine if kinds is None or program.kind in kinds]
            for program in mine:
                print(f"{scene.name}: {name}, {program.kind}, {program.program}", flush=True)
                if program.prepare is not None:
                    program.prepare(program)
            programs += mine
        except Exception as error:  # a rival that fails does not cost the others their numbers
            failed[name] = type(error).__name__
            print(f"{scene.name}: {name} failed: {error}", flush=True)
    print(f"{scene.name}: {len(programs)} programs, {repeats} rounds", flush=True)
    records = measure(programs, repeats)
    return {
        "t1": scene.t1,
        "bodies": len(scene.bodies),
        "parameters": list(scene.names),
        "criterion": "integral of the square of " + " ".join(map(str, scene.observed)),
        "repeats": repeats,
        "failed": failed,
        "programs": records,
    }


def _compare(scene: Scene, records: list[dict[str, Any]], reference: dict[str, Any] | None) -> None:
    """Errors against the reference and ratios to lgsens's program of the same kind.

    Where there is no reference, and for gradients with respect to all numbers, the comparison is with lgsens.
    Errors of a gradient are relative to the largest effect of a relative change of a parameter.
    """
    if reference is not None and not np.array_equal(reference["p"], scene.start):
        reference = None  # one of other parameters
    own: dict[str, dict[str, Any]] = {}
    for record in records:
        if record["rival"] == "lgsens":
            own.setdefault(record["kind"], record)  # the first of a kind has the rivals' unknowns
    parts = {"gradient, p": slice(None), f"gradient, p, batch of {scene.batch}": slice(None)}
    parts |= {f"gradient, {name}": list(where) for name, where in scene.subsets}
    for record in records:
        kind, where = record["kind"], parts.get(record["kind"])
        lgsens = own.get(kind)
        for key in ("value_error", "value_difference_from_lgsens", "gradient_error", "gradient_difference_from_lgsens"):
            record.pop(key, None)
        if record["value"] is not None and reference is not None:
            record["value_error"] = abs(record["value"] / reference["value"] - 1)
        elif record["value"] is not None and lgsens is not None:
            record["value_difference_from_lgsens"] = abs(record["value"] / lgsens["value"] - 1)
        if record["gradient"] is not None and where is not None and reference is not None:
            wanted = np.asarray(reference["gradient"])[where]
            record["gradient_error"] = difference(record["gradient"], wanted, scene.scale[where])
        elif record["gradient"] is not None and lgsens is not None:
            wanted = np.asarray(lgsens["gradient"])
            scale = 1 / wanted if where is None else scene.scale[where]
            record["gradient_difference_from_lgsens"] = difference(record["gradient"], wanted, scale)
        if lgsens is not None:
            record["ratio_to_lgsens"] = record["seconds"] / lgsens["seconds"]
            record["cpu_ratio_to_lgsens"] = record["cpu_seconds"] / lgsens["cpu_seconds"]


def difference(found: list[float], wanted: np.ndarray, scale: np.ndarray) -> float:
    """Of two gradients, relative to the largest effect of a relative change of a parameter."""
    return float(np.max(np.abs((np.asarray(found) - wanted) * scale)) / np.max(np.abs(wanted * scale)))


def compare_again(path: Path) -> None:
    """Compare the numbers of the file with the references that it has by now."""
    document = _read(path)
    for name, found in document["scenes"].items():
        _compare(SCENES[name](), found["programs"], document["references"].get(name))
    write(path, document)
