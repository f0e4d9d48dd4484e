"""Links of a corner that bend: sections for them, the nodes that carry what holds on to them, and their way back."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import jax.numpy as jnp
from jaxtyping import Array

from lgsens._validate import as_float, suggestion
from lgsens.examples._corner_scene import SHARED, connections
from lgsens.examples._link_beam import LinkBeam, SectionShape, nearest
from lgsens.examples._suspension_parts import Link
from lgsens.model import BeamSection

Car = TypeVar("Car", bound=Any)


def bending(car: Car, sections: Mapping[str, BeamSection | SectionShape], elements: int, up: Any) -> Car:
    """See `QuarterCar.bending`."""
    links = dict(car.links)
    for name, section in sections.items():
        if name not in links or len(links[name].ends) != 2:
            of_two = [key for key, link in links.items() if len(link.ends) == 2]
            raise ValueError(f"`bending`: {suggestion(name, of_two)}, the links with two ends.")
        if not isinstance(section, BeamSection | SectionShape):
            raise ValueError(f"`bending`, {name!r}: must be a BeamSection or a SectionShape, got {section!r}.")
        if isinstance(section, BeamSection) and section.stiffness.shape != (6,):
            raise ValueError(f"`bending`, {name!r}: its stiffness must have shape (6,), that of principal axes.")
        beam = LinkBeam(section, elements, None if up is None else as_float(up, (3,), "`up`"))
        links[name] = dataclasses.replace(links[name], mass=None, centre=None, inertia=None, beam=beam)
        links[name].bent(name)
    return with_nodes(dataclasses.replace(car, links=links))


def rigid(car: Car) -> Car:
    """See `QuarterCar.rigid`."""

    def stiff(link: Link) -> Link:
        if link.beam is None:
            return link
        part = link.part(None)
        return dataclasses.replace(link, mass=part.mass, centre=part.centre, inertia=part.inertia, beam=None)

    return dataclasses.replace(car, links={name: stiff(link) for name, link in car.links.items()})


def _carried_by(car: Any, link: str, drop_link: Mapping[str, Array]) -> dict[str, Array]:
    """The points at which joints, by "joints.NAME", and forces hold on to a link.

    `drop_link`: by its body the end of that of an anti-roll bar.
    """
    own = car.links[link]
    ends = dict(zip(sorted(own.ends), own.axis))
    found = {f"joints.{link}_{body}": point for body, point in ends.items()}
    if "chassis" in ends:
        found |= {f"joints.{link}_{carrier}": ends["chassis"] for carrier in SHARED}
    for name, connection in connections(car.links, car.joints, {}).items():
        if link in connection.between and f"joints.{name}" not in found:
            found[f"joints.{name}"] = connection.at if connection.at.ndim == 1 else jnp.mean(connection.at, axis=0)
    acting = {"damper": car.damper.ends, "drop_link": drop_link} | (
        {} if car.spring is None else {"spring": car.spring.ends}
    )
    acting |= {key: stop.ends for key, stop in car.stops.items()}
    return found | {key: of[link] for key, of in acting.items() if link in of}


def with_nodes(car: Car, drop_link: Mapping[str, Array] | None = None) -> Car:
    """The corner with the numbers of the nodes of its beams; `drop_link` as in `_carried_by`."""

    def numbered(name: str, link: Link) -> Link:
        if link.beam is None:
            return link
        nodes = nearest(name, *link.axis, link.beam.elements, _carried_by(car, name, drop_link or {}))
        return dataclasses.replace(link, beam=dataclasses.replace(link.beam, nodes=nodes))

    return dataclasses.replace(car, links={name: numbered(name, link) for name, link in car.links.items()})
