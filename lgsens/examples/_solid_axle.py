"""A solid axle: both knuckles are one body, held by the links of either side and by links of its own."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import is_concrete
from lgsens.examples._axle_parts import Between, Mount
from lgsens.examples._corner_check import check_springs
from lgsens.examples._corner_scene import SHARED, connections
from lgsens.examples._leverage import SINGULAR, Velocities, strut_ratios
from lgsens.examples._suspension_parts import PLANAR, Connection, Link
from lgsens.model import FixedJoint

Car = TypeVar("Car", bound=Any)
BODY = "solid_axle"
LIVE = "live_axle"  # the joint of one with the final drive in it, by which the rig tells where traction acts


class SolidAxle(eqx.Module):
    """An axle whose wheels stand on one body, and the links that it has once: a Panhard rod, an upper link in the
    middle, the rods and the crank of a Watt's linkage. Those of the sides are links of the corners, as of others.

    The knuckle of a corner is that side's half of the axle, with half of its mass. An axle on links has two freedoms,
    heave and roll, so what holds it counts four: three links along the car and a Panhard rod or a Watt's linkage, or
    four of which two spread. With more, four links along and a Panhard rod, it binds unless bushings give way.

    Where both sides move alike, the knuckle of a corner slides in a plane upright to y, and of the links of the axle
    only those between chassis and axle that go along the car count, half of each in a corner, of a hinge its middle.
    Rods across, and what hangs on other links, are left out there with their masses; that a Panhard rod moves the
    axle sideways by its arc takes both sides.

    Attributes:
        links: by name, with `ends` on "solid_axle", on the chassis, and on each other.
        along: those of which a corner has half, static.
        mounts: bushings, by the joints NAME_BODY of these links that they replace.
        link_radius: of links that are uniform bars [m], shape (); None: there are none.
        carriers: what of them holds on to the subframe, static.
        live: whether the final drive is in the axle, which takes up its moment, so that traction acts on the axle where
            tyres touch the road; a De Dion axle has it on the chassis (static). The moment of the propeller shaft,
            which rolls the axle, is left out.

    Source: Reimpell, Stoll & Betzler (2001), §1.4; Milliken & Milliken (1995), §17.
    """

    links: dict[str, Link]
    along: tuple[str, ...] = eqx.field(static=True)
    mounts: dict[str, Mount] = eqx.field(default_factory=dict)
    link_radius: Float[Array, ""] | None = None
    carriers: tuple[tuple[str, str], ...] = eqx.field(static=True, default=())
    live: bool = eqx.field(static=True, default=True)

    @property
    def link(self) -> str:
        """The body of a corner on which it acts."""
        return "knuckle"

    @property
    def own_mass(self) -> Array:
        """Of its own links [kg], shape ()."""
        return sum((link.own_mass for link in self.links.values()), start=jnp.zeros(()))

    def corner(self, car: Car) -> Car:
        """A corner where both sides move alike, with half of the links that go along the car."""
        return dataclasses.replace(car, **self.more(car.wheel.centre, car.links, car.joints, car.mounts))

    def more(self, at: Array, links: Mapping[str, Link], joints: Mapping[str, Connection], mounts: Mapping[str, Mount]):
        """These of such a corner, by the fields of a `QuarterCar`, with its wheel centre `at`."""
        plane = Connection(PLANAR, ("chassis", "knuckle"), at)
        halves = {name: _half(self.links[name]) for name in self.along}
        called = {f"{name}_{body}": f"{name}_{_named(body)}" for name in self.along for body in (BODY, *SHARED)}
        counts = {name: len(jnp.atleast_2d(joint.at)) for name, joint in self.connections().items()}
        soft = {called[name]: mount.halved(counts[name]) for name, mount in self.mounts.items() if name in called}
        return {"joints": {**joints, BODY: plane}, "links": {**links, **halves}, "mounts": {**mounts, **soft}}

    def freed(self, corner: Car) -> Car:
        """The corner of which `corner` made that: what holds its knuckle for itself."""
        own = {BODY, *self.along, *(f"{name}_{body}" for name in self.along for body in ("knuckle", *SHARED))}
        without = lambda of: {name: one for name, one in of.items() if name not in own}
        parts = {"joints": without(corner.joints), "links": without(corner.links), "mounts": without(corner.mounts)}
        return dataclasses.replace(corner, **parts)

    def scene(self, cars: Mapping[str, Any], compliant: bool) -> Between:
        """It between corners; of one side alone there is nothing between."""
        if len(cars) < 2:
            return Between({}, {}, {}, ())
        left, right = (f"{side}_knuckle" for side in cars)
        middle = (cars["left"].wheel.centre + cars["right"].wheel.centre) / 2
        joints: dict[str, Any] = {LIVE if self.live else BODY: FixedJoint(left, right, at=middle)}
        forces, given = {}, {}
        named = lambda body: left if body == BODY else body
        for name, connection in self.connections().items():
            if not (compliant and name in self.mounts):
                joints[name] = connection.joint(named)
                continue
            mount = self.mounts[name]
            a, b = map(named, connection.between)
            bushings = dict(mount.elements(name, a, b, connection.at))
            forces |= bushings
            given |= {} if mount.preload is None else bushings
        bodies = {name: link.part(self.link_radius).body() for name, link in self.links.items()}
        return Between(bodies, joints, forces, (*forces,), given)

    def connections(self) -> dict[str, Connection]:
        """The joints of its links by name."""
        return connections(self.links, {}, dict(self.carriers))

    def check(self, name: str, cars: Mapping[str, Any], compliant: bool) -> None:
        """Raise `ValueError` for links that leave the axle other freedoms than heave and roll.

        In velocities at the design position as in `_leverage`, with heave and roll of the axle prescribed: the rows
        are independent, and as many as the unknowns where no bushings give way.
        """
        if not is_concrete(self, cars):
            return
        velocities, rows, soft = self._velocities(cars, compliant)
        free = velocities.unknowns - len(rows)
        held = {"one side": sorted(cars["left"].links), "the axle itself": sorted(self.links)}
        if free < 2 or (free > 2 and not soft):
            raise ValueError(
                f"{name}, key '{BODY}.links': the axle has {free} degrees of freedom to the chassis, and needs two, "
                f"heave and roll, got the links {held}. A link with two ball joints takes one of its six, one with a "
                "hinge on the chassis and a ball joint takes two; joints of the file are there on both sides, and no "
                "wheel is steered. Where there are more, bushings (`bushings.NAME`) in place of joints let it move."
            )
        centre = np.asarray(sum(car.wheel.centre for car in cars.values())) / len(cars)
        heave = velocities.moving("chassis", BODY, np.eye(3)[2:], centre)
        roll = velocities.turning("chassis", BODY, np.eye(3)[:1])
        matrix = np.concatenate([rows, roll, heave])
        condition = np.linalg.cond(matrix)
        if not condition < SINGULAR:
            raise ValueError(
                f"{name}, key '{BODY}.links': links repeat each other, or leave the axle no heave or no roll at the "
                f"design position (condition {condition:.0e}). Is there one across the car? Else move a hardpoint, or "
                "put bushings (`bushings.NAME`) in place of joints."
            )
        leaves = [car for car in cars.values() if car.leaf_spring is not None]
        for car in leaves:
            check_springs(car, name, 1.0)
        if soft:  # springs are looked at on ball joints, where these do not bind
            rigid, joined, _ = self._velocities(cars, compliant=False)
            if not leaves and rigid.unknowns - len(joined) == 2:
                self.check(name, cars, compliant=False)
            return
        twists = np.linalg.solve(matrix, np.append(np.zeros(len(matrix) - 1), 1.0))
        for side, car in cars.items():
            struts = {"spring": car.spring, "damper": car.damper}
            ratios = strut_ratios(name, velocities, twists, struts, _on_side(side, car))
            check_springs(car, name, ratios["spring"])

    def _velocities(self, cars: Mapping[str, Any], compliant: bool) -> tuple[Velocities, np.ndarray, bool]:
        """The axle and all links, the rows of their joints, and whether bushings take the place of some, or leaf
        springs of all that the axle needs."""
        every, bodies = [], [BODY, *self.links]
        soft = any(car.leaf_spring is not None for car in cars.values())
        for side, car in cars.items():
            named = _on_side(side, car)
            bodies += [named(link) for link in car.links]
            for key, connection in connections(car.links, car.joints, dict(car.carriers)).items():
                if compliant and key in car.mounts:
                    soft = True
                else:
                    a, b = map(named, connection.between)
                    every.append(dataclasses.replace(connection, between=(a, b)))
        for key, connection in self.connections().items():
            if compliant and key in self.mounts:
                soft = True
            else:
                every.append(connection)
        velocities = Velocities(bodies)
        return velocities, velocities.rows(every), soft


def _on_side(side: str, car: Any) -> Callable[[str], str]:
    """What the bodies of a corner are called."""
    named = {"knuckle": BODY} | {link: f"{side}_{link}" for link in car.links}
    return lambda body: named.get(body, body)


def _named(body: str) -> str:
    """What a corner calls it."""
    return "knuckle" if body == BODY else body


def _half(link: Link) -> Link:
    """Of a link between chassis and axle, as a corner has it."""
    ends = {
        _named(body): points if points.ndim == 1 else jnp.mean(points, axis=0) for body, points in link.ends.items()
    }
    inertia = None if link.inertia is None else link.inertia / 2
    return dataclasses.replace(link, ends=ends, mass=link.own_mass / 2, inertia=inertia)
