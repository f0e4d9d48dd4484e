"""A joint and a spring of one's own that say what the library asks of them: drawn, reduced, preloaded, carried over."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import close, random_rotation

import lgsens as lg
from lgsens.model import (
    AbstractConstraint,
    AbstractForce,
    AbstractJoint,
    AbstractLoad,
    Angle,
    Attached,
    BushingLoad,
    Coincidence,
    Distance,
    Frame,
    InPlane,
    Orthogonality,
    SpringDamperLoad,
    TyreLoad,
    body_fixed,
    constraint_jacobian,
    load_tangents,
)
from lgsens.model._carried import _CarriedConstraint, _CarriedLoad, carried
from lgsens.model._loads import PointForce
from lgsens.plotting._shapes import shapes

WEIGHT = 4.0 * 9.81
TURNED = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
TIP = jnp.array([0.5, 0.0, 0.0])


class Level(AbstractConstraint):
    """Two points are at the same height."""

    here: jax.Array = body_fixed("point", "a")
    there: jax.Array = body_fixed("point", "b")

    @property
    def num_rows(self):
        return 1

    def violable(self, free):
        return ("z" in free or bool(free & {"rx", "ry"}),)

    def value(self, a, b):
        return (b.point(self.there) - a.point(self.here))[2:]


class Plain(AbstractConstraint):
    """The same, which says nothing of itself."""

    level: Level

    @property
    def num_rows(self):
        return 1

    def value(self, a, b):
        return self.level.value(a, b)


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

    here: jax.Array = body_fixed("point", "a")
    there: jax.Array = body_fixed("point", "b")
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

    @property
    def preload_shape(self):
        return ()

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


def point(rng):
    return jnp.asarray(rng.standard_normal(3))


def pose(rng):
    return Frame(point(rng), jnp.asarray(random_rotation(rng)))


@pytest.mark.parametrize("body", ["a", "b"])
def test_on_a_part_as_in_its_frame(body):
    """Elements that declare what is fixed to bodies are rewritten for merged ones; others see the frame of the part."""
    rng = np.random.default_rng(0)
    a, b, part = pose(rng), pose(rng), pose(rng)
    parts = (part, None) if body == "a" else (None, part)
    va, vb = (jnp.asarray(rng.standard_normal(6)) for _ in "ab")
    matrix = jnp.diag(jnp.array([1.0, 2.0, 3.0]))
    constraints = [
        InPlane(point(rng), point(rng), point(rng)),
        Coincidence(point(rng), point(rng)),
        Orthogonality(point(rng), point(rng)),
        Distance(point(rng), point(rng), jnp.asarray(1.0)),
        Angle(*jnp.eye(3)[:2], jnp.eye(3)[0], jnp.asarray(0.3)),
        Level(point(rng), point(rng)),
    ]
    loads = [
        BushingLoad(point(rng), point(rng), matrix, 0.1 * matrix, point(rng)),
        SpringDamperLoad(point(rng), point(rng), *jnp.arange(1.0, 5.0)),
        TyreLoad(point(rng), *jnp.arange(1.0, 4.0), lg.FlatRoad()),
        PointForce(point(rng), point(rng), point(rng), lg.FlatRoad(height=1.0)),
        StrapLoad(point(rng), point(rng), *jnp.arange(1.0, 4.0)),
    ]

    @jax.jit
    def both(constraints, loads):
        rewritten = [carried(e, *parts) for e in (*constraints, *loads)]
        seen = [_CarriedConstraint(e, *parts) for e in constraints] + [_CarriedLoad(e, *parts) for e in loads]
        n = len(constraints)
        return [
            [
                *((e.value(a, b), constraint_jacobian(e, a, b)) for e in elements[:n]),
                *((e.force(a, b, va, vb, 0.0), *load_tangents(e, a, b, va, vb, 0.0)) for e in elements[n:]),
            ]
            for elements in (rewritten, seen)
        ]

    rewritten, seen = both(constraints, loads)
    for element, one, other in zip((*constraints, *loads), rewritten, seen):
        assert type(carried(element, *parts)) is type(element)
        for x, y in zip(one, other):
            x = 0.0 if x is None else x  # tangents that are zero
            np.testing.assert_allclose(x, y, atol=1e-12, err_msg=type(element).__name__)  # tens of terms of order 1


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
