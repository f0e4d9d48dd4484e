"""How the two bodies of a joint lie and move in each other.

A joint has a frame on each of its bodies (`AbstractJoint.frames`), fixed to it: with the body at (x₀, R₀) and the frame
at (p, C) in the reference configuration it is at x + R R₀ᵀ(p − x₀), with the axes R R₀ᵀC. Of the pose of the frame on b
in that on a,

    d = C_aᵀ(p_b − p_a),     D = C_aᵀ C_b,

each relative coordinate s of a joint is a function. Its rate is the derivative of s along (ẋ, R Ω̃) of either body, and
its acceleration that of the rate along (ẋ, R Ω̃, ẍ, Ω̇): a coordinate has no operation on a velocity behind it, nor a
rate one on an acceleration, which says what a criterion depends on.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.liegroups import SO3, skew
from lgsens.model._frames import Frame, normals


class Coordinate(NamedTuple):
    """A relative coordinate of a joint.

    Attributes:
        name, unit: what it is called, and "rad" or "m".
        of: its value, given the pose of the joint's frame on b in that on a; a function of module level with a name, by
            which it is pickled, or a value.
        periodic: whether it is an angle that comes back after 2π, which a trajectory continues over many turns.
        absolute: whether it is not 0 in the reference configuration.
    """

    name: str
    unit: str
    of: Callable[[Frame], Float[Array, ""]]
    periodic: bool = False
    absolute: bool = False


def _about_x(seen: Frame) -> Float[Array, ""]:
    return jnp.arctan2(seen.orientation[2, 1], seen.orientation[1, 1])


def _about_second_arm(seen: Frame) -> Float[Array, ""]:
    return jnp.arctan2(seen.orientation[0, 2], seen.orientation[0, 0])


def _distance(seen: Frame) -> Float[Array, ""]:
    return jnp.sqrt(jnp.sum(seen.position**2))


class _Along(NamedTuple):
    axis: int

    def __call__(self, seen: Frame) -> Float[Array, ""]:
        return seen.position[self.axis]


class _RotationVector(NamedTuple):
    axis: int

    def __call__(self, seen: Frame) -> Float[Array, ""]:
        return SO3().log(seen.orientation)[self.axis]


ANGLE = Coordinate("angle", "rad", _about_x, True)
DISPLACEMENT = Coordinate("displacement", "m", _Along(0))
LENGTH = Coordinate("length", "m", _distance, absolute=True)
# of a cross from a, about its arm there, and of b from the cross, about the other arm: D = R_x(α) R_y(β)
ARM_ANGLES = (
    ANGLE._replace(name="angle_a"),
    Coordinate("angle_b", "rad", _about_second_arm, True),
)
# in the plane whose normal is the x of the frame on a
IN_PLANE = tuple(Coordinate(f"displacement_{name}", "m", _Along(i)) for i, name in ((1, "y"), (2, "z")))
ROTATION_VECTOR = tuple(Coordinate(f"rotation_{name}", "rad", _RotationVector(i)) for i, name in enumerate("xyz"))


def frames_along(at_a, at_b, axis) -> tuple[Frame, Frame]:
    """The frames of a joint (`AbstractJoint.frames`) at these points, x along `axis`; None: with the ground's axes."""
    axes = jnp.eye(3, dtype=at_a.dtype) if axis is None else jnp.stack(normals(axis), axis=1)
    return Frame(at_a, axes), Frame(at_b, axes)


# of a joint with one point, and an axis if it has one
frames_at: Any = property(lambda joint: frames_along(joint.at, joint.at, getattr(joint, "axis", None)))


class Relative(NamedTuple):
    """What `relative_motion` finds, along a leading axis: s, ṡ, s̈ of each coordinate, (d, D), C_a and p_b."""

    values: Float[Array, "n s"]
    rates: Float[Array, "n s"]
    accelerations: Float[Array, "n s"]
    seen: Frame
    axes: Float[Array, "n 3 3"]
    point: Float[Array, "n 3"]


@partial(jax.jit, static_argnums=0)
def relative_motion(coordinates: tuple[Coordinate, ...], frames, references, motions) -> Relative:
    """The formulas above of two bodies, a and b.

    Arguments:
        coordinates: s.
        frames, references: of each the frame of the joint and its own in the reference configuration.
        motions: of each x, R, ẋ, Ω, ẍ, Ω̇, with a leading axis.
    """

    def ends(poses):
        for frame, reference, (x, orientation) in zip(frames, references, poses):
            axes = reference.orientation.T @ frame.orientation
            point = Frame(x, orientation).point(reference.local_point(frame.position))
            yield Frame(point, orientation @ axes)

    def seen(poses):
        a, b = ends(poses)
        return Frame(a.local_point(b.position), a.orientation.T @ b.orientation)

    def at_time(motions):
        poses, twists, changes = ([motion[i : i + 2] for motion in motions] for i in (0, 2, 4))
        none = [jnp.zeros((), motions[0][0].dtype)] * (not coordinates)
        values = lambda poses: jnp.stack([coordinate.of(seen(poses)) for coordinate in coordinates] or none)

        def moved(poses, twists):
            return [(velocity, R @ skew(spin)) for (_, R), (velocity, spin) in zip(poses, twists)]

        def with_rates(poses, twists):
            return jax.jvp(values, (poses,), (moved(poses, twists),))

        (s, rate), (_, acceleration) = jax.jvp(with_rates, (poses, twists), (moved(poses, twists), changes))
        a, b = ends(poses)
        count = len(coordinates)
        return Relative(s[:count], rate[:count], acceleration[:count], seen(poses), a.orientation, b.position)

    return jax.vmap(at_time)([tuple(motion) for motion in motions])


def but_for_turns(s: Float[Array, ""], near: Any = 0.0, turn: float = 2.0 * jnp.pi) -> Float[Array, ""]:
    """Of s and whole turns, of 2π or another angle, that which is nearest to another angle; no derivative by that."""
    return s - turn * jnp.round((s - near) / turn)


def continued(values: Float[Array, " n"], rates: Float[Array, " n"], t: Float[Array, " n"]) -> Float[Array, " n"]:
    """Angles between −π and π as an angle that grows on, the first one as it is.

    Of θ + 2πk in each step that which is nearest to θ_n + h (θ̇_n + θ̇_{n+1})/2, whatever the turn in the step.
    """
    missing = jnp.diff(t) * (rates[1:] + rates[:-1]) / 2 - jnp.diff(values)
    turns = jnp.cumsum(jax.lax.stop_gradient(jnp.round(missing / (2 * jnp.pi))))
    return values.at[1:].add(2 * jnp.pi * turns)
