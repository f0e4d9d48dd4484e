"""Sliders and points on lines between bodies that move in a plane: what is left of their equations, in any plane and
along any line in it; against whole bodies, for which all equations are needed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg

SETTINGS = {"t1": 0.2, "num_steps": 20, "integrator": lg.GeneralizedAlpha(0.8, tolerance=1e-13)}


def plane(normal, angle):
    """The normal of a coordinate plane, a line in it, and the direction across."""
    axes = np.roll(np.eye(3), -normal, axis=0)  # axes[0] is the normal
    line = np.cos(angle) * axes[1] + np.sin(angle) * axes[2]
    return axes[0], line, np.cross(axes[0], line)


def slider_crank(normal, angle, *, whole=False, point=False):
    """Crank of 0.3 m and rod of 1 m in a plane; a slider, or the end of the rod on a line."""
    k, line, across = plane(normal, angle)
    letters = "xyz"
    free = " ".join(letter for letter in letters if letter != letters[normal]) + f" r{letters[normal]}"
    crank, end = 0.3 * (0.6 * line + 0.8 * across), 0.3 * 0.6 * line + np.sqrt(1.0 - 0.24**2) * line
    options = {"free": None if whole else free}
    bodies = {
        "crank": lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=crank / 2, angular_velocity=3.0 * k, **options),
        "rod": lg.RigidBody(2.0, (0.3, 0.3, 0.3), position=(crank + end) / 2, **options),
    }
    joints = {
        "a": lg.RevoluteJoint(None, "crank", at=(0.0, 0.0, 0.0), axis=k),
        "b": lg.RevoluteJoint("crank", "rod", at=crank, axis=k),
    }
    if point:
        joints["line"] = lg.PointOnLineJoint(None, "rod", at=end, axis=line)
    else:
        bodies["slider"] = lg.RigidBody(0.5, (0.01, 0.01, 0.01), position=end, **options)
        joints |= {
            "c": lg.RevoluteJoint("rod", "slider", at=end, axis=k),
            "line": lg.PrismaticJoint(None, "slider", at=end, axis=line),
        }
    gravity = {"gravity": lg.Gravity(-9.81 * across)}
    return lg.Model(bodies, joints, gravity, redundant="minimum_norm" if whole else "refuse")


@pytest.mark.parametrize("point", [False, True])
@pytest.mark.parametrize("normal", range(3))
@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2])
def test_what_is_left_in_a_plane(normal, angle, point):
    model = slider_crank(normal, angle, point=point)
    assert model.summary().equations["line"] == (1 if point else 2)
    rank = lg.constraint_rank(model)
    assert rank.redundant == 0 and rank.degrees_of_freedom == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "normal, angle, point",
    [(2, 0.4, False), (0, np.pi / 2, False), (1, 0.0, True)],
)
def test_the_motion_is_that_of_whole_bodies(normal, angle, point):
    found, expected = (
        lg.simulate(slider_crank(normal, angle, whole=whole, point=point), **SETTINGS) for whole in (False, True)
    )
    for name in found.system.body_names:
        # joints of the latter give way by 1e-7 of what the scheme is off in a step
        np.testing.assert_allclose(found.body(name).position, expected.body(name).position, atol=1e-8)
    forces = [trajectory.joint("line").force for trajectory in (found, expected)]
    _, line, across = plane(normal, angle)
    np.testing.assert_allclose(*(force @ across for force in forces), atol=1e-4)  # that over h², of 20 N
    np.testing.assert_allclose(forces[0] @ line, 0.0, atol=1e-9)


def block(slope, free=None):
    """A block on an incline, with friction from what the slider carries."""
    line = jnp.stack([jnp.cos(slope), -jnp.sin(slope), 0.0 * slope])
    bodies = {"block": lg.RigidBody(2.0, (0.1, 0.1, 0.1), velocity=0.5 * line, free=free)}
    joints = {"slider": lg.PrismaticJoint(None, "block", at=(0.0, 0.0, 0.0), axis=line)}
    friction = lg.JointFriction("slider", coefficient=0.2, slip_speed=1e-4, load_rounding=1e-3)
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, -9.81, 0.0)), "friction": friction})


@pytest.mark.slow  # joints that rub have quick tests; that they read these rows is the same code
def test_friction_reads_what_is_left():
    """v̇ = g (sin α − μ cos α), and its derivative by α."""
    slope = 0.6

    def speed(slope):
        found = lg.simulate(block(slope, "x y rz"), **SETTINGS | {"t1": 0.1})
        return jnp.linalg.norm(found.body("block").velocity[-1])

    expected = lambda slope: 0.5 + 0.1 * 9.81 * (jnp.sin(slope) - 0.2 * jnp.cos(slope))
    found = jax.value_and_grad(speed)(slope)
    # roundings leave (1e-4 m/s over 0.5 m/s)² and (1e-3 N over 16 N)² of the friction
    np.testing.assert_allclose(found, jax.value_and_grad(expected)(slope), rtol=1e-7)


@pytest.mark.slow  # its equations are in `test_free_input`
@pytest.mark.parametrize("joint", [lg.PointOnLineJoint, lg.PrismaticJoint])
def test_a_bead_on_a_wire(joint):
    """A point mass that moves in a plane, without rotations: g sin α along the wire, m g cos α across."""
    slope, wire = 0.6, np.array([np.cos(0.6), 0.0, -np.sin(0.6)])
    model = lg.Model(
        {"bead": lg.RigidBody(2.0, None, free="x z")},
        {"wire": joint(None, "bead", at=(0.0, 0.0, 0.0), axis=wire)},
        {"gravity": lg.Gravity((0.0, 0.0, -9.81))},
    )
    found = lg.simulate(model, **SETTINGS)
    np.testing.assert_allclose(found.body("bead").position[-1], 0.02 * 9.81 * np.sin(slope) * wire, atol=1e-12)
    across = np.array([np.sin(slope), 0.0, np.cos(slope)])  # a wire that is pressed by the bead
    force = np.asarray(found.joint("wire").force)
    np.testing.assert_allclose(np.abs(force @ across), 2.0 * 9.81 * np.cos(slope), rtol=1e-10)


def test_a_line_that_leaves_the_plane_is_refused():
    for joint in (lg.PrismaticJoint, lg.PointOnLineJoint):
        body = lg.RigidBody(1.0, (0.1, 0.1, 0.1), free="x y rz")
        line = joint(None, "b", at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, 0.2))
        with pytest.raises(ValueError, match=says(joint.__name__, "'b'", "`axis`", "leaves the plane", "normal to z")):
            lg.Model({"b": body}, {"line": line}).system()
