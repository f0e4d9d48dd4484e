"""What a suspension is made of: parts, links, connections, spring and damper, and the elements that they become."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.examples._link_beam import LinkBeam
from lgsens.model import (
    ALL_FREE,
    AbstractForce,
    AbstractJoint,
    Beam,
    CurveSpringDamper,
    CylindricalJoint,
    FixedJoint,
    PlanarJoint,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    Sampled,
    SphericalJoint,
    SpringDamper,
    UniversalJoint,
    lumped,
)

ALONG_Y: Any = (0.0, 1.0, 0.0)
AT_A_POINT: dict[str, Any] = {"fixed": FixedJoint, "spherical": SphericalJoint}
ALONG_A_LINE: dict[str, Any] = {
    "cylindrical": CylindricalJoint,
    "prismatic": PrismaticJoint,
    "revolute": RevoluteJoint,
}
LEVEL = "level"  # a hinge through a point, along y: what symmetry makes of a ball joint
PLANAR = "planar"  # sliding on a plane through a point, upright to y: what symmetry makes of no joint at all
BOTH_SIDES = (LEVEL, PLANAR)  # by which one side moves as both do alike
VECTORS = {"at", "arms", "axes", "ends", "centre", "arm", "link_arm", "bearing", "lever", "preload", "up"}
AXIAL = "rotational_preload"
# Curves of a bushing along its axes e₁, e₂, e₃ = e₁ × e₂: these become S e₁, S e₂, −S e₃, and turns change their sign.
TURNED_ROUND = {"spring_3", "damper_3", *(f"rotational_{kind}_{i}" for kind in ("spring", "damper") for i in (1, 2))}
Tree = TypeVar("Tree")


def reflected(tree: Tree) -> Tree:
    """The mirror image of parts in the plane y = 0, S = diag(1, −1, 1); twice it is what it was.

    Points and directions become S x, tensors S J S: products of inertia with y change their sign, principal moments
    about the axes of the file stay. Moments and angles are of screws, so a moment becomes −S m: what was right-handed
    is left-handed. Rates, masses and lengths stay; of a curve that changes its sign places and forces do.
    """

    def leaf(path, value):
        names = {entry.name for entry in path if isinstance(entry, jax.tree_util.GetAttrKey)}
        flip = jnp.asarray([1.0, -1.0, 1.0], value.dtype)
        if "curves" in names:
            return -value[:, ::-1] if path[-1].key in TURNED_ROUND else value
        if "inertia" in names:
            return value if value.ndim == 1 else value * jnp.outer(flip, flip)
        sign = -flip if AXIAL in names else flip if names & VECTORS else None
        return value if sign is None else value * jnp.broadcast_to(sign, value.shape)

    return jax.tree_util.tree_map_with_path(leaf, tree)


def itself(body: str) -> str:
    """The body of this name is called so."""
    return body


def numbered(points: Mapping[str, Array]) -> list[str]:
    """The names of points, of two of one name "NAME 1" and "NAME 2"."""
    return [name + end for name, at in points.items() for end in ([""] if at.ndim == 1 else [" 1", " 2"])]


def regrouped(rows: Float[Array, "n 3"], like: Sequence[Array]) -> list[Array]:
    """The rows of points in arrays of the shapes of others, (3,) or (2, 3), which have as many in all."""
    ends = np.cumsum([old.size // 3 for old in like])
    return [rows[end - old.size // 3 : end].reshape(old.shape) for old, end in zip(like, ends)]


class Part(eqx.Module):
    """A body: centre of mass [m], mass [kg], moments of inertia about the axes of the file [kg m²]; (3,) principal."""

    centre: Float[Array, "3"]
    mass: Float[Array, ""]
    inertia: Float[Array, "3"] | Float[Array, "3 3"]

    def body(self, points: Sequence[tuple[Array, Array]] = (), free: str | Sequence[str] = ALL_FREE) -> RigidBody:
        """It with point masses, pairs of a mass and a place, fixed to it."""
        body = RigidBody(mass=self.mass, inertia=self.inertia, position=self.centre, free=free)
        return body.with_points(*zip(*points)) if points else body

    def halved(self) -> "Part":
        """Its half on either side of the plane y = 0, of which it is symmetric."""
        return Part(self.centre, self.mass / 2, self.inertia / 2)

    def joined(self, other: "Part") -> "Part":
        """Both as one body."""
        both = jnp.stack([self.mass, other.mass]), jnp.stack([self.centre, other.centre])
        mass, centre, apart = lumped(*both)
        own = [part.inertia if part.inertia.ndim == 2 else jnp.diag(part.inertia) for part in (self, other)]
        return Part(centre, mass, own[0] + own[1] + apart)


def stiffened(beam: Beam) -> Part:
    """A straight beam as one rigid body: that of its nodes."""
    mass, centre, apart = lumped(jnp.stack([body.mass for body in beam.bodies.values()]), beam.points)
    own = beam.axes[0] @ jnp.diag(beam.section.inertia) @ beam.axes[0].T
    return Part(centre, mass, apart + own * (mass / beam.section.mass))


class Connection(eqx.Module):
    """A joint between two bodies: of a kind, at a point or along the line of two [m], a universal one with its arms."""

    kind: str = eqx.field(static=True)
    between: tuple[str, str] = eqx.field(static=True)
    at: Float[Array, "3"] | Float[Array, "2 3"]
    arms: tuple[Float[Array, "3"], Float[Array, "3"]] | None = None

    def joint(self, named: Callable[[str], str] = itself) -> AbstractJoint:
        """The joint of a scene in which its bodies are called so."""
        between = [named(body) for body in self.between]
        if self.kind == LEVEL:
            return RevoluteJoint(*between, at=self.at, axis=ALONG_Y)
        if self.kind == PLANAR:
            return PlanarJoint(*between, at=self.at, axis=ALONG_Y)
        if self.arms is not None:
            return UniversalJoint(*between, at=self.at, axis_a=self.arms[0], axis_b=self.arms[1])
        if self.kind in AT_A_POINT:
            return AT_A_POINT[self.kind](*between, at=self.at)
        middle = (self.at[0] + self.at[1]) / 2  # between the bushes of a wishbone, also in pictures
        return ALONG_A_LINE[self.kind](*between, at=middle, axis=self.at[1] - self.at[0])

    def blocked(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A point, and the directions in which it lets b neither turn nor move in a there: in NumPy, for checks."""
        at, every, none = np.atleast_2d(np.asarray(self.at)), np.eye(3), np.zeros((0, 3))
        if self.arms is not None:
            return at[0], np.cross(np.asarray(self.arms[0]), np.asarray(self.arms[1]))[None], every
        if self.kind == LEVEL:
            return at[0], every[::2], every
        if self.kind == PLANAR:
            return at[0], every[::2], every[1:2]
        if self.kind in AT_A_POINT:
            return at[0], every if self.kind == "fixed" else none, every
        across = np.linalg.svd((at[1] - at[0])[None])[2][1:]
        turns = every if self.kind == "prismatic" else across
        return at[0], turns, every if self.kind == "revolute" else across


class Link(eqx.Module):
    """A link and where it holds on to other bodies: a rigid one, or a beam between its two ends.

    Attributes:
        ends: by the body it holds on to one point [m], shape (3,), a ball joint, or two, shape (2, 3), a hinge along
            their line. A link with one or two ball joints and no hinge has a universal joint at the first of them, the
            chassis if it is one, so that it does not spin.
        mass: [kg], shape (); None: that of its beam. centre, inertia: as of a `Part`; None: it is a uniform round bar
            between its two ends.
        arm: of the universal joint, fixed in the other body; None: level and across the link, which goes up and down
            by turning about it. link_arm: the one fixed in the link; None: across both.
        beam: its section; None: it is rigid.
    """

    ends: dict[str, Float[Array, "3"] | Float[Array, "2 3"]]
    mass: Float[Array, ""] | None
    centre: Float[Array, "3"] | None = None
    inertia: Float[Array, "3"] | None = None
    arm: Float[Array, "3"] | None = None
    link_arm: Float[Array, "3"] | None = None
    beam: LinkBeam | None = None

    @property
    def chassis(self) -> Array:
        """Where it holds on to the chassis."""
        return self.ends["chassis"]

    @property
    def knuckle(self) -> Array:
        """Where it holds on to the knuckle."""
        return self.ends["knuckle"]

    @property
    def first(self) -> str | None:
        """The body at its universal joint."""
        if len(self.ends) > 2 or any(points.ndim == 2 for points in self.ends.values()):
            return None
        return "chassis" if "chassis" in self.ends else min(self.ends)

    @property
    def balls(self) -> list[str]:
        """The bodies at its ball joints."""
        return [name for name, points in self.ends.items() if points.ndim == 1 and name != self.first]

    @property
    def is_bar(self) -> bool:
        """Whether a massless rod can take its place."""
        return self.centre is None and self.first is not None and self.beam is None

    @property
    def axis(self) -> tuple[Array, Array]:
        """Of a link with two ends these, by the names of the bodies."""
        start, end = (self._middle(name) for name in sorted(self.ends))
        return start, end

    @property
    def own_mass(self) -> Array:
        """[kg], shape ()."""
        if self.beam is None:
            assert self.mass is not None
            return self.mass
        start, end = self.axis
        return self.beam.section.mass * jnp.linalg.norm(end - start)

    def bent(self, name: str) -> Beam:
        """Its beam, of this name: node 0 is at the first of its ends, by the names of the bodies."""
        assert self.beam is not None
        return self.beam.beam(name, *self.axis)

    def part(self, radius: Any) -> Part:
        """Its mass: its own, or that of its beam's nodes, or of a bar of this radius: m r²/2 about its axis,
        m L²/12 + m r²/4 across."""
        if self.beam is not None:
            return stiffened(self.bent(""))
        if self.centre is not None and self.inertia is not None:
            return Part(self.centre, self.own_mass, self.inertia)
        start, end = self.axis
        direction = end - start
        square = jnp.dot(direction, direction)
        along = jnp.outer(direction, direction) / square
        across = jnp.eye(3, dtype=square.dtype) - along
        inertia = self.own_mass * (radius**2 / 2 * along + (square / 12 + radius**2 / 4) * across)
        return Part((end + start) / 2, self.own_mass, inertia)

    def _middle(self, name: str) -> Array:
        points = self.ends[name]
        return points if points.ndim == 1 else (points[0] + points[1]) / 2

    def direction(self) -> Array:
        """From its universal joint to its other end, or its centre of mass if it has no other."""
        others = [name for name in self.ends if name != self.first]
        return (self._middle(others[0]) if others or self.centre is None else self.centre) - self.ends[self.first or ""]

    def arms(self) -> tuple[Array, Array]:
        """Of its universal joint, in the other body and in the link."""
        direction, arm = self.direction(), self.arm
        if arm is None:
            steep = direction[2] ** 2 > 0.99 * jnp.dot(direction, direction)
            x, z = jnp.eye(3, dtype=direction.dtype)[::2]
            arm = jnp.cross(jnp.where(steep, x, z), direction)
        return arm, jnp.cross(arm, direction) if self.link_arm is None else self.link_arm

    def connections(self, name: str) -> Iterator[Connection]:
        """Its joints, of the link of this name."""
        for body, points in sorted(self.ends.items()):
            if body == self.first:
                yield Connection("universal", (body, name), points, self.arms())
            else:
                yield Connection("spherical" if points.ndim == 1 else "revolute", (body, name), points)


class Strut(eqx.Module):
    """A spring or a damper between two bodies.

    Attributes:
        ends: by the two bodies the points at which it acts [m], shape (3,) each.
        rate: [N/m] or [N s/m], shape (); of a curve its slope at the design position, or at rest.
        curve: extension [m] or its rate [m/s], increasing, and tension over `rate`, shape (2, n): the monotone cubic
            through these points, straight on outside of them (`Sampled`); None: a straight line.
        free_length: at which a spring has no extension [m], shape (); None: that of the design position.
    """

    ends: dict[str, Float[Array, "3"]]
    rate: Float[Array, ""]
    curve: Float[Array, "2 n"] | None = None
    free_length: Float[Array, ""] | None = None

    @property
    def bodies(self) -> tuple[str, str]:
        """The chassis, if it is one of them, is the second."""
        first, second = sorted(self.ends)
        return (second, first) if first == "chassis" else (first, second)

    @property
    def link(self) -> str:
        """The body that it acts on, beside the chassis."""
        return self.bodies[0]

    @property
    def link_point(self) -> Array:
        """Its point there."""
        return self.ends[self.link]

    @property
    def chassis_point(self) -> Array:
        """Its point on the chassis."""
        return self.ends[self.bodies[1]]

    def push(self) -> float | None:
        """What a spring with a free length pushes with at the design position [N]; None: it has none."""
        if self.free_length is None or self.curve is None:
            return None
        extension = np.linalg.norm(self.chassis_point - self.link_point) - self.free_length
        return -float(self.rate * Sampled(self.curve[0], self.curve[1], "monotone")(extension))

    def element(self, kind: str, free_length: Any = None, named: Callable[[str], str] = itself) -> AbstractForce:
        """The force element, a "spring" or a "damper", of bodies called so; a preload is added at all lengths."""
        a, b = self.bodies
        places: dict[str, Any] = {"a": named(a), "b": named(b), "at_a": self.ends[a], "at_b": self.ends[b]}
        if self.curve is None:
            rates: dict[str, Any] = (
                {"stiffness": self.rate} if kind == "spring" else {"stiffness": 0.0, "damping": self.rate}
            )
            return SpringDamper(**places, **rates, free_length=free_length)
        signal: Any = Sampled(self.curve[0], self.rate * self.curve[1], "monotone")
        curve: dict[str, Any] = {kind: signal, "free_length": self.free_length if free_length is None else free_length}
        return CurveSpringDamper(**places, **curve)
