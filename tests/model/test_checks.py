"""Numbers that come in after construction: found where the system is assembled, and by the program inside jit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import says

import lgsens as lg
from lgsens.model._checks import far_from_rotation, is_inertia

NAN = jnp.asarray(jnp.nan)


def scene():
    at = jnp.array([0.0, 0.0, -1.0])
    body = lg.RigidBody(2.0, (0.3, 0.2, 0.4), position=at, angular_velocity=(0.0, 1.0, 0.0))
    hinge = lg.RevoluteJoint(None, "bob", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    spring = lg.SpringDamper(None, "bob", at_a=(1.0, 0.0, 0.0), at_b=at, stiffness=10.0)
    rod = lg.DistanceJoint(None, "foot", at_a=(2.0, 0.0, 0.0), at_b=(3.0, 0.0, 0.0), length=1.0)
    foot = lg.RigidBody(1.0, None, position=(3.0, 0.0, 0.0), free="x y")
    gravity = lg.Gravity((0.0, 0.0, -9.81))
    return lg.Model({"bob": body, "foot": foot}, {"hinge": hinge, "rod": rod}, {"spring": spring, "gravity": gravity})


def bob(model):
    return model.bodies["bob"]


BAD = {
    "NaN position": (
        lambda m: bob(m).position,
        jnp.array([jnp.nan, 0.0, 0.0]),
        "Body 'bob': `position`.*finite",
        "bob",
    ),
    "negative mass": (
        lambda m: bob(m).mass,
        jnp.asarray(-0.5),
        "Body 'bob'.*`mass` must be positive, got -0.5",
        "-0.5",
    ),
    "a Python float": (lambda m: bob(m).mass, -0.5, "Body 'bob'.*`mass` must be positive, got -0.5", "-0.5"),
    "infinite mass": (lambda m: bob(m).mass, jnp.asarray(jnp.inf), "Body 'bob': `mass` must be finite", "bob"),
    "inertia": (
        lambda m: bob(m).inertia,
        jnp.array([1.0, 1.0, 3.0]),
        "Body 'bob': `inertia`.*is not that of a body",
        "'bob': inertia",
    ),
    "scaled": (
        lambda m: bob(m).orientation,
        1.5 * jnp.eye(3),
        "Body 'bob': `orientation`.*far from a rotation; leave it to the model",
        "'bob': orientation, far from a rotation",
    ),
    "reflected": (
        lambda m: bob(m).orientation,
        -jnp.eye(3),
        "Body 'bob': `orientation`.*far from a rotation",
        "'bob': orientation, far from a rotation",
    ),
    "NaN axis": (lambda m: m.joints["hinge"].axis, jnp.full(3, NAN), "Joint 'hinge': `axis` must be finite", "hinge"),
    "length": (lambda m: m.joints["rod"].length, jnp.asarray(-1.0), "Joint 'rod'.*`length` must be positive", None),
    "NaN stiffness": (lambda m: m.forces["spring"].stiffness, NAN, "Force 'spring': `stiffness`.*finite", "spring"),
    "a word": (lambda m: bob(m).mass, "heavy", "Body 'bob': `mass` must be a number", None),
}


def run(model):
    return lg.simulate(model, t1=0.1, num_steps=2)


@pytest.mark.parametrize("name", BAD)
def test_known_numbers_are_named(name):
    where, value, message, _ = BAD[name]
    with pytest.raises(ValueError, match=f"(?s){message}"):
        run(eqx.tree_at(where, scene(), value))


@eqx.filter_jit
def traced(model, t1):
    """One program: all of a model's numbers and the time are traced."""
    return lg.simulate(model, t1=t1, num_steps=2)


END = jnp.asarray(0.1)


def test_traced_numbers_end_a_run():
    """Values are NaN inside jit, the result says so, and what comes out names the element."""
    assert lg.raise_if_failed(traced(scene(), END)).result == lg.RESULTS.successful
    for name, (where, value, _, found) in BAD.items():
        if found is None:
            continue
        trajectory = traced(eqx.tree_at(where, scene(), jnp.asarray(value, float)), END)
        assert trajectory.result == lg.RESULTS.invalid_numbers, name
        assert np.all(np.isnan(trajectory.states.v))
        with pytest.raises(ValueError, match=f"(?s)not finite, or one that no body has.*Found:.*{found}"):
            lg.raise_if_failed(trajectory)


def test_traced_numbers_of_what_a_body_leaves_out_end_a_run():
    """A velocity out of the plane, a tilt of its axis or of a hinge, which would have no effect; round-off is none."""

    def run(spin, tilt, axis):
        rotated = jax.scipy.linalg.expm(tilt * jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]))
        bob = lg.RigidBody(1.0, (1.0, 1.0, 1.0), orientation=rotated, angular_velocity=spin, free="x y rz")
        hinge = lg.RevoluteJoint(None, "bob", at=(0.0, 0.0, 0.0), axis=axis)
        return lg.Model({"bob": bob}, {"hinge": hinge}).system().is_valid()

    spin, axis, nothing = jnp.array([0.0, 0.0, 2.0]), jnp.array([0.0, 0.0, 1.0]), jnp.asarray(0.0)
    off = jnp.array([1.0, 0.0, 0.0])
    valid = jax.jit(run)
    results = [
        bool(valid(*numbers))
        for numbers in (
            (spin + 1e-12 * off, nothing, axis + 1e-12 * off),  # far below the eight digits that rules ask for
            (spin + 0.1 * off, nothing, axis),
            (spin, nothing + 0.1, axis),
            (spin, nothing, axis + 0.1 * off),
        )
    ]
    assert results == [True, False, False, False]


def test_times_in_the_wrong_order():
    trajectory = traced(scene(), -10 * END)
    assert trajectory.result == lg.RESULTS.invalid_numbers
    with pytest.raises(ValueError, match=says("`t1` is not later than `t0`", "Found: t0 = 0 s, t1 = -1 s")):
        lg.raise_if_failed(trajectory)


@pytest.mark.slow  # two programs
def test_equilibrium_and_derivatives_of_bad_numbers():
    state = jax.jit(lambda mass: lg.equilibrium(eqx.tree_at(lambda m: bob(m).mass, scene(), mass)))(-1.0)
    assert np.all(np.isnan(state.v))
    build = lambda mass: eqx.tree_at(lambda m: bob(m).mass, scene(), mass)
    criterion = lg.Criterion(terminal=lambda s, p: s.body("bob").position[0])
    with pytest.raises(ValueError, match="one that no body has"):
        lg.differentiate(criterion, build, jnp.asarray(-1.0), t1=0.1, num_steps=2)


def test_an_optimizer_may_leave_the_rotations_a_little():
    turned = eqx.tree_at(lambda m: bob(m).orientation, scene(), jnp.eye(3) + 0.02)
    turned.system()  # which known numbers are checked by
    assert traced(turned, END).result == lg.RESULTS.successful


class Weight(lg.AbstractForce):
    """A force of one's own, whose numbers are as they are given."""

    acceleration: jax.Array
    share: float

    @property
    def bodies(self):
        return ()

    def loads(self, bodies):
        return lg.Gravity(self.share * self.acceleration).loads(bodies)


def test_a_loop_over_a_whole_model_is_traced_once():
    """Numbers that Model was given as weakly typed arrays or Python floats are neither left out nor traced again."""
    own = Weight(jnp.asarray(-9.81), 1.0)
    assert own.acceleration.weak_type
    model = lg.Model({"bob": bob(scene())}, {}, {"own": own})
    numbers, rest = eqx.partition(model, eqx.is_inexact_array)
    assert not jax.tree.leaves(rest)
    optimizer, traces = optax.adamw(1e-2, weight_decay=0.1), []

    @jax.jit
    def step(numbers, state):
        traces.append(0)
        slope = jax.grad(lambda m: sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(m)))(numbers)
        with jax.numpy_dtype_promotion("standard"):  # optax is less strict
            updates, state = optimizer.update(slope, state, numbers)
        return optax.apply_updates(numbers, updates), state

    state = optimizer.init(numbers)
    for _ in range(4):
        numbers, state = step(numbers, state)
    assert len(traces) == 1
    found = eqx.combine(numbers, rest).forces["own"]
    assert float(found.share) < 0.97 and not found.acceleration.weak_type  # four steps of 1e-2


def test_inertias_are_those_of_bodies():
    """By the eigenvalues, for random matrices, some of which no body has."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(200, 3, 3)))[0]
    moments = rng.uniform(-0.2, 1.0, size=(200, 3))
    inertia = np.einsum("nij,nj,nkj->nik", turn, moments, turn)
    slack = 0.1 * np.abs(inertia).max(axis=(1, 2))
    expected = moments.sum(axis=1) / 2 - moments.max(axis=1) >= -slack
    assert 20 < expected.sum() < 180
    np.testing.assert_array_equal(is_inertia(jnp.asarray(inertia)), expected)
    np.testing.assert_array_equal(is_inertia(inertia), expected)
    assert is_inertia(jnp.zeros((1, 3, 3)))[0]
    assert not far_from_rotation(turn[0] * np.linalg.det(turn[0])) and far_from_rotation(np.full((3, 3), np.nan))
