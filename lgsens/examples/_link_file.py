"""Reads links, of a corner or of a solid axle; `lgsens/examples/_suspension_file.py` has the format."""

from typing import Any

from lgsens.examples._hardpoint_file import FORMAT, Reader
from lgsens.examples._link_beam import read_beam
from lgsens.examples._suspension_parts import Link

CARRIERS = ("subframe", "rack")
OF_LINK = ("mass", "centre_of_mass", "inertia", "arm", "link_arm", "beam")


def carried(table: Reader, key: str, ends: dict[str, Any], carriers: dict[str, str]) -> dict[str, Any]:
    """The ends of an element with the chassis in place of subframe or rack, which `carriers` keeps."""
    taken = [body for body in ends if body in CARRIERS]
    if not taken:
        return ends
    if len(taken) > 1 or "chassis" in ends:
        raise table.fail(
            taken[-1], f"is with {sorted({*ends} - {taken[-1]})} one body to a corner; hold on to one of them."
        )
    carriers[key] = taken[0]
    return {"chassis" if body in CARRIERS else body: points for body, points in ends.items()}


def read_link(name: str, table: Reader, bodies: tuple[str, ...], kilogram: float, carriers: dict[str, str]) -> Link:
    """A link that may hold on to these bodies; `carriers` as in `carried`."""
    ends = carried(table, f"links.{name}", table.ends([body for body in bodies if body != name], OF_LINK), carriers)
    beam = read_beam(table, ("mass", "centre_of_mass", "inertia")) if "beam" in table else None
    if beam is not None and len(ends) != 2:
        raise table.fail("beam", f"goes between two ends, got {sorted(ends)}; leave it out, the link is rigid.")
    own = "centre_of_mass" in table or "inertia" in table
    if len(ends) < 2 and not own:  # one end makes no bar
        missing, *others = [body for body in bodies if body not in (*ends, name)]
        raise table.fail(missing, f"is missing, or a point on another one of {others}; {FORMAT}")
    if len(ends) > 2 and not own:
        table.point("centre_of_mass")
    mass, inertia = table.mass_and_moments(kilogram) if own else (None, None)
    if not own and beam is None:
        mass = table.number("mass", kilogram)
    link = Link(
        ends,
        mass,
        centre=table.point("centre_of_mass") if own else None,
        inertia=inertia,
        arm=table.direction("arm"),
        link_arm=table.direction("link_arm"),
        beam=beam,
    )
    if beam is not None:
        try:
            link.bent(name)
        except ValueError as error:
            raise table.fail("beam", str(error)) from error
    if link.first is None and (link.arm, link.link_arm) != (None, None):
        key = "link_arm" if link.arm is None else "arm"
        raise table.fail(key, "the link has a hinge or three ends and no universal joint; leave it out.")
    return link
