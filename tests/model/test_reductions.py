"""Leaner scenes: each is one that is written by hand, numbers go through, and what cannot be is refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.model import Fixed, Frozen, Joint, Merged, Rod, Without


def four_bar(coupler=0.3):
    """Crank, coupler of a uniform bar, rocker; a bushing at the rocker, and a damper."""
    spin = (0.0, 0.0, 1.0)
    bodies = {
        "crank": lg.RigidBody(2.0, (0.1, 0.1, 0.1), position=(0.0, 0.5, 0.0)),
        "coupler": lg.RigidBody(coupler, (0.001, 0.1, 0.1), position=(1.0, 1.0, 0.0)),
        "rocker": lg.RigidBody(1.0, (0.2, 0.1, 0.2), position=(2.0, 0.5, 0.0)),
    }
    joints = {
        "a": lg.RevoluteJoint(None, "crank", at=(0, 0, 0), axis=spin),
        "b": lg.UniversalJoint("crank", "coupler", at=(0, 1, 0), axis_a=spin, axis_b=(0, 1, 0)),
        "c": lg.SphericalJoint("coupler", "rocker", at=(2, 1, 0)),
    }
    rates = {"stiffness": (1e5, 1e5, 1e5), "rotational_stiffness": (1e4, 1e4, 10.0)}
    forces = {
        "gravity": lg.Gravity((0.0, -9.81, 0.0)),
        "bush": lg.Bushing(None, "rocker", at=(2, 0, 0), **rates),
        "damper": lg.SpringDamper(None, "crank", at_a=(1, 0, 0), at_b=(0, 1, 0), stiffness=5.0, damping=3.0),
    }
    return lg.Model(bodies, joints, forces)


def test_a_link_becomes_a_rod_with_its_mass_at_the_ends():
    lean = four_bar().reduced(Rod("coupler"))
    assert sorted(lean.bodies) == ["crank", "rocker"] and sorted(lean.joints) == ["a", "coupler"]
    rod = lean.joints["coupler"]
    np.testing.assert_array_equal([rod.at_a, rod.at_b], [(0, 1, 0), (2, 1, 0)])
    crank = lean.bodies["crank"]
    # 2 kg at y = 0.5 and 0.15 kg at y = 1: J_zz = 0.1 + (2 · 0.15/2.15) · 0.5²
    np.testing.assert_allclose(crank.mass, 2.15)
    np.testing.assert_allclose(crank.position, [0, (1.0 + 0.15) / 2.15, 0], rtol=1e-15)
    np.testing.assert_allclose(crank.inertia[2, 2], 0.1 + 2 * 0.15 / 2.15 * 0.25, rtol=1e-14)
    assert float(four_bar().reduced(Rod("coupler", lump=False)).bodies["crank"].mass) == 2.0


def test_numbers_of_the_rich_model_go_through():
    mass = lambda m: four_bar(m).reduced(Rod("coupler")).bodies["rocker"].mass
    np.testing.assert_allclose(jax.jit(jax.grad(mass))(0.3), 0.5)
    with pytest.raises(ValueError, match="not known here; give `kind`"):
        jax.jit(lambda k: eqx.tree_at(_turning, four_bar(), k).reduced(Joint("bush")).bodies["rocker"].mass)(
            jnp.ones(3)
        )


def _turning(model):
    return model.forces["bush"].rotational_stiffness


@pytest.mark.parametrize(
    "kind, found",
    [(None, lg.RevoluteJoint), ("revolute", lg.RevoluteJoint), ("spherical", lg.SphericalJoint), ("fixed", None)],
)
def test_a_bushing_becomes_the_joint_of_its_rates(kind, found):
    lean = four_bar().reduced(Joint("bush", kind))
    joint = lean.joints["bush"]
    assert type(joint) is (found or lg.model.FixedJoint) and "bush" not in lean.forces
    np.testing.assert_array_equal(joint.at, (2, 0, 0))
    if found is lg.RevoluteJoint:
        np.testing.assert_array_equal(joint.axis, (0, 0, 1))  # the soft one


def test_bodies_are_merged_and_held():
    merged = four_bar().reduced(Merged("crank", "coupler"))
    assert merged.merge_fixed and merged.joints["b"].rigid
    assert merged.summary().coordinates == 12
    held = four_bar().reduced(Fixed("rocker")).bodies["rocker"]
    assert held.free == ()
    assert four_bar().reduced(Frozen("rocker", "x rx ry rz")).bodies["rocker"].free == ("y", "z")
    guided = four_bar().reduced(Frozen("crank", "x y z rx ry", guide="a"))
    assert "a" not in guided.joints


def test_forces_and_numbers_are_left_out():
    lean = four_bar().reduced(Without("damper", "damping"), Without("gravity"))
    assert float(lean.forces["damper"].damping) == 0.0 and float(lean.forces["damper"].stiffness) == 5.0
    assert "gravity" not in lean.forces


@pytest.mark.parametrize(
    "reduction, message",
    [
        (Rod("rocker"), "two spherical or universal joints hold and on which nothing acts"),
        (Rod("conrod"), "'conrod' is not one of"),
        (Joint("damper"), "no joint takes the place of a SpringDamper"),
        (Joint("bush", "screw"), "`kind` must be one of"),
        (Without("stop"), "'stop' is not one of"),
        (Without("damper", "colour"), "'colour' is not one of"),
        (Merged("crank", "chassis"), "'chassis' is not one of"),
        (Frozen("crank", "rx"), "Free one rotation or all three"),
        (Frozen("crank", "z", guide="q"), "'q' is not one of"),
        ("crank", "reductions must be Rod"),
    ],
)
def test_what_cannot_be_is_refused(reduction, message):
    with pytest.raises(ValueError, match=message):
        four_bar().reduced(reduction)


def test_the_path_to_a_rod_is_that_of_its_inertia():
    """At s the link has 1 − s of its mass, and the total stays."""
    half = four_bar().toward([(Rod("coupler"),)], [0.5], 1.0)
    masses = [float(half.bodies[name].mass) for name in ("crank", "coupler", "rocker")]
    np.testing.assert_allclose(masses, [2.075, 0.15, 1.075])
