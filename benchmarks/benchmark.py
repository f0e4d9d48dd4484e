"""What the benchmarks share: their options, how calls are timed, what is written beside the figures."""

import argparse
import datetime
import importlib.metadata
import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

PACKAGES = ("lgsens", "jax", "jaxlib", "numpy", "diffrax", "exudyn", "casadi", "mujoco")


def options(description: str | None, *, repeats: bool = True) -> argparse.ArgumentParser:
    """A parser with `--out` and, where something is timed in rounds, `--repeats`."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"), help="folder (default: %(default)s)")
    if repeats:
        parser.add_argument("--repeats", type=_rounds, default=5, help="rounds, at least 5 (default: %(default)s)")
    return parser


def _rounds(text: str) -> int:
    if (count := int(text)) < 5:
        raise argparse.ArgumentTypeError(f"must be at least 5, got {count}")
    return count


# before jax and numpy are imported; without YNN fusions of sums, as lgsens does it, for every rival in JAX
SINGLE_THREAD = {
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false --xla_cpu_experimental_ynn_fusion_type=-reduce",
    "PJRT_NPROC": "1",  # XLA's own pool: its threads wait for each other in small programs
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
# the same, and what lgsens asks of jaxlib 0.10 besides, for every rival in JAX: loops whose turns read less than 10 MB
# become functions, and kernels are emitted without an MLIR compiler for each (`lgsens._xla`)
ONE_FUNCTION = (
    "--xla_backend_extra_options=xla_cpu_disable_new_fusion_emitters=true,"
    "xla_cpu_small_while_loop_byte_threshold=10000000"
)
AS_JAX_COMES = "--xla_backend_extra_options=xla_lgsens=off"  # a choice that lgsens leaves alone
WHOLE_LOOPS = SINGLE_THREAD | {"XLA_FLAGS": f"{SINGLE_THREAD['XLA_FLAGS']} {ONE_FUNCTION}"}


class Times(NamedTuple):
    """Of each call the wall time and the processor time of the process, which other load changes less, in s."""

    wall: list[float]
    cpu: list[float]


def interleaved(calls: Mapping[Any, Callable[[], Any]], repeats: int, *, seconds: float = 0.0) -> dict[Any, Times]:
    """The times of calls that block and that have run before, in rounds in which each is called once.

    `seconds`: more rounds than `repeats`, until this time has passed.
    """
    found = {name: Times([], []) for name in calls}
    begun, rounds = time.perf_counter(), 0
    while rounds < repeats or time.perf_counter() - begun < seconds:
        for name, call in calls.items():
            started, cpu_started = time.perf_counter(), time.process_time()
            call()
            found[name].wall.append(time.perf_counter() - started)
            found[name].cpu.append(time.process_time() - cpu_started)
        rounds += 1
    return found


def grid(head: str, rows: Iterable[Iterable[Any]]) -> str:
    """A table in Markdown; `head`: the names of its columns, with bars between them."""
    line = lambda cells: "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"
    names = [name.strip() for name in head.split("|")]
    return "\n".join([line(names), "|---" * len(names) + "|", *map(line, rows)])


def environment(threads: Mapping[str, str] | None = None) -> dict[str, Any]:
    """When and where, with the versions of all packages."""
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
        "threads": dict(threads or {}),
        "load_average": round(os.getloadavg()[0], 1),
    }


def circumstances(found: Mapping[str, Any]) -> str:
    """A line of what `environment` found."""
    versions = ", ".join(f"{package} {version}" for package, version in found["versions"].items())
    machine, threads = found["machine"], found["threads"]
    count = threads.get("PJRT_NPROC", "1") if threads else None
    how = {None: "", "1": ", one thread"}.get(count, f", {count} threads")
    how += ", loops as functions" if ONE_FUNCTION in str(threads) else ""
    return (
        f"{found['date']}, {machine['architecture']}, {machine['cores']} cores, load average "
        f"{found['load_average']}{how}; {versions}."
    )


def write(path: Path, document: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
