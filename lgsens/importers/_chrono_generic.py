"""Chrono's generic suspension, bodies, joints, distances, springs and torsion springs in lists, as rows."""

from typing import Any

import numpy as np

from lgsens.importers._chrono_data import Data, as_vector
from lgsens.importers._chrono_types import Row

_CHASSIS = ("Chassis", "Subchassis", "Steering")


def generic_rows(data: Data) -> tuple[list[Row], list[str]]:
    """The rows, and notes on what is in another form. Axes of joints are those of their frames, z of a hinge."""
    mirrored = {entry["Name"]: entry["Mirrored"] for entry in _entries(data, "Bodies")}
    notes: list[str] = []

    def name(body: Any) -> str:
        if isinstance(body, list):
            return f"{body[1].lower()} {body[0]}"
        if body in _CHASSIS:
            return ""
        if body not in mirrored:
            raise ValueError(f"{data.path}: the body {body!r} is not one of {sorted(mirrored)} nor of {_CHASSIS}.")
        return body if mirrored[body] else f"*{body}"

    ends = lambda entry: (name(entry["Body1"]), name(entry["Body2"]))
    point = lambda entry, key: as_vector(entry[key], f"{data.path}: {entry['Name']}/{key}")
    rows: list[Row] = []
    for entry in _entries(data, "Bodies"):
        products = as_vector(entry["Products of Inertia"], f"{data.path}: products of inertia of {entry['Name']}")
        if products.any():
            raise ValueError(f"{data.path}: {entry['Name']} has products of inertia; give it principal axes.")
        moments = np.diag(point(entry, "Moments of Inertia"))
        rows.append(("given", name(entry["Name"]), entry["Mass"], moments, point(entry, "Position"), _axes(entry)))
    for entry in _entries(data, "Joints"):
        kind, at, axes = entry["Type"], point(entry, "Position"), _axes(entry)
        if kind == "Revolute":
            rows.append(("hinge", *ends(entry), at, axes[:, 2]))
        elif kind == "Spherical":
            rows.append(("ball", *ends(entry), at))
        elif kind == "Universal":
            rows.append(("cross", *ends(entry), at, axes[:, 0], axes[:, 1]))
        else:
            raise ValueError(f"{data.path}: the joint {entry['Name']!r} has the unknown type {kind!r}.")
    for entry in _entries(data, "Distance Constraints"):
        a, b = ends(entry)
        rows.append(("distance", entry["Name"], a, point(entry, "Point1"), b, point(entry, "Point2")))
    for entry in (*_entries(data, "TSDAs"), *_entries(data, "RSDAs")):
        label, (a, b) = entry["Name"], ends(entry)
        data.content[label] = {key: value for key, value in entry.items() if key not in _STRUCTURE}
        if "Axis" in entry:
            numbers = ("Spring Coefficient", "Damping Coefficient", *(("Preload",) if "Preload" in entry else ()))
            rows.append(("torsion", a, b, point(entry, "Axis"), label, *numbers))
        else:
            rows.append(("spring", label, a, point(entry, "Point1"), b, point(entry, "Point2")))
    rows.append(("spindle", name(data.need("Spindle", "Attachment Body"))))
    return rows, notes


_STRUCTURE = {"Name", "Mirrored", "Body1", "Body2", "Point1", "Point2", "Position", "Axis", "Visualization"}


def _entries(data: Data, key: str) -> list[dict[str, Any]]:
    return data.content.get(key, [])


def _axes(entry: dict[str, Any]) -> np.ndarray:
    """The rotation of a quaternion (w, x, y, z), which files give with five digits."""
    w, *v = np.asarray(entry["Rotation"], float) / np.linalg.norm(entry["Rotation"])
    v = np.array(v)
    skew = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + 2.0 * w * skew + 2.0 * skew @ skew
