"""Redundant constraints: motion, multipliers of least norm, gradients; against mechanisms without them and NumPy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.examples import four_bar
from tests.helpers import says

Z = np.array([0.0, 0.0, 1.0])
EXACT = lg.GeneralizedAlpha(0.8, tolerance=1e-13)


def door(p, hinges=2, **options):
    """A door of 2 m on hinges at a third and two thirds... of its height; the axis leans, so that it swings."""
    mass, width, lean, spread = p["mass"], p["width"], p["lean"], p["spread"]
    axis = jnp.stack([jnp.sin(lean), 0.0 * lean, jnp.cos(lean)])
    across = jnp.stack([0.0 * lean, 1.0 + 0.0 * lean, 0.0 * lean])
    third = jnp.cross(axis, across)
    turn = jnp.stack([across, third, axis], axis=1)  # columns: the axes of the door
    inertia = mass / 12.0 * jnp.stack([0.0 * width + 4.0, width**2 + 4.0, width**2])
    body = lg.RigidBody(
        mass, inertia, width / 2.0 * across, turn, angular_velocity=1.5 * Z, velocity=0.75 * width * third
    )
    at = {"lower": -spread * axis, "upper": spread * axis} if hinges == 2 else {"only": jnp.zeros(3)}
    joints = {name: lg.RevoluteJoint(None, "door", at=point, axis=axis) for name, point in at.items()}
    if hinges == 2:
        options = {"redundant": "minimum_norm"} | options
    return lg.Model({"door": body}, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))}, **options)


DOOR = {"mass": 20.0, "width": 0.9, "lean": 0.3, "spread": 0.6}


def planar(redundant, **numbers):
    """The four-bar in its own form of 17 equations, or of four revolute joints: 20 equations of rank 17."""
    model = four_bar(**numbers)
    if not redundant:
        return model
    joints, axis = dict(model.joints), model.joints["A"].axis
    for name, a, b in (("B", "crank", "coupler"), ("C", "coupler", "rocker")):
        joints[name] = lg.RevoluteJoint(a, b, at=joints[name].at, axis=axis)
    return lg.Model(model.bodies, joints, model.forces, redundant="minimum_norm")


CORNERS = np.array([(0, 0, 0), (1, 0, 0), (1, -1, 0), (1, -1, 1), (0, -1, 1), (0, 0, 1)], float)


def bricard(mass=1.0, size=1.0, relaxed=None, redundant="minimum_norm"):
    """The Bricard mechanism of the IFToMM benchmarks: five rods on edges of a cube and the ground, six revolute joints.

    Each of the axes is orthogonal to both rods; `relaxed`: the joint that is cylindrical instead.
    """
    corners = size * jnp.asarray(CORNERS)
    rods = jnp.roll(corners, -1, axis=0) - corners
    bodies, joints = {}, {}
    names = [*(f"rod {i}" for i in range(5)), None]
    for i, name in enumerate(names):
        along = rods[i] / size
        kind = lg.CylindricalJoint if i == relaxed else lg.RevoluteJoint
        joints[f"hinge {i}"] = kind(names[i - 1], name, at=corners[i], axis=jnp.cross(rods[i - 1], rods[i]))
        if name is not None:
            inertia = mass * size**2 / 12.0 * (jnp.eye(3) - 0.99 * jnp.outer(along, along))
            bodies[name] = lg.RigidBody(mass, inertia, (corners[i] + corners[(i + 1) % 6]) / 2.0)
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, -9.81, 0.0))}, redundant=redundant)


MOTION = ("position", "velocity", "acceleration", "angular_velocity", "angular_acceleration")


def same_motion(one, other, tolerance):
    for body in one.system.body_names:
        for what in MOTION:
            a, b = getattr(one.body(body), what), getattr(other.body(body), what)
            np.testing.assert_allclose(
                a, b, rtol=0, atol=tolerance * (1.0 + jnp.abs(b).max()), err_msg=f"{body} {what}"
            )


def test_a_door_on_two_hinges_moves_like_one_on_one():
    two, one = (lg.simulate(door(DOOR, hinges), t1=0.5, num_steps=100, integrator=EXACT) for hinges in (2, 1))
    # round-off of Φ/(βh²) is 1e-16/(0.3 · 25e-6) ~ 1e-11, and joints give way by 1e-7 of that of which the scheme is off
    same_motion(two, one, 1e-9)
    upper, lower = two.multiplier("upper"), two.multiplier("lower")
    single = one.multiplier("only")[:, :3]
    assert jnp.abs(single).max() > 100.0
    np.testing.assert_allclose(upper[:, :3] + lower[:, :3], single, rtol=0, atol=1e-6)
