"""Whether a suspension moves as one does, before anything is compiled: velocities at the design position, in NumPy.

Twists (v, w) about the origin of knuckle and links, the chassis held, the wheel locked, per velocity of the wheel
centre c: of every connection at p and each direction d in which it lets nothing move, e in which nothing turns,

    d·(v_b + w_b × p − v_a − w_a × p) = 0,     e·(w_b − w_a) = 0,     e_z·(v + w × c) = 1 of the knuckle,

as many equations as unknowns where travel is the one freedom. A spring whose ends part at ℓ̇ has the motion ratio −ℓ̇.
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import numpy as np

from lgsens._validate import is_concrete
from lgsens.examples._suspension_parts import PLANAR, Connection, Link, Strut, itself

RATIOS = (0.1, 3.0)  # motion ratios that cars have; racing cars' rockers reach some 0.4 to 1.5
LEAST_OF_BAR = 0.05  # travel of the end of a drop link along it, per wheel travel: with less a bar does next to nothing
LEAST_ANGLE = math.radians(10.0)  # of a link to the plane of its universal joint's arms, where it would be singular
SINGULAR = 1e8  # condition of the rows, at least


def motion_ratios(
    name: str,
    centre: Any,
    links: Mapping[str, Link],
    joints: Mapping[str, Connection],
    struts: Mapping[str, Strut],
    bar: Any = None,
) -> dict[str, float]:
    """The motion ratios of spring and damper; {}: numbers are traced and not looked at. And whether an anti-roll `bar`
    does anything.

    Raises `ValueError`, naming key, value and remedy, for a suspension that does not move up and down, for universal
    joints that are nearly singular, and for motion ratios that no car has.
    """
    if not is_concrete(centre, links, joints, struts, bar):
        return {}
    every = [*joints.items(), *((f"links.{key}", c) for key, link in links.items() for c in link.connections(key))]
    for key, connection in every:
        if connection.arms is not None:
            check_arms(name, key, links[connection.between[1]], connection)
    velocities = Velocities(("knuckle", *links))
    rows = velocities.rows([connection for _, connection in every])
    free = velocities.unknowns - len(rows)
    if free != 1:
        if any(joint.kind == PLANAR for joint in joints.values()):
            raise ValueError(
                f"{name}: half of the solid axle, both sides moving alike, has {free} degrees of freedom to the "
                f"chassis and needs one, got, with halves of what there is once and goes along the car, the links "
                f"{sorted(links)}. The whole axle (`Axle`, `lgsens kc`) may have links that bind its halves."
            )
        raise ValueError(
            f"{name}, key 'links': the wheel has {free} degrees of freedom to the chassis, and needs "
            f"one, its travel, got the links {sorted(links)} and the joints {sorted(joints)}. A link with two ball "
            "joints takes one from the knuckle's six, one with a hinge on the chassis and a ball joint takes two."
            + "".join(f" {link!r} holds on to one body alone." for link in _loose(links, every))
        )
    matrix = np.concatenate([rows, velocities.moving("chassis", "knuckle", np.eye(3)[2:], centre)])
    condition = np.linalg.cond(matrix)
    if not condition < SINGULAR:
        raise ValueError(
            f"{name}, key 'links': joints repeat each other, or leave the wheel no travel at the design position "
            f"(condition {condition:.0e}); move a hardpoint, or check the line of a hinge."
        )
    twists = np.linalg.solve(matrix, np.append(np.zeros(len(rows)), 1.0))
    if bar is not None:
        check_bar(name, velocities, twists, bar)
    return strut_ratios(name, velocities, twists, struts)


def check_bar(name: str, velocities: "Velocities", twists: np.ndarray, bar: Any) -> None:
    """Its drop link moves along itself, by twists per wheel travel."""
    end = bar.ends[bar.link]
    line = np.asarray(end - bar.lever)
    ratio = (velocities.moving("chassis", bar.link, line[None], end) @ twists).item() / np.linalg.norm(line)
    if not abs(ratio) >= LEAST_OF_BAR:
        raise ValueError(
            f"{name}, key 'anti_roll_bar': the end of the drop link on {bar.link!r} moves by {ratio:.3g} m along the "
            "link per m of wheel travel, so the bar does not twist as the car rolls. Hold it on to what travels with "
            "the wheel, or turn the drop link towards the way of its end."
        )


def _loose(links: Collection[str], connections: Iterable[tuple[str, Connection]]) -> list[str]:
    """The links of which all ends are on one body."""
    beside: dict[str, set[str]] = {link: set() for link in links}
    for _, connection in connections:
        for link in beside.keys() & {*connection.between}:
            beside[link] |= {*connection.between} - {link}
    return sorted(link for link, others in beside.items() if len(others) < 2)


def strut_ratios(
    name: str,
    velocities: "Velocities",
    twists: np.ndarray,
    struts: Mapping[str, Strut],
    named: Callable[[str], str] = itself,
) -> dict[str, float]:
    """The motion ratios of struts by twists per wheel travel, of bodies that are called so. Raises `ValueError`."""
    ratios = {}
    for key, strut in struts.items():
        a, b = strut.bodies
        line = np.asarray(strut.ends[b] - strut.ends[a])
        speeds = [velocities.moving("chassis", named(end), line[None], strut.ends[end]) @ twists for end in (a, b)]
        ratios[key] = ratio = float((speeds[0] - speeds[1])[0] / np.linalg.norm(line))
        if not RATIOS[0] <= ratio <= RATIOS[1]:
            raise ValueError(
                f"{name}, key {key!r}: its motion ratio at the design position, compression per wheel travel, is "
                f"{ratio:.3g}; no car has one outside of {RATIOS[0]:g} to {RATIOS[1]:g}"
                + (", and it would have to pull to bear it" if ratio < 0 else "")
                + f". Does it change its length as the wheel moves? Check its two points, that it acts on {a!r} and "
                f"{b!r}, and their hinges and arms."
            )
    return ratios


class Velocities:
    """Linear equations for the twists (v, w) of bodies, one after the other; those of others are zero."""

    def __init__(self, bodies: Collection[str]):
        self._columns = {body: slice(6 * i, 6 * i + 6) for i, body in enumerate(bodies)}

    @property
    def unknowns(self) -> int:
        """How many components these twists have."""
        return 6 * len(self._columns)

    def _relative(self, a: str, b: str, parts: np.ndarray) -> np.ndarray:
        rows = np.zeros((len(parts), self.unknowns))
        for body, sign in ((b, 1.0), (a, -1.0)):
            if body in self._columns:
                rows[:, self._columns[body]] += sign * parts
        return rows

    def moving(self, a: str, b: str, directions: np.ndarray, at: Any) -> np.ndarray:
        """The velocity of b in a at a point, along directions, shape (n, 3)."""
        return self._relative(a, b, directions @ np.hstack([np.eye(3), -np.cross(np.eye(3), np.asarray(at))]))

    def turning(self, a: str, b: str, directions: np.ndarray) -> np.ndarray:
        """The angular velocity of b in a about them."""
        return self._relative(a, b, np.hstack([np.zeros_like(directions), directions]))

    def rows(self, joints: Iterable[Connection]) -> np.ndarray:
        """What the joints say."""
        found = [np.zeros((0, self.unknowns))]
        for joint in joints:
            at, turning, moving = joint.blocked()
            turning = turning / np.linalg.norm(turning, axis=1, keepdims=True)
            found += [self.turning(*joint.between, turning), self.moving(*joint.between, moving, at)]
        return np.concatenate(found)


def check_arms(name: str, key: str, link: Link, connection: Connection) -> None:
    """The link turns about both arms, and not about itself."""
    arms = [np.asarray(arm) for arm in connection.arms or ()]
    normal = np.cross(arms[0], arms[1])
    sine = np.linalg.norm(normal) / np.prod([np.linalg.norm(arm) for arm in arms])
    if not sine > math.sin(LEAST_ANGLE):
        raise ValueError(
            f"{name}, key '{key}.link_arm': {arms[1]} lies along the other arm, {arms[0]}; turn one of them."
        )
    along = link.direction()
    cosine = abs(normal @ along) / np.linalg.norm(normal) / np.linalg.norm(along)
    if not cosine > math.sin(LEAST_ANGLE):
        angle = math.degrees(math.asin(cosine))
        raise ValueError(
            f"{name}, key '{key}.arm': the cross with the arms {arms[0]} and {arms[1]} is singular, the link lies in "
            f"their plane to {angle:.1f} degrees and could spin about itself; give arms across it, or leave them out."
        )
