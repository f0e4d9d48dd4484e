"""A suspension file of Chrono, with a record of what was asked of it: what was not is in the report."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

# Of pictures and of names only.
_PICTURES = {"Radius", "Width", "Link Radius", "Visualization", "Name", "Type", "Template", "Vehicle-Frame Inertia"}


class Data:
    """The sections of a file, by name; `taken` are the entries that were asked for."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        text = self.path.read_text(encoding="utf-8")
        # JSON with comments, and with commas before closing brackets
        text = re.sub(r"/\*.*?\*/", "", re.sub(r'("(?:[^"\\]|\\.)*")|//[^\n]*', lambda m: m[1] or "", text), flags=re.S)
        try:
            self.content = json.loads(re.sub(r",(\s*[}\]])", r"\1", text))
        except json.JSONDecodeError as error:
            raise ValueError(f"{path}: no JSON: {error}") from error
        if not isinstance(self.content, dict) or "Suspension" not in str(self.content.get("Type")):
            raise ValueError(f'{path}: no suspension of Chrono: it needs "Type": "Suspension" or "TrackSuspension".')
        self.taken: set[tuple[str, str]] = set()

    @property
    def template(self) -> str:
        return str(self.content.get("Template", "TorsionArmSuspension"))

    def get(self, section: str, key: str) -> Any:
        """An entry of a section; None: there is none."""
        found = self.content.get(section)
        if not isinstance(found, dict) or key not in found:
            return None
        self.taken.add((section, key))
        return found[key]

    def has(self, section: str, key: str) -> bool:
        return key in self.content.get(section, {})

    def need(self, section: str, key: str) -> Any:
        if (found := self.get(section, key)) is None:
            raise ValueError(f"{self.path}: {self.template} needs {key!r} in {section!r}.")
        return found

    def number(self, section: str, key: str) -> float:
        return self._as_number(self.need(section, key), f"{section}/{key}")

    def vector(self, section: str, key: str) -> np.ndarray:
        return as_vector(self.need(section, key), f"{self.path}: {section}/{key}")

    def angle(self, key: str) -> float:
        """An angle in degrees at the top of the file [rad]."""
        return float(np.radians(self._as_number(self.content.get(key, 0.0), key)))

    def mass(self, section: str) -> float:
        mass = self.number(section, "Mass")
        if not 0.0 < mass < np.inf:
            raise ValueError(f"{self.path}: {section}/Mass must be positive, got {mass!r} kg.")
        return mass

    def curve(self, section: str, key: str) -> np.ndarray | None:
        """The columns of a table of pairs, of increasing places; None where there is none."""
        if (rows := self.get(section, key)) is None:
            return None
        try:
            columns = np.array(rows, dtype=float).T
        except (TypeError, ValueError):
            columns = np.zeros((0, 0))
        shape = columns.shape
        if len(shape) != 2 or shape[0] != 2 or shape[1] < 2 or not np.all(np.diff(columns[0]) > 0.0):
            raise ValueError(
                f"{self.path}: {section}/{key} must be two or more pairs of numbers, the first ones increasing, "
                f"got {_shown(rows)}."
            )
        return columns

    def _as_number(self, value: Any, where: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{self.path}: {where} must be a number, got {value!r}.")
        return float(value)

    def left(self) -> list[str]:
        """What nobody has asked for."""
        found = []
        for section, entries in self.content.items():
            if isinstance(entries, dict):
                asked = _PICTURES | {key for of, key in self.taken if of == section}
                found += [
                    f"{section}/{key}: {_shown(of)}" for key, of in entries.items() if key not in asked and of != 0
                ]
        return found


def as_vector(value: Any, what: str) -> np.ndarray:
    try:
        vector = np.asarray(value, float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{what} must be three numbers, got {value!r}.")
    return vector


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 60 else f"{text[:50]} …"


def prepare(data: Data) -> None:
    """Sections that describe several bodies, as one section for each."""
    content = data.content
    if watt := content.get("Watt Mechanism"):
        ends = {}
        for side in ("Left", "Right"):
            chassis, centre = (
                data.vector("Watt Mechanism", f"Location {side} Link to {to}") for to in ("Chassis", "Center")
            )
            ends[side] = centre
            content[f"{side} Link"] = _part(data, "Watt Mechanism", "Side Link") | {
                "Location Chassis": chassis.tolist(),
                "Location Center": centre.tolist(),
            }
        middle = (ends["Left"] + ends["Right"]) / 2
        content["Center Link"] = _part(data, "Watt Mechanism", "Center Link") | {"COM": middle.tolist()}
        assert watt is content["Watt Mechanism"]
    if "Leafspring" in content:
        _leaves(data)
    if "Torsion Bar" in content:
        content["Arm"]["Location Chassis"] = [0.0, 0.0, 0.0]


def _part(data: Data, section: str, name: str) -> dict[str, Any]:
    return {"Mass": data.need(section, f"{name} Mass"), "Inertia": data.need(section, f"{name} Inertia")}


def _leaves(data: Data) -> None:
    """Two leaves of length l that bend like one with the vertical rate k: k_θ = k l²/2 each, with the arm of the load
    along x for the preload; both rates of the file are divided by two, and the damping is 0.01 s times the rate."""
    content = data.content
    point = lambda name: data.vector("Leafspring", f"Location {name}")
    ends = {
        "Frontleaf": (point("Front Hanger"), point("Clamp A")),
        "Rearleaf": (point("Shackle"), point("Clamp B")),
        "Shackle": (point("Shackle"), point("Rear Hanger")),
    }
    middle = (ends["Frontleaf"][1] + ends["Rearleaf"][1]) / 2
    ends |= {"Clamp A": (ends["Frontleaf"][1], middle), "Clamp B": (ends["Rearleaf"][1], middle)}
    for name, both in ends.items():
        of = data.need("Leafspring", "Half Clamp" if name.startswith("Clamp") else name)
        content[name] = {"Mass": of["Mass"], "Inertia": of["Inertia"], "COM": np.mean(both, axis=0).tolist()}
    vertical, lateral, load, bias = (
        data.number("Leafspring", key)
        for key in ("Vertical Stiffness", "Lateral Stiffness", "Vertical Preload Force", "Stiffness Bias")
    )
    share = 2.0 / (1.0 + bias)  # of the front leaf, against 2 − share
    for name, leaf, part in (("Front Bending", "Frontleaf", share), ("Rear Bending", "Rearleaf", 2.0 - share)):
        arm = ends[leaf][0] - ends[leaf][1]
        rate = part * vertical * float(arm @ arm) / 2.0
        # a leaf turns about +y where the clamp behind its end moves up
        content[name] = {"Stiffness": rate, "Damping": 0.01 * rate, "Preload": -load / 2.0 * float(arm[0])}
    arm = ends["Frontleaf"][0] - ends["Frontleaf"][1]
    rate = lateral * float(arm @ arm) / 2.0
    content["Lateral Bending"] = {"Stiffness": rate, "Damping": 0.01 * rate, "Preload": 0.0}
