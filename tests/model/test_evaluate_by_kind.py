"""Joints of one kind are evaluated together: the same constraints as one by one, in a program that does not grow."""

from collections import Counter

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import equations
from jaxtyping import Array, Float

import lgsens as lg
from lgsens.examples import spatial_chain
from lgsens.model._frames import Frame, ground_frame
from lgsens.model._joints import AbstractJoint, _coincidence, _orthogonality


class Hook(AbstractJoint):
    """A joint of one's own, with a setting that decides what its constraints are."""

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"]
    locked: bool = eqx.field(static=True)

    @property
    def assembled(self):
        return True

    def constraints(self, a, b):
        point = (_coincidence(a, b, self.at),)
        axes = jnp.eye(3)
        return (*point, _orthogonality(a, b, axes[0], axes[1])) if self.locked else point


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    names = ["one", "two", "three", "four"]
    bodies = {
        name: lg.RigidBody(1.0 + i, (1.0, 1.2, 1.5), rng.standard_normal(3), angular_velocity=rng.standard_normal(3))
        for i, name in enumerate(names)
    }
    point = lambda: rng.standard_normal(3)
    joints = {
        "z": lg.SphericalJoint(None, "one", at=point()),
        "y": lg.UniversalJoint("one", "two", at=point(), axis_a=(1.0, 0.0, 0.0), axis_b=(0.0, 1.0, 0.2)),
        "x": lg.SphericalJoint("two", None, at=point()),
        "w": Hook("two", "three", at=jnp.asarray(point()), locked=True),
        "v": Hook("three", "four", at=jnp.asarray(point()), locked=False),
        "u": lg.SphericalJoint("one", "four", at=point()),
        "t": lg.DistanceJoint("one", "three", at_a=point(), at_b=point()),
        "s": lg.DistanceJoint("two", "four", at_a=point(), at_b=point(), length=1.5),
    }
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})


def test_constraints_are_those_of_each_joint(scene):
    system = scene.system()
    rng = np.random.default_rng(1)
    q = system.group.retract(system.pose, jnp.asarray(rng.standard_normal(system.group.dim)))
    found = np.asarray(system.constraint(q, 0.0))

    def frame(name, of):
        if name is None:
            return ground_frame(of.position.dtype)
        i = system.body_names.index(name)
        return Frame(of.position[i], of.orientation[i])

    assert (
        found.size == sum(system.multiplier_rows(name).size for name in scene.joints) == 3 + 4 + 3 + 4 + 3 + 3 + 1 + 1
    )
    for name, joint in scene.joints.items():
        elements = joint.constraints(frame(joint.a, system.pose), frame(joint.b, system.pose))
        moved = [element.value(frame(joint.a, q), frame(joint.b, q), 0.0) for element in elements]
        # the same products of numbers of order one, perhaps added in another order
        np.testing.assert_allclose(found[system.multiplier_rows(name)], np.concatenate(moved), atol=1e-13)


def test_traced_and_given_numbers_make_the_same_system(scene):
    given, traced = scene.system(), jax.jit(lambda model: model.system())(scene)
    assert jax.tree.structure(given) == jax.tree.structure(traced)
    for one, other in zip(jax.tree.leaves(given), jax.tree.leaves(traced)):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, atol=1e-14)  # numbers of order one, a few operations


def arithmetic(jaxpr) -> Counter:
    """The operations of a jaxpr that compute, also those inside it: not what takes the leaves of bodies and joints."""
    counted = ("mul", "div", "sub", "add", "sqrt", "dot_general", "reduce_sum")
    return Counter(each.primitive.name for each in equations(jaxpr) if each.primitive.name in counted)


def test_the_equations_of_a_chain_take_as_many_operations_whatever_its_length():
    short, long = (arithmetic(jax.make_jaxpr(lambda model: model.system())(spatial_chain(n)).jaxpr) for n in (4, 12))
    assert short == long and sum(short.values()) > 10


def test_poses_are_taken_once_for_each_side_of_all_elements(scene):
    """Each gather's transpose is a scatter to compile; but of one alone XLA would make the poses anew for each end."""
    system = scene.system()
    program = jax.make_jaxpr(system.constraint)(system.pose, 0.0)
    orientations = system.pose.orientation.shape
    taken = [
        each.primitive.name == "gather" and each.invars[0].aval.shape == orientations for each in equations(program)
    ]
    assert sum(taken) == 2


def test_springs_of_two_kinds_are_one_stack():
    """Four that are alike are made together and one by itself: what the equations see of them is the same."""
    springs = {f"long{i}": {"free_length": 1.0} for i in range(4)} | {"short": {"preload": 7.0}}
    forces = {
        name: lg.SpringDamper(None, "mass", at_a=(0, 0, 0), at_b=(0, 0, 1.5), stiffness=100.0, **given)
        for name, given in springs.items()
    }
    model = lg.Model({"mass": lg.RigidBody(2.0, (1.0, 1.0, 1.0), position=(0, 0, 1.5))}, {}, forces)
    (stack,) = model.system().loads
    assert stack.owners == tuple(sorted(springs))
    of = lambda k: lg.initial_state(eqx.tree_at(lambda m: m.forces["long2"].stiffness, model, k)).vdot[2]
    value, slope = jax.jit(jax.value_and_grad(of))(jnp.asarray(100.0))
    # 50 N from each of those that are 0.5 m too long, on 2 kg.
    np.testing.assert_allclose(value, -(4 * 50.0 + 7.0) / 2.0, rtol=1e-14)
    np.testing.assert_allclose(slope, -0.25, rtol=1e-14)
