"""What a suspension does with its wheel as it travels: the curves by which engineers judge its geometry.

Axes are those of ISO 8855: x forward, y left, z up; the chassis stands still. Spin axis e, wheel centre and contact
centre P are those of `_wheel.py`. With σ = 1 for a wheel on the left (y > 0), −1 on the right, and ′ = d/ds by the
travel s:

    camber   γ = −σ asin(e·e_z)             ISO 8855: positive with the top of the wheel outward
    toe      δ = −σ atan2(−e·e_x, e·e_y)    positive with the front of the wheel inward (toe-in)
    track    Δb = 2 σ (P − P₀)·e_y          of an axle both of whose wheels travel alike
    wheelbase Δl = ∓ (P − P₀)·e_x           − of a rear, + of a front axle
    motion ratio i = −dℓ/ds                 how much a spring is compressed per wheel travel
    roll centre  h = P_y P_y′/P_z′          over the road: a front view's normal to the path of P meets y = 0 there
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens.analysis import Kinematics
from lgsens.examples._wheel import Stance, wheel_plane


class SuspensionCurves(NamedTuple):
    """The curves of a suspension over wheel travel, ISO 8855 axes and signs; arrays of shape (n,).

    Attributes:
        travel: vertical displacement of the wheel centre to the chassis [m], positive in bump.
        camber: inclination of the wheel plane to the vertical [rad], positive with its top outward.
        toe: angle between the trace of the wheel plane on the road and x [rad], positive with its front inward.
        track_change: change of the track, twice the way of the contact centre outward [m].
        wheelbase_change: change of the wheelbase, by the way of the contact centre along x [m].
        spring_motion_ratio, damper_motion_ratio: compression per wheel travel [–].
        roll_centre_height: of the kinematic roll centre over the road [m]; NaN of half of a solid axle or of a twist
            beam, whose other side moves too: `lgsens.rigs.kc` has it.
        spring_length: distance of the spring's two points [m].
    """

    travel: Float[Array, " n"]
    camber: Float[Array, " n"]
    toe: Float[Array, " n"]
    track_change: Float[Array, " n"]
    wheelbase_change: Float[Array, " n"]
    spring_motion_ratio: Float[Array, " n"]
    damper_motion_ratio: Float[Array, " n"]
    roll_centre_height: Float[Array, " n"]
    spring_length: Float[Array, " n"]

    __repr__ = brief


def suspension_curves(motion: Kinematics, stance: Stance, *, rear: bool, alone: bool) -> SuspensionCurves:
    """The curves of a wheel that was driven over its travel at rate 1.

    Arguments:
        motion: of a rig with the bodies `wheel`, which does not spin, whose axis is y of its frame and whose centre of
            mass is its centre, the driver `travel`, and the forces `spring` and `damper`.
        stance: how the wheel stands in the reference configuration.
        rear: whether the axle is the rear one, for the sign of the wheelbase.
        alone: whether it moves as it does where the other wheel stays; else one wheel tells no roll centre.
    """
    wheel = motion.body("wheel")
    axis = wheel.orientation[:, :, 1]
    turning = jnp.cross(wheel.angular_velocity, jnp.asarray([[0.0, 1.0, 0.0]], axis.dtype))  # Ω × e, body frame
    axis_rate = jnp.einsum("nij,nj->ni", wheel.orientation, turning)
    side = jnp.where(stance.centre[1] > 0, 1.0, -1.0)

    along = lambda *args: jax.jvp(lambda axis, place: wheel_plane(axis, place, stance.radius), args[:2], args[2:])
    plane, rates = jax.vmap(along)(axis, wheel.position, axis_rate, wheel.velocity)
    at, rate = plane.contact, rates.contact
    moved = at - stance.contact[None]
    spring, damper = motion.force("spring"), motion.force("damper")
    return SuspensionCurves(
        travel=motion.values["travel"],
        camber=-side * plane.inclination,
        toe=-side * plane.steer,
        track_change=2.0 * side * moved[:, 1],
        wheelbase_change=-moved[:, 0] if rear else moved[:, 0],
        spring_motion_ratio=-spring.rate,
        damper_motion_ratio=-damper.rate,
        roll_centre_height=at[:, 1] * rate[:, 1] / rate[:, 2] if alone else jnp.full_like(at[:, 1], jnp.nan),
        spring_length=spring.length,
    )
