"""How a wheel stands: its spin axis by static camber and toe, and its contact centre.

Axes are those of ISO 8855: x forward, y left, z up. Let e be the unit vector of the spin axis that points left, c the
wheel centre and r the loaded radius. The plane of the wheel is normal to e; its level line is X = e × e_z/|…|, forward,
its steepest one u = X × e = (e_z − (e_z·e) e)/|…|, and the tyre touches the road at its lowest point, the contact
centre P = c − r u. With steer angle δ and inclination ε

    e = (−sin δ cos ε, cos δ cos ε, sin ε),     u·e_z = cos ε,

and σ = 1 for a wheel on the left (y > 0), −1 on the right, camber is γ = −σ ε, positive with the top of the wheel
outward, toe −σ δ, positive with its front inward. A wheel that stands on the road has r = c_z/cos ε.

Source: ISO 8855:2011 (wheel plane, contact centre, steer, inclination and camber angle).
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens._xla import one_program
from lgsens.examples._suspension_parts import Part
from lgsens.model import ALL_FREE, RigidBody


class WheelPlane(NamedTuple):
    """How a wheel stands, ISO 8855 axes.

    Attributes:
        steer: angle from x to the trace of the wheel plane on the road [rad], positive to the left, shape ().
        inclination: of the wheel plane to the vertical [rad], positive with its top to the right, shape ().
        contact: the contact centre, its lowest point [m], inertial frame, shape (3,).
    """

    steer: Float[Array, ""]
    inclination: Float[Array, ""]
    contact: Float[Array, "3"]

    __repr__ = brief


def wheel_plane(axis: Float[Array, "3"], centre: Float[Array, "3"], radius: Float[Array, ""]) -> WheelPlane:
    """Steer angle, inclination and contact centre of a wheel.

        δ = atan2(−e·e_x, e·e_y),     ε = asin(e·e_z),     P = c − r u,  u = (e_z − (e_z·e) e)/|…|

    Arguments:
        axis: e, unit vector of the spin axis that points left, inertial frame, shape (3,).
        centre: c, the wheel centre [m], inertial frame, shape (3,).
        radius: r, from the wheel centre to the road in the plane of the wheel [m], shape (); 0: the contact centre is
            the wheel centre.

    Source: ISO 8855:2011 (wheel plane, contact centre, steer and inclination angle).
    """
    up = jnp.asarray([0.0, 0.0, 1.0], axis.dtype) - axis[2] * axis
    contact = centre - radius * up / jnp.linalg.norm(up)
    return WheelPlane(jnp.arctan2(-axis[0], axis[1]), jnp.arcsin(axis[2]), contact)


class Stance(NamedTuple):
    """How a wheel stands on the road, z = 0, in the reference configuration.

    Attributes:
        centre: the wheel centre [m], shape (3,).
        radius: the loaded radius, in the plane of the wheel [m], shape ().
        contact: the contact centre [m], shape (3,).
    """

    centre: Float[Array, "3"]
    radius: Float[Array, ""]
    contact: Float[Array, "3"]

    @staticmethod
    def of(axis: Float[Array, "3"], centre: Float[Array, "3"]) -> "Stance":
        """With this spin axis, to the left, and this wheel centre."""
        radius = centre[2] / jnp.sqrt(1.0 - axis[2] ** 2)
        return Stance(centre, radius, wheel_plane(axis, centre, radius).contact)


class Wheel(Part):
    """A wheel: a body whose spin axis is the second of its own axes, about which its inertia is.

    Attributes:
        centre, mass, inertia: as of a `Part`, but for the axes of the inertia.
        camber, toe: at the design position [rad], shape (), signs of ISO 8855: positive with the top outward, with the
            front inward.
    """

    camber: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros(()))
    toe: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.zeros(()))

    @property
    @one_program
    def axes(self) -> Float[Array, "3 3"]:
        """X, e and u as columns, inertial frame."""
        side = jnp.where(self.centre[1] > 0, 1.0, -1.0).astype(self.centre.dtype)
        steer, inclination = -side * self.toe, -side * self.camber
        (s, c), (tilt, level) = ((jnp.sin(angle), jnp.cos(angle)) for angle in (steer, inclination))
        zero = jnp.zeros_like(s)
        rows = [[c, -s * level, s * tilt], [s, c * level, -c * tilt], [zero, tilt, level]]
        return jnp.stack([jnp.stack(row) for row in rows])

    @property
    def spin_axis(self) -> Float[Array, "3"]:
        """e, to the left, inertial frame."""
        return self.axes[:, 1]

    @property
    def stance(self) -> Stance:
        """How it stands on the road."""
        return Stance.of(self.spin_axis, self.centre)

    def on_axis(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """The point of the spin axis that is nearest to one [m], shape (3,)."""
        return self.centre + self.spin_axis * jnp.dot(self.spin_axis, point - self.centre)

    def body(self, points: Sequence[tuple[Array, Array]] = (), free: str | Sequence[str] = ALL_FREE) -> RigidBody:
        """It, with its own axes, and point masses, pairs of a mass and a place, fixed to it."""
        body = RigidBody(self.mass, self.inertia, self.centre, self.axes, free=free)
        return body.with_points(*zip(*points)) if points else body
