"""What several test modules need: random bodies and poses, differences, a scene with everything."""

import re
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.liegroups import Pose, R3xSO3
from lgsens.linear import programs_in
from lgsens.model import AbstractForce, AbstractLoad, Attached, Frame

EPS = float(np.finfo(np.float64).eps)
GRAVITY = (0.0, 0.0, -9.81)
# Of tests that a GPU, where JAX finds one, cannot pass: sizes of batches, equality bit by bit, what is not lowered.
on_a_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="says what holds on a CPU alone")


def some_quick(values: Iterable[Any], count: int = 1) -> list[Any]:
    """Parameters of a test, of which the quick run has so many; a tuple is several arguments."""
    several = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*own, marks=[pytest.mark.slow] * (i >= count)) for i, own in enumerate(several)]


def close(actual, expected, ulps, scale=None):
    """|actual − expected| ≤ `ulps` round-offs of the largest entry expected (or of `scale`)."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape
    size = np.abs(expected).max(initial=0.0) if scale is None else scale
    np.testing.assert_allclose(actual, expected, rtol=0, atol=ulps * EPS * size)


def factorizations(jaxpr) -> int:
    """How many LU factorizations are in a program, however deep."""
    return sum(equation.primitive.name == "lu" for equation in equations(jaxpr))


def random_rotation(rng) -> np.ndarray:
    return Rotation.from_quat(rng.normal(size=4)).as_matrix()


class PointMasses(NamedTuple):
    """A rigid body as points: the definition from which mass, inertia and kinetic energy follow."""

    masses: np.ndarray
    offsets: np.ndarray  # from the centre of mass, body frame

    @classmethod
    def random(cls, rng, count=6):
        masses, offsets = rng.uniform(0.3, 1.0, count), rng.normal(scale=0.5, size=(count, 3))
        return cls(masses, offsets - masses @ offsets / masses.sum())

    @property
    def inertia(self):
        squares = np.sum(self.offsets**2, axis=1)
        return np.einsum("n,n,ij->ij", self.masses, squares, np.eye(3)) - np.einsum(
            "n,ni,nj->ij", self.masses, self.offsets, self.offsets
        )


def random_body(rng, points: PointMasses | None = None, **kwargs) -> lg.RigidBody:
    """A body with full inertia matrix anywhere in a box of 2 m, in any orientation."""
    points = PointMasses.random(rng) if points is None else points
    kwargs = {"position": rng.uniform(-1, 1, 3), "orientation": random_rotation(rng)} | kwargs
    return lg.RigidBody(mass=points.masses.sum(), inertia=points.inertia, **kwargs)


def moved(frame: Frame, x) -> Frame:
    """The frame after x = [u, θ] by the retraction of the library (which tests/liegroups checks)."""
    return Frame(*R3xSO3().retract(Pose(*frame), x))


def moved_without_library(frame: Frame, x) -> Frame:
    """The same in NumPy and SciPy."""
    turned = np.asarray(frame.orientation) @ Rotation.from_rotvec(x[3:]).as_matrix()
    return Frame(np.asarray(frame.position) + x[:3], turned)


def displaced(pose: Pose, x) -> Pose:
    """All bodies of a system moved by x, shape (6 N,), in NumPy and SciPy."""
    frames = [moved_without_library(Frame(*each), w) for each, w in zip(zip(*pose), np.reshape(x, (-1, 6)))]
    return Pose(np.stack([f.position for f in frames]), np.stack([f.orientation for f in frames]))


def central_difference(function, dim, step=None):
    """The derivative of `function(x)` at x = 0, one column for each of `dim` coordinates.

    Error: step²/6 |f'''| + EPS |f| / step; with the default step EPS^(1/3) both are about 4e-11 of |f|.
    """
    step = EPS ** (1 / 3) if step is None else step
    columns = []
    for direction in np.eye(dim):
        ahead, behind = function(step * direction), function(-step * direction)
        columns.append((np.asarray(ahead) - np.asarray(behind)) / (2 * step))
    return np.stack(columns, axis=-1)


class Drag(AbstractLoad):
    """A load as a user writes it, without tangents: −c |ẋ| ẋ on b, and a moment −c Rᵀ sin(t) x."""

    coefficient: jnp.ndarray

    def force(self, a, b, va, vb, t):
        speed = jnp.sqrt(jnp.sum(vb[:3] ** 2))
        moment = b.orientation.T @ (jnp.sin(t) * b.position)
        return -self.coefficient * jnp.concatenate([jnp.zeros_like(va), speed * vb[:3], moment])


class DragForce(AbstractForce):
    """The force element of `Drag`."""

    body: str = eqx.field(static=True)
    coefficient: jnp.ndarray

    @property
    def bodies(self):
        return (self.body,)

    def loads(self, bodies):
        return (Attached(Drag(self.coefficient), None, self.body),)


BODIES = ("d", "b", "f", "a", "e", "c")  # not sorted, so that an order that depends on insertion shows


def everything(seed=0, order=BODIES) -> lg.Model:
    """Six bodies, every joint and every force element; 36 coordinates, 28 constraints."""
    rng = np.random.default_rng(seed)
    bodies = {}
    for name in BODIES:
        points = PointMasses.random(rng)
        motion = {"velocity": rng.normal(size=3), "angular_velocity": rng.normal(size=3)}
        bodies[name] = random_body(rng, points, **motion)
    at = lambda: rng.uniform(-1, 1, 3)
    axis = lambda: rng.normal(size=3)
    joints = {
        "ball": lg.SphericalJoint(None, "a", at=at()),
        "hinge": lg.RevoluteJoint("a", "b", at=at(), axis=axis()),
        "cardan": lg.UniversalJoint("c", "b", at=at(), axis_a=axis(), axis_b=axis()),
        "slider": lg.PrismaticJoint("f", None, at=at(), axis=axis()),
        "sleeve": lg.CylindricalJoint("a", "d", at=at(), axis=axis()),
        "weld": lg.FixedJoint("c", "e", at=at()),
        "rod": lg.DistanceJoint("e", "f", at_a=at(), at_b=at()),
    }
    bump = lg.BumpRoad(height=0.05, duration=0.25, start=0.1)
    forces = {
        "gravity": lg.Gravity(GRAVITY),
        "spring": lg.SpringDamper("a", "c", at_a=at(), at_b=at(), stiffness=50.0, damping=3.0, preload=-7.0),
        "anchor": lg.SpringDamper(None, "d", at_a=at(), at_b=at(), stiffness=40.0, damping=2.0, free_length=0.4),
        "stay": lg.SpringDamper("e", None, at_a=at(), at_b=at(), stiffness=30.0),
        "tyre": lg.TyreSpring("b", at=at(), stiffness=90.0, road=bump, preload=5.0),
        "track": lg.TyreSpring("f", at=at(), stiffness=70.0, road=bump, free_radius=0.3),
        "push": lg.AppliedForce("d", at=at(), force=axis(), moment=axis(), signal=bump),
        "pull": lg.AppliedForce("a", force=axis(), signal=bump),
        "drag": DragForce("c", jnp.asarray(0.3, dtype=float)),
    }
    return lg.Model({name: bodies[name] for name in order}, joints, forces)


class Point(NamedTuple):
    """Arguments of `AbstractSystem.residual`."""

    q: Pose
    v: np.ndarray
    vdot: np.ndarray
    lam: np.ndarray
    t: np.ndarray


def random_point(system, rng, t=0.17) -> Point:
    """A state near the reference that satisfies no constraint."""
    k, m = system.group.dim, len(system.constraint_names)
    q = displaced(system.pose, rng.normal(scale=0.3, size=k))
    q = Pose(*map(jnp.asarray, q))
    return Point(
        q,
        jnp.asarray(rng.normal(size=k)),
        jnp.asarray(rng.normal(size=k)),
        jnp.asarray(rng.normal(size=m)),
        jnp.asarray(t),
    )


def equations(jaxpr) -> Iterator[Any]:
    """The equations of a program, in all its parts."""
    for equation in jaxpr.eqns:
        yield equation
        for inner in programs_in(equation):
            yield from equations(inner)


def random_like(tree, rng):
    """Normal random numbers in the shapes of arrays."""
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), tree)


def says(*parts):
    """A pattern for a message with these parts, in this order."""
    return "(?s)" + ".*".join(re.escape(part) for part in parts)
