"""A joint and a spring of one's own that say what the library asks of them: drawn, reduced, preloaded, carried over."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, random_body, random_point, says

import lgsens as lg
from lgsens.model import (
    AbstractConstraint,
    AbstractDynamicLoad,
    AbstractForce,
    AbstractJoint,
    AbstractLoad,
    Attached,
    Coordinate,
    Frame,
    body_fixed,
)
from lgsens.plotting._shapes import shapes
from lgsens.testing import check_force, check_joint

WEIGHT = 4.0 * 9.81
TURNED = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
TIP = jnp.array([0.5, 0.0, 0.0])


class Level(AbstractConstraint):
    """Two points are at the same height."""

    here: jax.Array = eqx.field(metadata=body_fixed("point", "a"))
    there: jax.Array = eqx.field(metadata=body_fixed("point", "b"))

    @property
    def num_rows(self):
        return 1

    def violable(self, free):
        return ("z" in free or bool(free & {"rx", "ry"}),)

    def value(self, a, b, t):
        return (b.point(self.there) - a.point(self.here))[2:]


class Plain(AbstractConstraint):
    """The same, which says nothing of itself."""

    level: Level

    @property
    def num_rows(self):
        return 1

    def value(self, a, b, t):
        return self.level.value(a, b, t)


class Table(AbstractJoint):
    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    plain: bool = eqx.field(static=True, default=False)

    @property
    def assembled(self):
        return True

    def constraints(self, a, b):
        level = Level(a.local_point(TIP), b.local_point(TIP))
        return (Plain(level) if self.plain else level,)


class StrapLoad(AbstractLoad):
    """A force along the line between two points that grows by k per metre."""

    here: jax.Array = eqx.field(metadata=body_fixed("point", "a"))
    there: jax.Array = eqx.field(metadata=body_fixed("point", "b"))
    stiffness: jax.Array
    length: jax.Array
    tension: jax.Array

    def measure(self, a, b, va, vb, t):
        return self.tension + self.stiffness * (jnp.linalg.norm(b.point(self.there) - a.point(self.here)) - self.length)

    def force(self, a, b, va, vb, t):
        d = b.point(self.there) - a.point(self.here)
        pull = self.measure(a, b, va, vb, t) * d / jnp.linalg.norm(d)
        moments = jnp.cross(self.here, a.local_axis(pull)), -jnp.cross(self.there, b.local_axis(pull))
        return jnp.concatenate([pull, moments[0], -pull, moments[1]])


class PlainLoad(AbstractLoad):
    strap: StrapLoad

    def measure(self, *arguments):
        return self.strap.measure(*arguments)

    def force(self, *arguments):
        return self.strap.force(*arguments)


class Strap(AbstractForce):
    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: jax.Array
    at_b: jax.Array
    preload: jax.Array
    plain: bool = eqx.field(static=True, default=False)

    @property
    def bodies(self):
        return (self.a, self.b)

    preload_shape = ()

    def loads(self, bodies):
        here, there = (
            at if name is None else bodies[name].frame.local_point(at)
            for name, at in ((self.a, self.at_a), (self.b, self.at_b))
        )
        length = jnp.linalg.norm(self.at_b - self.at_a)
        load = StrapLoad(here, there, jnp.asarray(100.0), length, self.preload)
        return (Attached(PlainLoad(load) if self.plain else load, self.a, self.b),)


def hung(*, plain=False, merge=False, **changes) -> lg.Model:
    """A beam with a plate fixed to it, 4 kg together, on a strap from its tip."""
    bodies = {
        "beam": lg.RigidBody(3.0, (0.1, 0.2, 0.2), position=(0.5, 0.0, 0.0), free="z"),
        "plate": lg.RigidBody(1.0, (0.1, 0.2, 0.2), position=(0.6, 0.0, 0.0), orientation=TURNED),
    }
    strap = Strap("plate", None, TIP, TIP + jnp.array([0.0, 0.0, 1.0]), jnp.asarray(0.0), plain)
    forces = {"gravity": lg.Gravity((0.0, 0.0, -9.81)), "strap": strap}
    return lg.Model(bodies, {"weld": lg.FixedJoint("beam", "plate", at=TIP)}, forces, merge_fixed=merge)


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("merge", [False, True])
def test_a_spring_of_ones_own_has_a_preload(plain, merge):
    loaded, unbalanced = lg.static_preload(hung(plain=plain, merge=merge), ("strap",))
    assert float(unbalanced) <= 1e-12 * WEIGHT
    # it hangs from the plate, and pulls there and at the ceiling
    close(loaded.forces["strap"].preload, WEIGHT, ulps=100)


class Half(AbstractConstraint):
    """A level that says of one of its points only that it is fixed to a body."""

    here: jax.Array = eqx.field(metadata=body_fixed("point", "a"))
    there: jax.Array

    @property
    def num_rows(self):
        return 1

    def value(self, a, b, t):
        return (b.point(self.there) - a.point(self.here))[2:]


@pytest.mark.slow
def test_what_an_element_says_of_its_numbers_is_checked():
    """On a part of a merged body a declared element is rewritten; others see the frame of the part."""
    check_joint(Level(TIP, -TIP)).raise_if_failed()
    assert {failure.compared for failure in check_joint(Half(TIP, -TIP)).failures} == {"on a part, in its frame"}


@pytest.mark.slow  # small version: test_a_spring_of_ones_own_has_a_preload
def test_what_a_load_says_of_its_numbers_is_checked():
    check_force(StrapLoad(TIP, -TIP, *jnp.arange(1.0, 4.0))).raise_if_failed()


def reduced(free, plain=False) -> lg.Model:
    return lg.Model({"slab": lg.RigidBody(1.0, (1.0, 1.0, 1.0), free=free)}, {"table": Table(None, "slab", plain)})


@pytest.mark.parametrize(("free", "rows"), [("x y rz", 0), ("x y", 0), ("x z ry", 1), ("x y z rx ry rz", 1)])
def test_a_joint_of_ones_own_loses_what_cannot_be_violated(free, rows):
    assert reduced(free).summary().equations == {"table": rows}
    assert reduced(free, plain=True).summary().equations == {"table": 1}  # it says nothing


def test_what_is_declared_is_drawn():
    table = shapes(reduced("x z ry").system())
    assert [mark.body for mark in table.joints] == [-1]
    np.testing.assert_array_equal(table.joints[0].at, TIP)
    link = [outline.points for outline in table.outlines if outline.role == "link"]
    np.testing.assert_array_equal(link, [[TIP, np.zeros(3)]])  # from where it is held to its centre of mass
    assert not shapes(reduced("x z ry", plain=True).system()).joints
    (strap,) = shapes(hung().system()).struts
    assert strap.role == "spring"
    assert not shapes(hung(plain=True).system()).struts


class Flat(AbstractConstraint):
    """A point of b stays in the xy-plane of a."""

    there: jax.Array

    @property
    def num_rows(self):
        return 1

    def value(self, a, b, t):
        return a.local_point(b.point(self.there))[2:]


class Sheet(AbstractJoint):
    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)

    def constraints(self, a, b):
        return (Flat(b.local_point(TIP)),)


class Slope(Sheet):
    """With a coordinate and frames: how much higher the frame on b is, in that on a."""

    coordinates = (Coordinate("climb", "m", lambda seen: seen.position[2]),)

    @property
    def frames(self):
        return Frame(TIP, jnp.eye(3)), Frame(2.0 * TIP, jnp.eye(3))


@pytest.mark.parametrize("kind", [Sheet, Slope])
def test_what_a_joint_of_ones_own_does(kind):
    """Any motion, any λ: F·(ẋ_b − ẋ_a at the point) + M·(ω_b − ω_a) = −λᵀB v; without frames at the centre of mass."""
    rng = np.random.default_rng(4)
    joint = kind("a", "b")
    model = lg.Model({name: random_body(rng) for name in "ab"}, {"table": joint})
    system = model.system()
    q, v, vdot, lam, t = random_point(system, rng)
    states = jax.tree.map(lambda leaf: leaf[None], lg.State(q, v, vdot, lam, vdot))
    run = lg.Trajectory(t=t[None], states=states, result=jnp.asarray(0), stats=None, system=system)
    found = run.joint("table")
    power, point = 0.0, np.asarray(found.point[0])
    for name, sign in (("a", -1.0), ("b", 1.0)):
        x, orientation, velocity, spin, *_ = (np.asarray(array[0]) for array in run.body(name))
        omega = orientation @ spin
        speed = velocity + np.cross(omega, point - x)
        power += sign * (np.asarray(found.force[0]) @ speed + np.asarray(found.moment[0]) @ omega)
    np.testing.assert_allclose(power, -float(lam @ system.constraint_jacobian(q, t) @ v), rtol=1e-12)
    if kind is Sheet:
        np.testing.assert_allclose(point, q.position[1], rtol=1e-14)
        assert found.coordinates == {}
    else:
        lifted = np.asarray(run.point("b", 2.0 * TIP).position - run.point("a", TIP).position)[0]
        a = model.bodies["a"]
        axes = np.asarray(q.orientation[0] @ a.orientation.T)
        np.testing.assert_allclose(found.coordinates["climb"], [lifted @ axes[:, 2]], rtol=1e-12)


class Chirp(lg.AbstractSignal):
    """As the docstring of `AbstractSignal` has it."""

    amplitude: jax.Array
    rate: jax.Array

    def __call__(self, t):
        return self.amplitude * jnp.sin(jnp.pi * self.rate * t**2)


class PushLoad(AbstractLoad):
    """A force f of the inertial frame on a point X of b, and its opposite on the same place of a, as `AbstractForce`
    says what a load returns."""

    vector: jax.Array
    point: jax.Array
    signal: lg.AbstractSignal

    def force(self, a, b, va, vb, t):
        f = self.signal(t) * self.vector
        place = b.point(self.point)
        moments = [jnp.cross(frame.local_point(place), frame.local_axis(f)) for frame in (a, b)]
        return jnp.concatenate([-f, -moments[0], f, moments[1]])


class Push(lg.AbstractForce):
    vector: jax.Array
    signal: lg.AbstractSignal

    @property
    def bodies(self):
        return ("a", "b")

    def loads(self, bodies):
        return (Attached(PushLoad(self.vector, bodies["b"].frame.local_point(TIP), self.signal), "a", "b"),)


def test_order_and_frames_of_a_force_of_ones_own():
    """Its power is f·(ẋ of the point on b − ẋ of the point on a), here with a signal of one's own."""
    rng = np.random.default_rng(2)
    bodies = {name: random_body(rng) for name in "ab"}
    vector, chirp = jnp.array([1.0, -2.0, 0.5]), Chirp(jnp.asarray(3.0), jnp.asarray(0.7))
    system = lg.Model(bodies, {}, {"push": Push(vector, chirp)}).system()
    point = random_point(system, rng, t=0.4)
    still = jnp.zeros_like(point.v)
    power = -float(point.v @ system.residual(point.q, still, still, point.lam, point.t))
    x, orientation, twist = (np.asarray(array) for array in (*point.q, point.v.reshape(2, 6)))
    b = bodies["b"]
    place = x[1] + orientation[1] @ np.asarray(b.orientation).T @ (np.asarray(TIP) - b.position)
    speed = [v[:3] + np.cross(R @ v[3:], place - origin) for v, R, origin in zip(twist, orientation, x)]
    f = 3.0 * np.sin(np.pi * 0.7 * 0.4**2) * np.asarray(vector)
    np.testing.assert_allclose(power, f @ (speed[1] - speed[0]), rtol=1e-12)


class Doubled(lg.SpringDamper):
    """Two of them: what a class of one's own says of its loads counts, not what its base class says of its load."""

    def loads(self, bodies):
        return 2 * super().loads(bodies)


def test_loads_of_a_spring_of_ones_own():
    body = {"mass": lg.RigidBody(2.0, (1.0, 1.0, 1.0), position=(0.0, 0.0, 1.5))}
    of = lambda kind: lg.Model(
        body, {}, {"s": kind(None, "mass", at_a=(0, 0, 0), at_b=(0, 0, 1.5), stiffness=100.0, free_length=1.0)}
    )
    falls = [lg.initial_state(of(kind)).vdot[2] for kind in (lg.SpringDamper, Doubled)]
    np.testing.assert_allclose(falls, [-25.0, -50.0], rtol=1e-14)


class NetLoad(AbstractLoad):
    """A network of position and velocity of b, as notebooks/own_elements.md has it where `static` is given."""

    params: Any
    static: Any = eqx.field(static=True, default=None)

    def force(self, a, b, va, vb, t):
        push = eqx.combine(self.params, self.static)(jnp.concatenate([b.position, vb]))
        return jnp.zeros(12).at[6:9].set(push)


class NetForce(AbstractForce):
    load: NetLoad
    bodies = property(lambda self: ("a",))

    def loads(self, bodies):
        return (Attached(self.load, None, "a"),)


@pytest.mark.slow
def test_a_network_as_a_force():
    """Its arrays are leaves and the rest is static; the message says so where it is given as it is."""
    net = eqx.nn.MLP(9, 3, 4, 1, activation=jnp.tanh, key=jax.random.key(0))
    scene = lambda load: lg.Model({"a": random_body(np.random.default_rng(0))}, {}, {"net": NetForce(load)})
    end = lambda load: lg.simulate(scene(load), t1=0.1, num_steps=4).body("a").position[-1, 0]
    parts = ("Force 'net': `load.params.activation` must be a number", "eqx.partition(net, eqx.is_inexact_array)")
    with pytest.raises(ValueError, match=says(*parts, "eqx.field(static=True)", "eqx.combine(params, static)")):
        end(NetLoad(net))
    params, static = eqx.partition(net, eqx.is_inexact_array)
    along = jax.tree.map(jnp.ones_like, params)
    slope = sum(jnp.sum(leaf) for leaf in jax.tree.leaves(jax.grad(lambda p: end(NetLoad(p, static)))(params)))
    at = lambda h: end(NetLoad(jax.tree.map(lambda leaf, one: leaf + h * one, params, along), static))
    np.testing.assert_allclose(slope, (at(1e-4) - at(-1e-4)) / 2e-4, rtol=1e-6)


def test_elements_that_return_other_shapes_are_named():
    """A rate of one number for two states would leave the second as it is, and an initial value would be both."""

    class Memory(AbstractDynamicLoad):
        states = ("fast", "slow")

        def force(self, a, b, va, vb, t, z):
            return jnp.zeros(12).at[6].set(z[1])

        def rate(self, a, b, va, vb, t, z):
            return -z

        def initial(self, a, b, va, vb, t):
            return jnp.ones(2)

    class Acts(AbstractForce):
        load: Any
        bodies = ("beam",)

        def loads(self, bodies):
            return (Attached(self.load, None, "beam"),)

    bodies = {"beam": lg.RigidBody(1.0, (0.1, 0.2, 0.2))}
    run = lambda joints, forces: jax.eval_shape(
        lambda: lg.simulate(lg.Model(bodies, joints, forces), t1=0.1, num_steps=2).t
    )
    one = lambda *args: jnp.ones(1)
    run({}, {"memory": Acts(Memory())})
    for method, shape, wrong in (("rate", 2, one), ("initial", 2, one), ("size", 2, one), ("force", 12, one)):
        load = type("Wrong", (Memory,), {method: wrong})()
        with pytest.raises(ValueError, match=says(f"Wrong.{method} must return", f"({shape},), got shape (1,)")):
            run({}, {"memory": Acts(load)})

    class Wide(Table):
        def constraints(self, a, b):
            return (type("Flat", (Level,), {"value": lambda self, a, b, t: b.position - a.position})(TIP, TIP),)

    with pytest.raises(ValueError, match=says("Flat.value must return its `num_rows` equations, shape (1,)", "(3,)")):
        run({"table": Wide(None, "beam")}, {})
