"""Reads hardpoint files, and says which key is missing or wrong."""

import math
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

from jaxtyping import Array

from lgsens._validate import as_float
from lgsens.model import RigidBody


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _are_numbers(value: Any, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(_is_number, value))


class Reader:
    """Reads keys of a TOML document, and says which one is missing or wrong."""

    def __init__(self, table: dict, path: str, keys: tuple[str, ...] = ()):
        self._table, self._path, self._keys = table, path, keys

    def _fail(self, key: str, why: str) -> ValueError:
        return ValueError(f"Hardpoint file {self._path!r}, key {'.'.join((*self._keys, key))!r}: {why}")

    def _get(self, key: str, holds: Callable[[Any], bool], what: str) -> Any:
        if key not in self._table:
            raise self._fail(key, "is missing; see lgsens/examples/data/five_link_suspension.toml for the format.")
        value = self._table[key]
        if not holds(value):
            raise self._fail(key, f"must be {what}, got {value!r}.")
        return value

    def table(self, key: str) -> "Reader":
        value = self._get(key, lambda value: isinstance(value, dict), "a table")
        return Reader(value, self._path, (*self._keys, key))

    def names(self) -> list[str]:
        return list(self._table)

    def number(self, key: str, scale: float = 1.0, positive: bool = True) -> Array:
        value = self._get(key, _is_number, "a finite number")
        if positive:
            self._get(key, lambda value: value > 0, "positive")
        return as_float(value * scale, (), key)

    def vector(self, key: str, scale: float = 1.0) -> Array:
        value = self._get(key, lambda value: _are_numbers(value, 3), "three numbers [x, y, z]")
        return as_float([x * scale for x in value], (3,), key)

    def segment(self, first: str, second: str, scale: float) -> tuple[Array, Array]:
        """Two points that differ."""
        if self.vector(first).tolist() == self.vector(second).tolist():
            raise self._fail(second, f"must differ from {first!r}; the two points coincide.")
        return self.vector(first, scale), self.vector(second, scale)

    def moments(self, key: str) -> Array:
        """Principal moments of inertia that a body can have."""
        value = self.vector(key)
        try:
            RigidBody(mass=1.0, inertia=value)
        except ValueError as error:
            raise self._fail(key, str(error)) from error
        return value

    def interval(self, key: str) -> tuple[Array, Array]:
        holds = lambda value: _are_numbers(value, 2) and 0 < value[0] < value[1]
        lower, upper = self._get(key, holds, "two numbers [lower, upper] with 0 < lower < upper")
        return as_float(lower, (), key), as_float(upper, (), key)

    def choice(self, key: str, known) -> str:
        # a list, for a value that has no hash
        return self._get(key, lambda value: value in list(known), f"one of {sorted(known)}")


def read(path: str | Path | None) -> tuple[dict, str]:
    """The TOML document and the name by which messages call it; None: the file that ships with lgsens."""
    if path is None:
        source = resources.files("lgsens.examples") / "data" / "five_link_suspension.toml"
        text, path = source.read_text(encoding="utf-8"), source.name
    else:
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"Hardpoint file {str(path)!r} cannot be read: {error}.") from error
    try:
        return tomllib.loads(text), str(path)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"Hardpoint file {str(path)!r} is not valid TOML: {error}.") from error
