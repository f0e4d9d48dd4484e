"""What the wheels of an axle do on the rig: the outputs of K&C, ISO 8855 axes and signs.

Axes: x forward, y left, z up; the chassis stands still. σ = 1 on the left, −1 on the right. A prime is a derivative by
what the rig moves: along the sweep (`rates`), by one pad, by both, or by the rack, from one linear equilibrium each.

Positions, of each wheel: steer angle δ, inclination ε and contact centre P by `wheel_plane`, camber γ = −σ ε, toe −σ δ.

Rates. With z the height of a wheel centre, F the vertical forces on its wheel, ℓ the length of its spring and φ the
roll angle, that of the line through both wheel centres, tan φ = (z_R − z_L)/(y_L − y_R):

    motion ratio  −ℓ′/z′             by both pads
    wheel rate    F′/z′              by both pads
    roll rate     M′/φ′              by both pads against each other; M′ = −Σ P_y F′
    roll centre   ½ Σ P_y S′/P_z′    each by the pad of its wheel, S the sum of P_y of both wheels: over the road; of
                                     wheels that are independent, S′ = P_y′, where the normals to the paths of the
                                     contact centres in front view meet the middle of the car, in the mean of both sides

Force-based roll centre. Under lateral forces at the contact centres, with the pads held, springs and body stay where
they are, and the links alone change the vertical forces by F′; their moment about x is that of Σ F_y′ at the height

    h = −Σ P_y F′ / Σ F_y′     along "lateral", in phase:

the definition of ISO 8855 (where a lateral force on the body does not roll it). Without compliance, and without toe,
of which lateral forces of tyres have a part along x, it is the kinematic one: one pad moved, forces F_y on both contact
centres do the work F_y S′ + F′ P_z′ = 0 (virtual work), also where a solid axle or a twist beam moves the other wheel.

Anti-features. The same with longitudinal forces: the vertical force that links add per force, over what the car's
inertia adds, h_c/l of all of it, of which this axle has a share p:

    F′/B′ · p l/h_c     anti-dive of a front axle under braking forces B, and its negative anti-lift of a rear one;
    F′/T′ · p l/h_c     anti-squat of a rear axle under traction T, and its negative anti-lift of a front one.

Steering axis. No ball joints are assumed: it is the axis of the screw by which a wheel moves when the rack moves and
both springs keep their lengths, so that the suspension does not travel: the response to the rack and such parts of the
responses to both pads that ℓ′ = 0. Of a rigid suspension with ball joints it is their line, if turning about
that leaves the spring's length as it is: not with the offset seat of a strut. With ω its direction and v the velocity
of the wheel centre, d = ±ω/|ω| upward and c + ω × v/|ω|² is on it; X is where it meets the road:

    caster                 atan2(−d_x, d_z)        positive with its top rearward
    kingpin inclination    atan2(−σ d_y, d_z)      positive with its top inward
    scrub radius           σ (P − X)·Y_T           positive with X inward of P
    trail (caster offset)  (X − P)·X_T             positive with X in front of P

Steering. The ratio is the turn of the steering wheel per mean steer angle. Ackermann compares with wheels whose axes
meet on the line of the other axle, cot δ_o − cot δ_i = b/l for the outer and inner one, b from contact to contact as
they are then: the share (cot δ_o − cot δ_i) l/b is 1 there and 0 for parallel steering, with angles from the middle of
the sweep (without static toe). It is not determined, NaN, within half a degree of straight ahead.

Sources: ISO 8855:2011 (axes, angles, offsets, roll centre); Gillespie (1992), chapter 7 (anti-features, Ackermann);
Reimpell, Stoll & Betzler (2001), chapter 3 (steering axis, roll centre, rates).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens._validate import number_field, require
from lgsens.analysis import Statics
from lgsens.examples import Stance, wheel_plane
from lgsens.rigs._pads import SIDES, tyre_axes
from lgsens.rigs._sweeps import RACK

LIMITS = {"wheelbase": (0.5, 30.0), "centre_height": (0.02, 5.0)}  # m
LIMITS |= {"braking_share": (0.0, 1.0), "traction_share": (0.0, 1.0)}
NOT_STEERED = np.radians(0.5)  # within which Ackermann's share is not determined


class Vehicle(eqx.Module):
    """What anti-features and Ackermann need to know of the car.

    Raises `ValueError` for what no car has.

    Arguments:
        wheelbase: l [m], shape ().
        centre_height: h_c of the centre of mass over the road [m], shape ().
        braking_share, traction_share: p of this axle in the forces of all wheels [–], shape ().
        rack_ratio: way of the rack per turn of the steering wheel [m/rad], shape (); None: no steering ratio.
        rear: whether the axle is the rear one (static).
    """

    wheelbase: Float[Array, ""] = number_field("wheelbase", default=2.7)
    centre_height: Float[Array, ""] = number_field("centre_height", default=0.55)
    braking_share: Float[Array, ""] = number_field("braking_share", default=0.5)
    traction_share: Float[Array, ""] = number_field("traction_share", default=1.0)
    rack_ratio: Float[Array, ""] | None = number_field("rack_ratio", default=None)
    rear: bool = eqx.field(static=True, default=True, kw_only=True)

    def __check_init__(self):
        for name, (low, high) in LIMITS.items():
            value = getattr(self, name)
            require(
                lambda value, low=low, high=high: low <= value <= high,
                f"Vehicle: `{name}` must be within {low:g} and {high:g}, got {value}; lengths are in metres.",
                value,
            )


class WheelCurves(NamedTuple):
    """How the two wheels stand, left and right, or the derivatives of that; arrays of shape (n, 2).

    Attributes:
        travel: vertical displacement of the wheel centre [m].
        steer: steer angle [rad], positive to the left.
        toe: [rad], positive with the front of the wheel inward.
        camber: [rad], positive with the top of the wheel outward.
        contact_x, contact_y: displacement of the contact centre [m], forward and to the left.
        centre_x, centre_y: of the wheel centre [m].
        force: vertical force on the wheel [N].
    """

    travel: Float[Array, "n 2"]
    steer: Float[Array, "n 2"]
    toe: Float[Array, "n 2"]
    camber: Float[Array, "n 2"]
    contact_x: Float[Array, "n 2"]
    contact_y: Float[Array, "n 2"]
    centre_x: Float[Array, "n 2"]
    centre_y: Float[Array, "n 2"]
    force: Float[Array, "n 2"]

    __repr__ = brief


class AxleCurves(NamedTuple):
    """The outputs of one sweep, ISO 8855 axes and signs; None: what this axle or sweep does not have.

    Attributes:
        value: the number that the sweep moves [m], [N] or [N m], shape (n,).
        wheels: how the wheels stand.
        rates: their derivatives by `value`: bump and roll steer, compliances.
        track_change, wheelbase_change: of the contact centres [m], in the mean of both sides, shape (n,).
        roll_angle, roll_angle_rate: of the body over its wheels [rad], positive with the right wheel up, and its
            derivative by `value`, shape (n,).
        spring_motion_ratio, damper_motion_ratio: compression per wheel travel [–], both wheels moving alike, (n, 2).
        wheel_rate: vertical force per wheel travel [N/m], both wheels moving alike, shape (n, 2).
        roll_rate: moment per roll angle [N m/rad], shape (n,).
        roll_centre_height: kinematic, over the road [m], shape (n,).
        caster, kingpin_inclination: of the steering axis [rad], shape (n, 2).
        scrub_radius, trail: where it meets the road, from the contact centre [m], shape (n, 2).
        steer_per_rack: derivative of the steer angles by the way of the rack [rad/m], shape (n, 2).
        steering_ratio: turn of the steering wheel per mean steer angle [–], positive, shape (n,).
        ackermann: share of Ackermann's condition, of sweeps that steer [–], shape (n,).
        force_roll_centre_height: from the forces under lateral ones [m], shape (n,).
        anti_dive, anti_lift, anti_squat: [–], 1 for a car that does not pitch, shape (n,).
    """

    value: Float[Array, " n"]
    wheels: WheelCurves
    rates: WheelCurves
    track_change: Float[Array, " n"]
    wheelbase_change: Float[Array, " n"]
    roll_angle: Float[Array, " n"]
    roll_angle_rate: Float[Array, " n"]
    spring_motion_ratio: Float[Array, "n 2"] | None
    damper_motion_ratio: Float[Array, "n 2"] | None
    wheel_rate: Float[Array, "n 2"]
    roll_rate: Float[Array, " n"]
    roll_centre_height: Float[Array, " n"]
    caster: Float[Array, "n 2"] | None = None
    kingpin_inclination: Float[Array, "n 2"] | None = None
    scrub_radius: Float[Array, "n 2"] | None = None
    trail: Float[Array, "n 2"] | None = None
    steer_per_rack: Float[Array, "n 2"] | None = None
    steering_ratio: Float[Array, " n"] | None = None
    ackermann: Float[Array, " n"] | None = None
    force_roll_centre_height: Float[Array, " n"] | None = None
    anti_dive: Float[Array, " n"] | None = None
    anti_lift: Float[Array, " n"] | None = None
    anti_squat: Float[Array, " n"] | None = None

    __repr__ = brief


def axle_curves(found: Statics, stances: Stance, vehicle: Vehicle) -> AxleCurves:
    """The outputs of an axle on the rig, without those of single sweeps.

    Arguments:
        found: its equilibria, with the responses to the sweep, the left pad, the right pad and, if it has one, the
            rack; the bodies `left_wheel`, `right_wheel`, the forces `left_spring`, `left_damper`, … if there are any.
        stances: how the wheels stand in the reference configuration, arrays of shape (2, …).
        vehicle: the car.
    """
    moving = [found.along(i) for i in range(found.responses.v.shape[1])]
    bodies = [[run.body(f"{side}_wheel") for side in SIDES] for run in moving]
    stacked = lambda name: jnp.stack([jnp.stack([getattr(b, name) for b in row], axis=1) for row in bodies], axis=1)
    turn, centre = (stacked(name)[:, 0] for name in ("orientation", "position"))  # (n, 2, …)
    velocity = stacked("velocity")  # (n, r, 2, 3)
    spin = jnp.einsum("nsij,nrsj->nrsi", turn, stacked("angular_velocity"))  # ω, inertial frame
    axis = turn[..., 1]
    axis_rate = jnp.cross(spin, jnp.broadcast_to(axis[:, None], spin.shape))
    side = jnp.asarray([1.0, -1.0], axis.dtype)
    at, by = jax.vmap(jax.vmap(_wheel, (0, 0, 1, 1, 0, 0)), (0, 0, 0, 0, None, None))(
        axis, centre, axis_rate, velocity, stances, side
    )
    by = jnp.moveaxis(by, 2, 0)  # (r, n, 2, quantities)
    pads = lambda run: -jnp.concatenate([run.multiplier(f"{side}_pad") for side in SIDES], axis=1)
    force_by = jnp.stack([pads(run) for run in moving])
    curves_of = lambda of, force: WheelCurves(**dict(zip(_PLACED, jnp.moveaxis(of, 2, 0))), force=force)
    wheels = curves_of(at, pads(found))
    rates = [curves_of(*one) for one in zip(by, force_by)]
    _, left, right, *rack = rates
    both, against = (jax.tree.map(lambda l, r, sign=sign: sign * l + r, left, right) for sign in (1.0, -1.0))
    y = stances.contact[None, :, 1] + wheels.contact_y
    difference = lambda of: of[:, 1] - of[:, 0]
    apart = -difference(stances.centre[None, :, 1] + wheels.centre_y)
    rise = difference(wheels.travel)
    rolled = lambda by: (difference(by.travel) * apart + rise * difference(by.centre_y)) / (rise**2 + apart**2)
    sideways = jnp.stack([jnp.sum(by_pad.contact_y, axis=1) for by_pad in (left, right)], axis=1)
    contact_rise = jnp.stack([by[1, :, 0, -1], by[2, :, 1, -1]], axis=1)
    curves = AxleCurves(
        value=jnp.zeros_like(y[:, 0]),
        wheels=wheels,
        rates=rates[0],
        track_change=-difference(wheels.contact_y),
        wheelbase_change=(-1.0 if vehicle.rear else 1.0) * jnp.mean(wheels.contact_x, axis=1),
        roll_angle=jnp.arctan2(rise, apart),
        roll_angle_rate=rolled(rates[0]),
        spring_motion_ratio=None,
        damper_motion_ratio=None,
        wheel_rate=both.force / both.travel,
        roll_rate=-jnp.sum(y * against.force, axis=1) / rolled(against),
        roll_centre_height=jnp.mean(y * sideways / contact_rise, axis=1),
    )
    known = {owner for stack in found.system.loads for owner in stack.owners}
    lengths = {
        kind: jnp.stack([jnp.stack([run.force(f"{side}_{kind}").rate for side in SIDES], axis=1) for run in moving])
        for kind in ("spring", "damper")
        if {f"{side}_{kind}" for side in SIDES} <= known
    }  # ℓ′ (r, n, 2)
    for kind, length in lengths.items():
        ratio = -(length[1] + length[2]) / both.travel
        curves = curves._replace(**{f"{kind}_motion_ratio": ratio})
    if not rack:
        return curves
    held = jnp.zeros_like(y)
    if "spring" in lengths:
        by_pads = jnp.moveaxis(lengths["spring"][1:3], 0, 2)  # of spring and pad
        held = -jnp.linalg.solve(by_pads, lengths["spring"][3][..., None])[..., 0]
    combined = lambda of: of[:, 3] + jnp.einsum("np,npsi->nsi", held, of[:, 1:3])
    steer = rack[0].steer
    ratio = None if vehicle.rack_ratio is None else 1.0 / (vehicle.rack_ratio * jnp.abs(jnp.mean(steer, axis=1)))
    return curves._replace(
        **_steering_axis(combined(spin), combined(velocity), axis, centre, stances.radius, side),
        steer_per_rack=steer,
        steering_ratio=ratio,
    )


def of_sweep(
    curves: AxleCurves, shares: tuple[tuple[str, float], ...], stances: Stance, vehicle: Vehicle
) -> AxleCurves:
    """The outputs of one sweep, with those that are of its loads; `shares` as in `Sweep`."""
    total = lambda kind: sum(share for name, share in shares if name.endswith(f"_{kind}"))
    force = curves.rates.force
    if lateral := total("lateral"):
        moment = jnp.sum((stances.contact[None, :, 1] + curves.wheels.contact_y) * force, axis=1)
        curves = curves._replace(force_roll_centre_height=-moment / lateral)
    if dict(shares).get(RACK):
        y = stances.contact[None, :, 1] + curves.wheels.contact_y
        curves = curves._replace(ackermann=_ackermann(curves.wheels.steer, vehicle.wheelbase / (y[:, 0] - y[:, 1])))
    lever = vehicle.wheelbase / vehicle.centre_height
    if braking := total("braking"):
        support = vehicle.braking_share * lever * jnp.sum(force, axis=1) / braking
        curves = curves._replace(**({"anti_lift": -support} if vehicle.rear else {"anti_dive": support}))
    if traction := total("traction"):
        support = vehicle.traction_share * lever * jnp.sum(force, axis=1) / traction
        curves = curves._replace(**({"anti_squat": support} if vehicle.rear else {"anti_lift": -support}))
    return curves


_PLACED = WheelCurves._fields[:-1]  # what `_wheel` measures first


def _wheel(axis, centre, axis_rates, velocities, origin: Stance, side):
    """How one wheel stands, and the height of its contact centre; and the derivatives along each direction."""

    def measure(axis, centre):
        steer, inclination, contact = wheel_plane(axis, centre, origin.radius)
        (x, y, _), moved = contact - origin.contact, centre - origin.centre
        return jnp.stack(
            [moved[2], steer, -side * steer, -side * inclination, x, y, moved[0], moved[1], contact[2]],
        )

    along = lambda *rates: jax.jvp(measure, (axis, centre), rates)[1]
    return measure(axis, centre), jax.vmap(along)(axis_rates, velocities)


def _steering_axis(spin, velocity, axis, centre, radii, side) -> dict[str, Array]:
    """Of the screw with this angular velocity and this velocity of the wheel centre, of each wheel."""

    def one(spin, velocity, axis, centre, radius, side):
        square = jnp.sum(spin * spin)
        direction = spin * jnp.sign(spin[2]) / jnp.sqrt(square)
        contact = wheel_plane(axis, centre, radius).contact
        on_axis = centre + jnp.cross(spin, velocity) / square
        on_road = on_axis + direction * (contact[2] - on_axis[2]) / direction[2]
        forward, left, _ = tyre_axes(axis).T
        return {
            "caster": jnp.arctan2(-direction[0], direction[2]),
            "kingpin_inclination": jnp.arctan2(-side * direction[1], direction[2]),
            "scrub_radius": side * jnp.dot(contact - on_road, left),
            "trail": jnp.dot(on_road - contact, forward),
        }

    return jax.vmap(jax.vmap(one), (0, 0, 0, 0, None, None))(spin, velocity, axis, centre, radii, side)


def _ackermann(steer, ratio):
    """(cot δ_R − cot δ_L) l/b, alike in both turns; NaN near straight ahead."""
    steer = steer - steer[len(steer) // 2][None]
    turned = jnp.all(jnp.abs(steer) > NOT_STEERED, axis=1)
    sines = jnp.where(turned, jnp.prod(jnp.sin(steer), axis=1), 1.0)
    return jnp.where(turned, jnp.sin(steer[:, 0] - steer[:, 1]) / sines * ratio, jnp.nan)
