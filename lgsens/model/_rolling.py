"""Rolling without slip, a joint with equations of position and of velocity level.

A thin disc of radius ρ with its centre C and unit axle e rolls on a plane through P with the unit normal n. Its lowest
point is C + r,

    r = −ρ u/|u|,     u = n − (n·e) e,

as u is what the plane of the disc has of n. With n·u = |u|² the height of that point over the plane is

    Φ = n·(C − P) − ρ |u|,

a holonomic row. The material points of disc and ground there have the same velocity, w = ẋ_b + ω_b × (C + r − x_b) −
(ẋ_a + ω_a × (C + r − x_a)) = 0. Its component along n is dΦ/dt (the lowest point moves on the disc along the plane), so
two rows remain, which no function of the configuration has as its rate,

    f·w = 0,     l·w = 0,     f = e × n/|u|,     l = n × f,

forward and along the projected axle. Source: Neimark & Fufaev, Dynamics of Nonholonomic Systems (1972), ch. 1.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, require
from lgsens.liegroups import cross
from lgsens.model._constraints import AbstractConstraint, AbstractVelocityConstraint
from lgsens.model._frames import ROTATION, Frame
from lgsens.model._free import ROTATIONS, TRANSLATIONS, is_along
from lgsens.model._joints import AbstractJoint
from lgsens.model._relative import Coordinate


class _Contact(eqx.Module):
    """The numbers of the formulas above; P and n in a, C and e in b."""

    point_a: Float[Array, "3"]
    normal_a: Float[Array, "3"]
    point_b: Float[Array, "3"]
    axle_b: Float[Array, "3"]
    radius: Float[Array, ""]


def _upright(n, e) -> tuple[Float[Array, "3"], Float[Array, ""]]:
    """u and its length."""
    u = n - jnp.sum(n * e) * e
    return u, jnp.sqrt(jnp.sum(u * u))


class ContactHeight(AbstractConstraint):
    """The lowest point of a disc is on a plane: Φ = n·(C − P) − ρ |u|; λ is the force of b on a along n [N]."""

    contact: _Contact

    num_rows = 1
    drawn = None

    def fixed(self, kind, bodies="ab"):
        points = {"a": self.contact.point_a, "b": self.contact.point_b}
        return [points[body] for body in bodies] if kind == "point" else []

    def value(self, a, b, t):
        at = self.contact
        n = a.axis(at.normal_a)
        _, length = _upright(n, b.axis(at.axle_b))
        return (jnp.sum(n * (b.point(at.point_b) - a.point(at.point_a))) - at.radius * length)[None]


class Slip(AbstractVelocityConstraint):
    """The lowest point of a disc does not slip, f·w = 0 and l·w = 0; λ is the force of b on a along f and l [N]."""

    contact: _Contact
    drawn = None
    num_rows = 2

    def rate(self, a, b, va, vb, t):
        at = self.contact
        n, e = a.axis(at.normal_a), b.axis(at.axle_b)
        u, length = _upright(n, e)
        place = b.point(at.point_b) - at.radius * u / length
        material = lambda frame, v: v[: ROTATION.start] + cross(frame.axis(v[ROTATION]), place - frame.position)
        w = material(b, vb) - material(a, va)
        forward = cross(e, n) / length
        return jnp.stack([jnp.sum(forward * w), jnp.sum(cross(n, forward) * w)])


def _rolled(i: int) -> Callable[[Frame], Float[Array, ""]]:
    """A coordinate of a wheel whose frame has y along e, in the frame of a plane with z along n."""

    def of(seen: Frame):
        x, e = seen.orientation[:, 0], seen.orientation[:, 1]
        n = jnp.zeros_like(e).at[2].set(1.0)
        u, length = _upright(n, e)
        forward, centre = cross(e, n) / length, seen.position
        contact = centre - centre[2] / length * u / length  # ρ = d_z/|u|
        lean, spin = (e[2], length), (jnp.sum(x * cross(e, forward)), jnp.sum(x * forward))
        angles = [jnp.arctan2(*sides) for sides in ((forward[1], forward[0]), lean, spin)]
        return [contact[0], contact[1], *angles][i]

    return of


class Rolling(AbstractJoint):
    """A disc or wheel that rolls without slip on a plane; 3 equations.

    Of these one is holonomic, the height of the lowest point over the plane, and two are nonholonomic: its velocity
    along the plane is zero, forward and sideways. The contact is bilateral: it does not lift.

    Arguments:
        wheel: name of the body that rolls.
        ground: name of the body with the plane; None: the ground.
        at: the centre of the wheel in the reference configuration [m], inertial frame, shape (3,).
        axis: direction of its axle there, inertial frame, shape (3,), any length > 0.
        radius: its radius [m], shape (), positive.
        normal: normal of the plane, upwards, inertial frame, shape (3,), any length > 0.
        point: a point of the plane [m], inertial frame, shape (3,); None: the lowest point of the wheel. With a point
            the mechanism is assembled before it moves.

    Its coordinates (`Trajectory.joint`): how far the lowest point is, forward (axis × normal) and along the projected
    axle, from the point of the plane; heading about the normal, lean of the axle towards it, spin about the axle.
    The multipliers are the force of the wheel on the ground along the normal, forward (axis × normal) and sideways
    [N]; the first is negative where it presses. Equations are solved by dense matrices. In a mechanism of several
    bodies (a bicycle) take `GeneralizedAlpha(stabilized=True)`, ρ∞ ≤ 0.5 or `RadauIIA`: with positions in index 3 and
    larger ρ∞ what rolling couples to them can grow from step to step. Raises `ValueError` for a wrong shape, a zero
    direction, a radius ≤ 0, or a wheel that lies flat.
    """

    a: str | None = eqx.field(static=True)
    b: str = eqx.field(static=True)
    at: Float[Array, "3"]
    axis: Float[Array, "3"]
    radius: Float[Array, ""]
    normal: Float[Array, "3"]
    point: Float[Array, "3"] | None

    def __init__(self, wheel: str, ground: str | None = None, *, at, axis, radius, normal=(0.0, 0.0, 1.0), point=None):
        self.a, self.b = ground, wheel
        self.at = as_float(at, (3,), "Rolling: `at`")
        self.axis, self.normal = as_float(axis, (3,), "Rolling: `axis`"), as_float(normal, (3,), "Rolling: `normal`")
        self.radius = as_float(radius, (), "Rolling: `radius`")
        self.point = None if point is None else as_float(point, (3,), "Rolling: `point`")
        require(
            lambda radius: radius > 0, lambda: f"Rolling: `radius` must be positive, got {self.radius} m.", self.radius
        )
        require(
            lambda n, e: np.linalg.norm(np.cross(n, e)) > 1e-6 * np.linalg.norm(n) * np.linalg.norm(e) > 0,
            lambda: (
                f"Rolling: `axis` {self.axis} and `normal` {self.normal} are parallel or zero: the wheel lies flat and "
                "has no lowest point; turn one of them."
            ),
            self.normal,
            self.axis,
        )

    @property
    def assembled(self):
        return self.point is None

    coordinates = (
        Coordinate("forward", "m", _rolled(0)),
        Coordinate("sideways", "m", _rolled(1)),
        Coordinate("heading", "rad", _rolled(2), True),
        Coordinate("lean", "rad", _rolled(3)),
        Coordinate("spin", "rad", _rolled(4), True),
    )

    def _plane(self):
        """n, e, |u|, P."""
        n, e = (x / jnp.sqrt(jnp.sum(x * x)) for x in (self.normal, self.axis))
        u, length = _upright(n, e)
        return n, e, length, self.at - self.radius * u / length if self.point is None else self.point

    @property
    def frames(self):
        n, e, length, point = self._plane()
        forward = cross(e, n) / length
        axes = lambda y, z: jnp.stack([forward, y, z], axis=1)
        return Frame(point, axes(cross(n, forward), n)), Frame(self.at, axes(e, cross(forward, e)))

    def constraints(self, a: Frame, b: Frame):
        n, e, _, point = self._plane()
        ends = a.local_point(point), a.local_axis(n), b.local_point(self.at), b.local_axis(e)
        contact = _Contact(*ends, self.radius)
        return ContactHeight(contact), Slip(contact)

    def violable_about(self, name, free, axis):
        """Of a wheel that turns about one inertial axis: its height; forward and sideways."""
        require(
            lambda axle: is_along(axle, axis),
            lambda: (
                f"Joint {name!r}: `axis` {self.axis} must be that of {ROTATIONS[axis]!r}, the only rotation that "
                f"{self.b!r} has; turn the axle, or free all rotations."
            ),
            self.axis,
        )
        line = [i for i, translation in enumerate(TRANSLATIONS) if i != axis and translation in free]
        lifts = len(line) > 1 or not self.assembled
        if not lifts and line:
            require(
                lambda normal: is_along(normal, 3 - axis - line[0]),
                lambda: (
                    f"Joint {name!r}: {self.b!r} moves along {TRANSLATIONS[line[0]]!r} only, out of the plane with the "
                    f"`normal` {self.normal}; free another translation."
                ),
                self.normal,
            )
        return [(lifts,), (True, TRANSLATIONS[axis] in free)]
