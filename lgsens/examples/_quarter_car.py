"""The quarter-car of the paper's §9 with a real five-link rear suspension."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import as_float, require, suggestion
from lgsens.analysis import Kinematics, kinematics
from lgsens.examples._hardpoint_file import Reader, read
from lgsens.examples._suspension_curves import SuspensionCurves, suspension_curves
from lgsens.model import (
    ALL_FREE,
    BumpRoad,
    Bushing,
    DistanceJoint,
    FixedJoint,
    Gravity,
    Model,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SphericalJoint,
    SpringDamper,
    TranslationDriver,
    TyreSpring,
    UniversalJoint,
    lumped,
    static_preload,
)

GRAVITY = 9.81  # m/s²
ALONG_Y: Any = (0.0, 1.0, 0.0)
ALONG_Z: Any = (0.0, 0.0, 1.0)


class Link(eqx.Module):
    """A rigid bar: universal joint at the chassis, spherical joint at the knuckle; points [m], mass [kg]."""

    chassis: Float[Array, "3"]
    knuckle: Float[Array, "3"]
    mass: Float[Array, ""]


class Strut(eqx.Module):
    """Where a spring or a damper acts: between a link and the chassis; points [m], rate [N/m] or [N s/m]."""

    link: str = eqx.field(static=True)
    link_point: Float[Array, "3"]
    chassis_point: Float[Array, "3"]
    rate: Float[Array, ""]

    def element(self, **rates: Any) -> SpringDamper:
        """The force element with these numbers of `SpringDamper`."""
        return SpringDamper(self.link, "chassis", at_a=self.link_point, at_b=self.chassis_point, **rates)


class Part(eqx.Module):
    """A body: centre of mass [m], mass [kg], principal moments about the axes of the file [kg m²]."""

    centre: Float[Array, "3"]
    mass: Float[Array, ""]
    inertia: Float[Array, "3"]


class QuarterCar(eqx.Module):
    """A quarter-car with a five-link suspension: its data, all numbers leaves. `QuarterCar.load()` reads them.

    Five links, knuckle, wheel and chassis are eight rigid bodies. Each link has a universal joint at the chassis and a
    spherical joint at the knuckle; the wheel turns on a hinge of the knuckle or is locked to it; the chassis heaves
    only. With 48 coordinates and 45 (46) constraints the mechanism has 3 (2) degrees of freedom; a reduced scene has
    the same with 19 and 16 (17), see `model`. Frame: x forward, y left, z up; SI units.

    Source: Sonneville & Brüls (2014), §9; hardpoints, masses and rates from BPMinaker/eom_pkg,
    input_5link.m (R. Rieveley 2009).
    """

    name: str = eqx.field(static=True)
    links: dict[str, Link]
    knuckle: Part
    wheel: Part
    chassis: Part
    bearing: Float[Array, "3"]
    spring: Strut
    damper: Strut
    tyre_stiffness: Float[Array, ""]
    link_radius: Float[Array, ""]
    bump_height: Float[Array, ""]
    bump_duration: Float[Array, ""]

    @staticmethod
    def load(path: str | Path | None = None) -> "QuarterCar":
        """Read a suspension from a TOML file; None: the one that ships with lgsens.

        The shipped file, `lgsens/examples/data/five_link_suspension.toml`, shows the format. Raises `ValueError` naming
        the file and the key (or the line) for a file that cannot be read or is incomplete.
        """
        with jax.ensure_compile_time_eval():  # the file's numbers are constants, inside `jit` too
            return _parse(*read(path))

    @property
    def hardpoints(self) -> Float[Array, "5 3"]:
        """The chassis ends of the links in sorted order of their names [m], shape (5, 3)."""
        return jnp.stack([self.links[name].chassis for name in sorted(self.links)])

    def with_values(self, *, stiffness=None, damping=None, bump_height=None, hardpoints=None) -> "QuarterCar":
        """The car with some numbers replaced; None: it keeps its own.

        Arguments:
            stiffness, damping, bump_height: of spring [N/m] and damper [N s/m], and of the bump [m], shape ().
            hardpoints: as the property [m], shape (5, 3).

        Raises `ValueError` for other shapes.
        """
        names = sorted(self.links)
        numbers = lambda car: [car.spring.rate, car.damper.rate, car.bump_height]
        members = lambda car: numbers(car) + [car.links[name].chassis for name in names]
        points = [None] * len(names)
        if hardpoints is not None:
            points = as_float(hardpoints, (len(names), 3), "`hardpoints`")
        values = [
            old if new is None else as_float(new, old.shape, "`stiffness`, `damping` or `bump_height`")
            for old, new in zip(members(self), (stiffness, damping, bump_height, *points))
        ]
        return eqx.tree_at(members, self, values)

    def model(
        self,
        *,
        wheel: str = "hinged",
        chassis: str = "guided",
        links: str = "bodies",
        bushings: Sequence[str] = (),
        bushing_stiffness=1e8,
        bushing_damping=1e4,
        free_length=None,
        free_radius=None,
    ) -> Model:
        """The scene at rest on its springs at the design position, a bump ahead.

        Arguments:
            wheel: "hinged" (45 constraints, 3 degrees of freedom) or "locked" (46 and 2).
            chassis: "guided" by a prismatic joint (6 coordinates, 5 constraints), or "heave": a body that has that
                one coordinate. The motion is the same.
            links: "bodies", or "rods": the links on which neither spring nor damper acts become massless rods
                (`DistanceJoint`), 1 constraint for 6 coordinates and 7 constraints each. Half the mass of each
                goes to either end, on the knuckle and on the chassis, whose centres of mass and inertias
                move with it. Mass and centre of mass of a uniform bar stay so, and with them the static forces; its
                moment of inertia about its centre becomes m L²/4 for m L²/12. A link that carries the spring or
                the damper is bent and not only pulled, and remains a body.
            bushings: the links that a `Bushing` holds at the knuckle in place of the spherical joint: 3 constraints
                less each. Such a link remains a body.
            bushing_stiffness, bushing_damping: of those bushings, in every direction [N/m] and [N s/m].
            free_length: free length of the spring [m]. None: the preloads of spring, tyre and bushings are those that
                hold the car at the design position, whatever the parameters, and so are their derivatives.
            free_radius: free radius of the tyre [m], with `free_length`.

        Raises `ValueError` for an unknown kind of wheel, chassis or links, and for bushings at links that the car does
        not have.
        """
        _check_choice("wheel", wheel, ("hinged", "locked"))
        _check_choice("chassis", chassis, ("guided", "heave"))
        _check_choice("links", links, ("bodies", "rods"))
        for name in bushings:
            if name not in self.links:
                raise ValueError(f"`bushings`: {suggestion(name, self.links)}.")
        kept = {self.spring.link, self.damper.link, *bushings}
        rods = {name: link for name, link in self.links.items() if links == "rods" and name not in kept}
        chassis_free = "z" if chassis == "heave" else ALL_FREE
        bodies = {
            "chassis": _body(self.chassis, [(rod.mass / 2, rod.chassis) for rod in rods.values()], chassis_free),
            "knuckle": _body(self.knuckle, [(rod.mass / 2, rod.knuckle) for rod in rods.values()]),
            "wheel": _body(self.wheel),
        } | {name: _bar(link, self.link_radius) for name, link in self.links.items() if name not in rods}
        hub: Any = (
            RevoluteJoint("knuckle", "wheel", at=self.bearing, axis=ALONG_Y)
            if wheel == "hinged"
            else FixedJoint("knuckle", "wheel", at=self.bearing)
        )
        joints = {"hub": hub}
        if chassis == "guided":
            joints["heave"] = PrismaticJoint(None, "chassis", at=self.chassis.centre, axis=ALONG_Z)
        along_x = jnp.asarray([1.0, 0.0, 0.0], self.bearing.dtype)
        for name, link in self.links.items():
            if name in rods:
                joints[name] = DistanceJoint("chassis", "knuckle", at_a=link.chassis, at_b=link.knuckle)
                continue
            across = jnp.cross(along_x, link.knuckle - link.chassis)
            joints[f"{name}_chassis"] = UniversalJoint("chassis", name, at=link.chassis, axis_a=along_x, axis_b=across)
            if name not in bushings:
                joints[f"{name}_knuckle"] = SphericalJoint("knuckle", name, at=link.knuckle)
        road = BumpRoad(height=self.bump_height, duration=self.bump_duration)
        tyre = {"stiffness": self.tyre_stiffness, "free_radius": free_radius, "road": road}
        forces: dict[str, Any] = {
            "gravity": Gravity((0.0, 0.0, -GRAVITY)),
            "spring": self.spring.element(stiffness=self.spring.rate, free_length=free_length),
            "damper": self.damper.element(stiffness=0.0, damping=self.damper.rate),
            "tyre": TyreSpring("wheel", at=self.wheel.centre, **tyre),
        }
        for name in bushings:
            rates = {"stiffness": bushing_stiffness, "damping": bushing_damping}
            rates = {rate: jnp.full(3, value, self.bearing.dtype) for rate, value in rates.items()}
            forces[f"{name}_bushing"] = Bushing("knuckle", name, at=self.links[name].knuckle, **rates)
        model = Model(bodies, joints, forces)
        if free_length is not None:
            return model
        model, unbalanced = static_preload(model, ("spring", "tyre", *(f"{name}_bushing" for name in bushings)))
        require(
            lambda left, mass: left <= 1e-6 * GRAVITY * mass,  # NaN is not balanced
            f"The spring and the tyre cannot hold {self.name!r} at its design position ({unbalanced} N remain); does "
            "the spring change its length as the wheel moves?",
            unbalanced,
            self.chassis.mass,
        )
        return model

    def travel(self, travel, *, links: str = "rods", throw: bool = True) -> Kinematics:
        """The suspension on a rig: the chassis held, the wheel locked, its centre moved up and down at rate 1.

        Arguments:
            travel: vertical displacements of the wheel centre [m], positive in bump, shape (n,), in an order in which
                each is near the one before.
            links: as in `model`; the motion is the same.
            throw: as in `lgsens.kinematics`.

        Velocities and rates are derivatives by the travel. The forces are not those of the car: its spring has no
        preload here. Raises `ValueError` for travel that the links do not allow.
        """
        # Lengths that are given need no preload to be found.
        scene = self.model(wheel="locked", chassis="heave", links=links, free_length=1.0, free_radius=1.0)
        driver = TranslationDriver(None, "wheel", at=self.wheel.centre, axis=ALONG_Z)
        held = {"chassis": _body(self.chassis, free=())}
        rig = Model(scene.bodies | held, scene.joints | {"travel": driver}, scene.forces)
        return kinematics(rig, {"travel": travel}, throw=throw)

    def curves(self, travel, *, axle: str = "rear", throw: bool = True) -> SuspensionCurves:
        """Camber, toe, track, wheelbase, motion ratios and roll centre over the travel of the wheel.

        Arguments:
            travel: as in `travel`.
            axle: "rear" or "front", for the sign of the wheelbase.
            throw: as in `lgsens.kinematics`.

        `SuspensionCurves` says what they are and their signs (ISO 8855); the wheel is upright and straight at the
        design position. Differentiable by every number of the suspension, exactly. Raises `ValueError` for another
        axle and as `travel`.
        """
        _check_choice("axle", axle, ("rear", "front"))
        return suspension_curves(self.travel(travel, throw=throw), self.wheel.centre, rear=axle == "rear")


def stiff_quarter_car(car: QuarterCar, *, wheel: str = "locked", **settings: Any) -> Model:
    """The quarter-car with bushings of 1e8 N/m in place of the ball joints of wishbone and guide link, at rest.

    Beside its own modes, 10 and 57 rad/s, it has six between 730 and 18 000 rad/s, the fastest nearly critically
    damped; Ψ₀ is that of ball joints to 1e-3. Explicit integrators must take steps of 0.2 ms or less.

    Arguments:
        car: the suspension, `QuarterCar.load()`.
        wheel: as in `QuarterCar.model`, and so are `settings`; `bushing_stiffness=` and `bushing_damping=` among them.
    """
    return car.model(wheel=wheel, bushings=("wishbone", "guide_link"), **settings)


def _check_choice(name: str, value: str, known: tuple[str, str]) -> None:
    if value not in known:
        raise ValueError(f"`{name}` must be {known[0]!r} or {known[1]!r}, got {value!r}.")


def _body(part: Part, points: Sequence[tuple[Array, Array]] = (), free: str | Sequence[str] = ALL_FREE) -> RigidBody:
    """A part with point masses, pairs of a mass and a place, fixed to it."""
    mass, inertia, centre = part.mass, part.inertia, part.centre
    if points:
        masses, places = zip((mass, centre), *points)
        mass, centre, shifted = lumped(jnp.stack(masses), jnp.stack(places))
        inertia = jnp.diag(inertia) + shifted
    return RigidBody(mass=mass, inertia=inertia, position=centre, free=free)


def _bar(link: Link, radius) -> RigidBody:
    """A uniform round bar between its two ends: m r²/2 about its axis, m L²/12 + m r²/4 across."""
    direction = link.knuckle - link.chassis
    square = jnp.dot(direction, direction)
    along = jnp.outer(direction, direction) / square
    across = jnp.eye(3, dtype=square.dtype) - along
    inertia = link.mass * (radius**2 / 2 * along + (square / 12 + radius**2 / 4) * across)
    return RigidBody(mass=link.mass, inertia=inertia, position=(link.knuckle + link.chassis) / 2)


def _parse(document: dict, path: str) -> QuarterCar:
    root = Reader(document, path)
    units = root.table("units")
    metre, kilogram = float(units.number("length")), float(units.number("mass"))
    table = root.table("links")
    if len(table.names()) != 5:
        raise ValueError(f"Hardpoint file {path!r}, key 'links': five links are needed, got {sorted(table.names())}.")
    links = {}
    for name in table.names():
        link = table.table(name)
        links[name] = Link(*link.segment("chassis", "knuckle", metre), link.number("mass", kilogram))

    def part(key: str, centre: str) -> Part:
        body = root.table(key)
        return Part(body.vector(centre, metre), body.number("mass", kilogram), body.moments("inertia"))

    def strut(key: str, rate: str) -> Strut:
        element = root.table(key)
        points = element.segment("link_point", "chassis_point", metre)
        return Strut(element.choice("link", links), *points, element.number(rate))

    bump = root.table("bump")
    return QuarterCar(
        name=str(document.get("name", Path(path).stem)),
        links=links,
        knuckle=part("knuckle", "centre_of_mass"),
        wheel=part("wheel", "centre"),
        chassis=part("chassis", "centre_of_mass"),
        bearing=root.table("wheel").vector("bearing", metre),
        spring=strut("spring", "stiffness"),
        damper=strut("damper", "damping"),
        tyre_stiffness=root.table("tyre").number("stiffness"),
        link_radius=root.table("link_section").number("radius"),
        bump_height=bump.number("height", positive=False),
        bump_duration=bump.number("duration"),
    )
