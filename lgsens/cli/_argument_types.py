"""What arguments of the command line are: their text in, a value or argparse's error out."""

import argparse
import math
from collections.abc import Callable
from typing import Any


def _read(kind: Callable[[str], Any], text: str, what: str) -> Any:
    try:
        return kind(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"must be {what}, got {text!r}") from error


DEFAULT_PARAMETERS = "k,c"  # of a corner, a key of `PARAMETERS`


def positive(text: str) -> float:
    value = _read(float, text, "a number")
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"must be positive, got {text}")
    return value


def relative(text: str) -> float:
    value = positive(text)
    if value >= 1.0:
        raise argparse.ArgumentTypeError(f"must be less than 1, got {text}; it is relative")
    return value


def share(text: str) -> float:
    value = _read(float, text, "a number")
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"must be between 0 and 1, got {text}")
    return value


def way(text: str) -> float:
    value = positive(text)
    if value > 2.0:  # no wheel of a vehicle moves as far
        raise argparse.ArgumentTypeError(f"{value:g} m is more than wheels move; did you mean {value / 1e3:g}?")
    return value


def count(text: str) -> int:
    value = _read(int, text, "a whole number")
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {text}")
    return value


def named(text: str) -> tuple[str, float | tuple[float, float]]:
    """NAME=NUMBER or NAME=LOWER:UPPER."""
    name, _, bound = text.rpartition("=")
    try:
        low, *more = (float(end) for end in bound.split(":"))
    except ValueError:
        low, more = math.nan, []
    if not name or len(more) > 1 or not all(map(math.isfinite, (low, *more))):
        raise argparse.ArgumentTypeError(f"must be NAME=NUMBER or NAME=LOWER:UPPER, got {text!r}")
    return name, (low, more[0]) if more else low
