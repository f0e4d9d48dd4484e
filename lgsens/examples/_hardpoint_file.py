"""Reads hardpoint files, and says which key is missing or wrong."""

import difflib
import json
import math
import tomllib
from collections.abc import Callable, Collection
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array

from lgsens._validate import as_float
from lgsens.model import RigidBody

DATA = resources.files("lgsens.examples") / "data"
DEFAULT = "quarter-car"  # what the car that ships with lgsens is called, and its file
DEFAULT_FILE = "five_link_suspension"
FORMAT = f"see lgsens/examples/data/{DEFAULT_FILE}.toml for the format."


MOST_GYRATION = 5.0  # m


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _are_numbers(value: Any, count: int) -> bool:
    return isinstance(value, list) and len(value) == count and all(map(_is_number, value))


def _are_points(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(_are_numbers(point, 3) for point in value)


class Reader:
    """Reads keys of a document, and says which one is missing or wrong.

    Points are read in units of `metre` [m] over the road, which is at the height `road` [m] of the document.
    """

    def __init__(self, table: dict, path: str, keys: tuple[str, ...] = (), metre: float = 1.0, road: float = 0.0):
        self._table, self._path, self._keys = table, path, keys
        self._metre, self._road = metre, road

    @property
    def road(self) -> float:
        """The height of the road in the document."""
        return self._road / self._metre

    @property
    def metres_of_road(self) -> float:
        """That height [m]."""
        return self._road

    def fail(self, key: str, why: str) -> ValueError:
        return ValueError(f"Hardpoint file {self._path!r}, key {'.'.join((*self._keys, key))!r}: {why}")

    def _get(self, key: str, holds: Callable[[Any], bool], what: str) -> Any:
        if key not in self._table:
            like = difflib.get_close_matches(key, self._table, n=1, cutoff=0.75)
            raise self.fail(key, f"is missing{f' (is {like[0]!r} meant for it?)' if like else ''}; {FORMAT}")
        value = self._table[key]
        if not holds(value):
            raise self.fail(key, f"must be {what}, got {value!r}.")
        return value

    def __contains__(self, key: str) -> bool:
        return key in self._table

    def only(self, keys: Collection[str]) -> None:
        """No other keys are in this table."""
        for key in self._table:
            if key not in keys:
                raise self.fail(key, f"is no key of this table; those are {sorted(keys)}.")

    def table(self, key: str) -> "Reader":
        value = self._get(key, lambda value: isinstance(value, dict), "a table")
        return Reader(value, self._path, (*self._keys, key), self._metre, self._road)

    def tables(self, key: str) -> dict[str, "Reader"]:
        """The tables in a table, by name; none where there is no such table."""
        members = self.table(key) if key in self else Reader({}, self._path)
        return {name: members.table(name) for name in members._table}

    def number(self, key: str, scale: float = 1.0, positive: bool = True) -> Array:
        value = self._get(key, _is_number, "a finite number")
        if positive:
            self._get(key, lambda value: value > 0, "positive")
        return as_float(value * scale, (), key)

    def share(self, key: str) -> Array:
        """A part of a whole, which may be none or all of it."""
        self._get(key, lambda value: _is_number(value) and 0.0 <= value <= 1.0, "between 0 and 1")
        return self.number(key, positive=False)

    def metres(self, key: str, most: float, positive: bool = True) -> Array:
        """A length in metres, which the unit of the file's points is not for; at most so much."""
        return self.within(key, self.number(key, positive=positive), most)

    def within(self, key: str, lengths: Array, most: float) -> Array:
        """Lengths [m], no one of which is beyond any car's."""
        largest = float(np.max(np.abs(lengths)))
        if largest > most:
            raise self.fail(
                key,
                f"is in metres ('units.length' is of points alone), and {largest:g} m are more than the {most:g} m "
                f"that are possible; did you mean {largest / 1e3:g}?",
            )
        return lengths

    def count(self, key: str) -> int:
        holds = lambda value: isinstance(value, int) and not isinstance(value, bool) and value >= 1
        return self._get(key, holds, "a whole number of at least 1")

    def vector(self, key: str) -> Array:
        """Three numbers as they are: a direction, moments of inertia."""
        return self.numbers(key, 3, "three numbers [x, y, z]")

    def numbers(self, key: str, count: int, what: str = "") -> Array:
        """So many numbers."""
        value = self._get(key, lambda value: _are_numbers(value, count), what or f"{count} numbers [a, b, …]")
        return as_float(value, (count,), key)

    def triples(self, key: str, count: int = 1) -> Array:
        """Three numbers, shape (3,); where there are two things to have them also twice three, shape (2, 3)."""
        value = self._get(
            key,
            lambda value: _are_numbers(value, 3) or (count == 2 and _are_points(value)),
            "three numbers" + (", or two times three, [[…], […]]" if count == 2 else ""),
        )
        return as_float(value, None, key)

    def directions(self, key: str) -> Array:
        """Two directions that are not one, shape (2, 3)."""
        value = self._get(key, _are_points, "two directions [[x, y, z], [x, y, z]]")
        if np.linalg.norm(np.cross(*value)) <= 1e-6 * np.prod(np.linalg.norm(value, axis=1)):
            raise self.fail(key, f"must be two different directions, got {value}.")
        return as_float(value, (2, 3), key)

    def direction(self, key: str) -> Array | None:
        """A vector that is not zero; None: it is left out."""
        if key not in self:
            return None
        if not np.any(value := self.vector(key)):
            raise self.fail(key, "must be a direction, got zero.")
        return value

    def _over_road(self, point: list) -> list:
        x, y, z = (coordinate * self._metre for coordinate in point)
        return [x, y, z - self._road]

    def point(self, key: str) -> Array:
        self.vector(key)
        return as_float(self._over_road(self._table[key]), (3,), key)

    def points(self, key: str) -> Array:
        """One point, shape (3,), or two that differ, (2, 3)."""
        value = self._get(
            key,
            lambda value: _are_numbers(value, 3) or _are_points(value),
            "three numbers [x, y, z], or two points [[x, y, z], [x, y, z]]",
        )
        if not _are_points(value):
            return self.point(key)
        if value[0] == value[1]:
            raise self.fail(key, f"two points must differ to have a line, got {value[0]} twice.")
        return as_float([self._over_road(point) for point in value], (2, 3), key)

    def ends(self, bodies: Collection[str], keys: Collection[str]) -> dict[str, Array]:
        """The points by the bodies that name them, beside the other keys of this table; none of them coincide."""
        found, seen = {}, {}
        for key in self._table:
            if key in keys:
                continue
            if key not in bodies:
                known = f"bodies are {sorted(bodies)}, keys {sorted(keys)}"
                raise self.fail(key, f"is no body and no key of this table; {known}.")
            found[key] = self.points(key)
            for point in np.atleast_2d(found[key]).tolist():
                if (other := seen.setdefault(tuple(point), key)) != key:
                    raise self.fail(key, f"must differ from {other!r}; the two points coincide.")
        return found

    def curve(self, key: str) -> np.ndarray:
        """Points of a curve that rises, shape (2, n)."""

        def holds(value: Any) -> bool:
            if not (isinstance(value, list) and len(value) > 1 and all(_are_numbers(point, 2) for point in value)):
                return False
            steps = np.diff(np.asarray(value, float), axis=0)
            return bool(np.all(steps[:, 0] > 0) and np.all(steps[:, 1] >= 0))

        what = "two points or more [[x, force], …], x increasing and force never falling"
        return np.asarray(self._get(key, holds, what), float).T

    def moments(self, key: str) -> Array:
        """Principal moments of inertia that a body can have."""
        value = self.vector(key)
        try:
            RigidBody(mass=1.0, inertia=value)
        except ValueError as error:
            raise self.fail(key, str(error)) from error
        return value

    def mass_and_moments(self, kilogram: float) -> tuple[Array, Array]:
        """Of a body: `mass`, and `inertia` that it can have."""
        mass, inertia = self.number("mass", kilogram), self.moments("inertia")
        radius = math.sqrt(float(np.max(inertia)) / float(mass))
        if not radius <= MOST_GYRATION:
            raise self.fail(
                "inertia",
                f"is in kg m² ('units' is of masses and points alone), and {np.asarray(inertia).tolist()} of "
                f"{float(mass):g} kg is a radius of gyration of {radius:.3g} m, more than of any part of a car; did "
                f"you mean {[float(f'{1e-6 * moment:.6g}') for moment in np.asarray(inertia)]}?",
            )
        return mass, inertia

    def interval(self, key: str) -> tuple[Array, Array]:
        holds = lambda value: _are_numbers(value, 2) and 0 < value[0] < value[1]
        lower, upper = self._get(key, holds, "two numbers [lower, upper] with 0 < lower < upper")
        return as_float(lower, (), key), as_float(upper, (), key)

    def choice(self, key: str, known) -> str:
        # a list, for a value that has no hash
        return self._get(key, lambda value: value in list(known), f"one of {sorted(known)}")

    def pair(self, key: str, known) -> tuple[str, str]:
        """Two different names."""
        holds = lambda value: isinstance(value, list) and len(value) == 2 and value[0] != value[1]
        first, second = self._get(
            key, lambda value: holds(value) and all(name in list(known) for name in value), f"two of {sorted(known)}"
        )
        return first, second


def shipped() -> list[str]:
    """The names of the files of suspensions that ship with lgsens."""
    return sorted(Path(file.name).stem for file in DATA.iterdir() if file.name.endswith(".toml"))


def read(path: str | Path | None) -> tuple[dict, str]:
    """The document, TOML or by its name JSON, and the name by which messages call it.

    A name of `shipped()` is that file; None or "quarter-car": the five-link suspension.
    """
    path = DEFAULT_FILE if path in (None, DEFAULT) else path
    if str(path) in shipped():
        source = DATA / f"{path}.toml"
        text, name = source.read_text(encoding="utf-8"), source.name
    else:
        name = str(path)
        try:
            text = Path(path).read_text(encoding="utf-8-sig")  # with a byte-order mark or without
        except UnicodeDecodeError as error:
            raise ValueError(f"Hardpoint file {name!r} cannot be read: {error}; save it as UTF-8.") from error
        except OSError as error:
            raise ValueError(
                f"Hardpoint file {name!r} cannot be read: {error}; those that ship with lgsens are {shipped()}."
            ) from error
    language, load = ("JSON", json.loads) if name.endswith(".json") else ("TOML", tomllib.loads)
    try:
        document = load(text)
    except ValueError as error:  # of both
        scene = "; `lgsens tradeoff` and `lgsens doctor` take scenes in Python" if name.endswith(".py") else ""
        raise ValueError(f"Hardpoint file {name!r} is not valid {language}: {error}{scene}.") from error
    if not isinstance(document, dict):
        raise ValueError(f"Hardpoint file {name!r} must hold tables, got a {type(document).__name__}.")
    return document, name


def suspension_document(path: str | Path | None = None) -> dict[str, Any]:
    """The tables of a suspension's file as they are there, in its own units and axes.

    Arguments:
        path: as of `QuarterCar.load`.

    Raises `ValueError` for a file that cannot be read.
    """
    return read(path)[0]
