"""What an axle has beside rigid links: bushings, stops, a rack, an anti-roll bar, and the elements that they become."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.examples._link_beam import ELEMENTS, LinkBeam, SectionShape
from lgsens.examples._suspension_parts import ALONG_Y, Part, reflected
from lgsens.model import (
    AbstractForce,
    AbstractJoint,
    AntiRollBar,
    BeamSection,
    BentBeam,
    BumpStop,
    Bushing,
    DistanceJoint,
    RevoluteJoint,
    RigidBody,
    Sampled,
    SphericalJoint,
    TorsionSpringDamper,
)

RATES = ("stiffness", "rotational_stiffness", "damping", "rotational_damping")
CURVED: dict[str, str] = dict(zip(RATES, ("spring", "rotational_spring", "damper", "rotational_damper")))
CURVES = {f"{kind}_{i + 1}": (f"{kind}s", i) for kind in CURVED.values() for i in range(3)}  # of a `Bushing`, its axes


class Mount(eqx.Module):
    """A bushing in place of a joint, of a hinge one at each of its two points; or one between subframe and chassis.

    Attributes:
        stiffness, damping: along its axes [N/m], [N s/m], shape (3,), or (2, 3): of the two bushings of a hinge.
        rotational_stiffness, rotational_damping: about them [N m/rad], [N m s/rad], of the same shape. None: 0.
        axes: the first of them, and a direction in the plane of the first and the second, shape (2, 3); None: x, y, z.
        preload, rotational_preload: the force [N] that pulls the joint's second body to its first at the design
            position, and the moment [N m] that turns it back, in x, y and z, shape (3,) or (2, 3); None: those with
            which the axle rests there.
        at: its place [m], shape (3,); None: that of the joint.
        curves: by a key of the file, spring_1, rotational_damper_3, …, what comes to the rate along that axis: force
            [N] or moment [N m] over displacement or speed of the joint's second body [m], [rad], [m/s], [rad/s], shape
            (2, n), monotone cubics (`Sampled`). With one of them there are `axes`.
    """

    stiffness: Float[Array, "*two 3"]
    damping: Float[Array, "*two 3"] | None = None
    rotational_stiffness: Float[Array, "*two 3"] | None = None
    rotational_damping: Float[Array, "*two 3"] | None = None
    axes: Float[Array, "2 3"] | None = None
    preload: Float[Array, "*two 3"] | None = None
    rotational_preload: Float[Array, "*two 3"] | None = None
    at: Float[Array, "3"] | None = None
    curves: dict[str, Float[Array, "2 n"]] = eqx.field(default_factory=dict)

    def elements(self, name: str, a: str, b: str, at: Array) -> Iterator[tuple[str, Bushing]]:
        """The force elements by name, NAME, or NAME_1 and NAME_2 for two points."""
        points = jnp.atleast_2d(at)
        of = lambda key, i: jnp.broadcast_to(getattr(self, key), points.shape)[i]
        given = [key for key in RATES if getattr(self, key) is not None]
        curves: dict[str, Any] = {}
        for key, curve in self.curves.items():
            kind, axis = CURVES[key]
            three = list(curves.get(kind, (None, None, None)))
            three[axis] = Sampled(curve[0], curve[1], "monotone")
            curves[kind] = tuple(three)
        for i, point in enumerate(points):
            rates: dict[str, Any] = {key: of(key, i) for key in given}
            bushing = Bushing(a, b, at=point, axes=self.axes, **rates, **curves)
            if self.preload is not None:
                along = [of(key, i) @ bushing.triad for key in ("preload", "rotational_preload")]
                bushing = bushing.with_preload(jnp.concatenate(along))
            yield name if len(points) == 1 else f"{name}_{i + 1}", bushing

    def halved(self, count: int) -> "Mount":
        """Half of so many of it, on either side of the plane y = 0: of the two of a hinge one in the middle."""

        def half(array):
            return None if array is None else count / 2 * (array if array.ndim == 1 else jnp.mean(array, axis=0))

        rates = {key: half(getattr(self, key)) for key in (*RATES, "preload", "rotational_preload")}
        curves = {key: jnp.stack([curve[0], count / 2 * curve[1]]) for key, curve in self.curves.items()}
        return dataclasses.replace(self, **rates, curves=curves)


class Stop(eqx.Module):
    """A bump or rebound stop: `BumpStop` between the points of two bodies, `ends`."""

    ends: dict[str, Float[Array, "3"]]
    gap: Float[Array, ""]
    stiffness: Float[Array, ""]
    rounding: Float[Array, ""]
    progression: Float[Array, ""] | None
    rebound: bool = eqx.field(static=True)

    def element(self, named: Callable[[str], str]) -> BumpStop:
        """The force element between bodies that are called so."""
        (a, at_a), (b, at_b) = sorted(self.ends.items())
        rates = {key: getattr(self, key) for key in ("gap", "stiffness", "rounding", "progression", "rebound")}
        return BumpStop(named(a), named(b), at_a=at_a, at_b=at_b, **rates)


class Rack(eqx.Module):
    """A steering rack, which slides in the chassis or the subframe.

    Attributes:
        part: its mass.
        axis: along which it slides, shape (3,).
        ratio: its way per turn of the steering wheel [m/rad], shape (); None: not said.
        travel: how far it goes either way [m], shape (); None: not said.
        carrier: "chassis" or "subframe".
    """

    part: Part
    axis: Float[Array, "3"]
    ratio: Float[Array, ""] | None
    travel: Float[Array, ""] | None
    carrier: str = eqx.field(static=True)


class Between(NamedTuple):
    """What a part between the corners brings into a scene.

    Attributes:
        sought: of its forces those with preloads.
        given: of these those that have their own.
    """

    bodies: dict[str, RigidBody]
    joints: dict[str, AbstractJoint]
    forces: dict[str, AbstractForce]
    sought: tuple[str, ...]
    given: Mapping[str, AbstractForce] = MappingProxyType({})


class Bar(eqx.Module):
    """An anti-roll bar across the car: on each side a half that turns about y in a bearing, and a massless drop link.
    Or a beam, straight from lever to bearing, across and back, on ball joints or bushings, of which torsion and bending
    follow from the section: what it moves by at the end of either lever per force there, opposite on the other side, is

        C = a³/3EI + a/kGA + r² L/2GJ + b² (L/6EI + 2/kGA L)

    with a the length of its levers, r and b that across and along y, and L from bearing to bearing (Timoshenko): what
    levers bend, the middle twists, and the middle bends, which the bearings do not hinder.

    Attributes:
        bearing: a point on the bar's straight middle [m], shape (3,). lever: where its lever meets the drop link.
        ends: by the link or knuckle at the other end of the drop link the point there.
        mass: of the whole bar [kg], shape (), uniform along its middle and its levers; None: that of the beam.
        section: `stiffness` [N m/rad] of the whole bar in torsion, or `diameter`, `length`, `bore`, `shear_modulus` as
            of an `AntiRollBar`; and `damping` [N m s/rad].
        carrier: "chassis" or "subframe", which holds the bearing.
        beam: a round section or a tube; None: halves twist against each other. mount: of its bearings; None: balls.
    """

    bearing: Float[Array, "3"]
    lever: Float[Array, "3"]
    ends: dict[str, Float[Array, "3"]]
    mass: Float[Array, ""] | None
    section: dict[str, Float[Array, ""]]
    carrier: str = eqx.field(static=True)
    beam: LinkBeam | None = None
    mount: Mount | None = None

    @property
    def link(self) -> str:
        """The body at the other end of the drop link."""
        return next(iter(self.ends))

    def bending(self, section: SectionShape | BeamSection, *, elements: int = ELEMENTS) -> "Bar":
        """The bar as a beam of this section, round or a tube, with so many elements for each lever and the middle."""
        return dataclasses.replace(self, mass=None, section={}, beam=LinkBeam(section, elements))

    @property
    def own_mass(self) -> Array:
        """Of the whole bar [kg], shape ()."""
        if self.beam is None:
            assert self.mass is not None
            return self.mass
        lever = self.lever - self.bearing
        return self.beam.section.mass * 2.0 * (jnp.linalg.norm(lever) + jnp.abs(self.bearing[1]))

    @property
    def rate(self) -> Array:
        """Of a beam as of halves that twist against each other [N m/rad]: r²/2C, shape ()."""
        assert self.beam is not None
        shear, torsion, bending = (self.beam.section.stiffness[i] for i in (1, 3, 4))
        lever, length = self.lever - self.bearing, 2.0 * jnp.abs(self.bearing[1])
        a, b2 = jnp.linalg.norm(lever), lever[1] ** 2
        softness = a**3 / (3.0 * bending) + a / shear + (a**2 - b2) * length / (2.0 * torsion)
        softness = softness + b2 * (length / (6.0 * bending) + 2.0 / (shear * length))
        return (a**2 - b2) / (2.0 * softness)

    def bent(self, right: "Bar") -> BentBeam:
        """The beam, "anti_roll_bar.0" at the end of this lever, to that on the right."""
        assert self.beam is not None
        corners = jnp.stack([self.lever, self.bearing, right.bearing, right.lever])
        return BentBeam("anti_roll_bar", self.beam.section, corners, elements=self.beam.elements)

    def half(self) -> Part:
        """One half: slender rods from the middle, y = 0, to the bearing and on to the end of the lever."""
        corners = jnp.stack([self.bearing * jnp.asarray([1.0, 0.0, 1.0]), self.bearing, self.lever])
        rods = jnp.diff(corners, axis=0)
        squares = jnp.sum(rods**2, axis=1)
        masses = self.own_mass / 2 * jnp.sqrt(squares) / jnp.sum(jnp.sqrt(squares))
        parts = [
            Part(middle, mass, mass / 12 * (square * jnp.eye(3, dtype=rod.dtype) - jnp.outer(rod, rod)))
            for middle, mass, square, rod in zip((corners[1:] + corners[:-1]) / 2, masses, squares, rods)
        ]
        return parts[0].joined(parts[1])

    def joints(self, side: str, link: str) -> dict[str, AbstractJoint]:
        """Of the half on this side, to the body that is called so."""
        half = f"{side}_anti_roll_bar"
        bearing = RevoluteJoint(self.carrier, half, at=self.bearing, axis=ALONG_Y)
        return {f"{half}_{self.carrier}": bearing} | self.drop_link(side, half, link)

    def drop_link(self, side: str, lever: str, link: str) -> dict[str, AbstractJoint]:
        """Between two bodies, on this side."""
        return {f"{side}_drop_link": DistanceJoint(lever, link, at_a=self.lever, at_b=self.ends[self.link])}

    def bearings(self, side: str, body: str) -> tuple[dict[str, AbstractJoint], dict[str, AbstractForce]]:
        """What carries this node of a beam, on this side: joints or bushings."""
        name = f"{side}_anti_roll_bar_{self.carrier}"
        if self.mount is None:
            return {name: SphericalJoint(self.carrier, body, at=self.bearing)}, {}
        return {}, dict(self.mount.elements(name, self.carrier, body, self.bearing))

    def scene(self, cars: Mapping[str, Any], compliant: bool) -> Between:
        """It between corners: a beam, or halves that twist against each other, of one side alone without a twist."""
        bars = {side: self if side == "left" else reflected(self) for side in cars}
        held = {side: car.scene_name(self.link, "drop_link", f"{side}_") for side, car in cars.items()}
        if self.beam is None or not compliant or len(cars) < 2:
            bodies = {f"{side}_anti_roll_bar": of.half().body() for side, of in bars.items()}
            joints = {name: joint for side, of in bars.items() for name, joint in of.joints(side, held[side]).items()}
            return Between(bodies, joints, {"anti_roll_bar": self.element(*bodies)} if len(bodies) == 2 else {}, ())
        beam = self.bent(bars["right"])
        lever, bearing = dict(zip(cars, beam.corners[::3])), dict(zip(cars, beam.corners[1:3]))
        joints: dict[str, AbstractJoint] = {}
        forces: dict[str, AbstractForce] = {**beam.forces}
        for side, of in bars.items():
            turning, bushings = of.bearings(side, bearing[side])
            joints |= turning | of.drop_link(side, lever[side], held[side])
            forces |= bushings
        return Between(beam.bodies, joints, forces, (*forces,))

    def element(self, left: str, right: str) -> AntiRollBar | TorsionSpringDamper:
        """What twists between its two halves."""
        section = self.section if self.beam is None else {"stiffness": self.rate}
        kind: Any = TorsionSpringDamper if "stiffness" in section else AntiRollBar
        return kind(left, right, axis=ALONG_Y, **section)
