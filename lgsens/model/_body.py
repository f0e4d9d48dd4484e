"""The rigid body."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, require
from lgsens.model._frames import Frame


class RigidBody(eqx.Module):
    """A rigid body in its reference configuration, which is also where the motion starts.

    Its coordinates are the position x of the centre of mass and the rotation matrix R (paper §3.2), its
    velocity v = [ẋ, Ω] with Ω̃ = Rᵀ Ṙ, its equations m ẍ = F and J Ω̇ + Ω × J Ω = M.

    Arguments:
        mass: mass m [kg], shape (), positive.
        inertia: about the centre of mass, body frame [kg m²]: principal moments, shape (3,), or the full
            matrix J, shape (3, 3), symmetric and positive definite. Its principal moments satisfy the
            triangle inequality.
        position: centre of mass [m], inertial frame, shape (3,).
        orientation: rotation matrix R, body to inertial frame, shape (3, 3).
        velocity: velocity of the centre of mass [m/s], inertial frame, shape (3,).
        angular_velocity: angular velocity Ω [rad/s], body frame, shape (3,).

    The initial velocities are projected on those that the joints allow (`initial_state`).

    Raises `ValueError` for wrong shapes, a mass that is not positive, an inertia that no body can
    have, or an orientation that is not a rotation. Source: Sonneville & Brüls (2014), §3.2.
    """

    mass: Float[Array, ""]
    inertia: Float[Array, "3"] | Float[Array, "3 3"]
    position: Float[Array, "3"]
    orientation: Float[Array, "3 3"]
    velocity: Float[Array, "3"]
    angular_velocity: Float[Array, "3"]

    def __init__(
        self,
        mass,
        inertia,
        position=(0.0, 0.0, 0.0),
        orientation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
    ):
        self.mass = as_float(mass, (), "RigidBody: `mass`")
        self.inertia = as_float(inertia, None, "RigidBody: `inertia`")
        self.position = as_float(position, (3,), "RigidBody: `position`")
        self.orientation = as_float(orientation, (3, 3), "RigidBody: `orientation`")
        self.velocity = as_float(velocity, (3,), "RigidBody: `velocity`")
        self.angular_velocity = as_float(angular_velocity, (3,), "RigidBody: `angular_velocity`")
        if self.inertia.shape not in ((3,), (3, 3)):
            raise ValueError(
                "RigidBody: `inertia` must be three principal moments, shape (3,), or the matrix about the "
                f"centre of mass, shape (3, 3), got shape {self.inertia.shape}."
            )
        require(
            lambda mass: mass > 0 and np.isfinite(mass),
            f"RigidBody: `mass` must be positive, got {self.mass} kg.",
            self.mass,
        )
        require(
            _is_physical,
            f"RigidBody: `inertia` {self.inertia} kg m² is not the inertia of a body: it must be symmetric and "
            "positive definite, and each principal moment at most the sum of the other two (check units, "
            "axes and the centre of mass).",
            self.inertia,
        )
        require(
            _is_rotation,
            "RigidBody: `orientation` must be a rotation matrix (RᵀR = I, det R = 1); its columns are the "
            "body's axes in the inertial frame.",
            self.orientation,
        )

    @property
    def frame(self) -> Frame:
        """The pose in the reference configuration."""
        return Frame(self.position, self.orientation)

    @property
    def inertia_matrix(self) -> Float[Array, "3 3"]:
        """J about the centre of mass, body frame [kg m²]; the symmetric part of a full matrix."""
        if self.inertia.ndim == 1:
            return jnp.diag(self.inertia)
        return (self.inertia + self.inertia.T) / 2


def _is_physical(inertia) -> bool:
    """Symmetric, positive definite, triangle inequality, each to a few thousand round-offs of the matrix."""
    matrix = np.diag(inertia) if inertia.ndim == 1 else np.asarray(inertia)
    slack = 4096 * np.finfo(matrix.dtype).eps * np.abs(matrix).max()
    if not np.all(np.isfinite(matrix)) or np.abs(matrix - matrix.T).max() > slack:
        return False
    moments = np.linalg.eigvalsh(matrix)
    return bool(moments[0] > 0 and moments[2] <= moments[0] + moments[1] + slack)


def _is_rotation(matrix) -> bool:
    """RᵀR = I and det R = 1, to the accuracy of data given with eight digits (single precision: five)."""
    matrix = np.asarray(matrix)
    slack = np.sqrt(np.finfo(matrix.dtype).eps)
    return bool(np.abs(matrix.T @ matrix - np.eye(3)).max() <= slack and np.linalg.det(matrix) > 0)
