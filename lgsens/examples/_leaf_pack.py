"""The leaf springs of a solid axle, which bear and guide it.

A pack of leaves that slide on each other without friction bends as a beam of n(s) leaves side by side, s the share of
the way from the seat, where it is clamped, to an eye: n = n_f + (n − n_f)(1 − s) of n leaves, n_f of them of full
length. With a and b from the seat to the front and the rear eye, I = n w t³/12 and r = n_f/n, half of it is a
cantilever of compliance C(a) and the flat spring between two eyes has the rate k:

    C(a) = a³/(3 E I) κ(r),     κ = 3/(1 − r)³ (1/2 − 2 r + r² (3/2 − ln r)),     κ(1) = 1
    1/k  = (b² C(a) + a² C(b))/(a + b)²           48 E I/L³ of full leaves with the seat in the middle

At the design position, under load, the halves are parabolas with the line through both eyes for a tangent at the seat.
There the preloads of its elements hold the axle; the leaf is bent by them as far as it is stiff, whatever its shape
free of load.

Source: SAE HS-788, Manual on Design and Application of Leaf Springs; κ is ∫₀¹ 3 s²/(r + (1 − r) s) ds, with s from
the eye.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.examples._hardpoint_file import Reader
from lgsens.examples._link_beam import MATERIAL, read_material
from lgsens.examples._suspension_parts import LEVEL, Connection, Part
from lgsens.model import Beam, BeamElement, BeamSection, RigidBody

TABLE, SHACKLE = "leaf_spring", "shackle"
FRONT, SEAT, REAR = "front", "seat", "rear"
POINTS = (FRONT, SEAT, REAR, SHACKLE)
ELEMENTS = 4  # of either half
MOST_LEAVES = 30
MOST_CAMBER, MOST_SPLAY, MOST_SHACKLE = 0.35, 0.4, 0.6  # of the length between eyes, of what is along, of that length


class LeafPack(eqx.Module):
    """A semi-elliptic leaf spring along the car, between an eye on the chassis and a shackle, clamped to the axle.

    Attributes:
        ends: of the left side [m], shape (3,): "front", the eye on the chassis, "seat", where it is clamped to the
            axle, "rear", the other eye, and "shackle", where that of it holds on to the chassis. Pins are along y.
        section: width and thickness of a leaf [m], shape ().
        material: young [N/m²], poisson, density [kg/m³] and, if there is some, damping [s], as of `BeamSection`.
        shackle_mass: [kg], shape (), uniform between its pins.
        leaves, full_length: how many there are, and how many of these go from eye to eye (static).
        elements: of either half (static).
    """

    ends: dict[str, Float[Array, "3"]]
    section: dict[str, Float[Array, ""]]
    material: dict[str, Float[Array, ""]]
    shackle_mass: Float[Array, ""]
    leaves: int = eqx.field(static=True)
    full_length: int = eqx.field(static=True)
    elements: int = eqx.field(static=True, default=ELEMENTS)

    @property
    def leaf(self) -> BeamSection:
        """The section of one leaf."""
        numbers: dict[str, Any] = self.material
        return BeamSection.rectangle(self.section["width"], self.section["thickness"], **numbers)

    @property
    def points(self) -> Float[Array, "n 3"]:
        """The nodes at the design position [m], from the front to the rear eye, shape (2 elements + 1, 3)."""
        seat = self.ends[SEAT]
        chord = self.ends[REAR] - self.ends[FRONT]
        tangent = chord / jnp.linalg.norm(chord)
        share = (np.arange(1, self.elements + 1) / self.elements)[:, None].astype(seat.dtype)

        def half(eye):
            along = jnp.dot(eye - seat, tangent) * tangent
            return (seat[None] + share * along[None]) + share**2 * (eye - seat - along)[None]

        return jnp.concatenate([half(self.ends[FRONT])[::-1], seat[None], half(self.ends[REAR])])

    @property
    def counts(self) -> np.ndarray:
        """How many leaves there are in the middle of each element."""
        share = (np.arange(self.elements) + 0.5) / self.elements
        half = self.full_length + (self.leaves - self.full_length) * (1.0 - share)
        return np.concatenate([half[::-1], half])

    @property
    def rate(self) -> Float[Array, ""]:
        """k of the flat spring [N/m], without shear."""
        r = self.full_length / self.leaves
        taper = 1.0 if r == 1.0 else 3.0 / (1.0 - r) ** 3 * (0.5 - 2.0 * r + r**2 * (1.5 - np.log(r)))
        bending = self.leaves * self.leaf.stiffness[4]
        a, b = (jnp.linalg.norm(self.ends[eye] - self.ends[SEAT]) for eye in (FRONT, REAR))
        return 3.0 * bending * (a + b) / (taper * a**2 * b**2)

    @property
    def own_mass(self) -> Float[Array, ""]:
        """Of leaves and shackle [kg], shape ()."""
        lengths = jnp.linalg.norm(jnp.diff(self.points, axis=0), axis=1)
        return self.leaf.mass * jnp.sum(lengths * self.counts) + self.shackle_mass

    def connections(self) -> dict[str, Connection]:
        """Its joints, which bushings may replace, by name."""
        node = lambda i: f"{TABLE}.{i}"
        between = {
            FRONT: (LEVEL, ("chassis", node(0))),
            SEAT: ("fixed", (node(self.elements), "knuckle")),
            REAR: (LEVEL, (node(2 * self.elements), SHACKLE)),
            SHACKLE: (LEVEL, ("chassis", SHACKLE)),
        }
        return {f"{TABLE}_{name}": Connection(*of, self.ends[name]) for name, of in between.items()}

    def parts(self, own: str) -> tuple[dict[str, RigidBody], dict[str, BeamElement]]:
        """Its bodies and elements by names that begin so."""
        beam = Beam(own + TABLE, self.leaf, self.points)
        lengths = jnp.linalg.norm(jnp.diff(beam.points, axis=0), axis=1)
        padded, counts = jnp.pad(lengths, 1), np.pad(self.counts, 1).astype(lengths.dtype)
        shares = (padded[1:] * counts[1:] + padded[:-1] * counts[:-1]) / (padded[1:] + padded[:-1])
        bodies = {
            name: eqx.tree_at(lambda body: (body.mass, body.inertia), body, (n * body.mass, n * body.inertia))
            for n, (name, body) in zip(shares, beam.bodies.items())
        }
        bodies[own + SHACKLE] = self.shackle().body()
        forces = {
            name: dataclasses.replace(element, section=element.section.stacked(n))
            for n, (name, element) in zip(self.counts, beam.forces.items())
        }
        return bodies, forces

    def shackle(self) -> Part:
        """A plate, as wide as the leaves, between two pins."""
        rod = self.ends[SHACKLE] - self.ends[REAR]
        square, width = jnp.dot(rod, rod), self.section["width"] ** 2
        across = square * jnp.eye(3, dtype=rod.dtype) - jnp.outer(rod, rod)
        wide = width * jnp.diag(jnp.asarray([1.0, 0.0, 1.0], rod.dtype))
        middle = (self.ends[SHACKLE] + self.ends[REAR]) / 2.0
        return Part(middle, self.shackle_mass, self.shackle_mass / 12.0 * (across + wide))


def read_leaf_spring(table: Reader, kilogram: float) -> LeafPack:
    """The table `leaf_spring`."""
    table.only(
        (*POINTS, "width", "thickness", *MATERIAL, "damping", "shackle_mass", "leaves", "full_length", "elements")
    )
    ends = {name: table.point(name) for name in POINTS}
    front, seat, rear, shackle = (np.asarray(ends[name]) for name in POINTS)
    chord, arm = rear - front, shackle - rear
    length = np.linalg.norm(chord)
    share = np.dot(seat - front, chord) / max(length**2, 1e-12)
    off = np.linalg.norm(seat - front - share * chord)
    if not (0.1 < share < 0.9 and off < MOST_CAMBER * length and abs(chord[1]) < MOST_SPLAY * abs(chord[0])):
        raise table.fail(
            SEAT,
            "must be between the two eyes, and no further from their line than a leaf is bent, of a spring along the "
            f"car, not across; got front, seat and rear {np.stack([front, seat, rear]).tolist()} [m].",
        )
    reach, swings = np.linalg.norm(arm), np.linalg.norm(np.cross(arm, chord)) > 0.2 * np.linalg.norm(arm) * length
    if not (0 < reach < MOST_SHACKLE * length and swings and abs(arm[1]) < MOST_SPLAY * reach):
        raise table.fail(
            SHACKLE,
            "is where the shackle, which begins at the rear eye, is pinned to the chassis: over or under it, not along "
            "the spring, where it cannot swing, nor across the car, along its pins; got rear and shackle "
            f"{np.stack([rear, shackle]).tolist()} [m].",
        )
    section = {name: table.metres(name, 0.5) for name in ("width", "thickness")}
    if not section["thickness"] <= section["width"]:
        raise table.fail(
            "thickness",
            f"{float(section['thickness']):g} m is more than the width, {float(section['width']):g} m, of a leaf that "
            "lies flat; they are exchanged.",
        )
    material = read_material(table) | ({"damping": table.number("damping")} if "damping" in table else {})
    leaves = table.count("leaves")
    full = table.count("full_length") if "full_length" in table else 1
    if not full <= leaves <= MOST_LEAVES:
        raise table.fail("leaves", f"must be at least `full_length`, {full}, and at most {MOST_LEAVES}, got {leaves}.")
    elements = table.count("elements") if "elements" in table else ELEMENTS
    return LeafPack(ends, section, material, table.number("shackle_mass", kilogram), leaves, full, elements)
