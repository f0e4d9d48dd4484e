"""The pose of a body and of the points and axes fixed to it.

Elements connect a body a to a body b (or the ground, whose frame is the inertial frame). Their
generalized coordinates are ordered [x_a, θ_a, x_b, θ_b]: a translation in the inertial frame and a
rotation in the body frame, δx and δθ = (Rᵀ δR)^∨, for each body.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._validate import array_of
from lgsens._xla import one_program
from lgsens.liegroups import Pose, R3xSO3, cross, skew, turn, turn_back

BODY_DIM = 6
BODY_A, BODY_B = slice(0, 6), slice(6, 12)
ROTATION = slice(3, 6)  # within one body
ROTATION_A, TRANSLATION_B, ROTATION_B = slice(3, 6), slice(6, 9), slice(9, 12)  # within an element's 12
ALL, TRANSLATING_B, TURNING_A, TURNING_B = tuple(range(12)), (6, 7, 8), (3, 4, 5), (9, 10, 11)


def embedded(part: Array, *places: slice | None) -> Array:
    """Zeros with `part` at these of an element's coordinates along each axis; None: along an axis of another kind.

    `.at[…].set` is a scatter for JAX, and its derivative a gather.
    """
    around = [(0, 0, 0) if place is None else (place.start, 2 * BODY_DIM - place.stop, 0) for place in places]
    return lax.pad(part, jnp.zeros((), part.dtype), around)


class Frame(NamedTuple):
    """Pose of a body: centre of mass [m] in the inertial frame, and orientation R (body to inertial).

    The frame of a body with a pivot has its origin there, and its velocity [ẋ, Ω] is that of the pivot: ẋ = 0.
    """

    position: Float[Array, "3"]
    orientation: Float[Array, "3 3"]

    def point(self, local: Float[Array, "3"]) -> Float[Array, "3"]:
        """x + R X: a body-fixed point in the inertial frame [m]."""
        return self.position + turn(self.orientation, local)

    def axis(self, local: Float[Array, "3"]) -> Float[Array, "3"]:
        """R e: a body-fixed direction in the inertial frame."""
        return turn(self.orientation, local)

    def local_point(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Rᵀ(p − x): an inertial point in the body frame [m]."""
        return turn_back(self.orientation, point - self.position)

    def local_axis(self, axis: Float[Array, "3"]) -> Float[Array, "3"]:
        """Rᵀ e: an inertial direction in the body frame."""
        return turn_back(self.orientation, axis)


def moved(frame: Frame, x) -> Frame:
    """The frame after x = [u, θ]: x + u, R exp(θ̃)."""
    return Frame(*R3xSO3().retract(Pose(*frame), x))


def tilted(frames: Sequence[Frame], x) -> list[Frame]:
    """Frames after small x = [u, θ] of each, to first order: x + u, R (I + θ̃). Derivatives at x = 0 are those of
    `moved`, of whose exponential XLA would compile the series."""
    parts = jnp.split(x, len(frames))
    return [Frame(f.position + u[:3], f.orientation + f.orientation @ skew(u[3:])) for f, u in zip(frames, parts)]


def motion_at(arm, position, orientation, twist, rate):
    """x, ẋ and ẍ [m, s] of the point at X in body frames, from x, R, [ẋ, Ω] and [ẍ, Ω̇] of these; along leading axes.

    x + R X,   ẋ + R (Ω × X),   ẍ + R (Ω̇ × X + Ω × (Ω × X))
    """
    to_inertial = lambda local: jnp.einsum("...ij,...j->...i", orientation, local)
    (velocity, spin), (acceleration, change) = ((x[..., : ROTATION.start], x[..., ROTATION]) for x in (twist, rate))
    arm = jnp.broadcast_to(arm, spin.shape)
    swing = jnp.cross(spin, arm)
    acceleration = acceleration + to_inertial(jnp.cross(change, arm) + jnp.cross(spin, swing))
    return position + to_inertial(arm), velocity + to_inertial(swing), acceleration


@one_program
def normals(axis: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, "3"]]:
    """The unit vector along `axis` and two unit vectors that complete it to a right-handed triad.

    The triad starts from the coordinate axis least aligned with `axis`; which one it is does not
    change the motion, only the meaning of the joint's multipliers.
    """
    unit = axis / jnp.linalg.norm(axis)
    least = jax.nn.one_hot(jnp.argmin(jnp.abs(unit)), 3, dtype=axis.dtype)
    first = cross(unit, least)
    first = first / jnp.linalg.norm(first)
    return unit, first, cross(unit, first)


def ground_frame(dtype) -> Frame:
    """The inertial frame itself."""
    return Frame(array_of(np.zeros(3, dtype)), array_of(np.eye(3, dtype=dtype)))


def separation(a: Frame, b: Frame, point_a, point_b) -> tuple[Float[Array, "3"], Float[Array, "3 12"]]:
    """The vector d between two body-fixed points, and its gradient D with δd = D [δx_a δθ_a δx_b δθ_b].

        d = x_b + R_b X_b − x_a − R_a X_a,     D = [−I,  R_a X̃_a,  I,  −R_b X̃_b]

    from δ(R X) = R θ̃ X = −R X̃ δθ.
    """
    d = b.point(point_b) - a.point(point_a)
    eye = jnp.eye(3, dtype=d.dtype)
    gradient = jnp.concatenate([-eye, a.orientation @ skew(point_a), eye, -b.orientation @ skew(point_b)], axis=1)
    return d, gradient


def separation_force(a: Frame, b: Frame, point_a, point_b, force) -> Float[Array, "12"]:
    """Dᵀ f = [−f, −X̃_a R_aᵀ f, f, X̃_b R_bᵀ f] for a force f in the inertial frame, with D of `separation`."""
    moment_a = cross(a.local_axis(force), point_a)
    moment_b = cross(point_b, b.local_axis(force))
    return jnp.concatenate([-force, moment_a, force, moment_b])


def separation_stiffness(a: Frame, b: Frame, point_a, point_b, force) -> Float[Array, "12 12"]:
    """The gradient of Dᵀ f for a force f fixed in the inertial frame.

        D_q(Dᵀ f) = blockdiag(0, −X̃_a (R_aᵀ f)~, 0, X̃_b (R_bᵀ f)~)

    from (−R X̃)ᵀ f = X̃ Rᵀ f and δ(Rᵀ f) = −θ̃ Rᵀ f = (Rᵀ f)~ δθ. With f = λ it is the paper's K_t (§3.2;
    ERRATA: −X̃ (Rᵀλ)~, with X from the pivot to the centre of mass, our −X_b).
    """
    of_a = embedded(-skew(point_a) @ skew(a.local_axis(force)), ROTATION_A, ROTATION_A)
    return of_a + embedded(skew(point_b) @ skew(b.local_axis(force)), ROTATION_B, ROTATION_B)
