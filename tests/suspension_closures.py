"""Suspensions by hand: positions from distances and right angles, forces from free bodies. Nothing of lgsens."""

import copy
from typing import Any

import numpy as np
from scipy.optimize import brentq, root
from scipy.spatial.transform import Rotation

Z = np.array([0.0, 0.0, 1.0])


def corner_of(document: dict[str, Any]) -> dict[str, Any]:
    """The corner of an axle's file, as it is written: chassis for subframe and rack, and no table of the axle."""
    to_chassis = lambda table: {"chassis" if key in ("subframe", "rack") else key: of for key, of in table.items()}
    axle = ("subframe", "rack", "anti_roll_bar", "bushings", "bump_stop", "rebound_stop")
    corner = {key: table for key, table in document.items() if key not in axle}
    return corner | {"links": {name: to_chassis(link) for name, link in document.get("links", {}).items()}}


def changed(scene, changes):
    """A document with values put at places `TABLE.KEY`; None: the key goes."""
    scene = copy.deepcopy(scene)
    for place, value in changes.items():
        *tables, key = place.split(".")
        table = scene
        for name in tables:
            table = table[name]
        if value is None:
            del table[key]
        else:
            table[key] = value
    return scene


def points_of(value) -> np.ndarray:
    return np.atleast_2d(np.asarray(value, float))


def triad(a, b, c):
    """Axes fixed to three points of a body."""
    first = (b - a) / np.linalg.norm(b - a)
    second = np.cross(first, c - a)
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)], axis=1)


class Closure:
    """The knuckle keeps its distances to the chassis, one for each bar and two for each wishbone; its height is given.

    Unknowns: the translation of the wheel centre and the rotation vector of the knuckle, and with a push-rod the angle
    of its rocker. A McPherson strut keeps its top mount on the line of its slider.
    """

    def __init__(self, document: dict[str, Any]):
        self.document, self.links = document, document["links"]
        self.centre = np.array(document["wheel"]["centre"])
        ends = [link for link in self.links.values() if {"chassis", "knuckle"} <= set(link)]
        rods = [(start, np.array(link["knuckle"])) for link in ends for start in points_of(link["chassis"])]
        self.chassis, self.knuckle = (np.array(column) for column in zip(*rods))
        self.lengths = np.linalg.norm(self.knuckle - self.chassis, axis=1)

    def place(self, unknowns, point):
        return self.centre + unknowns[:3] + Rotation.from_rotvec(unknowns[3:6]).apply(np.asarray(point) - self.centre)

    def rocker(self, unknowns, point):
        first, second = points_of(self.links["rocker"]["chassis"])
        axis = (second - first) / np.linalg.norm(second - first)
        return first + Rotation.from_rotvec(unknowns[6] * axis).apply(np.asarray(point) - first)

    def link(self, name, unknowns, point):
        """Where a point of a link between chassis and knuckle is."""
        link = self.links[name]
        starts, ball = points_of(link["chassis"]), np.array(link["knuckle"])
        moved = self.place(unknowns, ball)
        if len(starts) == 2:  # a hinge
            turn = triad(*starts, moved) @ triad(*starts, ball).T
        else:  # a universal joint: the arm in the link stays across the arm in the chassis
            before, after = (v - starts[0] for v in (ball, moved))
            before, after = before / np.linalg.norm(before), after / np.linalg.norm(after)
            least, _ = Rotation.align_vectors(after[None], before[None])
            turned = lambda angle: (Rotation.from_rotvec(angle * after) * least).as_matrix()
            turn = turned(brentq(lambda angle: turned(angle) @ link["link_arm"] @ link["arm"], -0.5, 0.5, xtol=1e-15))
        return starts[0] + turn @ (np.asarray(point) - starts[0])

    def body(self, name, unknowns, point):
        if name in ("chassis", "knuckle"):
            return self.place(unknowns, point) if name == "knuckle" else np.array(point)
        return self.rocker(unknowns, point) if name == "rocker" else self.link(name, unknowns, point)

    def equations(self, unknowns, travel):
        rows = list(np.linalg.norm(self.place(unknowns, self.knuckle) - self.chassis, axis=1) - self.lengths)
        rows.append(unknowns[2] - travel)
        if "slider" in self.document.get("joints", {}):
            top, bottom = self.document["joints"]["slider"]["at"]
            first, second = self.place(unknowns, np.array([top, bottom]))
            off = np.cross(np.array(top) - first, second - first)
            rows += [off[0], off[1]]  # the line is nearly upright, so the third follows
        if "push_rod" in self.links:
            arm, ends = "lower", self.links["push_rod"]
            length = np.linalg.norm(np.subtract(ends[arm], ends["rocker"]))
            moved = self.link(arm, unknowns, ends[arm]) - self.rocker(unknowns, ends["rocker"])
            rows.append(np.linalg.norm(moved) - length)
        return np.array(rows)

    def solve(self, travel):
        """Outward from the design position in steps of a centimetre at most."""
        unknowns = np.zeros(7 if "push_rod" in self.links else 6)
        for target in np.linspace(0.0, travel, 1 + max(1, round(abs(travel) / 0.01))):
            found = root(self.equations, unknowns, args=(target,), method="hybr", options={"xtol": 1e-15})
            unknowns = found.x
        assert np.abs(self.equations(unknowns, travel)).max() < 1e-14
        return unknowns

    def curves(self, travel):
        """Camber, toe, contact centre, length of spring and damper of the wheel on the left."""
        unknowns = self.solve(travel)
        turn = Rotation.from_rotvec(unknowns[3:6]).as_matrix()
        normal = turn[:, 1]  # points left, which is outward
        steepest = Z - (Z @ normal) * normal
        steepest /= np.linalg.norm(steepest)
        camber = np.sign(steepest[1]) * np.arctan2(np.linalg.norm(steepest[:2]), steepest[2])
        trace = np.cross(normal, Z)  # forward along the wheel; toe-in turns it to the right, −y
        radius = self.centre[2] - self.document["road"]["height"]
        contact = self.centre + unknowns[:3] - radius * steepest
        return np.array([camber, np.arctan2(-trace[1], trace[0]), *contact, *self.struts(unknowns)])

    def struts(self, unknowns):
        for key in ("spring", "damper"):
            ends = [body for body in ("chassis", "knuckle", *self.links) if body in self.document[key]]
            a, b = (self.body(body, unknowns, self.document[key][body]) for body in ends)
            yield np.linalg.norm(b - a)


def wrench(point, force):
    return np.concatenate([force, np.cross(point, force)])


def motion_ratio(document, key) -> float:
    """By virtual work: a wheel load of 1 N at its centre is borne by a spring that pushes with 1/i.

    Forces between free bodies without weight, as many as equations of balance, six for each body.
    """
    links, bodies = document["links"], ["knuckle", *document["links"]]
    columns = []

    def add(a, b, wrenches):
        for w in wrenches:
            column = np.zeros((len(bodies), 6))
            for body, sign in ((a, -1.0), (b, 1.0)):
                if body != "chassis":
                    column[bodies.index(body)] = sign * w
            columns.append(column.ravel())

    def holds(a, b, points, moments, directions):
        forces = [wrench(points[0], d) for d in directions]
        add(a, b, [*forces, *(np.concatenate([np.zeros(3), m]) for m in moments)])

    across = lambda line: np.linalg.svd(line[None])[2][1:]
    for name, link in links.items():
        ends = {body: points_of(link[body]) for body in ("chassis", "knuckle", *links) if body in link}
        universal = len(ends) < 3 and all(len(points) == 1 for points in ends.values())
        first = "chassis" if "chassis" in ends else min(ends)
        for body, points in ends.items():
            moments = []
            if len(points) == 2:
                moments = across(points[1] - points[0])
            elif universal and body == first:
                other = [p[0] for end, p in ends.items() if end != body] or [np.array(link["centre_of_mass"])]
                along = other[0] - points[0]
                arm = link.get("arm", np.cross(Z, along))
                moments = [np.cross(arm, link.get("link_arm", np.cross(arm, along)))]
            holds(body, name, points, moments, np.eye(3))
    for joint in document.get("joints", {}).values():
        points = points_of(joint["at"])
        sideways = across(points[1] - points[0])
        holds(*joint["between"], points, sideways, sideways if joint["type"] == "cylindrical" else np.eye(3))
    (a, at_a), (b, at_b) = ((body, np.array(x)) for body, x in document[key].items() if body in ["chassis", *bodies])
    add(a, b, [wrench(at_b, (at_b - at_a) / np.linalg.norm(at_b - at_a))])
    load = np.zeros((len(bodies), 6))
    load[0] = wrench(np.array(document["wheel"]["centre"]), Z)
    return 1.0 / np.linalg.solve(np.stack(columns, axis=1), -load.ravel())[-1]
