"""What a rig does to a wheel: a pad that lifts its contact centre, and the loads of its tyre.

Let e be the spin axis, to the left, c the wheel centre and P = c − r u the contact centre (`wheel_plane`), which moves
in the wheel as this turns. A pad without friction prescribes the height of P: as the tangent of the wheel at P is
level, the constraint force of Φ = P·e_z − s is a vertical force at P. Loads have the directions of the tyre axis system
of ISO 8855: X_T = e × e_z/|…|, the trace of the wheel plane on the road, forward; Z_T up; Y_T to the left.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import number_field, point_field, require
from lgsens.examples import LIVE, Stance, wheel_plane
from lgsens.liegroups import cross
from lgsens.model import (
    AbstractConstraint,
    AbstractForce,
    AbstractJoint,
    AbstractLoad,
    Attached,
    Frame,
    Model,
    RigidBody,
    body_fixed,
)

SIDES = ("left", "right")
MOST_TURNED = 0.8  # of a spin axis its part along y, at least: no wheel stands by more than 36° otherwise
# By kind of load its force and moment in tyre axes, and whether it acts at the contact centre or the wheel centre: the
# moment of a brake is taken up by the knuckle, that of a drive shaft by the chassis, but for that of a live axle.
KINDS = {
    "lateral": ((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), True),
    "braking": ((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0), True),
    "traction": ((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), False),
    "aligning": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), True),
}


def tyre_axes(axis: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """X_T, Y_T and Z_T as columns, of a wheel with this spin axis."""
    up = jnp.asarray([0.0, 0.0, 1.0], axis.dtype)
    along = cross(axis, up)
    along = along / jnp.linalg.norm(along)
    return jnp.stack([along, cross(up, along), up], axis=1)


class ContactHeight(AbstractConstraint):
    """The contact centre of b has the height s over the road, z = 0: Φ = P·e_z − s; λ is the force on the pad [N]."""

    centre_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    axis_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    radius: Float[Array, ""]
    displacement: Float[Array, ""]

    drawn = "tyre"
    num_rows = 1

    @property
    def driven(self):
        return self.displacement

    def value(self, a, b, t):
        plane = wheel_plane(b.axis(self.axis_b), b.point(self.centre_b), self.radius)
        return (plane.contact[2] - self.displacement)[None]


class Pad(AbstractJoint):
    """A pad under a wheel, level and without friction, which prescribes the height of its contact centre; 1 equation.

    Arguments:
        b: name of the wheel, or of what it is locked to; y of its frame is the spin axis, to the left.
        at: the wheel centre in the reference configuration [m], inertial frame, shape (3,), over the road z = 0.
        displacement: of the contact centre [m], shape (), upward.

    The multiplier is the vertical force of the wheel on the pad [N], negative where the pad carries it. Raises
    `ValueError` for a wrong shape.
    """

    b: str = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    displacement: Float[Array, ""] = number_field("displacement", default=0.0)

    a: str | None = eqx.field(static=True, default=None, init=False)

    def constraints(self, a: Frame, b: Frame):
        left = jnp.asarray([0.0, 1.0, 0.0], self.at.dtype)
        radius = Stance.of(b.axis(left), self.at).radius
        return (ContactHeight(b.local_point(self.at), left, radius, self.displacement),)


class TyreWrench(AbstractLoad):
    """A factor times a force and a moment in tyre axes at the point c − r u of b."""

    centre_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    axis_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))
    radius: Float[Array, ""]
    vector: Float[Array, "3"]
    moment: Float[Array, "3"]
    factor: Float[Array, ""]

    drawn = None

    @property
    def driven(self):
        return self.factor

    def force(self, a, b, va, vb, t):
        axis = b.axis(self.axis_b)
        at = wheel_plane(axis, b.point(self.centre_b), self.radius).contact
        axes = tyre_axes(axis)
        f, m = axes @ (self.factor * self.vector), axes @ (self.factor * self.moment)
        return jnp.concatenate([jnp.zeros(6, f.dtype), f, b.local_axis(m + cross(at - b.position, f))])


class TyreLoad(AbstractForce):
    """A load of a tyre on its wheel, in the tyre axes of ISO 8855, times a factor.

    Arguments:
        wheel: name of the wheel, or of what it is locked to; y of its frame is the spin axis, to the left.
        at: the wheel centre in the reference configuration [m], inertial frame, shape (3,).
        force: in X_T, Y_T and Z_T [N], shape (3,).
        moment: about them [N m], shape (3,).
        radius: how far below the wheel centre the force acts [m], shape (): the loaded radius, at the contact centre,
            or 0, at the wheel centre.
        factor: [–], shape ().

    Raises `ValueError` for wrong shapes. Source: ISO 8855:2011 (tyre axis system, tyre forces and moments).
    """

    wheel: str = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    force: Float[Array, "3"] = point_field("force")
    moment: Float[Array, "3"] = point_field("moment")
    radius: Float[Array, ""] = number_field("radius")
    factor: Float[Array, ""] = number_field("factor", default=0.0)

    @property
    def bodies(self):
        return (self.wheel,)

    def with_factor(self, factor):
        return dataclasses.replace(self, factor=factor)

    def loads(self, bodies):
        b = bodies[self.wheel].frame
        left = jnp.asarray([0.0, 1.0, 0.0], self.at.dtype)
        wrench = TyreWrench(b.local_point(self.at), left, self.radius, self.force, self.moment, self.factor)
        return (Attached(wrench, None, self.wheel),)


def _stance(name: str, wheel: RigidBody, centre: Float[Array, "3"]) -> Stance:
    axis = wheel.orientation[:, 1]
    require(
        lambda axis: axis[1] > MOST_TURNED,
        f"`model`: y of the frame of {name!r}, its spin axis, points along {axis}, and must point to the left; give "
        "the body another `orientation`.",
        axis,
    )
    return Stance.of(axis, centre)


def stances(model: Model, centres: Mapping[str, Float[Array, "3"]]) -> Stance:
    """How the wheels stand in the reference configuration, arrays of shape (2, …), left and right."""
    both = [_stance(f"{side}_wheel", model.bodies[f"{side}_wheel"], centres[side]) for side in SIDES]
    return Stance(*(jnp.stack(of) for of in zip(*both)))


def on_rig(model: Model, centres: Mapping[str, Float[Array, "3"]]) -> Model:
    """An axle on the rig: pads `left_pad` and `right_pad` under its wheels, loads `left_lateral`, `left_braking`, … .

    Arguments:
        model: with the bodies `left_wheel` and `right_wheel`, which do not turn in their knuckles, the chassis held.
        centres: the wheel centres in the reference configuration by side [m], inertial frame, shape (3,), the road at
            z = 0; each wheel's spin axis is y of its frame.

    Lateral, braking and aligning loads act at the contact centre (the brake's moment on the knuckle), traction at the
    wheel centre (that of a drive shaft on the chassis), or at the contact centre where the model has the joint
    `live_axle`: the final drive is in the axle, which takes up its moment. Raises `ValueError` for a missing wheel, one
    whose y is not to the left, or names that the model has already.
    """
    live = LIVE in model.joints
    joints, forces = {}, {}
    for side in SIDES:
        wheel, centre = f"{side}_wheel", centres[side]
        if wheel not in model.bodies:
            raise ValueError(f"`model`: the rig needs the body {wheel!r}; the bodies are {sorted(model.bodies)}.")
        stance = _stance(wheel, model.bodies[wheel], centre)
        joints[f"{side}_pad"] = Pad(b=wheel, at=centre)
        for kind, (force, moment, contact) in KINDS.items():
            radius = stance.radius if contact or live else jnp.zeros_like(stance.radius)
            wrench: dict[str, Any] = {"force": force, "moment": moment, "radius": radius}
            forces[f"{side}_{kind}"] = TyreLoad(wheel, at=centre, **wrench)
    if taken := sorted(({*joints} & {*model.joints}) | ({*forces} & {*model.forces})):
        raise ValueError(f"`model`: {taken} are names of the rig's; give these elements other ones.")
    return Model(model.bodies, model.joints | joints, model.forces | forces)
