"""The basic constraints: tangents against autodiff, and against differences that share no code."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    GRAVITY,
    central_difference,
    close,
    moved_without_library,
    random_body,
    random_point,
    random_rotation,
    says,
    some_quick,
)

import lgsens as lg
from lgsens.model import (
    AbstractConstraint,
    AbstractForce,
    AbstractJoint,
    AbstractLoad,
    Attached,
    Coincidence,
    Distance,
    Frame,
    InPlane,
    Orthogonality,
)
from lgsens.model._loads import Weight
from lgsens.model._stack import Stack
from lgsens.testing import check_joint

KINDS = {"Coincidence": Coincidence, "Orthogonality": Orthogonality, "InPlane": InPlane, "Distance": Distance}
ROWS = {"Coincidence": 3, "Orthogonality": 1, "InPlane": 1, "Distance": 1}
POSES = 20

# Points, axes and multipliers are of order 1, |d| lies between 1 and 10, and a formula has up to six products
# of matrices: some ten round-offs of the largest entry. 200 leaves room and tells any wrong term.
ULPS = 200


def sample(name, seed=0):
    """`POSES` elements of one kind, two frames each (4 m apart, so that |d| is not small) and multipliers."""
    rng = np.random.default_rng(seed)
    fields = {"point_a": 3, "point_b": 3, "axis_a": 3, "axis_b": 3}
    own = [f for f in fields if f in KINDS[name].__dataclass_fields__]
    values = {f: jnp.asarray(rng.normal(scale=0.5, size=(POSES, 3))) for f in own}
    if name == "Distance":
        values["length"] = jnp.asarray(rng.uniform(1.0, 3.0, POSES))
    frames = []
    for offset in (0.0, 4.0):
        position = rng.normal(scale=0.5, size=(POSES, 3)) + np.array([offset, 0.0, 0.0])
        frames.append(Frame(jnp.asarray(position), jnp.asarray([random_rotation(rng) for _ in range(POSES)])))
    return KINDS[name](**values), *frames, jnp.asarray(rng.normal(size=(POSES, ROWS[name])))


@eqx.filter_jit
@eqx.filter_vmap
def closed_form(element, a, b, lam):
    return element.value(a, b, 0.0), element.jacobian(a, b, 0.0), element.geometric_stiffness(a, b, lam, 0.0)


# small version: test_tangents_equal_central_differences
@pytest.mark.parametrize("name", some_quick(["InPlane", "Distance", "Coincidence", "Orthogonality"], 2))
def test_tangents_equal_autodiff(name):
    element, *_ = sample(name)
    assert element.num_rows == ROWS[name]
    one = jax.tree.map(lambda leaf: leaf[0], element)
    # two poses of a few numbers, round-off as it is measured: some ten units in the last place of the largest entry
    check_joint(one, poses=POSES).raise_if_failed()


@pytest.mark.parametrize("name", KINDS)
def test_tangents_equal_central_differences(name):
    """Differences of the value, and of Bᵀλ, by rotations from SciPy."""
    element, a, b, lam = jax.tree.map(lambda leaf: leaf[:1], sample(name, seed=1))
    _, jacobian, stiffness = closed_form(element, a, b, lam)

    def at(x):
        first, second = (Frame(*(leaf[0] for leaf in frame)) for frame in (a, b))
        first, second = moved_without_library(first, x[:6]), moved_without_library(second, x[6:])
        frames = (Frame(*(jnp.asarray(leaf)[None] for leaf in frame)) for frame in (first, second))
        value, jacobian, _ = closed_form(element, *frames, lam)
        return value[0], lam[0] @ jacobian[0]

    # Values up to 10 m and third derivatives of that size: 4e-11 × 10 (see `central_difference`), with a
    # margin of 10.
    for actual, index in ((jacobian[0], 0), (stiffness[0], 1)):
        expected = central_difference(lambda x, index=index: at(x)[index], 12)
        np.testing.assert_allclose(actual, expected, rtol=0, atol=4e-9)


# The same joints as a user writes them: a value and nothing else.


class UserCoincidence(AbstractConstraint):
    point_a: jax.Array
    point_b: jax.Array

    @property
    def num_rows(self):
        return 3

    def value(self, a, b, t):
        return b.position + b.orientation @ self.point_b - (a.position + a.orientation @ self.point_a)


class UserDistance(AbstractConstraint):
    point_a: jax.Array
    point_b: jax.Array
    length: jax.Array

    @property
    def num_rows(self):
        return 1

    def value(self, a, b, t):
        first = a.position + a.orientation @ self.point_a
        second = b.position + b.orientation @ self.point_b
        return 0.5 * (jnp.sum((second - first) ** 2, keepdims=True) / self.length[None] - self.length[None])


class UserJoint(AbstractJoint):
    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: jax.Array

    @property
    def assembled(self):
        return True

    def constraints(self, a, b):
        return (UserCoincidence(a.orientation.T @ (self.at - a.position), b.orientation.T @ (self.at - b.position)),)


class UserRod(AbstractJoint):
    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: jax.Array
    at_b: jax.Array

    @property
    def assembled(self):
        return True

    def constraints(self, a, b):
        point_a = a.orientation.T @ (self.at_a - a.position)
        point_b = b.orientation.T @ (self.at_b - b.position)
        return (UserDistance(point_a, point_b, jnp.linalg.norm(self.at_b - self.at_a)),)


def users_scene(own: bool):
    rng = np.random.default_rng(3)
    bodies = {name: random_body(rng, angular_velocity=rng.normal(size=3)) for name in ("one", "two")}
    ground, between, end_a, end_b = (jnp.asarray(rng.uniform(-1, 1, 3)) for _ in range(4))
    ball, rod = (UserJoint, UserRod) if own else (lg.SphericalJoint, lg.DistanceJoint)
    joints = {
        "pivot": ball("one", None, at=ground),
        "ball": ball("one", "two", at=between),
        "rod": rod(None, "two", at_a=end_a, at_b=end_b),
    }
    return lg.Model(bodies, joints, {"gravity": lg.Gravity(GRAVITY)})


@eqx.filter_jit
def evaluate(model, point):
    system = model.system()
    return system.residual(*point), system.constraint(point.q, point.t), system.tangents(*point)


def test_constraint_without_tangents_gets_them():
    own, library = users_scene(own=True), users_scene(own=False)
    system = library.system()
    assert own.system().constraint_names == system.constraint_names
    for seed in range(3):
        point = random_point(system, np.random.default_rng(seed))
        actual, expected = evaluate(own, point), evaluate(library, point)
        jax.tree.map(lambda x, y: close(x, y, ULPS), actual, expected)


def hung_by(kind):
    """A body on a joint to the ground that is made of this kind of `UserCoincidence`."""

    class Joint(UserJoint):
        def constraints(self, a, b):
            (right,) = UserJoint.constraints(self, a, b)
            return (kind(right.point_a, right.point_b),)

    body = lg.RigidBody(1.0, (1.0, 1.0, 1.0))
    return lg.Model({"body": body}, {"joint": Joint(None, "body", jnp.zeros(3))}, {})


@pytest.mark.parametrize("sets", [((3, 4), (4, 5)), ((4, 3),), ((3, 3),), ((10, 11, 12),), ((-1, 0),)])
def test_coupled_coordinates_are_validated(sets):
    class Wrong(UserCoincidence):
        @property
        def coupled(self):
            return sets

    model = hung_by(Wrong)
    with pytest.raises(ValueError, match=says("Wrong", "`coupled`", repr(sets), "Leave it out")):
        model.system()


ROTATIONS = (3, 4, 5, 9, 10, 11)


@pytest.mark.parametrize("places", [(3, 4, 5), (0, 1, 2), (9, 10, 11, 3, 4, 5), ()])
def test_what_a_constraint_acts_on_is_validated(places):
    class Wrong(UserCoincidence):
        @property
        def acts_on(self):
            return places

    model = hung_by(Wrong)
    with pytest.raises(ValueError, match=says("Wrong", "`acts_on`", repr(ROTATIONS), repr(places), "Leave it out")):
        model.system()


@pytest.mark.parametrize("places", [(7, 6), (6, 6), (11, 12), (-1, 0), ()])
def test_what_a_load_acts_on_is_validated(places):
    class Wrong(Weight):
        @property
        def acts_on(self):
            return places

    stacked = Wrong(jnp.ones(1), jnp.ones((1, 3)))
    with pytest.raises(ValueError, match=says("Wrong", "`acts_on`", repr(places), "Leave it out")):
        Stack(elements=stacked, a=None, b=(0,), owners=("weight",), kept=((),), places=(0,))


def test_only_what_elements_act_on_is_added():
    """Of a hinge's five equations the three of its point have all columns, the two of its axis those of rotations; a
    weight adds a force, and no moment."""
    rng = np.random.default_rng(5)
    bodies = {name: random_body(rng) for name in ("one", "two")}
    joints = {"hinge": lg.RevoluteJoint("one", "two", at=jnp.zeros(3), axis=jnp.asarray([0.0, 0.0, 1.0]))}
    system = lg.Model(bodies, joints, {"gravity": lg.Gravity(GRAVITY)}).system()
    q, _ = system.reference()
    assert [part.values.shape for part in system.sparse_constraint_jacobian(q, 0.0).parts] == [(1, 3, 12), (2, 1, 6)]
    assert [places.shape for places in system.topology.forces] == [(2, 3)]


class Anchor(AbstractLoad):
    """A force on the first body, or on the ground in its place."""

    size: jax.Array

    @property
    def acts_on(self):
        return (0, 1, 2)

    def force(self, a, b, va, vb, t):
        return jnp.zeros(12).at[0].set(self.size)


class AnchorForce(AbstractForce):
    a: str | None = eqx.field(static=True)

    @property
    def bodies(self):
        return (self.a, "two")

    def loads(self, bodies):
        return (Attached(Anchor(jnp.asarray(3.0)), self.a, "two"),)


@pytest.mark.parametrize("a, expected", [("one", -3.0), (None, 0.0)])
def test_a_load_may_act_on_the_ground_alone(a, expected):
    rng = np.random.default_rng(6)
    system = lg.Model({name: random_body(rng) for name in ("one", "two")}, {}, {"anchor": AnchorForce(a)}).system()
    q, _ = system.reference()
    zero = jnp.zeros(system.group.dim)
    np.testing.assert_array_equal(system.residual(q, zero, zero, zero[:0], 0.0), zero.at[0].set(expected))
