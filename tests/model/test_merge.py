"""Bodies on fixed joints as one body: the same mechanics, in the unknowns of one body."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import BODIES, PointMasses, close, everything, random_body, random_rotation, says, some_quick

import lgsens as lg
from lgsens.liegroups import Power, R3xSO3
from lgsens.model import AbstractConstraint, AbstractJoint

X, Y, Z, ORIGIN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)


def as_merged(model: lg.Model) -> lg.Model:
    return lg.Model(model.bodies, model.joints, model.forces, merge_fixed=True)


def counts(model: lg.Model) -> tuple[int, int]:
    summary = model.summary()
    return summary.coordinates, summary.constraints


def body(**changes):
    return lg.RigidBody(**({"mass": 1.0, "inertia": (1.0, 1.0, 1.0)} | changes))


class Leash(AbstractConstraint):
    """A constraint as a user writes it, in the frames of its bodies: x_a · x_b stays what it is."""

    product: jnp.ndarray

    @property
    def num_rows(self):
        return 1

    def value(self, a, b, t):
        return jnp.sum(a.position * b.orientation[0])[None] - self.product


class LeashJoint(AbstractJoint):
    """The joint of a `Leash`."""

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)

    @property
    def assembled(self):
        return True

    def constraints(self, a, b):
        return (Leash(jnp.sum(a.position * b.orientation[0])),)


def welded(seed=0) -> lg.Model:
    """`everything` with more fixed joints: three bodies as one, two on the ground, and one on its own.

    Every joint and every force element is on a part of something, a spring and a load within one body, and
    a constraint and a load that only know the frames of their bodies.
    """
    rng = np.random.default_rng(100 + seed)
    base = everything(seed)
    at = lambda: rng.uniform(-1, 1, 3)
    bodies = dict(base.bodies)
    for name in ("g", "h", "i"):
        bodies[name] = random_body(rng, velocity=rng.normal(size=3), angular_velocity=rng.normal(size=3))
    joints = dict(base.joints) | {
        "second": lg.FixedJoint("b", "e", at=at()),
        "post": lg.FixedJoint(None, "g", at=at()),
        "beam": lg.FixedJoint("h", "g", at=at()),
        "stick": lg.FixedJoint("i", "d", at=at()),
        "leash": LeashJoint("i", "b"),
    }
    del joints["cardan"], joints["rod"]  # between parts of one body, and one that would lock the scene
    joints["eye"] = lg.DistanceJoint("e", "h", at_a=at(), at_b=at())
    forces = dict(base.forces) | {
        "inner": lg.SpringDamper("b", "c", at_a=at(), at_b=at(), stiffness=30.0, damping=1.0, free_length=0.2),
        "sunk": lg.SpringDamper("h", None, at_a=at(), at_b=at(), stiffness=30.0, free_length=0.2),
        "wind": lg.AppliedForce("g", force=at(), moment=at()),
        "jet": lg.AppliedForce("i", force=at(), moment=at()),
        "tie": lg.SpringDamper("g", "i", at_a=at(), at_b=at(), stiffness=25.0, preload=2.0),
    }
    return lg.Model(bodies, joints, forces)


@pytest.fixture(scope="module")
def scenes():
    model = welded()
    return model, as_merged(model)


def test_counts(scenes):
    """Nine bodies are four: a, f, b + c + e, d + i; each fixed joint takes six unknowns and six equations with it."""
    separate, merged = scenes
    assert counts(separate) == (54, 6 * 5 + 19)
    assert counts(merged) == (24, 19)
    system = merged.system()
    assert system.body_names == ("a", "b + c + e", "d + i", "f")
    assert system.group == Power(R3xSO3(), 4)
    summary = merged.summary()
    assert [summary.equations[name] for name in ("weld", "second", "post", "beam", "stick")] == [0] * 5
    assert summary.bodies["g"] == () and summary.bodies["e"] == lg.model.ALL_FREE
    for line in (
        "  g  ",
        "fixed to the ground",
        "x y z rx ry rz, one body: b + c + e",
        "Unknown coordinates        24",
    ):
        assert line in str(summary)


def test_names_leaves_and_structure_are_those_of_the_model(scenes):
    separate, merged = scenes
    assert [leaf.shape for leaf in jax.tree.leaves(merged)] == [leaf.shape for leaf in jax.tree.leaves(separate)]
    assert set(merged.bodies) == set(BODIES) | set("ghi")
    gradient = jax.jit(jax.grad(lambda model: model.system().mass_matrix().sum()))(merged)
    assert isinstance(gradient, lg.Model) and gradient.merge_fixed


def measured(model, bodies, joints, forces):
    """The motion of bodies, the multipliers of joints and what force elements measure, at the start."""
    now = lg.Instant(jnp.asarray(0.17), lg.initial_state(model, t0=0.17, throw=False), model.system())
    return {
        "bodies": {name: now.body(name)._asdict() for name in bodies},
        "joints": {name: now.multiplier(name) for name in joints},
        "forces": {name: now.force(name) for name in forces},
    }


@pytest.mark.slow
def test_initial_state_is_the_same(scenes):
    """Velocities that are not those of one body are projected alike; accelerations and all forces follow."""
    every = lambda model: measured(model, model.bodies, model.joints, set(model.forces) - {"gravity"})
    expected, found = (jax.jit(every)(model) for model in scenes)
    assert np.abs(expected["joints"]["weld"]).max() > 1.0
    # accelerations and forces up to 200, from matrices of condition up to 1e3 on both sides
    jax.tree.map(lambda actual, wanted: close(actual, wanted, 4000, scale=200.0), found, expected)


@pytest.mark.slow
def test_gradient_of_the_initial_state_is_the_same(scenes):
    """By every number of every body, joint and force: of motions of parts and of forces in and on merged bodies."""

    def combined(model):
        found = measured(model, "eig", ("weld", "beam", "leash"), ("tie", "drag"))
        return sum(jnp.sum(jnp.cos(i + jnp.arange(x.size)) * x.ravel()) for i, x in enumerate(jax.tree.leaves(found)))

    expected, found = (jax.jit(jax.grad(combined))(model) for model in scenes)
    for actual, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        # a gradient carries the condition twice
        np.testing.assert_allclose(actual, wanted, rtol=0, atol=1e-10 * max(1e3, np.abs(wanted).max()))
    for name in "bcedi":
        for leaf in jax.tree.leaves(found.bodies[name]):
            assert np.abs(leaf).max() > 1e-3
    assert min(np.abs(found.joints[name].at).max() for name in ("weld", "beam", "hinge")) > 1e-3


# Bodies with some of their degrees of freedom.

PLANAR = {"free": "x y rz"}
REDUCED = {
    "heave": ({"free": "z"}, {}, "z", None),
    "heave alike": ({"free": "z"}, {"free": "z"}, "z", None),
    "plane": ({}, PLANAR, "x y rz", None),
    "plane alike": (PLANAR | {"orientation": np.diag([1.0, -1.0, -1.0])}, PLANAR, "x y rz", None),
    "pivot": ({"free": "rx ry rz", "pivot": (0.3, 0.1, -0.2)}, {}, "rx ry rz", (0.3, 0.1, -0.2)),
    "hinge": ({}, {"free": "ry"}, "ry", (2.0, 0.5, 0.1)),
}


@pytest.mark.parametrize("case", some_quick(REDUCED))
def test_reduced_bodies(case):
    """The freedoms of the one that has fewer; velocities, accelerations and forces are those of the separate bodies."""
    first, second, free, pivot = REDUCED[case]
    rng = np.random.default_rng(4)
    bodies = {}
    for name, given, position in (("a", first, ORIGIN), ("b", second, (2.0, 0.5, 0.1))):
        own = PointMasses.random(rng)
        motion = {}
        if not given:
            motion = {"velocity": rng.normal(size=3), "angular_velocity": rng.normal(size=3)}
            given = {"orientation": random_rotation(rng)}
        elif "pivot" in given:
            motion = {"angular_velocity": rng.normal(size=3)}
        elif "rz" in given["free"]:
            motion = {"velocity": (1.0, 2.0, 0.0), "angular_velocity": (0.0, 0.0, 3.0)}
        bodies[name] = body(mass=own.masses.sum(), inertia=own.inertia, position=position, **(given | motion))
    bodies["c"] = body(position=(3.0, 0.0, 0.0))
    joints = {"weld": lg.FixedJoint("a", "b", at=X), "ball": lg.SphericalJoint("b", "c", at=(2.5, 0.0, 0.0))}
    forces = {
        "gravity": lg.Gravity((1.0, 2.0, -9.81)),
        "spring": lg.SpringDamper(None, "a", at_a=Z, at_b=Y, stiffness=30.0, damping=2.0, free_length=1.0),
        "push": lg.AppliedForce("b", force=(1.0, 2.0, 3.0), moment=(0.3, 0.2, 0.1)),
    }
    separate = lg.Model(bodies, joints, forces)
    merged = as_merged(separate)
    found, expected = (
        jax.jit(lambda m: measured(m, "abc", ("weld", "ball"), ("spring", "push")))(m) for m in (merged, separate)
    )
    jax.tree.map(lambda actual, wanted: close(actual, wanted, 4000, scale=100.0), found, expected)
    assert np.abs(found["bodies"]["a"]["acceleration"]).max() + np.abs(found["bodies"]["b"]["acceleration"]).max() > 0.1
    assert merged.summary().bodies["a"] == merged.summary().bodies["b"] == tuple(free.split())
    assert counts(merged) == (len(free.split()) + 6, 3)
    system = merged.system()
    if pivot is not None:
        close(system.pose.position[0], pivot, 4)


# Joints that keep their order, and what is refused.


def test_multipliers_are_in_the_order_of_the_basic_constraints():
    """Also where a joint before it has others of them first: those of the hinge are a force and two moments."""
    joints = {
        "a": lg.CylindricalJoint(None, "one", at=ORIGIN, axis=Z),
        "b": lg.RevoluteJoint(None, "two", at=X, axis=Z),
    }
    model = lg.Model({"one": body(), "two": body(position=X)}, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
    weight = lg.Instant(jnp.zeros(()), lg.initial_state(model), model.system()).multiplier("b")
    close(weight, [0.0, 0.0, -9.81, 0.0, 0.0], 20)


TWO = {"a": body(), "b": body(position=X)}
THREE = TWO | {"c": body(position=Y)}


def weld(a, b):
    return lg.FixedJoint(a, b, at=ORIGIN)


REFUSED = {
    "not a choice": (TWO, {}, ("Model: `merge_fixed` must be True or False", "'all'")),
    "a loop": (
        THREE,
        {"one": weld("a", "b"), "two": weld("b", "c"), "zero": weld("c", "a")},
        ("joint 'zero' connects 'c' and 'a'", "make one body already", "remove it", "['one', 'two']"),
    ),
    "twice to the ground": (
        THREE,
        {"one": weld("a", None), "two": weld("a", "b"), "zero": weld(None, "b")},
        ("joint 'zero' connects the ground and 'b'", "remove it"),
    ),
    "a hinge within": (
        THREE,
        {"hinge": lg.RevoluteJoint("a", "b", at=X, axis=Z), "one": weld("a", "b")},
        ("joint 'hinge' connects 'a' and 'b'", "remove it", "['one']"),
    ),
    "a rod between what is held": (
        THREE | {"a": body(free=())},
        {"rod": lg.DistanceJoint("a", None, at_a=X, at_b=Y, length=1.0)},
        ("joint 'rod' connects 'a' and the ground",),
    ),
    "nothing moves": (TWO, {"one": weld("a", None), "two": weld("a", "b")}, ("fixed joints hold all bodies", "move")),
    "a name": (TWO | {"a + b": body()}, {"one": weld("a", "b")}, ("'a + b' is the name of a merged body", "another")),
    "other freedoms": (
        {"a": body(free="z"), "b": body(free="x", position=X)},
        {"one": weld("a", "b")},
        ("merge the bodies ['a', 'b']", "'a': ('z',)", "all translate alike", "Leave `merge_fixed` out"),
    ),
    "two pivots": (
        {"a": body(free="ry", pivot=X), "b": body(free="ry", pivot=X)},
        {"one": weld("a", "b")},
        ("merge the bodies ['a', 'b']", "only one of them turns about a point"),
    ),
    "a turn on a line": (
        {"a": body(free="z rx ry rz"), "b": body(position=X)},
        {"one": weld("a", "b")},
        ("merge the bodies ['a', 'b']", "'a': ('z', 'rx', 'ry', 'rz')"),
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_merged_is_named(case):
    bodies, joints, parts = REFUSED[case]
    with pytest.raises(ValueError, match=says(*parts)):
        lg.Model(bodies, joints, merge_fixed="all" if case == "not a choice" else True)


def test_what_need_not_be_refused():
    """Held bodies are ground, with or without joints between them; without fixed joints nothing changes."""
    held = {"a": body(free=()), "b": body(free="", position=X), "c": body(position=Y)}
    model = lg.Model(held, {"one": weld("a", "b"), "two": weld("b", None), "ball": lg.SphericalJoint("a", "c", at=Y)})
    assert counts(as_merged(model)) == counts(model) == (6, 3)
    assert as_merged(model).system().body_names == ("c",)
    plain = lg.Model(TWO, {"hinge": lg.RevoluteJoint("a", "b", at=X, axis=Z)}, merge_fixed=True)
    assert plain.system().parts is None and plain.summary() == lg.Model(plain.bodies, plain.joints).summary()


def test_multipliers_that_the_motion_does_not_determine():
    """A hinge in the plane of a merged body keeps two equations; what the weld beside it carries is open."""
    bodies = {"a": body(free="x y rz"), "b": body(position=X)}
    joints = {"weld": weld("a", "b"), "hinge": lg.RevoluteJoint(None, "b", at=X, axis=Z)}
    model = lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, -9.81, 0.0))}, merge_fixed=True)
    assert counts(model) == (3, 2)
    now = lg.Instant(jnp.zeros(()), lg.initial_state(model), model.system())
    # 2 kg that swing 0.5 m from the hinge, with J = 2 + 2 · 0.5² about their centre: α = 9.81/3, F = 2 (g − 0.5 α)
    close(now.multiplier("hinge"), [0.0, -16.35], 100)
    with pytest.raises(ValueError, match=says("`multiplier`", "'weld'", "'hinge' has 5 equations", "and 2 between")):
        now.multiplier("weld")
    with pytest.raises(ValueError, match=says("`multiplier`", "'clamp' is not one of ['hinge', 'weld']")):
        now.multiplier("clamp")
