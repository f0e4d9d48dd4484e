"""The tables of an axle in a suspension file; `lgsens/examples/_suspension_file.py` has the format."""

import dataclasses
import math
from collections.abc import Collection, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lgsens._validate import as_float
from lgsens.examples._axle_parts import ALONG_Y, CURVED, CURVES, RATES, Bar, Mount, Rack, Stop
from lgsens.examples._corner_scene import connections, joints_of
from lgsens.examples._hardpoint_file import Reader
from lgsens.examples._link_beam import read_beam
from lgsens.examples._link_file import CARRIERS, carried, read_link
from lgsens.examples._solid_axle import BODY, SolidAxle
from lgsens.examples._suspension_parts import LEVEL, Connection, Link, Part, Strut
from lgsens.examples._twist_beam import TwistBeam

OF_AXLE = (*CARRIERS, "vehicle", "anti_roll_bar", "twist_beam", "solid_axle", "bushings", "bump_stop", "rebound_stop")
OF_VEHICLE, SHARES = {"wheelbase": 30.0, "centre_height": 5.0}, ("braking_share", "traction_share")
OF_MOUNT = (*RATES, *CURVES, "axes", "preload", "rotational_preload")
OF_PART = ("centre_of_mass", "mass", "inertia")
SECTION = ("stiffness", "diameter", "length", "bore", "shear_modulus", "damping")
OF_TWIST_BEAM = ("beam", "shear_centre")
OF_STOP = ("gap", "stiffness", "rounding", "progression")


def stop(table: Reader, key: str, bodies: tuple[str, ...], damper: Strut, carriers: dict[str, str]) -> Stop:
    """A bump or rebound stop."""
    ends = table.ends(bodies, OF_STOP)
    if not ends:
        ends = damper.ends
        if "damper" in carriers:
            carriers[key] = carriers["damper"]
    elif len(ends) != 2 or any(point.ndim != 1 for point in ends.values()):
        raise table.fail(
            next(iter(ends)),
            f"a stop needs one point on each of two bodies of {sorted(bodies)}, got {sorted(ends)}; without any it "
            "has those of the damper.",
        )
    ends = carried(table, key, ends, carriers)
    rates = {name: table.number(name) for name in ("stiffness", "rounding")}
    progression = table.number("progression") if "progression" in table else None
    return Stop(
        ends, table.metres("gap", 0.5, positive=False), **rates, progression=progression, rebound=key != "bump_stop"
    )


def mounts(
    root: Reader,
    links: Mapping[str, Link],
    joints: Mapping[str, Connection],
    carriers: Mapping[str, str],
    solid: SolidAxle | None,
) -> dict[str, Mount]:
    """The bushings of a corner, by the joints that they replace, and the mounts of the subframe."""
    found = _bushings(root, connections(links, joints, carriers), () if solid is None else solid.connections())
    if "subframe" in root:
        for name, table in root.table("subframe").tables("mounts").items():
            table.only(("at", *OF_MOUNT))
            found[f"subframe_{name}"] = _mount(table, 1, table.point("at"))
    return found


def _bushings(root: Reader, known: Mapping[str, Connection], others: Collection[str]) -> dict[str, Mount]:
    """Those of some joints; `others` has the names of those elsewhere."""
    found = {}
    for name, table in root.tables("bushings").items():
        if name not in known and name in others:
            continue
        if name not in known:
            every = sorted({*known, *others})
            raise root.table("bushings").fail(name, f"there is no such joint; those of the file are {every}.")
        if known[name].kind in ("cylindrical", "prismatic"):
            raise table.fail("stiffness", f"joint {name!r} slides, and a bushing would hold it; leave it a joint.")
        table.only(OF_MOUNT)
        found[name] = _mount(table, len(np.atleast_2d(known[name].at)))
    return found


def _mount(table: Reader, count: int, at: Array | None = None) -> Mount:
    rates = {key: table.triples(key, count) for key in RATES[:2]}
    rates |= {key: table.triples(key, count) for key in RATES[2:] if key in table}
    curves = {key: _centred(table, key) for key in CURVES if key in table}
    for key, values in rates.items():
        positive = key == "stiffness" or (key == "rotational_stiffness" and count == 1)  # two points hold a link
        may_be_zero = [not positive or f"{CURVED[key]}_{i}" in curves for i in (1, 2, 3)]
        given = np.atleast_2d(values)
        if not np.all((given > 0) | ((given == 0) & np.array([may_be_zero]))):
            bound = "positive, else a body can move freely" if positive else "zero or positive"
            raise table.fail(key, f"must be {bound}, got {np.asarray(values).tolist()}; give small numbers for soft.")
    axes = table.directions("axes") if "axes" in table else jnp.eye(2, 3) if curves else None
    if "preload" in table or "rotational_preload" in table:
        rates |= {key: table.triples(key, count) for key in ("preload", "rotational_preload")}
    return Mount(**rates, axes=axes, at=at, curves=curves)


def _centred(table: Reader, key: str) -> Array:
    """A curve through [0, 0], where it rises."""
    curve = table.curve(key)
    middle = np.flatnonzero((curve == 0).all(axis=0))
    if not (len(middle) and 0 < middle[0] < curve.shape[1] - 1 and np.all(np.diff(curve[1])[middle[0] - 1 :][:2] > 0)):
        raise table.fail(
            key, "must have a point [0, 0], where it rises, and some on both sides; preloads are `preload`."
        )
    return as_float(curve, None, key)


def axle_members(root: Reader, kilogram: float, corner: Any) -> dict[str, Any]:
    """The fields of an `Axle`, of which this is a corner, a `QuarterCar`; the one on the left is on the file's side."""
    found: dict[str, Any] = {"left": corner}
    if BODY in root:
        known = connections(corner.links, joints_of(corner), dict(corner.carriers))
        found[BODY] = solid_axle(root, kilogram, (), known)
        found["left"] = corner = found[BODY].freed(corner)
    links = corner.links
    part = lambda table: Part(table.point("centre_of_mass"), *table.mass_and_moments(kilogram))
    if "subframe" in root:
        table = root.table("subframe")
        table.only((*OF_PART, "mounts"))
        found["subframe"] = part(table)
    if "rack" in root:
        table = root.table("rack")
        table.only((*OF_PART, "axis", "on", "travel", "ratio", "c_factor"))
        if "ratio" in table and "c_factor" in table:
            raise table.fail("c_factor", "is 2π times `ratio`; give one of them.")
        ratio = table.metres("ratio", 0.1) if "ratio" in table else None
        if "c_factor" in table:
            ratio = table.metres("c_factor", 0.5) / (2.0 * math.pi)
        axis = table.direction("axis")
        travel = table.metres("travel", 0.5) if "travel" in table else None
        axis = as_float(ALONG_Y, (3,), "axis") if axis is None else axis
        found["rack"] = Rack(part(table), axis, ratio, travel, _carrier(root, table))
    if "anti_roll_bar" in root:
        found["bar"] = _bar(root, root.table("anti_roll_bar"), kilogram, links)
    if "twist_beam" in root:
        side = np.sign(root.table("wheel").point("centre")[1])
        found["twist_beam"] = _twist_beam(root.table("twist_beam"), links, side)
    if "vehicle" in root:
        table = root.table("vehicle")
        table.only(("axle", *OF_VEHICLE, *SHARES))
        found["rear"] = "axle" not in table or table.choice("axle", ["front", "rear"]) == "rear"
        found["vehicle"] = {key: table.metres(key, most) for key, most in OF_VEHICLE.items() if key in table}
        found["vehicle"] |= {key: table.share(key) for key in SHARES if key in table}
    return found


def levelled(root: Reader, links: Collection[str], joints: dict[str, Connection]) -> dict[str, Connection]:
    """The joints of a corner: that of an arm which a twist beam guides is a hinge along y, as both sides move alike."""
    if "twist_beam" not in root:
        return joints
    table = root.table("twist_beam")
    (arm,) = _arm(table, links)
    between = {arm, "chassis"}
    found = [name for name, joint in joints.items() if joint.kind == "spherical" and {*joint.between} == between]
    if len(found) != 1:
        raise table.fail(
            arm,
            f"it guides an arm that is on one ball joint of the chassis (a bushing of the axle may replace it), and "
            f"{arm!r} has {found or 'none'}; give it one in `joints`, of type 'spherical'.",
        )
    return joints | {found[0]: dataclasses.replace(joints[found[0]], kind=LEVEL)}


def _arm(table: Reader, links: Collection[str]) -> dict[str, Any]:
    """The body of the corner to which a twist beam is fixed, and where."""
    bodies = ("knuckle", *links)
    ends = table.ends(bodies, OF_TWIST_BEAM)
    if len(ends) != 1 or any(point.ndim != 1 for point in ends.values()):
        raise table.fail(
            "beam", f"it is fixed to one body of the corner, a point of one of {sorted(bodies)}, got {sorted(ends)}."
        )
    return ends


def _twist_beam(table: Reader, links: Mapping[str, Link], side) -> TwistBeam:
    ends = _arm(table, links)
    ((arm, end),) = ends.items()
    if arm in links and links[arm].beam is not None:
        raise table.fail(arm, "is a link that bends, and a twist beam is fixed to a rigid arm; leave out its `beam`.")
    if not end[1]:
        raise table.fail(arm, "is in the plane y = 0, and the beam goes from there to its mirror image; move it.")
    if np.sign(end[1]) != side:
        raise table.fail(
            arm, f"is at y = {float(end[1]):g} m, on the other side of the car than the wheel; turn the sign of its y."
        )
    centre = table.within("shear_centre", table.numbers("shear_centre", 2), 1.0) if "shear_centre" in table else None
    member = TwistBeam(ends, read_beam(table, ()), centre)
    try:
        member.bent()
    except ValueError as error:
        raise table.fail("beam", str(error)) from error
    return member


def solid_axle(root: Reader, kilogram: float, taken: Collection[str], corner: Collection[str]) -> SolidAxle | None:
    """What holds a solid axle beside its corners, which have the joints `corner`; None: it is none."""
    if BODY not in root:
        return None
    if "twist_beam" in root:
        raise root.fail(BODY, "its knuckles are one body, and a twist beam joins two; leave one of the tables out.")
    table = root.table(BODY)
    table.only(("final_drive", "links"))
    live = "final_drive" not in table or table.choice("final_drive", ["axle", "chassis"]) == "axle"
    tables = table.tables("links")
    of_sides = {f"{side}_{name}" for side in ("left", "right") for name in (*taken, *corner)}
    for name in tables:
        if name in taken or name in of_sides:
            raise table.table("links").fail(
                name,
                f"is the name of something else; those taken are {sorted(taken)}, also after left_ and right_.",
            )
    bodies = ("chassis", BODY, *(["subframe"] if "subframe" in root else []), *tables)
    carriers: dict[str, str] = {}
    links = {name: read_link(name, of, bodies, kilogram, carriers) for name, of in tables.items()}
    for name, link in links.items():
        if link.beam is not None:
            raise tables[name].fail("beam", "links of a solid axle are rigid; give it mass in place of this.")
    bars = any(link.is_bar for link in links.values())
    radius = root.table("link_section").number("radius") if bars else None
    along = tuple(name for name, link in links.items() if {*link.ends} == {"chassis", BODY} and _along(link))
    axle = SolidAxle(links, along, {}, radius, tuple(sorted(carriers.items())), live)
    return dataclasses.replace(axle, mounts=_bushings(root, axle.connections(), corner))


def _along(link: Link) -> bool:
    """Whether it goes less across the car than along."""
    x, y, z = np.abs(np.asarray(link.axis[1] - link.axis[0]))
    return bool(y <= np.hypot(x, z))


def _carrier(root: Reader, table: Reader) -> str:
    known = ["chassis", "subframe"] if "subframe" in root else ["chassis"]
    return table.choice("on", known) if "on" in table else "chassis"


def _bar(root: Reader, table: Reader, kilogram: float, links: Collection[str]) -> Bar:
    bodies = ("knuckle", *links)
    ends = table.ends(bodies, ("bearing", "lever", "on", "mass", "beam", "bushing", *SECTION))
    if len(ends) != 1 or any(point.ndim != 1 for point in ends.values()):
        raise table.fail(
            "lever", f"its drop link needs the other end, a point of one body of {sorted(bodies)}, got {sorted(ends)}."
        )
    beam = read_beam(table, ("mass", *SECTION), ("tube", "round")) if "beam" in table else None
    section = {key: table.number(key) for key in SECTION if key in table}
    if "bushing" in table:
        if beam is None:
            raise table.fail("bushing", "is of the bearings of a bar with `beam`, others are hinges; leave it out.")
        table.table("bushing").only(OF_MOUNT)
    if "stiffness" in section and len({*section} - {"damping"}) > 1:
        raise table.fail("stiffness", f"follows from the bar's dimensions; leave it or {sorted(section)} out.")
    if "stiffness" not in section and beam is None:
        section |= {key: table.number(key) for key in ("diameter", "length")}
    bearing, lever = table.point("bearing"), table.point("lever")
    (end,) = ends.values()
    arm, rod = np.asarray(lever - bearing) * (1.0, 0.0, 1.0), np.asarray(end - lever)
    turning = abs(np.cross(arm, rod)[1])  # of the drop link about the bar
    if not turning > 0.1 * np.linalg.norm(arm) * np.linalg.norm(rod) or not np.linalg.norm(rod) > 0:
        raise table.fail(
            "lever",
            "the lever has no length across y, or the drop link goes along it or along y and cannot turn it; "
            f"got bearing, end of lever and end of drop link {np.asarray(jnp.stack([bearing, lever, end])).tolist()}.",
        )
    mass = table.number("mass", kilogram) if beam is None else None
    mount = _mount(table.table("bushing"), 1) if "bushing" in table else None
    bar = Bar(bearing, lever, ends, mass, section, _carrier(root, table), beam, mount)
    try:
        bar.element("left", "right")
    except ValueError as error:
        raise table.fail("diameter" if beam is None else "beam", str(error)) from error
    return bar
