"""Flexible beams: nodes that are bodies, and elements between them that are forces.

Mass. Each node has half of what is beside it, (m h/2) I for an element of length h, and M stays one of bodies.
Velocities that are linear along elements would give the consistent one, (m h/6) [[2, 1], [1, 2]], constant too in these
coordinates. Waves of wave number k, with x = k h/2, have the frequency ω of the continuous beam times

                                   lumped                        consistent: divided by √((2 + cos 2x)/3)
    along it, in torsion           sin x / x = 1 − x²/6          1 + x²/6
    in bending, slender            sin x tan x / x² = 1 + x²/6   1 + x²/2

because one strain in each element makes it too stiff in bending, for which lumped masses make up in part. So consistent
mass would be as far off along the beam, three times as far in bending, and couple bodies in M: it is not offered.
"""

import dataclasses
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._brief import as_called
from lgsens._validate import array_of, as_count, as_float, is_concrete, point_field, require
from lgsens.model._beam_load import element
from lgsens.model._beam_sections import BeamSection
from lgsens.model._body import RigidBody
from lgsens.model._evaluate_by_kind import unstacked
from lgsens.model._forces import AbstractConnection
from lgsens.model._joints import FixedJoint


class BeamElement(AbstractConnection):
    """An element of a geometrically exact beam between a section of a and one of b: straight, curved or twisted.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at_a, at_b: centroids of the end sections in the reference configuration [m], inertial frame, shape (3,).
        axes_a, axes_b: their axes as columns, the first along the beam, inertial frame, shape (3, 3), rotations.
        section: what is between them.
        preload: σ₀, forces [N] and moments [N m] of its sections in the reference configuration, shape (6,); None: 0.

    Strains are zero in the reference configuration; the element is massless (`Beam` has nodes with mass). It may be of
    any size and turn and move as it likes; section b turns by less than π in section a. `Trajectory.force(name)` is a
    `SectionState`. Raises `ValueError` for wrong shapes and sections at the same point. Source: `_beam_load`.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: Float[Array, "3"] = point_field("at_a")
    at_b: Float[Array, "3"] = point_field("at_b")
    axes_a: Float[Array, "3 3"] = eqx.field(kw_only=True, converter=lambda axes: as_float(axes, (3, 3), "`axes_a`"))
    axes_b: Float[Array, "3 3"] = eqx.field(kw_only=True, converter=lambda axes: as_float(axes, (3, 3), "`axes_b`"))
    section: BeamSection = eqx.field(kw_only=True)
    preload: Float[Array, "6"] | None = eqx.field(
        default=None, kw_only=True, converter=lambda s: None if s is None else as_float(s, (6,), "`preload`")
    )

    preload_shape = (6,)

    @property
    def preload_rates(self):
        return jnp.diagonal(self.section.matrix) / jnp.linalg.norm(self.at_b - self.at_a)

    def __check_init__(self):
        if not isinstance(self.section, BeamSection):
            raise ValueError(f"BeamElement: `section` must be a BeamSection, got {self.section!r}.")
        require(
            lambda a, b: np.any(a != b),
            lambda: f"BeamElement: `at_a` and `at_b` are the same point, {self.at_a}; an element has a length.",
            self.at_a,
            self.at_b,
        )

    def as_joint(self, kind, what):
        if kind not in (None, "fixed"):
            raise ValueError(f"{what}: `kind` must be 'fixed' or None for an element of a beam, got {kind!r}.")
        return FixedJoint(self.a, self.b, at=self.at_b), dataclasses.replace(self, preload=None), None

    def load(self, a, b):
        sections = (self.at_a, self.at_b), (self.axes_a, self.axes_b)
        preload = jnp.zeros(6, self.at_a.dtype) if self.preload is None else self.preload
        return element(a, b, *sections, self.section, preload)


class Beam(eqx.Module):
    """A flexible beam: bodies at its nodes, and elements between them, for a `Model`.

        link = Beam("link", section, [[0, 0, 0], [1, 0, 0]], elements=8)
        Model(bodies | link.bodies, joints, forces | link.forces)

    The nodes "link.0" … "link.8" are bodies, whose frames have their origin on the axis and their first axis along it:
    joints, forces and drivers take them by name, `Trajectory.body("link.8")` is the motion of the tip, and
    `Trajectory.force("link.3")` the `SectionState` of the element from node 3 to node 4. A clamp is a `FixedJoint`,
    which costs nothing with `merge_fixed`.

    Arguments:
        name: what its nodes and elements begin with, static.
        section: a `BeamSection`, along all of it.
        points: of its axis in the reference configuration [m], inertial frame, shape (m, 3): two ends, or, of a curved
            beam, m > 2 nodes. Its tangent at a node is that of the circle through the node and its neighbours.
        elements: of a straight beam, static; a curved one has m − 1.
        up: a direction, inertial frame, shape (3,), in whose plane with the tangent axis 3 of the sections lies: of a
            rectangle that of its height. Of a twisted beam one at each node, shape (n, 3), also where `elements` says
            how many nodes there are; sections turn uniformly in between, by less than π.

    Each node carries half the mass of the elements beside it, and their sections' rotary inertia; all masses of the
    scene are constant. Errors are O(1/elements²); for large rotations too, a beam bent to a circle by end moments is
    exact with any number of elements. Raises `ValueError` for wrong shapes, points that coincide, and an `up` along the
    beam. Source: Sonneville, Cardona & Brüls (2014), CMAME 268, 451.
    """

    name: str = eqx.field(static=True)
    section: BeamSection
    points: Float[Array, "n 3"]
    axes: Float[Array, "n 3 3"]

    __repr__ = as_called

    def __init__(self, name: str, section: BeamSection, points, *, elements: int | None = None, up=(0.0, 0.0, 1.0)):
        if not isinstance(section, BeamSection):
            raise ValueError(f"Beam: `section` must be a BeamSection, got {section!r}.")
        with jax.ensure_compile_time_eval():  # of numbers that are known, inside of `jit` too
            points, up = _known(as_float(points, None, "Beam: `points`"), as_float(up, None, "Beam: `up`"))
        if points.ndim != 2 or points.shape[1] != 3 or points.shape[0] < 2:
            raise ValueError(f"Beam: `points` must have shape (m, 3) with m of at least 2, got {points.shape}.")
        if points.shape[0] > 2 and elements is not None:
            raise ValueError("Beam: `elements` is for a straight beam, between two points; a curved one has m - 1.")
        if points.shape[0] == 2:
            count = as_count(1 if elements is None else elements, "elements", " (it is static)")
            along = (np.arange(count + 1)[:, None] / count).astype(points.dtype)
            points = points[:1] + along * (points[1:] - points[:1])
        chords = points[1:] - points[:-1]
        require(
            lambda chords: np.all(np.linalg.norm(chords, axis=1) > 0),
            lambda: f"Beam: `points` {points} has two after each other that coincide.",
            chords,
        )
        if up.shape not in ((3,), points.shape):
            raise ValueError(f"Beam: `up` must have shape (3,), or of each node {points.shape}, got {up.shape}.")
        axes = _triads(_tangents(chords), up)
        require(
            lambda axes: np.all(np.isfinite(axes)) and np.all(np.abs(np.linalg.det(axes) - 1.0) < 1e-6),
            lambda: f"Beam: `up` {up} lies along the beam; give a direction across it.",
            axes,
        )
        self.name, self.section = name, section
        with jax.ensure_compile_time_eval():
            self.points, self.axes = array_of(points), array_of(axes)

    @property
    def nodes(self) -> tuple[str, ...]:
        """The names of its bodies, in order."""
        return tuple(f"{self.name}.{i}" for i in range(self.points.shape[0]))

    @property
    def forces(self) -> dict[str, BeamElement]:
        """Its elements by name: that from node i to node i + 1 has the name of node i."""
        with jax.ensure_compile_time_eval():
            points, axes = map(unstacked, (self.points, self.axes))
            place = lambda i, end: {f"at_{end}": points[i], f"axes_{end}": axes[i]}
            return {
                a: BeamElement(a, b, **place(i, "a"), **place(i + 1, "b"), section=self.section)
                for i, (a, b) in enumerate(pairwise(self.nodes))
            }

    @property
    def bodies(self) -> dict[str, RigidBody]:
        """Its nodes by name."""
        points, axes, mass, inertia = _known(self.points, self.axes, self.section.mass, self.section.inertia)
        lengths = _norm(points[1:] - points[:-1])[:, 0]
        none, xp = 0.0 * lengths[:1], _module(points)
        carried = (xp.concatenate([none, lengths]) + xp.concatenate([lengths, none])) / 2.0
        numbers = carried * mass, carried[:, None] * inertia[None], points, axes
        with jax.ensure_compile_time_eval():
            at_rest = dict.fromkeys(("velocity", "angular_velocity"), jnp.zeros(3, self.points.dtype))
            return {node: RigidBody(*own, **at_rest) for node, *own in zip(self.nodes, *map(unstacked, numbers))}


def _known(*arrays) -> tuple[Any, ...]:
    """Arrays, those whose numbers are known as NumPy's: inside of `jit` JAX traces what is made of its own, and of each
    node and element compiles it."""
    return tuple(np.asarray(array) if is_concrete(array) else array for array in arrays)


def _module(array) -> Any:
    return np if isinstance(array, np.ndarray) else jnp


def _norm(vectors: Float[Array, "n 3"]) -> Float[Array, "n 1"]:
    return _module(vectors).sqrt((vectors**2).sum(axis=1, keepdims=True))


def _tangents(chords: Float[Array, "n 3"]) -> Float[Array, "m 3"]:
    """Unit tangents at nodes: with the circle through a node and its neighbours c₁/|c₁|² + c₂/|c₂|², and at an end,
    where chord and both tangents are symmetric, 2 (ĉ·t) ĉ − t."""
    unit, xp = chords / _norm(chords), _module(chords)
    if chords.shape[0] == 1:
        return xp.concatenate([unit, unit])
    slopes = chords / (chords**2).sum(axis=1, keepdims=True)
    inner = slopes[:-1] + slopes[1:]
    inner = inner / _norm(inner)
    end = lambda c, t: 2.0 * (c * t).sum() * c - t
    return xp.concatenate([end(unit[0], inner[0])[None], inner, end(unit[-1], inner[-1])[None]])


def _triads(tangents: Float[Array, "m 3"], up: Float[Array, "3"]) -> Float[Array, "m 3 3"]:
    xp: Any = np if isinstance(tangents, np.ndarray) and isinstance(up, np.ndarray) else jnp
    across = xp.cross(xp.broadcast_to(up, tangents.shape), tangents)
    with np.errstate(invalid="ignore"):  # `up` along the beam
        across = across / _norm(across)
    return xp.stack([tangents, across, xp.cross(tangents, across)], axis=2)
