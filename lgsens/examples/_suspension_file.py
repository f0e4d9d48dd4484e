"""The format of suspension files: what bodies, connections and forces the tables of a document stand for.

Bodies are `chassis`, `knuckle`, `wheel` and the links; wherever a table has the name of one as a key, its value is a
point of that body. Lengths and masses of points and bodies are in `units`, all else in SI units; axes are x forward,
y left, z up. TOML, or JSON of the same structure.

    [units]        length [m], mass [kg]: of the units of the file
    [road]         height: z of the road at the design position, in units of the file; left out: 0
    [links.NAME]   BODY = [x, y, z]: a ball joint at that body, or BODY = [[x, y, z], [x, y, z]]: a hinge through both
                   points; mass; centre_of_mass and inertia, left out: a uniform bar between its two ends; arm and
                   link_arm: directions of the arms of its universal joint, see `Link`; or in place of masses
    [links.NAME.beam]  a link with two ends bends: tube = {diameter, thickness}, round = {diameter} or rectangle =
                   {width, height} [m], a height goes along the direction up (left out: z); young [N/m²], poisson,
                   density [kg/m³], damping [s] (left out: none), see `BeamSection`; elements (left out: 4); or in
                   place of shape and material section = {stiffness: [E A, k₂ G A, k₃ G A, G J, E I₂, E I₃], mass,
                   inertia}, of axis 3 along up
    [joints.NAME]  type (cylindrical, fixed, prismatic, revolute, spherical), between = [BODY, BODY], at: a point, or
                   the two points of its line
    [knuckle], [wheel], [chassis]: centre_of_mass (wheel: centre, and bearing, its hub), mass, inertia (principal
                   moments about the axes of the file, of the wheel about its own, the second of which is its spin axis)
    [wheel]        camber_deg, toe_deg: at the design position [degree] (left out: 0, upright and straight), camber
                   positive with the top outward, toe with the front inward; the bearing is on the spin axis
    [spring]       BODY = [x, y, z] twice, and stiffness, or curve = [[compression, force], …], which is counted from
                   the design position, or from free_length [m]; a constant is added so that the car rests there
    [damper]       BODY = [x, y, z] twice, and damping, or curve = [[speed of compression, force], …] with [0, 0]
    [tyre]         stiffness.   [link_section]  radius of bars.   [bump]  height, duration
    [design]       limits of the design problem, see `DesignLimits`

Of a spring or damper `link`, `link_point`, `chassis_point` mean the same as the names of its two bodies.

Of an axle; points (of the side of the file) and masses are in `units` here as well, all else in SI units:

    [subframe]     centre_of_mass, mass, inertia: a body that links, joints and springs may hold on to in place of the
                   chassis; without mounts it is fixed to it
    [subframe.mounts.NAME]  at, and the keys of a bushing
    [rack]         centre_of_mass, mass, inertia: another such body, which slides along axis (left out: y) on the
                   chassis or on = "subframe"; travel [m], how far either way; ratio, its way per turn of the steering
                   wheel [m/rad], or c_factor [m per whole turn]
    [anti_roll_bar]  bearing: a point of its straight middle, along y, where the chassis or on = "subframe" carries it;
                   lever: the end of its lever, and BODY = [x, y, z], the other end of the drop link on a link or the
                   knuckle; mass; stiffness [N m/rad] of the whole bar, or diameter, length [m] and, if they are
                   others than those of a rod of steel, bore [m], shear_modulus [Pa]; damping [N m s/rad]; or in
                   place of all these
    [anti_roll_bar.beam]  as of a link, tube or round: the bar is a beam from lever to lever, see `Bar`
    [twist_beam]   BODY = [x, y, z]: where the axis of the cross member of a twist-beam axle, which goes on to the
                   mirror image of that point, is fixed to the arm, the knuckle or a link, that has one ball joint on
                   the chassis (joints.NAME, spherical); shear_centre: of the section from its axis, forward and up
                   [m] (left out: on it), see `TwistBeam`
    [twist_beam.beam]  as of a link, elements of either half
    [vehicle]      of the car, for the rig: axle = "rear" (left out: it) or "front"; wheelbase, centre_height over the
                   road [m]; braking_share, traction_share of this axle in all forces, see `lgsens.rigs.Vehicle`
    [solid_axle]   both knuckles, each one half of the axle with half its mass, are one body; final_drive = "axle" (left
                   out: there) or "chassis" (De Dion), see `SolidAxle`
    [solid_axle.links.NAME]  as links.NAME, those that the axle has once: a Panhard rod, an upper link in the middle,
                   what a Watt's linkage is made of; their bodies are `chassis`, `subframe`, `solid_axle` and each
                   other, and bushings may replace their joints NAME_BODY
    [leaf_spring]  in place of `spring`, of a solid axle: front, rear: its eyes, front on the chassis; seat: where it is
                   clamped to the axle; shackle: where that of the rear eye is pinned to the chassis, all pins along y;
                   width, thickness of a leaf [m]; leaves, and full_length, how many of them go from eye to eye (left
                   out: 1); young, poisson, density, damping as of a beam; shackle_mass; elements of either half (left
                   out: 4); bushings may replace leaf_spring_front, leaf_spring_seat, leaf_spring_rear,
                   leaf_spring_shackle; see `LeafPack`
    [anti_roll_bar.bushing]  the keys of a bushing: of the bearings of such a bar, left out: ball joints
    [bushings.NAME]  in place of the joint NAME, LINK_BODY of a link: stiffness, rotational_stiffness [N/m], [N m/rad],
                   damping, rotational_damping (left out: none), three numbers, or two times three of the two
                   bushings of a hinge; axes: [[x, y, z], [x, y, z]], the first and the plane of the second (left out:
                   those of the file); preload, rotational_preload [N], [N m] along the axes of the file, see `Mount`
                   (left out: those with which the axle rests in the design position); spring_1 … rotational_damper_3:
                   curves that come to the rates along or about an axis, [[displacement or speed, force or moment], …]
                   of the second of the joint's bodies (a link) against the first, with [0, 0]; see `Mount`
    [bump_stop], [rebound_stop]  BODY = [x, y, z] twice (left out: the points of the damper), gap [m], stiffness [N/m],
                   rounding [m], progression [m]; see `BumpStop`

A corner by itself has stops and links that bend, and of the rest what is rigid: the chassis takes the place of
subframe and rack, joints that of bushings, and there is no anti-roll bar. What a twist beam guides is on a hinge
along y, about which both sides turn alike; half of a solid axle slides in a plane upright to y.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lgsens._validate import as_float
from lgsens.examples._axle_file import OF_AXLE, levelled, mounts, solid_axle, stop
from lgsens.examples._corner_scene import connections
from lgsens.examples._file_axes import FileAxes
from lgsens.examples._hardpoint_file import Reader
from lgsens.examples._leaf_pack import SHACKLE, TABLE as LEAF, LeafPack, read_leaf_spring
from lgsens.examples._link_file import CARRIERS, OF_LINK, carried, read_link
from lgsens.examples._solid_axle import BODY
from lgsens.examples._suspension_parts import ALONG_A_LINE, AT_A_POINT, Connection, Link, Part, Strut
from lgsens.examples._wheel import Wheel
from lgsens.model import Sampled

LEAST_RADIUS, LARGEST_RADIUS = 0.1, 2.0  # m, loaded radii of tyres
PARTS = ("chassis", "knuckle", "wheel", *CARRIERS, "anti_roll_bar", "drop_link", "twist_beam", "solid_axle", LEAF)
TABLES = ("name", "units", "road", "links", "joints", "chassis", "knuckle", "wheel", "spring", "damper", "tyre")
TABLES += ("link_section", "bump", "design", LEAF)
OF_TABLES = {"tyre": ("stiffness",), "bump": ("height", "duration"), "link_section": ("radius",)}
RATES = {"spring": "stiffness", "damper": "damping"}
ANGLES = {"camber_deg": 20.0, "toe_deg": 5.0}  # how large they may be [degree]
MOST_OFF_AXIS = 0.01  # m; a bearing of a wheel thought upright is as far off where it leans
MOST_OFF_WHEEL = 5.0  # m; no point of a suspension is as far from its wheel
STOPS = ("bump_stop", "rebound_stop")
OF_MODEL = ("hub", "heave", "travel")  # joints that there are beside those of the file


def reader(document: dict, path: str) -> tuple[Reader, float]:
    """The tables of a document, read in metres over the road, and its unit of mass [kg]."""
    root = Reader(document, path)
    units = root.table("units")
    units.only(("length", "mass"))
    if "road" in root:
        root.table("road").only(("height",))
    metre, kilogram = float(units.number("length")), float(units.number("mass"))
    road = float(root.table("road").number("height", metre, positive=False)) if "road" in root else 0.0
    return Reader(document, path, metre=metre, road=road), kilogram


def members(document: dict, path: str) -> dict[str, Any]:
    """The fields of a `QuarterCar`. Raises `ValueError` naming file and key for what is missing or wrong."""
    root, kilogram = reader(document, path)
    tables = root.tables("links")
    own = (*PARTS, *OF_LINK, *((SHACKLE,) if LEAF in root else ()))
    for name in sorted({*own} & {*tables}):
        raise root.table("links").fail(name, f"is a name of its own; choose another than {[*own]}.")
    bodies = ("chassis", "knuckle", *(body for body in CARRIERS if body in root), *tables)
    carriers: dict[str, str] = {}
    links = {name: read_link(name, table, bodies, kilogram, carriers) for name, table in tables.items()}
    joints = {name: _joint(name, table, bodies, carriers) for name, table in root.tables("joints").items()}
    leaf = _leaf_spring(root, kilogram)
    of_leaf = {} if leaf is None else leaf.connections()
    known = connections(links, {**joints, **of_leaf}, carriers)
    solid = solid_axle(root, kilogram, (*PARTS, *OF_LINK, *links, *joints), known)
    joints = levelled(root, links, joints)
    taken = {*OF_MODEL, *links, *(f"{name}_{body}" for name, link in links.items() for body in link.ends)}
    for name in sorted(taken & set(joints)):
        raise root.table("joints").fail(
            name, f"another joint of the scene has this name; those taken are {sorted(taken)}."
        )

    def part(key: str, centre: str, *more: str) -> Part:
        body = root.table(key)
        body.only((centre, "mass", "inertia", *more))
        return Part(body.point(centre), *body.mass_and_moments(kilogram))

    wheel = _wheel(root, part("wheel", "centre", "bearing", *ANGLES))
    if not LEAST_RADIUS <= float(wheel.centre[2]) <= LARGEST_RADIUS:
        raise root.table("wheel").fail(
            "centre",
            f"is {float(wheel.centre[2]):.4g} m over the road, which is at z = {root.road:g} of the file, and no "
            f"tyre has a loaded radius outside of {LEAST_RADIUS} to {LARGEST_RADIUS} m; set the key 'road.height' to "
            "the z of the road at the design position, or 'units.length' to what the file is written in (0.001: mm).",
        )
    every = links if solid is None else links | solid.links
    bars = [link for link in every.values() if link.inertia is None and link.beam is None]
    for key, keys in OF_TABLES.items():
        if key in root:
            root.table(key).only(keys)
    bump = root.table("bump")
    of_corner = {key: rate for key, rate in RATES.items() if leaf is None or key != "spring"}
    struts = {key: _strut(key, root.table(key), bodies, rate, carriers) for key, rate in of_corner.items()}
    root.only((*TABLES, *OF_AXLE))  # after what is missing: a table that is spelled wrong is both
    stops = {key: stop(root.table(key), key, bodies, struts["damper"], carriers) for key in STOPS if key in root}
    if solid is None:
        _check_points(root, wheel, links, joints, {**struts, **stops})
    bushings = mounts(root, links, {**joints, **of_leaf}, carriers, solid)
    held = {"links": links, "joints": joints, "mounts": bushings}
    if solid is not None:
        held = solid.more(wheel.centre, **held)
        carriers |= dict(solid.carriers)
    return {
        "name": str(document.get("name", Path(path).stem)),
        **held,
        "knuckle": part("knuckle", "centre_of_mass"),
        "wheel": wheel,
        "chassis": part("chassis", "centre_of_mass"),
        "bearing": root.table("wheel").point("bearing"),
        **({"spring": None} | struts),
        "leaf_spring": leaf,
        "tyre_stiffness": root.table("tyre").number("stiffness"),
        "link_radius": root.table("link_section").metres("radius", 0.2) if bars else None,
        "bump_height": bump.metres("height", 1.0, positive=False),
        "bump_duration": bump.number("duration"),
        "stops": stops,
        "carriers": tuple(sorted(carriers.items())),
        "axes": FileAxes(root.metres_of_road),
    }


def _wheel(root: Reader, part: Part) -> Wheel:
    table, angles = root.table("wheel"), {}
    for key, most in ANGLES.items():
        if key in table:
            angle = table.number(key, positive=False)
            if abs(float(angle)) > most:
                raise table.fail(key, f"must be within ±{most:g} degrees, got {float(angle):g}.")
            angles[key.removesuffix("_deg")] = jnp.radians(angle)
    wheel, bearing = Wheel(part.centre, part.mass, part.inertia, **angles), table.point("bearing")
    if not (off := float(jnp.linalg.norm(bearing - wheel.on_axis(bearing)))) <= MOST_OFF_AXIS:
        raise table.fail(
            "bearing",
            f"is {off:.4g} m off the spin axis, the line through `centre` {np.asarray(wheel.centre).tolist()} along "
            f"{np.asarray(wheel.spin_axis).round(6).tolist()} [m]; the wheel would turn about another axis.",
        )
    return wheel


def _check_points(
    root: Reader, wheel: Wheel, links: Mapping[str, Link], joints: Mapping[str, Connection], struts: Mapping[str, Any]
) -> None:
    """Raise `ValueError` for points in another unit than the wheel's, and for a wheel, or links, on the other side of
    the car."""
    stacked = lambda points: np.concatenate([np.atleast_2d(point) for point in points])
    held = {f"links.{name}": stacked(link.ends.values()) for name, link in links.items()}
    held |= {f"joints.{name}": stacked([joint.at]) for name, joint in joints.items()}
    centre = np.asarray(wheel.centre)
    for key, points in (held | {name: stacked(strut.ends.values()) for name, strut in struts.items()}).items():
        distances = np.linalg.norm(points - centre, axis=1)
        if not distances.max() <= MOST_OFF_WHEEL:
            furthest = points[np.argmax(distances)] + np.array([0.0, 0.0, root.metres_of_road])
            raise root.fail(
                key,
                f"has the point {furthest.tolist()} m, {distances.max():.4g} m from the wheel's centre, and none of a "
                f"suspension is further than {MOST_OFF_WHEEL:g} m; is it in another unit than 'units.length' says?",
            )
    across = float(stacked(held.values())[:, 1].mean())
    beyond = lambda y: np.max(y * np.sign(centre[1])) < -0.3 * abs(centre[1])  # a hinge may be, but for a little
    if beyond(across):
        raise root.table("wheel").fail(
            "centre",
            f"is at y = {centre[1]:.4g} m, and links and joints are at {across:.4g} m in the mean, on the other side "
            "of the car; turn the sign of its y, and of its bearing's.",
        )
    for key, points in held.items():
        if beyond(points[:, 1]):
            raise root.fail(
                key,
                f"has all its points on the other side of the car, at y = {points[:, 1].round(6).tolist()} m, and the "
                f"wheel's centre is at {centre[1]:.4g} m; turn the sign of their y.",
            )


def _leaf_spring(root: Reader, kilogram: float) -> LeafPack | None:
    if LEAF not in root:
        return None
    if "spring" in root:
        raise root.fail("spring", f"the axle is on leaf springs, `{LEAF}`; leave one of the two out.")
    if BODY not in root:
        raise root.fail(LEAF, f"bears and guides a solid axle; give the table `{BODY}`, empty if it has no links.")
    return read_leaf_spring(root.table(LEAF), kilogram)


def _joint(name: str, table: Reader, bodies: tuple[str, ...], carriers: dict[str, str]) -> Connection:
    table.only(("type", "between", "at"))
    kind = table.choice("type", [*AT_A_POINT, *ALONG_A_LINE])
    at, wanted = table.points("at"), 1 if kind in AT_A_POINT else 2
    if at.ndim != wanted:
        raise table.fail("at", f"must be {('a point', 'two points, its line,')[wanted - 1]} of a {kind} joint.")
    a, b = carried(table, f"joints.{name}", dict.fromkeys(table.pair("between", bodies)), carriers)
    return Connection(kind, (a, b), at)


def _strut(key: str, table: Reader, bodies: tuple[str, ...], rate: str, carriers: dict[str, str]) -> Strut:
    if "link" in table:
        link = table.choice("link", [body for body in bodies if body != "chassis"])
        ends = {link: table.point("link_point"), "chassis": table.point("chassis_point")}
        if np.array_equal(ends[link], ends["chassis"]):
            raise table.fail("chassis_point", "must differ from 'link_point'; the two points coincide.")
    else:
        ends = table.ends(bodies, (rate, "curve", "free_length"))
        if len(ends) != 2 or any(point.ndim != 1 for point in ends.values()):
            raise table.fail(
                "link", f"it needs one point on each of two bodies of {sorted(bodies)}, got {sorted(ends)}."
            )
    ends = carried(table, key, ends, carriers)
    if "curve" not in table:
        if "free_length" in table:
            raise table.fail("free_length", "belongs to a `curve`; without one it follows from what the spring bears.")
        return Strut(ends, table.number(rate))
    if rate in table:
        raise table.fail(rate, "a curve has its own slope; give one of `curve` and this key.")
    return _with_curve(table, ends, rate)


def _with_curve(table: Reader, ends: dict[str, Array], rate: str) -> Strut:
    """The file has compression and push, the element extension and tension."""
    x, force = -table.curve("curve")[:, ::-1]
    free_length = table.number("free_length") if "free_length" in table else None
    if rate == "damping" and (free_length is not None or (0.0, 0.0) not in list(zip(x, force))[1:-1]):
        raise table.fail(
            "curve",
            "of a damper must have a point [0, 0] and some on both sides, bump and rebound, and no free_length.",
        )
    a, b = ends.values()
    at = 0.0 if free_length is None else jnp.linalg.norm(b - a) - free_length
    signal, at = Sampled(x, force, "monotone"), as_float(at, (), "extension")
    slope = jax.jit(lambda at: jax.jvp(signal, (at,), (jnp.ones_like(at),))[1])(at)
    if not x[0] < float(at) < x[-1]:
        raise table.fail(
            "curve", f"goes from {-x[-1]} to {-x[0]}, and does not contain the design position, {0.0 - float(at):.6g}."
        )
    if not slope > 0:
        raise table.fail(
            "curve", f"must rise at {0.0 - float(at):.6g}, the design position, got a slope of {float(slope)}."
        )
    return Strut(ends, slope, jnp.stack([signal.times, signal.values / slope]), free_length)
