"""What a trajectory says of a body, and of a point of one."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief


class BodyMotion(NamedTuple):
    """The motion of one body; every array has a leading axis over the n + 1 times, at an `Instant` none.

    Attributes:
        position: centre of mass [m], inertial frame, shape (n+1, 3).
        orientation: rotation matrix, body to inertial frame, shape (n+1, 3, 3).
        velocity: velocity of the centre of mass [m/s], inertial frame, shape (n+1, 3).
        angular_velocity: Ω [rad/s], body frame, shape (n+1, 3).
        acceleration: acceleration of the centre of mass [m/s²], inertial frame, shape (n+1, 3).
        angular_acceleration: Ω̇ [rad/s²], body frame, shape (n+1, 3).
    """

    position: Float[Array, "*n 3"]
    orientation: Float[Array, "*n 3 3"]
    velocity: Float[Array, "*n 3"]
    angular_velocity: Float[Array, "*n 3"]
    acceleration: Float[Array, "*n 3"]
    angular_acceleration: Float[Array, "*n 3"]

    __repr__ = brief

    def point(self, at) -> Float[Array, "n 3"]:
        """The path [m], inertial frame, of the body's point that is at `at` (inertial frame, shape (3,)) at first.

        Needs a motion with times: that of a `Trajectory`.
        """
        local = self.orientation[0].T @ (jnp.asarray(at, self.position.dtype) - self.position[0])
        return self.position + self.orientation @ local


class PointMotion(NamedTuple):
    """The motion of a point fixed to a body, inertial frame; arrays have a leading axis n + 1, at an `Instant` none.

    Attributes:
        position: where it is [m], shape (n+1, 3).
        velocity: its velocity [m/s], shape (n+1, 3).
        acceleration: its acceleration [m/s²], shape (n+1, 3).
    """

    position: Float[Array, "*n 3"]
    velocity: Float[Array, "*n 3"]
    acceleration: Float[Array, "*n 3"]

    __repr__ = brief
