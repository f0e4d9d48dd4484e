"""What commands share: their folder, their files, what they say when they are interrupted."""

import contextlib
import json
import math
import platform
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from lgsens.dynamics import RESULTS
from lgsens.examples import DEFAULT
from lgsens.simulation import SimulationError

ANEW = "the same command with --overwrite begins anew"
UNFINISHED = "search.npz", "tradeoff.json"  # from which --resume goes on


@contextlib.contextmanager
def output_folder(out: Path, overwrite: bool) -> Iterator[Path]:
    """A new folder, or with `overwrite` one that may exist, and gone again after a failure."""
    if out.exists() and not out.is_dir():
        raise ValueError(f"output directory {str(out)!r} is a file: choose another --out DIR")
    if out.exists() and not overwrite:
        remedy = "choose another --out DIR, or give --overwrite to replace the files in it"
        raise ValueError(f"output directory {str(out)!r} exists already: {remedy}")
    created = not out.exists()
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=out):  # asks for the right to write now, and not after minutes
        pass
    try:
        yield out
    except BaseException:
        if created:
            with contextlib.suppress(OSError):
                out.rmdir()
        raise


@contextlib.contextmanager
def asking_for(amplitudes: Mapping[str, float]) -> Iterator[None]:
    """Where a position or an equilibrium is not found, the message names the options that say how far to go."""
    try:
        yield
    except (ValueError, SimulationError) as error:
        if not str(error).startswith((RESULTS.position_failed.message, RESULTS.statics_failed.message)):
            raise
        options = " or ".join(f"--{name} {value:g}" for name, value in amplitudes.items())
        raise ValueError(f"argument {options}: too much for this suspension, give less. {error}") from error


def suspension_file(arguments: Any) -> str:
    """The file or the name of the suspension that is asked for."""
    if arguments.hardpoints is not None and arguments.suspension != DEFAULT:
        raise ValueError(f"--hardpoints: {arguments.suspension!r} is a suspension already; leave one of them out")
    return arguments.hardpoints or arguments.suspension


def unfinished(out: Path, name: str, resume: bool) -> Path:
    """The file in a folder from which an interrupted command goes on. Raises `ValueError` where that has none."""
    path = out / name
    if resume and not path.is_file():
        raise ValueError(
            f"--resume: {str(path)!r}, from which to go on, is not there, as the command has come to its end or never "
            "began there; leave --resume out, and give --overwrite to begin anew in a folder that exists"
        )
    if not resume:
        path.unlink(missing_ok=True)
    return path


_MAY_CHANGE = "out", "overwrite", "quiet", "steps"


def require_same(options: Mapping[str, Any], result: Path) -> None:
    """Raise `ValueError` for options that the command which goes on had not when it was interrupted and wrote this."""
    kept = json.loads(result.read_text(encoding="utf-8")) if result.is_file() else {}
    if kept.get("history", {}).get("ended") != "interrupted":
        return
    for name, now in json.loads(json.dumps(options, default=str)).items():
        before = kept["settings"].get(name, now)
        chosen = name == "dt" and options.get("accuracy") is not None  # by that
        if before != now and not chosen and name not in _MAY_CHANGE:
            had, has = ("its default" if value is None else repr(value) for value in (before, now))
            raise ValueError(
                f"argument --{name.replace('_', '-')}: what --resume goes on with has {had}, not {has}; give "
                "the same options, or --overwrite in place of --resume to begin anew"
            )


INTERRUPTED = 130  # the exit status that shells have for it


def interrupted(command: str, found: str | None, remedy: str = "the same command with --resume goes on") -> int:
    """Say so, what there is and how to go on."""
    more = f": {found}; {remedy}" if found else " before anything was found"
    print(f"\nlgsens {command}: interrupted{more}", file=sys.stderr)
    return INTERRUPTED


def write_all(command: str, files: Mapping[str, Callable[[Path], Any]], out: Path) -> int:
    """Each file by the function that writes it; an interrupt leaves whole ones only. The exit status, 0: all."""
    for i, (name, write) in enumerate(files.items()):
        try:
            write(out / name)
        except KeyboardInterrupt:
            (out / name).unlink(missing_ok=True)
            if not i:
                raise
            return interrupted(command, f"{' and '.join(list(files)[:i])} written", ANEW)
    return 0


def version(distribution: str = "lgsens") -> str:
    """The version of an installed distribution; "unknown" for a source tree that is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "unknown"


def versions(*names: str) -> dict[str, str]:
    """The versions of Python, of the libraries that every command uses, and of those named."""
    found = {name: version(name) for name in ("lgsens", "jax", "jaxlib", *names, "numpy")}
    return {"python": platform.python_version()} | found


def finite(values: Any) -> Any:
    """A number or a list without NaN, which JSON does not have: null in its place."""
    if isinstance(values, list):
        return [finite(value) for value in values]
    return values if math.isfinite(values) else None


def write_json(document: dict[str, Any], path: Path, **layout: Any) -> None:
    """A document as a file of finite numbers; `layout`: settings of `json.dumps`."""
    path.write_text(json.dumps(document, allow_nan=False, **layout) + "\n", encoding="utf-8")


def written(out: Path, names: Iterable[str]) -> str:
    """What the last line says, of the files of these names."""
    return f"\nwritten to {out}: {', '.join(sorted(names))}"
