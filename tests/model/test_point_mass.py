"""A body without inertia: a point mass. It translates, and joints hold it where it is."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, says

import lgsens as lg
from lgsens.examples import simple_pendulum
from lgsens.plotting._shapes import shapes

ORIGIN, X, Z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
CLOSED_FORM = json.loads((Path(__file__).parents[1] / "data/simple_pendulum_A01.json").read_text())
STEP = 1e-4  # of central differences: 1e-8 of third derivatives up to 1e3, and Newton leaves 1e-9 of the tension


def point(**changes):
    return lg.RigidBody(**({"mass": 2.0, "inertia": None} | changes))


def test_pendulum_is_that_of_the_closed_form():
    """Position and tension at 1 s to second order, and their derivatives by mass and length."""

    @jax.jit
    def both(p, every):  # one program: of 200 steps, every second one at twice the step
        def motion(p):
            trajectory = lg.simulate(simple_pendulum(*p), t1=1.0 * every, num_steps=200)
            last = 200 // every
            found = jnp.append(trajectory.body("mass").position[last, :2], trajectory.multiplier("rod")[last, 0])
            return found, found

        slope, value = jax.jacfwd(motion, has_aux=True)(p)
        return value, slope

    p = jnp.array([1.0, 1.0])
    (state,) = [state for state in CLOSED_FORM["states"] if state["t"] == 1]
    tension = state["thetadot"] ** 2 + 9.81 * np.cos(state["theta_from_downward"])
    exact = np.array([state["x"], state["y"], tension])
    coarse, fine = (np.abs(both(p, every)[0] - exact) for every in (2, 1))
    np.testing.assert_allclose(np.log2(coarse / fine), 2.0, atol=0.1)  # h⁴ over h² at h = 10 ms
    assert np.all(fine <= 1e-3 * np.abs(exact))
    ends = [both(p + STEP * sign * axis, 2)[0] for axis in np.eye(2) for sign in (1, -1)]
    differences = [(np.asarray(ends[2 * i]) - ends[2 * i + 1]) / (2 * STEP) for i in range(2)]
    _, slope = both(p, 2)
    np.testing.assert_allclose(slope, np.stack(differences, axis=1), rtol=1e-5, atol=1e-5)
    assert float(slope[2, 0]) > 1.0  # the tension grows with the mass


def test_unknowns_are_those_of_translations():
    """A bead on a wire, a ball joint at the point, a rod; by a spring to a body that turns."""
    bodies = {"bead": point(), "knot": point(position=X), "top": lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=Z)}
    joints = {
        "wire": lg.PrismaticJoint(None, "bead", at=ORIGIN, axis=X),
        "ball": lg.SphericalJoint("top", "knot", at=X),
        "rod": lg.DistanceJoint("bead", "knot", at_a=ORIGIN, at_b=X),
    }
    model = lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
    summary = model.summary()
    assert summary.bodies["bead"] == ("x", "y", "z")
    assert summary.equations == {"wire": 2, "ball": 3, "rod": 1}
    system = model.system()
    assert system.group.dim == 12
    mass = np.asarray(system.mass_matrix())
    np.testing.assert_array_equal(np.diagonal(mass), [2.0] * 6 + [1.0] * 6)  # bead, knot, top
    assert {outline.body for outline in shapes(system).outlines} == {0, 1, 2}  # points are small cubes
    assert len(jax.tree.leaves(bodies["bead"])) == len(jax.tree.leaves(bodies["top"])) - 1


@pytest.mark.slow
def test_points_are_merged():
    """Two points on a massless bar in a guide are one that translates."""
    bodies = {"a": point(), "b": point(mass=1.0, position=X, velocity=(0.0, 0.0, 3.0))}
    joints = {"bar": lg.FixedJoint("a", "b", at=ORIGIN)}
    moved = lg.simulate(lg.Model(bodies, joints, merge_fixed=True), t1=0.1, num_steps=2)
    assert moved.states.v.shape == (3, 3)
    close(moved.body("b").velocity[-1], [0.0, 0.0, 1.0], ulps=100)  # momentum is kept


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"free": "x ry"}, ("a point mass (`inertia` = None) has no rotations", "('x', 'ry')", "give an `inertia`")),
        ({"free": "rx ry rz", "pivot": X}, ("a point mass", "no rotations")),
        ({"angular_velocity": Z}, ("`angular_velocity`", "must vanish", "give an `inertia`")),
        ({"pivot": X}, ("`pivot` is for a body with rotations only",)),
    ],
)
def test_a_point_does_not_turn(changes, message):
    with pytest.raises(ValueError, match=says(*message)):
        point(**changes)


@pytest.mark.parametrize("merge", [False, True])
@pytest.mark.parametrize(
    "joint",
    [
        lg.RevoluteJoint("top", "mass", at=ORIGIN, axis=Z),
        lg.FixedJoint("top", "mass", at=ORIGIN),
        lg.RotationDriver(None, "mass", axis=Z),
    ],
)
def test_its_orientation_cannot_be_held(joint, merge):
    bodies = {"mass": point(), "top": lg.RigidBody(1.0, (1.0, 1.0, 1.0), position=Z)}
    model = lg.Model(bodies, {"j": joint}, merge_fixed=merge)
    message = says("Joint 'j'", type(joint).__name__, "'mass'", "point mass", "use a SphericalJoint")
    with pytest.raises(ValueError, match=message):
        model.system()
