"""Scenes of bodies with some of their degrees of freedom, and the same scenes with all of them."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from helpers import GRAVITY, DragForce, Point, PointMasses, random_body, random_rotation
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.examples import four_bar
from lgsens.liegroups import Pose


def about_y(angle):
    return Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()


class Setup(NamedTuple):
    """How a body of `mixed` is held."""

    free: tuple[str, ...] | str
    orientation: np.ndarray
    pivot: np.ndarray | None = None


def mixed(seed=0):
    """Six bodies with every kind of freedom, every joint and every force; and the point masses they are."""
    rng = np.random.default_rng(seed)
    at = lambda: rng.uniform(-1, 1, 3)
    setups = {
        "whole": Setup("x y z rx ry rz", random_rotation(rng)),
        "lift": Setup("z", random_rotation(rng)),
        "planar": Setup(("ry", "x", "z"), about_y(0.4)),
        "top": Setup("rx ry rz", random_rotation(rng), at()),
        "swing": Setup("ry", about_y(-0.7), at()),
        "held": Setup((), random_rotation(rng)),
    }
    points = {name: PointMasses.random(rng) for name in setups}
    bodies = {
        name: random_body(rng, points[name], free=s.free, orientation=s.orientation, pivot=s.pivot)
        for name, s in setups.items()
    }
    y = (0.0, 2.0, 0.0)
    joints = {
        "ball": lg.SphericalJoint("whole", "lift", at=at()),
        "pin": lg.SphericalJoint("planar", "swing", at=at()),
        "hinge": lg.RevoluteJoint("planar", "held", at=at(), axis=y),
        "bearing": lg.RevoluteJoint("whole", "swing", at=at(), axis=y),
        "cardan": lg.UniversalJoint("top", "whole", at=at(), axis_a=rng.normal(size=3), axis_b=rng.normal(size=3)),
        "weld": lg.FixedJoint("swing", "planar", at=at()),
        "clamp": lg.FixedJoint("held", "lift", at=at()),
        "slider": lg.PrismaticJoint("whole", None, at=at(), axis=rng.normal(size=3)),
        "rod": lg.DistanceJoint("top", "planar", at_a=at(), at_b=at()),
        "stay": lg.DistanceJoint(None, "top", at_a=at(), at_b=at()),
    }
    bump = lg.BumpRoad(height=0.05, duration=0.25, start=0.1)
    forces = {
        "gravity": lg.Gravity(GRAVITY),
        "spring": lg.SpringDamper("lift", "swing", at_a=at(), at_b=at(), stiffness=50.0, damping=3.0, preload=-7.0),
        "anchor": lg.SpringDamper(None, "top", at_a=at(), at_b=at(), stiffness=40.0, damping=2.0, free_length=0.4),
        "tyre": lg.TyreSpring("lift", at=at(), stiffness=90.0, road=bump, preload=5.0),
        "push": lg.AppliedForce("top", force=at(), moment=at(), signal=bump),
        "drag": DragForce("planar", jnp.asarray(0.3, dtype=float)),
    }
    return lg.Model(bodies, joints, forces), points


# Of the 28 equations that the joints would have, those that these bodies can violate: the height of the clamp, the
# pin and the hinge in the plane, the weld there with one angle.
EQUATIONS = {"ball": 3, "pin": 2, "hinge": 2, "bearing": 5, "cardan": 4, "weld": 3, "clamp": 1, "slider": 5}
EQUATIONS |= {"rod": 1, "stay": 1}


def with_all_freedoms(model: lg.Model) -> lg.Model:
    """The same scene in six coordinates of the centre of mass for each body."""
    names = ("mass", "inertia", "position", "orientation", "velocity", "angular_velocity")
    bodies = {name: lg.RigidBody(**{n: getattr(body, n) for n in names}) for name, body in model.bodies.items()}
    return lg.Model(bodies, model.joints, model.forces)


def random_free_point(system, rng, t=0.17) -> Point:
    """A state near the reference that the free coordinates can reach and that satisfies no joint."""
    k, m = system.group.dim, len(system.constraint_names)
    draw = lambda size, scale=1.0: jnp.asarray(rng.normal(scale=scale, size=size))
    q = system.group.retract(system.pose, draw(k, 0.3))
    return Point(q, draw(k), draw(k), draw(m), jnp.asarray(t))


def embedding(system, q) -> np.ndarray:
    """E(q) with [ẋ, Ω] = E v for the centres of mass of all bodies, shape (6N, k): ẋ = R (Ω × c) = −R c̃ Ω."""
    count = len(system.body_names)
    E = np.asarray(system.twists(jnp.eye(system.group.dim))).reshape(system.group.dim, 6 * count).T.copy()
    if system.centre is not None:
        for i, (c, rotation) in enumerate(zip(np.asarray(system.centre), np.asarray(q.orientation))):
            turning = E[6 * i + 3 : 6 * i + 6]
            E[6 * i : 6 * i + 3] += rotation @ np.cross(turning, c, axisa=0).T
    return E


def in_all_coordinates(system, point: Point) -> Point:
    """The point of `with_all_freedoms` at the same state of motion, λ apart."""
    motions = [system.motion(i, point.q, point.v, point.vdot) for i in range(len(system.body_names))]
    position, orientation, velocity, spin, acceleration, change = map(jnp.stack, zip(*motions))
    v = jnp.concatenate([velocity, spin], axis=1).ravel()
    return Point(
        Pose(position, orientation), v, jnp.concatenate([acceleration, change], axis=1).ravel(), point.lam, point.t
    )


def planar_four_bar(pivots: bool) -> lg.Model:
    """`four_bar` of planar bodies on hinges; `pivots`: crank and rocker turn about fixed points instead."""
    full = four_bar()
    names = ("mass", "inertia", "position", "orientation", "velocity", "angular_velocity")

    def body(name, free, pivot=None):
        numbers = {n: getattr(full.bodies[name], n) for n in names if pivot is None or n != "velocity"}
        return lg.RigidBody(**numbers, free=free, pivot=pivot)

    ends = {"crank": "A", "rocker": "D"}
    z = (0.0, 0.0, 1.0)
    joints = {
        name: lg.RevoluteJoint(joint.a, joint.b, at=joint.at, axis=z)
        for name, joint in full.joints.items()
        if not pivots or name in "BC"
    }
    bodies = {
        name: body(name, "rz", full.joints[ends[name]].at) if pivots and name in ends else body(name, "x y rz")
        for name in full.bodies
    }
    return lg.Model(bodies, joints, full.forces)
