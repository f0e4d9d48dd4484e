"""The bodies, joints and forces of a corner: of a car by itself, or of one side of an axle."""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from jaxtyping import Array

from lgsens.examples._axle_parts import Mount
from lgsens.examples._suspension_parts import Connection, Link
from lgsens.model import AbstractForce, AbstractJoint, DistanceJoint, FixedJoint, RevoluteJoint, RigidBody

SHARED = ("chassis", "subframe", "rack")


class CornerScene(NamedTuple):
    """What a corner brings into a scene.

    Attributes:
        ends: by body that it shares with others, masses [kg] and places [m] of ends of rods on it.
        sought: its forces whose preloads hold the car, elements of beams and those of `given` among them.
        given: its bushings that have preloads of their own.
    """

    bodies: dict[str, RigidBody]
    joints: dict[str, AbstractJoint]
    forces: dict[str, AbstractForce]
    ends: dict[str, list[tuple[Array, Array]]]
    sought: list[str]
    given: dict[str, AbstractForce]


def joints_of(car: Any) -> dict[str, Connection]:
    """The joints of a corner but for those of its links: those that it has by name, and of its leaf spring."""
    return car.joints if car.leaf_spring is None else {**car.joints, **car.leaf_spring.connections()}


def connections(
    links: Mapping[str, Link], joints: Mapping[str, Connection], carriers: Mapping[str, str]
) -> dict[str, Connection]:
    """All joints by name, those of links NAME_BODY; in place of the chassis the bodies that carry them."""

    def carried(key: str, connection: Connection) -> Connection:
        between: Any = tuple(carriers.get(key, end) if end == "chassis" else end for end in connection.between)
        return dataclasses.replace(connection, between=between)

    found = {name: carried(f"joints.{name}", connection) for name, connection in joints.items()}
    for name, link in links.items():
        for connection in link.connections(name):
            connection = carried(f"links.{name}", connection)
            found[f"{name}_{connection.between[0]}"] = connection
    return found


def corner_scene(
    car: Any,
    *,
    wheel: str,
    links: str,
    side: str = "",
    mounts: Mapping[str, Mount] | None = None,
    held: Collection[str] = (),
) -> CornerScene:
    """A corner but for the chassis and its guide, gravity, and the tyre.

    Arguments:
        car: the corner, a `QuarterCar`.
        wheel, links: as in `QuarterCar.model`.
        side: of an axle, before the names of what is this side's alone; "": of no axle, the chassis carries everything.
        mounts: bushings by the joint that they replace, or of the subframe.
        held: bodies on which others act that are not of the corner.
    """
    own, mounts = f"{side}_" if side else "", mounts or {}
    carriers = dict(car.carriers) if side else {}

    node = lambda key, body: car.scene_name(body, key, own)

    def named(key: str):
        """What bodies are called by an element of the corner."""
        return lambda body: (
            carriers.get(key, body) if body == "chassis" else body if body in SHARED else node(key, body)
        )

    def jointed(name: str):
        """By a joint, which has its carrier."""
        return lambda body: body if body in SHARED else node(f"joints.{name}", body)

    leaf, own_joints = car.leaf_spring, joints_of(car)
    joined = connections(car.links, own_joints, carriers)
    struts = {"damper": car.damper} | ({"spring": car.spring} if leaf is None else {})
    busy = {*held, *(end for link in car.links.values() for end in link.ends)}
    busy |= {end for acting in (*struts.values(), *car.stops.values()) for end in acting.ends}
    busy |= {end for name, c in joined.items() if name in own_joints or name in mounts for end in c.between}
    beams = {name: link.bent(own + name) for name, link in car.links.items() if link.beam is not None}
    rods = {name: link for name, link in car.links.items() if links == "rods" and link.is_bar and name not in busy}
    rods = {name: link for name, link in rods.items() if not {*link.ends} & {*beams}}
    parts = {"knuckle": car.knuckle, "wheel": car.wheel}
    parts |= {name: link.part(car.link_radius) for name, link in car.links.items() if name not in (*rods, *beams)}
    ends: dict[str, list[tuple[Array, Array]]] = {}
    joints, forces, sought, given = {}, {}, [own + "spring"] if leaf is None else [], {}
    hub: dict[str, Any] = {"at": car.wheel.on_axis(car.bearing)}
    hub |= {"axis": car.wheel.spin_axis} if wheel == "hinged" else {}
    joints[f"{own}hub"] = (RevoluteJoint if hub.keys() > {"at"} else FixedJoint)(own + "knuckle", own + "wheel", **hub)
    for name, rod in rods.items():
        (a, start), (b, end) = sorted(rod.ends.items())
        a, b = map(named(f"links.{name}"), (a, b))
        joints[own + name] = DistanceJoint(a, b, at_a=start, at_b=end)
        for body, place in ((a, start), (b, end)):
            ends.setdefault(body, []).append((rod.own_mass / 2, place))
    joints |= {
        own + name: connection.joint(jointed(name))
        for name, connection in joined.items()
        if name not in mounts and connection.between[1] not in rods
    }
    for name, mount in mounts.items():
        place = Connection("fixed", ("chassis", "subframe"), mount.at) if mount.at is not None else joined[name]
        a, b = map(jointed(name), place.between)
        bushings = dict(mount.elements(own + name, a, b, place.at))
        forces |= bushings
        sought += bushings
        given |= {} if mount.preload is None else bushings
    bodies = {own + name: part.body(ends.pop(own + name, ())) for name, part in parts.items()}
    for beam in beams.values():
        bodies, forces, sought = bodies | beam.bodies, forces | beam.forces, [*sought, *beam.forces]
    if leaf is not None:
        of_leaf, elements = leaf.parts(own)
        bodies, forces, sought = bodies | of_leaf, forces | elements, [*sought, *elements]
    forces |= {own + key: strut.element(key, named=named(key)) for key, strut in struts.items()}
    forces |= {own + key: stop.element(named(key)) for key, stop in car.stops.items()}
    return CornerScene(bodies, joints, forces, ends, sought, given)
