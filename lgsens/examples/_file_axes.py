"""The way back from a suspension to its file: the axes of that, and the file with other numbers."""

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

SIDEWAYS = np.array([1.0, -1.0, 1.0])
UPWARD = np.array([0.0, 0.0, 1.0])


class FileAxes(NamedTuple):
    """The axes in which a file has its points, x forward, y left and z up as of the scene.

    Attributes:
        road: the height of the road at the design position there [m]; the scene has it at z = 0.
        mirrored: whether the file is of the right side and the suspension of the left.
    """

    road: float = 0.0
    mirrored: bool = False

    @property
    def signs(self) -> np.ndarray:
        """What directions, and derivatives by points, are multiplied by to be those of the file, shape (3,)."""
        return SIDEWAYS if self.mirrored else np.ones(3)

    @property
    def offset(self) -> np.ndarray:
        """What is added to a point then [m], shape (3,)."""
        return self.road * UPWARD


def rewritten(
    document: Mapping[str, Any],
    points: Mapping[str, float],
    rates: Mapping[str, tuple[float, float]],
    angles: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """The document of a file with other numbers.

    Arguments:
        document: as read.
        points: coordinates in metres and the axes of the file, by names "links.tie_rod.rack.y",
            "links.upper_arm.chassis.1.z", "spring.chassis.x".
        rates: numbers before and after in SI units by names such as "spring.stiffness",
            "bushings.pivot.stiffness.2.1". A curve of a spring or damper grows as its slope.
        angles: by names such as "wheel.toe_deg" [degree].
    """
    found = copy.deepcopy(dict(document))
    for name, value in points.items():
        *path, axis = name.split(".")
        _put(found, [*path, "xyz".index(axis)], value / found["units"]["length"])
    for name, value in (angles or {}).items():
        _put(found, name.split("."), value)
    for name, (before, after) in rates.items():
        owner, *path = name.split(".")
        if owner in ("spring", "damper") and "curve" in found[owner]:
            found[owner]["curve"] = [[x, after / before * force] for x, force in found[owner]["curve"]]
        else:
            _put(found, [owner, *path], after)
    return found


def _put(document: dict[str, Any], path: list[Any], value: float) -> None:
    """A number at a place of a document, or where that has it by another name."""
    owner = document[path[0]]
    if path[0] in ("bump_stop", "rebound_stop") and path[1] not in owner:  # one without ends has those of the damper
        damper = document["damper"]
        ends = {key: point for key, point in damper.items() if isinstance(point, list) and key != "curve"}
        if "link" in damper:
            ends = {damper["link"]: damper["link_point"], "chassis": damper["chassis_point"]}
        owner |= copy.deepcopy(ends)
    if path[0] in ("spring", "damper") and "link" in owner and len(path) == 3:
        path = [path[0], "link_point" if path[1] == owner["link"] else "chassis_point", path[2]]
    place: Any = document
    for i, key in enumerate(path[:-1]):
        key = int(key) - 1 if isinstance(place, list) else key
        if i + 3 == len(path) and isinstance(place[key], list) and not isinstance(place[key][0], list):
            place[key] = [list(place[key]), list(place[key])]  # three numbers, of both bushings of a hinge
        place = place[key]
    last = path[-1]
    place[int(last) - 1 if isinstance(place, list) and isinstance(last, str) else last] = value
