"""The rigid body."""

from collections.abc import Iterable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._brief import as_called
from lgsens._validate import as_float, require, shaped
from lgsens._xla import one_program
from lgsens.model._checks import far_from_rotation
from lgsens.model._frames import Frame
from lgsens.model._free import (
    ALL_FREE,
    ROTATIONS,
    TRANSLATIONS,
    Free,
    as_free,
    is_along,
    places,
    single_rotation,
    vanish_but_for,
)


class RigidBody(eqx.Module):
    """A rigid body in its reference configuration, which is also where the motion starts.

    Its coordinates are the position x of the centre of mass and the rotation matrix R (paper §3.2), its
    velocity v = [ẋ, Ω] with Ω̃ = Rᵀ Ṙ, its equations m ẍ = F and J Ω̇ + Ω × J Ω = M.

    Arguments:
        mass: mass m [kg], shape (), positive.
        inertia: about the centre of mass, body frame [kg m²]: principal moments, shape (3,), or the full
            matrix J, shape (3, 3), symmetric and positive definite. Its principal moments satisfy the
            triangle inequality. None: a point mass, which has no rotations.
        position: centre of mass [m], inertial frame, shape (3,).
        orientation: rotation matrix R, body to inertial frame, shape (3, 3).
        velocity: velocity of the centre of mass [m/s], inertial frame, shape (3,).
        angular_velocity: angular velocity Ω [rad/s], body frame, shape (3,).
        free: the degrees of freedom that the body has, names among "x", "y", "z" (translation of the centre of
            mass along the axes of the inertial frame) and "rx", "ry", "rz" (rotation about the body axes), in a tuple
            or in one string: `free="z"` heaves only, `free="x y rz"` moves in the plane, `free=()` is held. The
            others are no unknowns, and joints lose the equations that can no longer be violated. Default: all six, of a
            point mass the translations.
        pivot: a fixed point about which the body turns [m], inertial frame, shape (3,), for a body with
            rotations only: `free="rx ry rz", pivot=…` is a body on a ball joint, `free="ry", pivot=…` one on
            a hinge. Its velocity is then that of its rotation: leave out `velocity`. None: the body turns about its
            centre of mass.

    What is attached beside the centre of mass of a body without rotations translates with it. Attach joints to a point
    mass at the point, by a `SphericalJoint` or a `DistanceJoint`; those that hold its orientation against a body that
    turns raise `ValueError`.

    The initial velocities are projected on those that the joints allow (`initial_state`).

    The rotation of a body that has only one is about an inertial axis too: its body axis of that name lies along the
    inertial axis of that name. So which equations of a joint are needed does not depend on numbers. Derivatives by its
    `orientation` are those of a turn about that axis.

    Raises `ValueError` for wrong shapes, a mass that is not positive, an inertia that no body can
    have, an orientation that is not a rotation; an unknown degree of freedom, a rotation of a point mass, two rotations
    (which are no group), one about an axis that is not an inertial one, a pivot with translations, or an initial
    velocity that is not free. Source: Sonneville & Brüls (2014), §3.2.
    """

    mass: Float[Array, ""] = eqx.field(metadata=shaped())
    inertia: Float[Array, "3"] | Float[Array, "3 3"] | None
    position: Float[Array, "3"] = eqx.field(metadata=shaped(3))
    orientation: Float[Array, "3 3"] = eqx.field(metadata=shaped(3, 3))
    velocity: Float[Array, "3"] = eqx.field(metadata=shaped(3))
    angular_velocity: Float[Array, "3"] = eqx.field(metadata=shaped(3))
    pivot: Float[Array, "3"] | None = eqx.field(metadata=shaped(3))
    free: Free = eqx.field(static=True)

    __repr__ = as_called

    def __init__(
        self,
        mass,
        inertia,
        position=(0.0, 0.0, 0.0),
        orientation=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
        *,
        free: str | Iterable[str] | None = None,
        pivot=None,
    ):
        self.mass = as_float(mass, (), "RigidBody: `mass`")
        self.inertia = None if inertia is None else as_float(inertia, None, "RigidBody: `inertia`")
        self.position = as_float(position, (3,), "RigidBody: `position`")
        self.orientation = as_float(orientation, (3, 3), "RigidBody: `orientation`")
        self.velocity = as_float(velocity, (3,), "RigidBody: `velocity`")
        self.angular_velocity = as_float(angular_velocity, (3,), "RigidBody: `angular_velocity`")
        all_free = TRANSLATIONS if self.inertia is None else ALL_FREE
        self.free = all_free if free is None else as_free(free, "RigidBody: `free`")
        self.pivot = None if pivot is None else as_float(pivot, (3,), "RigidBody: `pivot`")
        if self.inertia is not None and self.inertia.shape not in ((3,), (3, 3)):
            raise ValueError(
                "RigidBody: `inertia` must be three principal moments, shape (3,), or the matrix about the "
                f"centre of mass, shape (3, 3), got shape {self.inertia.shape}."
            )
        if self.inertia is not None:
            require(
                _is_physical,
                lambda: (
                    f"RigidBody: `inertia` {self.inertia} kg m² is not the inertia of a body: it must be symmetric "
                    "and positive definite, and each principal moment at most the sum of the other two (check units, "
                    "axes and the centre of mass)."
                ),
                self.inertia,
            )
        require(
            _is_rotation,
            "RigidBody: `orientation` must be a rotation matrix (RᵀR = I, det R = 1); its columns are the "
            "body's axes in the inertial frame.",
            self.orientation,
        )

    def __check_init__(self):
        require(
            lambda mass: mass > 0 and np.isfinite(mass),
            lambda: f"RigidBody: `mass` must be positive, got {self.mass} kg.",
            self.mass,
        )
        if self.inertia is None and {*self.free} & {*ROTATIONS}:
            raise ValueError(
                f"RigidBody: a point mass (`inertia` = None) has no rotations, got `free` = {self.free!r}; leave them "
                "out, or give an `inertia`."
            )
        axis = single_rotation(self.free)
        if axis is not None:
            name = self.free[-1]
            require(
                lambda orientation: is_along(orientation[:, axis], axis),
                lambda: (
                    f"RigidBody: `free` has the one rotation {name!r}, so the body's {name[1]} axis must lie along the "
                    f"inertial {name[1]} axis, got `orientation` {self.orientation}; choose other body axes, or free "
                    "all rotations and add a RevoluteJoint."
                ),
                self.orientation,
            )
        if self.pivot is not None and (not self.free or self.free[0] in "xyz"):
            raise ValueError(
                f"RigidBody: `pivot` is for a body with rotations only, got `free` = {self.free!r}; leave it "
                "out, or free 'rx', 'ry', 'rz' or one of them."
            )
        if self.free == ALL_FREE:
            return
        remedy = "free the others too" if self.inertia is not None else "give an `inertia` to what turns"
        rest = "" if self.pivot is None else " (that of the centre of mass follows from the rotation about `pivot`)"
        require(
            lambda given: vanish_but_for(given[None], [self.coordinates]),
            lambda: (
                f"RigidBody: `velocity` {self.velocity} and `angular_velocity` {self.angular_velocity} must vanish but "
                f"for the degrees of freedom `free` = {self.free!r}; {remedy}, or leave out their velocity{rest}."
            ),
            self.velocities,
        )

    @property
    def velocities(self) -> Float[Array, "6"]:
        """[ẋ, Ω]."""
        return jnp.concatenate([self.velocity, self.angular_velocity])

    @property
    def coordinates(self) -> tuple[int, ...]:
        """Which of the six coordinates [x, θ] the body has."""
        return places(self.free)

    @property
    def free_velocity(self) -> tuple[Float[Array, " n"], ...]:
        """The velocities of the coordinates that the body has, in pieces."""
        if self.free == ALL_FREE:
            return self.velocity, self.angular_velocity
        return (jnp.take(self.velocities, np.asarray(self.coordinates, int), mode="clip"),)

    @property
    def frame(self) -> Frame:
        """The body frame in the reference configuration: the orientation at the centre of mass, or at the pivot."""
        return Frame(self.position if self.pivot is None else self.pivot, self.orientation)

    @property
    def centre(self) -> Float[Array, "3"]:
        """The centre of mass in the body frame [m]: zero without a pivot."""
        return self.frame.local_point(self.position)

    @property
    def inertia_matrix(self) -> Float[Array, "3 3"]:
        """J about the centre of mass, body frame [kg m²]; the symmetric part of a full matrix."""
        if self.inertia is None:
            return jnp.zeros((3, 3), self.mass.dtype)
        if self.inertia.ndim == 1:
            return jnp.diag(self.inertia)
        return (self.inertia + self.inertia.T) / 2

    @property
    def frame_inertia(self) -> Float[Array, "3 3"]:
        """J about the origin of the body frame [kg m²]: with a pivot at −c it is J + m (|c|² I − c cᵀ) (Steiner)."""
        if self.pivot is None:
            return self.inertia_matrix
        return self.inertia_matrix + self.mass * parallel_axis(self.centre)

    def with_points(self, masses: Sequence[Array], places: Sequence[Array]) -> "RigidBody":
        """It with point masses [kg] fixed to it at places [m], inertial frame; each of its points moves as before."""
        mass, position, shifted = lumped(jnp.stack([self.mass, *masses]), jnp.stack([self.position, *places]))
        axes, inertia, velocity = self.orientation, self.inertia, self.velocity
        if inertia is not None:
            inertia = self.inertia_matrix + axes.T @ shifted @ axes
        if self.pivot is None and {*self.free} & {*ROTATIONS}:
            velocity = velocity + jnp.cross(axes @ self.angular_velocity, position - self.position)
        return RigidBody(
            mass, inertia, position, axes, velocity, self.angular_velocity, free=self.free, pivot=self.pivot
        )


@one_program
def lumped(
    masses: Float[Array, " n"], places: Float[Array, "n 3"]
) -> tuple[Float[Array, ""], Float[Array, "3"], Float[Array, "3 3"]]:
    """Point masses as one body: m = Σ m_i, x = Σ m_i x_i/m and, by d_i = x_i − x, J = Σ m_i (|d_i|² I − d_i d_iᵀ)."""
    mass = jnp.sum(masses)
    position = masses @ places / mass
    return mass, position, jnp.sum(masses[:, None, None] * jax.vmap(parallel_axis)(places - position[None]), axis=0)


@one_program
def parallel_axis(arm: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """|c|² I − c cᵀ: the inertia of a unit mass at c."""
    return jnp.dot(arm, arm) * jnp.eye(3, dtype=arm.dtype) - jnp.outer(arm, arm)


def _is_physical(inertia) -> bool:
    """Symmetric, positive definite, triangle inequality, each to a few thousand round-offs of the matrix."""
    matrix = np.diag(inertia) if inertia.ndim == 1 else np.asarray(inertia)
    slack = 4096 * np.finfo(matrix.dtype).eps * np.abs(matrix).max()
    if not np.all(np.isfinite(matrix)) or np.abs(matrix - matrix.T).max() > slack:
        return False
    moments = np.linalg.eigvalsh(matrix)
    return bool(moments[0] > 0 and moments[2] <= moments[0] + moments[1] + slack)


def _is_rotation(matrix) -> bool:
    """To the accuracy of data given with eight digits (single precision: three or four)."""
    matrix = np.asarray(matrix)
    return not far_from_rotation(matrix, np.sqrt(np.finfo(matrix.dtype).eps))
