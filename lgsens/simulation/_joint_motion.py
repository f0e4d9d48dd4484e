"""The motion of a joint: its relative coordinates, and the force and moment that it transmits."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens.model import AbstractJoint, Frame, MultibodySystem, continued, joint_wrenches, relative_motion


class JointMotion(NamedTuple):
    """How the bodies of a joint move in each other, and what it does to them; arrays have a leading axis n + 1.

    A joint has a frame on each of its bodies, at its hardpoint: x along its `axis`, y and z as its equations have them;
    of a `UniversalJoint` x along `axis_a`, y along `axis_b`; of a `DistanceJoint` x along the rod; of `Rolling` z along
    the normal, x forward; of others the axes of the inertial frame. Both are so in the reference configuration, and
    fixed to a and b. "The joint's frame" is that on a. Of an `Instant` arrays have no leading axis, and angles are
    between −π and π: an instant does not know of turns before it.

    Attributes:
        coordinates: the relative coordinates by name, shape (n+1,): "angle" [rad] of b about the axis, over any number
            of turns, zero in the reference configuration and between −π and π at the first time; "displacement" [m] of
            b along the axis; "angle_a", "angle_b" of a cross; "rotation_x", … [rad], the rotation vector of a
            `SphericalJoint`, of length π at most; "length" of a rod [m]; "forward", "sideways" [m], "heading", "lean",
            "spin" [rad] of a wheel. Those of a `FixedJoint`, and of one's own joints that declare none: {}.
        rates, accelerations: their derivatives by time, of the motion itself and not of the samples.
        position: d, from the joint's point on a to that on b [m], in the joint's frame, shape (n+1, 3).
        orientation: of the frame on b in that on a, shape (n+1, 3, 3).
        point: where the joint's point on b is [m], inertial frame, shape (n+1, 3).
        force: what the joint does to b [N], inertial frame, shape (n+1, 3); to a it does the opposite, at the same
            point (one of one's own if Φ depends on how a and b are to each other, and not to the ground).
        moment: its moment about that point [N m], inertial frame, shape (n+1, 3).
        local_force, local_moment: the same in the joint's frame.
    """

    coordinates: dict[str, Float[Array, " n"]]
    rates: dict[str, Float[Array, " n"]]
    accelerations: dict[str, Float[Array, " n"]]
    position: Float[Array, "n 3"]
    orientation: Float[Array, "n 3 3"]
    point: Float[Array, "n 3"]
    force: Float[Array, "n 3"]
    moment: Float[Array, "n 3"]
    local_force: Float[Array, "n 3"]
    local_moment: Float[Array, "n 3"]

    __repr__ = brief

    @property
    def angle(self) -> Float[Array, " n"]:
        """The angle of b about the axis of the joint [rad], over any number of turns."""
        return self._only("angle", self.coordinates, "angle")

    @property
    def displacement(self) -> Float[Array, " n"]:
        """The displacement of b along the axis of the joint [m]."""
        return self._only("displacement", self.coordinates, "displacement")

    @property
    def rate(self) -> Float[Array, " n"]:
        """The rate of the joint's one coordinate [rad/s] or [m/s]; of several there are `rates`."""
        return self._only("rate", self.rates)

    @property
    def acceleration(self) -> Float[Array, " n"]:
        """The acceleration of the joint's one coordinate [rad/s²] or [m/s²]; of several there are `accelerations`."""
        return self._only("acceleration", self.accelerations)

    @property
    def axial_force(self) -> Float[Array, " n"]:
        """What the joint does to b along its axis [N]: the force of a `TranslationDriver`; that of a `DistanceJoint`
        along the rod as it is now, positive where it pushes b away from a."""
        if "length" not in self.coordinates:
            return self.local_force[..., 0]
        return jnp.sum(self.local_force * self.position, -1) / jnp.linalg.norm(self.position, axis=-1)

    @property
    def axial_moment(self) -> Float[Array, " n"]:
        """What the joint does to b about its axis [N m]: the torque of a `RotationDriver`."""
        return self.local_moment[..., 0]

    def _only(self, what: str, values: Mapping[str, Any], name: str | None = None):
        if (name not in values) if name else (len(values) != 1):
            raise ValueError(
                f"`{what}`: the relative coordinates of this joint are {list(values)}; use `coordinates`, `rates` and "
                "`accelerations`, by their names."
            )
        return values[name or next(iter(values))]


def joint_motions(
    system: MultibodySystem, names: Iterable[str], q, v, vdot, lam, t: Float[Array, " n"]
) -> dict[str, JointMotion]:
    """The motions of joints of a scene, along the leading axis of a motion."""
    wrenches = joint_wrenches(system, names, q, v, vdot, lam, t)
    whole, *motion = system.of_parts(q, v, vdot)
    moving = lambda body: whole.motion(whole.body_names.index(body), *motion)
    known, reference = system.joints, system.reference_frame
    return {name: _joint_motion(known[name], moving, reference, wrench, t) for name, wrench in wrenches.items()}


def _joint_motion(
    joint: AbstractJoint,
    body: Callable[[str], tuple[Array, ...]],
    reference: Callable[[str], Frame],
    wrench: Float[Array, "n 6"],
    t: Float[Array, " n"],
) -> JointMotion:
    """The motion of a joint.

    Arguments:
        body, reference: the motion of a body by its name, and its frame in the reference configuration.
        wrench: the force on b, and its moment about the inertial origin.
    """
    n, dtype = t.shape[0], wrench.dtype
    still, upright = jnp.zeros((n, 3), dtype), jnp.broadcast_to(jnp.eye(3, dtype=dtype), (n, 3, 3))
    ground = Frame(still[0], upright[0])
    references = [ground if name is None else reference(name) for name in (joint.a, joint.b)]
    motions = [(still, upright, *[still] * 4) if name is None else body(name) for name in (joint.a, joint.b)]
    centre = Frame(references[1].position, ground.orientation)
    frames = joint.frames or (centre, centre)
    found = relative_motion(joint.coordinates, frames, references, motions)
    columns = lambda of: {s.name: of[:, i] for i, s in enumerate(joint.coordinates)}
    coordinates, rates = columns(found.values), columns(found.rates)
    for s in joint.coordinates:
        if s.periodic:
            coordinates[s.name] = continued(coordinates[s.name], rates[s.name], t)
    force = wrench[:, :3]
    moment = wrench[:, 3:] - jnp.cross(found.point, force)
    local = lambda vector: jnp.einsum("nij,ni->nj", found.axes, vector)
    return JointMotion(
        coordinates=coordinates,
        rates=rates,
        accelerations=columns(found.accelerations),
        position=found.seen.position,
        orientation=found.seen.orientation,
        point=found.point,
        force=force,
        moment=moment,
        local_force=local(force),
        local_moment=local(moment),
    )
