"""Suspensions of Chrono's vehicle data as models, all types on one path: a table of rows (`_chrono_types`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lgsens.importers._chrono_data import Data, prepare
from lgsens.importers._chrono_generic import generic_rows
from lgsens.importers._chrono_types import REPEATING, TYPES, Row
from lgsens.importers._report import Imported, Report, built, made
from lgsens.model import (
    AbstractForce,
    AbstractJoint,
    CurveSpringDamper,
    CylindricalJoint,
    DistanceJoint,
    FixedJoint,
    Gravity,
    PlanarJoint,
    PointOnPlaneJoint,
    RevoluteJoint,
    RigidBody,
    Sampled,
    SphericalJoint,
    SpringDamper,
    TorsionSpringDamper,
    UniversalJoint,
)

_GENERIC = "GenericWheeledSuspension"
# which arguments of the rows are bodies
_BODIES = {
    **dict.fromkeys(("body", "given", "spindle"), (0,)),
    **dict.fromkeys(("ball", "cross", "face", "hinge", "plane", "slider", "torsion", "universal"), (0, 1)),
    **dict.fromkeys(("distance", "spring"), (1, 3)),
    "arm": (0, 3),
    "rod": (0, 1, 3),
}
_UNITS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def chrono(
    path: str | Path,
    *,
    gravity: Sequence[float] = (0.0, 0.0, -9.81),
    chassis: RigidBody | None = None,
    wheels: str = "hinged",
) -> Imported:
    """A model of one axle from a suspension file of Chrono's vehicle data, of any of its types.

    Both sides are there: names are "left Upright", "right Upright", "Axle Tube". x is forward, y to the left, z up, the
    origin that of the suspension. Points that steer are held by the chassis. There is no tyre: the spindles hang on the
    springs.

    Arguments:
        path: the JSON file.
        gravity: [m/s²], inertial frame, shape (3,).
        chassis: the body that holds the suspension; None: the ground.
        wheels: "hinged": spindles turn; "locked": they are fixed to what carries them, for kinematics.

    Where no body has the three moments of inertia, the smaller two are raised, to sum up to the largest.
    `report.dropped` lists all entries of the file that were not used, but for those of pictures. Raises `ValueError`
    for a file that is no suspension, an unknown type, and missing or wrong entries. Source: the format of Project
    Chrono's data/vehicle.
    """
    if wheels not in ("hinged", "locked"):
        raise ValueError(f"`wheels` must be 'hinged' or 'locked', got {wheels!r}.")
    data = Data(path)
    if data.template not in (*TYPES, _GENERIC):
        raise ValueError(f"{path}: the type {data.template!r} is not one of {sorted((*TYPES, _GENERIC))}.")
    prepare(data)
    assembly = Assembly(data, chassis, wheels)
    rows, notes = generic_rows(data) if data.template == _GENERIC else (TYPES[data.template], [])
    for row in rows:
        assembly.add(row)
    forces: dict[str, AbstractForce] = {"gravity": made(Gravity, gravity)} | assembly.forces
    model, more = built(assembly.bodies, assembly.joints, forces, check=data.template in REPEATING)
    types = lambda of: {name: type(each).__name__ for name, each in of.items()}
    notes = (*notes, *assembly.notes, *more)
    name = f"{data.content.get('Name', data.path.stem)} ({data.template})"
    report = Report(name, tuple(assembly.bodies), types(assembly.joints), {}, types(forces), notes, tuple(data.left()))
    return Imported(model, report)


class Assembly:
    """The elements of an axle, row by row."""

    def __init__(self, data: Data, chassis: RigidBody | None, wheels: str):
        self.data, self.wheels = data, wheels
        self.bodies: dict[str, RigidBody] = {} if chassis is None else {"chassis": chassis}
        self.joints: dict[str, AbstractJoint] = {}
        self.forces: dict[str, AbstractForce] = {}
        self.notes: list[str] = []
        self.side = 1.0

    def add(self, row: Row) -> None:
        """A row, once for each side if it is about a body of a side."""
        if row[0] == "option":
            if row[2].removeprefix("*") not in self.data.content:
                return
            row = row[1:]
        kind, *arguments = row
        bodies = [arguments[place] for place in _BODIES[kind]]
        once = all(not name or name.startswith(("*", "left ", "right ", "near ")) for name in bodies)
        if kind == "spring" or not any(bodies):  # between the chassis and an axle on both sides
            once = bodies[-1].startswith("*") and self.data.content["Type"] == "TrackSuspension"
        if kind == "spindle":
            once = False
        for self.side in (1.0,) if once else (1.0, -1.0):
            getattr(self, f"_{kind}")(*arguments)

    def join(self, label: str, joint: AbstractJoint) -> None:
        self.joints[label if label not in self.joints else f"{label} {len(self.joints)}"] = joint

    # names, points and axes of the side that is being built

    def name(self, body: str, near: np.ndarray | None = None) -> str | None:
        if not body:
            return "chassis" if "chassis" in self.bodies else None
        if body.startswith("*"):
            return body[1:]
        if body.startswith("near "):
            assert near is not None
            return f"{'left' if near[1] > 0 else 'right'} {body.removeprefix('near ')}"
        return body if body.startswith(("left ", "right ")) else f"{'left' if self.side > 0 else 'right'} {body}"

    def label(self, body: str) -> str:
        return str(self.name(body)) if body else "chassis"

    def point(self, where: Any) -> np.ndarray:
        if not isinstance(where, str):
            return np.asarray(where) * (1.0, self.side, 1.0)
        section, key = where.removesuffix("~").split("/")
        return self.data.vector(section, key) * (1.0, self.side * (-1.0 if where.endswith("~") else 1.0), 1.0)

    def axis(self, along: Any) -> np.ndarray:
        if not isinstance(along, str):
            return np.asarray(along) * (1.0, self.side, 1.0)
        if along in _UNITS:
            return np.array(_UNITS[along])
        begin, end = along.split("..")
        return self.point(end) - self.point(begin)

    # rows

    def _body(self, body: str, *ends: str, axes: np.ndarray | None = None) -> None:
        section = body.removeprefix("*")
        if not ends or self.data.has(section, "COM"):
            centre = self.point(f"{section}/COM")
        else:
            centre = np.mean([self.point(end) for end in ends], axis=0)
        moments = "Moments of Inertia" if self.data.has(section, "Moments of Inertia") else "Inertia"
        inertia = np.diag(self.data.vector(section, moments))
        if moments != "Inertia":
            xy, xz, yz = self.data.vector(section, "Products of Inertia") * (self.side, 1.0, self.side)
            inertia += np.array([[0, xy, xz], [xy, 0, yz], [xz, yz, 0]])
        self.place(body, self.data.mass(section), inertia, centre, np.eye(3) if axes is None else axes)

    def place(self, body: str, mass: float, inertia: np.ndarray, centre, axes) -> None:
        """A body whose inertia is in its own axes."""
        name = str(self.name(body))
        moments, principal = np.linalg.eigh(inertia)
        if moments[2] > moments[0] + moments[1]:
            self.notes.append(f"{name}: no body has the moments of inertia {moments.tolist()}; the smaller are raised")
            moments[:2] += (moments[2] - moments[0] - moments[1]) / 2
            inertia = (principal * moments) @ principal.T
        diagonal = np.array_equal(inertia, np.diag(np.diag(inertia)))
        self.bodies[name] = RigidBody(mass, np.diag(inertia) if diagonal else inertia, centre, axes)

    def _given(self, body: str, mass: float, inertia: np.ndarray, centre, axes) -> None:
        flip = np.diag([1.0, self.side, 1.0])
        self.place(body, mass, inertia, self.point(centre), flip @ axes @ flip)

    def _cross(self, a: str, b: str, at, arm_a, arm_b) -> None:
        joint = made(
            UniversalJoint,
            self.name(a),
            self.name(b),
            at=self.point(at),
            axis_a=self.axis(arm_a),
            axis_b=self.axis(arm_b),
        )
        self.join(f"{self.label(a)} – {self.label(b)}", joint)

    def _arm(self, body: str, front: str, back: str, to: str, at: str) -> None:
        f, b, ball = map(self.point, (front, back, at))
        x = (f - b) / np.linalg.norm(f - b)
        z = np.cross(x, ball - b) * self.side
        z /= np.linalg.norm(z)
        self._body(body, front, back, at, axes=np.stack([x, np.cross(z, x), z], axis=1))
        hinge = made(RevoluteJoint, self.name(""), self.name(body), at=(f + b) / 2, axis=f - b)
        self.join(f"{self.label(body)} hinge", hinge)
        self._ball(body, to, at)

    def _rod(self, body: str, a: str, at_a: str, b: str, at_b: str) -> None:
        """A body on a universal joint and a ball joint; without mass a distance."""
        section = body.removeprefix("*")
        if not self.data.has(section, "Mass"):
            self._distance(body, a, at_a, b, at_b)
            return
        along = self.point(at_b) - self.point(at_a)
        self._body(body, at_a, at_b, axes=_along(along))
        self._universal(a, body, at_a, along * (1.0, self.side, 1.0), section)
        self._ball(body, b, at_b)

    def _universal(self, a: str, b: str, at: Any, along: Any, section: str) -> None:
        """`along`: a direction to which both arms are orthogonal, where the section does not give them."""
        direction = self.axis(along)
        arm_a = arm_b = None
        for key in ("Universal Joint Axis Chassis", "Universal Joint Axis"):
            if (found := self.data.get(section, key)) is not None and arm_a is None:
                arm_a = self.axis(found)
        if (found := self.data.get(section, "Universal Joint Axis Link")) is not None:
            arm_b = self.axis(found)
        across = _along(direction)
        arm_a = across[:, 0] if arm_a is None else arm_a
        arm_b = np.cross(direction, arm_a) if arm_b is None else arm_b
        joint = made(UniversalJoint, self.name(a), self.name(b), at=self.point(at), axis_a=arm_a, axis_b=arm_b)
        self.join(f"{self.label(a)} – {self.label(b)}", joint)

    def _ball(self, a: str, b: str, at: str) -> None:
        place = self.point(at)
        ends = self.name(a, place), self.name(b, place)
        self.join(" – ".join(end or "chassis" for end in ends), made(SphericalJoint, *ends, at=place))

    def _hinge(self, a: str, b: str, at: Any, along: Any) -> None:
        joint = made(RevoluteJoint, self.name(a), self.name(b), at=self.point(at), axis=self.axis(along))
        self.join(f"{self.label(a)} – {self.label(b)}", joint)

    def _slider(self, a: str, b: str, at: str, along: str) -> None:
        joint = made(CylindricalJoint, self.name(a), self.name(b), at=self.point(at), axis=self.axis(along))
        self.join(f"{self.label(a)} – {self.label(b)}", joint)

    def _face(self, a: str, b: str, at: str, along: str) -> None:
        joint = made(PlanarJoint, self.name(a), self.name(b), at=self.point(at), axis=self.axis(along))
        self.join(f"{self.label(b)} guide {along}", joint)

    def _plane(self, a: str, b: str, at: str, along: str) -> None:
        joint = made(PointOnPlaneJoint, self.name(a), self.name(b), at=self.point(at), axis=self.axis(along))
        self.join(f"{self.label(b)} guide {along}", joint)

    def _distance(self, label: str, a: str, at_a: Any, b: str, at_b: Any) -> None:
        begin, end = self.point(at_a), self.point(at_b)
        joint = made(DistanceJoint, self.name(a), self.name(b), at_a=begin, at_b=end)
        self.join(self.label(label), joint)

    def _spindle(self, carrier: str) -> None:
        """y turned by the camber about x and by the toe about z."""
        camber, toe = self.data.angle("Camber Angle (deg)"), self.data.angle("Toe Angle (deg)")
        along = np.array([-np.sin(toe) * np.cos(camber), np.cos(toe) * np.cos(camber), np.sin(camber)])
        y = along * (1.0, self.side, 1.0) * self.side
        x = np.cross(y, (0.0, 0.0, 1.0))
        x /= np.linalg.norm(x)
        self._body("Spindle", axes=np.stack([x, y, np.cross(x, y)], axis=1))
        ends, at = (self.name(carrier), self.name("Spindle")), self.point("Spindle/COM")
        locked = self.wheels == "locked"
        bearing = made(FixedJoint, *ends, at=at) if locked else made(RevoluteJoint, *ends, at=at, axis=y)
        self.join(f"{self.label('Spindle')} bearing", bearing)

    def _spring(self, section: str, a: str, at_a: Any, b: str, at_b: Any) -> None:
        ends = {"at_a": self.point(at_a), "at_b": self.point(at_b)}
        if np.array_equal(ends["at_a"], ends["at_b"]):
            raise ValueError(
                f"{self.data.path}: {section} has both ends at {ends['at_a'].tolist()} m, and no direction."
            )
        names = self.name(a), self.name(b)
        free, label = self.data.get(section, "Free Length"), self.label(section)
        curves, numbers = [], []
        for of in ("Spring", "Damping"):
            key, rows = f"{of} Coefficient", self.data.curve(section, f"{of} Curve Data")
            number = self.data.number(section, key) if self.data.has(section, key) else 0.0
            curve = ([-1.0, 1.0], [-number, number]) if rows is None and number else rows
            curves.append(None if curve is None else made(Sampled, curve[0], curve[1], "monotone"))
            numbers.append(None if rows is not None else number)
            if rows is not None:
                self.notes.append(
                    f"{label}: {of} Curve Data by a smooth monotone curve, which goes on straight beyond its ends; in "
                    "Chrono straight lines, and constants beyond"
                )
        if None in numbers:
            given = {"spring": curves[0], "damper": curves[1], "free_length": free}
            self.forces[label] = made(CurveSpringDamper, *names, **ends, **given)
        elif any(numbers):
            given = {"stiffness": numbers[0], "damping": numbers[1], "free_length": free}
            self.forces[label] = made(SpringDamper, *names, **ends, **given)

    def _torsion(
        self, a: str, b: str, along: Any, section: str, stiffness: str, damping: str, preload: str = ""
    ) -> None:
        """In Chrono a preload is the moment on b."""
        moment = -self.data.number(section, preload) if preload else None
        self.forces[f"{self.label(b)} torsion {along}" if isinstance(along, str) else self.label(section)] = made(
            TorsionSpringDamper,
            self.name(a),
            self.name(b),
            axis=self.axis(along),
            stiffness=self.data.number(section, stiffness),
            damping=self.data.number(section, damping),
            preload=moment,
        )


def _along(direction: np.ndarray) -> np.ndarray:
    """Axes with z along a direction, x across it and the vertical, or across x for a vertical one."""
    z = direction / np.linalg.norm(direction)
    up = np.array([0.0, 0.0, 1.0]) if abs(z[2]) < 0.99 else np.array([1.0, 0.0, 0.0])
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)
