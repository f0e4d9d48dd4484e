"""The assembled system: tangents, mass and gyroscopic forces against definitions; order and stacking."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    BODIES,
    GRAVITY,
    PointMasses,
    central_difference,
    close,
    displaced,
    everything,
    on_a_cpu,
    random_body,
    random_point,
)

import lgsens as lg
from lgsens.dynamics import accelerations, autodiff_tangents
from lgsens.liegroups import Pose


@eqx.filter_jit
def evaluate(system, point):
    """What the system says, compiled once for the scene with everything."""
    return system.residual(*point), system.constraint(point.q, point.t), system.tangents(*point)


@eqx.filter_jit
def differentiated(system, point):
    return autodiff_tangents(system, *point)


@pytest.fixture(scope="module")
def system():
    return everything().system()


# Entries are sums of some ten terms, each of some ten products; the largest belongs to the terms themselves.
ULPS = 500


@pytest.mark.slow  # small version: test_tangents_equal_central_differences
@pytest.mark.parametrize("seed", range(3))
def test_tangents_equal_autodiff(system, seed):
    point = random_point(system, np.random.default_rng(seed))
    _, violation, tangents = evaluate(system, point)
    expected = differentiated(system, point)
    assert np.abs(violation).max() > 0.1  # a state off the constraints, where tangents are harder
    jax.tree.map(lambda x, y: close(x, y, ULPS), tangents, expected)


def test_tangents_equal_central_differences(system):
    point = random_point(system, np.random.default_rng(4))
    _, _, tangents = evaluate(system, point)

    def by_position(x):
        q = Pose(*map(jnp.asarray, displaced(point.q, x)))
        residual, value, _ = evaluate(system, point._replace(q=q))
        return np.concatenate([residual, value])

    def by_velocity(x):
        return evaluate(system, point._replace(v=point.v + x))[0]

    k = system.group.dim
    position, damping = central_difference(by_position, k), central_difference(by_velocity, k)
    # Residuals and their third derivatives are of order 100: 4e-11 × 100 (see `central_difference`), margin
    # of 10.
    np.testing.assert_allclose(tangents.stiffness, position[:k], rtol=0, atol=4e-8)
    np.testing.assert_allclose(tangents.constraint_jacobian, position[k:], rtol=0, atol=4e-8)
    np.testing.assert_allclose(tangents.damping, damping, rtol=0, atol=4e-8)


def test_mass_matrix_is_the_hessian_of_kinetic_energy():
    """Each body as six point masses that move with ẋ + R (Ω × X): nothing here knows what an inertia is."""
    rng = np.random.default_rng(1)
    points = {name: PointMasses.random(rng) for name in ("p", "q")}
    bodies = {name: random_body(rng, points[name]) for name in points}
    matrix = lg.Model(bodies).system().mass_matrix()

    def kinetic_energy(v):
        total = 0.0
        for name, twist in zip(sorted(points), v.reshape(-1, 2, 3)):
            arms = jnp.cross(twist[1], jnp.asarray(points[name].offsets), axisb=1)
            velocities = twist[:1] + arms @ bodies[name].orientation.T
            total += jnp.sum(points[name].masses * jnp.sum(velocities**2, axis=1)) / 2
        return total

    # T is quadratic, so the point does not matter; six masses, each of some ten operations.
    hessian = jax.jit(jax.hessian(kinetic_energy))(jnp.asarray(rng.normal(size=12)))
    close(matrix, hessian, 100)


def test_momentum_of_a_free_body_is_conserved():
    """d(R J Ω)/dt = 0 and ẍ = g, with v̇ from the equations of motion."""
    rng = np.random.default_rng(2)
    body = random_body(rng, velocity=rng.normal(size=3), angular_velocity=rng.normal(size=3))
    system = lg.Model({"stone": body}, {}, {"gravity": lg.Gravity(GRAVITY)}).system()
    q, v = system.reference()
    vdot, lam = jax.jit(lambda s: accelerations(s, q, v, jnp.zeros(())))(system)
    assert lam.shape == (0,)
    inertia, orientation = np.asarray(system.inertia[0]), np.asarray(q.orientation[0])
    spin, change = np.asarray(v[3:]), np.asarray(vdot[3:])
    rate = orientation @ (np.cross(spin, inertia @ spin) + inertia @ change)
    assert np.abs(np.cross(spin, inertia @ spin)).max() > 0.1  # a body that is not a ball
    # J⁻¹ amplifies by the condition of J
    close(rate, np.zeros(3), 50 * np.linalg.cond(inertia), scale=1.0)
    close(vdot[:3], GRAVITY, 4)


def test_gyroscopic_force_is_lagranges():
    """M v̇ + Ω × J Ω from T(x, θ, ẋ, θ̇) of R = R₀ exp(θ̃): d/dt ∂T/∂θ̇ − ∂T/∂θ at θ = 0."""
    rng = np.random.default_rng(3)
    points = PointMasses.random(rng)
    body = random_body(rng, points)
    system = lg.Model({"body": body}).system()
    v, vdot = rng.normal(size=6), rng.normal(size=6)
    residual = system.residual(system.pose, jnp.asarray(v), jnp.asarray(vdot), jnp.zeros(0), jnp.zeros(()))

    def place(x):  # the six points, with the exponential as its series: exact to third order at x = 0
        theta = x[3:]
        wedge = jnp.cross(jnp.eye(3), -theta, axisa=0, axisb=0, axisc=0)
        rotation = jnp.eye(3) + wedge + wedge @ wedge / 2 + wedge @ wedge @ wedge / 6
        return x[None, :3] + jnp.asarray(points.offsets) @ (body.orientation @ rotation).T

    def energy(x, xdot):
        velocities = jax.jvp(place, (x,), (xdot,))[1]
        return jnp.sum(points.masses * jnp.sum(velocities**2, axis=1)) / 2

    def lagrange(x, xdot, xddot):
        momentum = lambda x, xdot: jax.grad(energy, argnums=1)(x, xdot)
        _, rate = jax.jvp(momentum, (x, xdot), (xdot, xddot))
        return rate - jax.grad(energy)(x, xdot)

    # Ω = T(θ) θ̇ with T(0) = I and d/dt (T θ̇) = θ̈ at θ = 0, so v and v̇ are ẋ and ẍ there.
    expected = jax.jit(lagrange)(jnp.zeros(6), jnp.asarray(v), jnp.asarray(vdot))
    close(residual, expected, 200)


# Order.


@on_a_cpu  # bit by bit, and products elsewhere are rounded by where they are
def test_bodies_are_numbered_by_name_and_not_by_insertion(system):
    point = random_point(system, np.random.default_rng(5))
    model = everything()
    assert tuple(model.bodies) == BODIES != tuple(sorted(BODIES)) == system.body_names
    for i, name in enumerate(system.body_names):
        np.testing.assert_array_equal(system.mass[i], model.bodies[name].mass)
        np.testing.assert_array_equal(system.pose.position[i], model.bodies[name].position)
        np.testing.assert_array_equal(system.velocity[6 * i : 6 * i + 3], model.bodies[name].velocity)
    expected = evaluate(system, point)
    backwards = everything(order=BODIES[::-1])
    backwards = lg.Model(
        backwards.bodies,
        dict(reversed(list(backwards.joints.items()))),
        dict(reversed(list(backwards.forces.items()))),
    )
    through_jit = jax.jit(lambda model: model)(backwards)
    assert tuple(through_jit.bodies) == tuple(sorted(BODIES))
    for other in (backwards.system(), through_jit.system()):
        assert other.constraint_names == system.constraint_names
        # the same kernels on the same numbers
        jax.tree.map(np.testing.assert_array_equal, evaluate(other, point), expected)


def test_multipliers_of_a_joint(system):
    """Each joint finds its own rows: a unit multiplier on them loads its two bodies and no other."""
    joints = everything().joints
    sizes = {"ball": 3, "hinge": 5, "cardan": 4, "slider": 5, "sleeve": 4, "weld": 6, "rod": 1}
    rows = {name: system.multiplier_rows(name) for name in joints}
    assert {name: len(found) for name, found in rows.items()} == sizes
    assert sorted(np.concatenate(list(rows.values()))) == list(range(28))
    jacobian = np.asarray(evaluate(system, random_point(system, np.random.default_rng(6)))[2].constraint_jacobian)
    for name, joint in joints.items():
        loaded = np.abs(jacobian[rows[name]]).reshape(len(rows[name]), len(BODIES), 6).max(axis=(0, 2)) > 0
        assert {body for body, touched in zip(system.body_names, loaded) if touched} == {joint.a, joint.b} - {None}


# Stacking.


def chain(count) -> lg.Model:
    """`count` bodies on ball joints one below the other, a spring at each."""
    bodies, joints, forces = {}, {}, {"gravity": lg.Gravity(GRAVITY)}
    for i in range(count):
        name, above = f"link{i}", f"link{i - 1}" if i else None
        bodies[name] = lg.RigidBody(1.0, (0.1, 0.2, 0.2), position=(0.0, 0.0, -0.5 - i))
        joints[f"ball{i}"] = lg.SphericalJoint(above, name, at=(0.0, 0.0, -float(i)))
        forces[f"spring{i}"] = lg.SpringDamper(
            above, name, at_a=(0.3, 0.0, -float(i)), at_b=(0.3, 0.0, -0.5 - i), stiffness=10.0
        )
    return lg.Model(bodies, joints, forces)


def test_what_is_compiled_does_not_grow_with_the_number_of_elements():
    """One kernel for joints on the ground, one for those between bodies; as many operations in the jaxprs."""
    groups, operations = [], []
    for count in (2, 10):
        system = chain(count).system()
        q, v = system.reference()
        lam = jnp.zeros(3 * count)
        assert sum(len(stack.owners) for stack in system.constraints) == count
        groups.append((len(system.constraints), len(system.loads)))
        traced = [
            jax.make_jaxpr(lambda s, q, v, lam: s.residual(q, v, v, lam, 0.0))(system, q, v, lam),
            jax.make_jaxpr(lambda s, q, v, lam: s.tangents(q, v, v, lam, 0.0))(system, q, v, lam),
        ]
        operations.append([len(jaxpr.eqns) for jaxpr in traced])
    assert groups == [(2, 3), (2, 3)]  # weight is the third kind of load
    assert operations[0] == operations[1]


# Leaves.


def strongly_typed_floats(tree):
    leaves = jax.tree.leaves(tree)
    assert leaves
    return all(isinstance(x, jax.Array) and x.dtype == jnp.float64 and not x.weak_type for x in leaves)


def test_leaves_are_strongly_typed_floats(system):
    model = everything()
    assert strongly_typed_floats(model)
    assert strongly_typed_floats(system)
    others = lg.Model(  # ints, lists, NumPy arrays and weakly typed numbers become leaves of the same type
        {"block": lg.RigidBody(jnp.asarray(2.0), [1, 1, 1], position=np.arange(3), velocity=np.ones(3, np.float32))},
        {"rod": lg.DistanceJoint(None, "block", at_a=[0, 0, 3], at_b=[0, 1, 2], length=2)},
        {
            "spring": lg.SpringDamper("block", None, at_a=[0, 1, 2], at_b=[1, 1, 1], stiffness=3, preload=1),
            "tyre": lg.TyreSpring("block", at=[0, 1, 2], stiffness=3, road=lg.SampledRoad([0, 1], [0, 1])),
            "push": lg.AppliedForce("block", force=[1, 2, 3], signal=lg.BumpRoad(height=1, duration=2)),
        },
    )
    assert jnp.asarray(2.0).weak_type
    assert strongly_typed_floats(others)
    # What a gradient step gives is again such a model.
    updated = jax.jit(lambda model: jax.tree.map(lambda x, g: x - 0.1 * g, model, model))(model)
    assert jax.tree.structure(updated) == jax.tree.structure(model)
    assert strongly_typed_floats(updated)


def turned(angle):
    """About x."""
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]])


def test_scale_is_the_extent_of_the_scene():
    for size in (0.01, 3.0):
        bodies = {"l": lg.RigidBody(1.0, (1, 1, 1)), "r": lg.RigidBody(1.0, (1, 1, 1), position=(size, 0, 0))}
        expected = np.tile([size, size, size, 1.0, 1.0, 1.0], 2)
        close(lg.Model(bodies).system().coordinate_scale(), expected, 4)
        single = lg.Model({"l": bodies["l"]}, {"pivot": lg.SphericalJoint("l", None, at=(0.0, -size, 0.0))})
        close(single.system().coordinate_scale(), expected[:6], 4)
    alone = lg.Model({"l": bodies["l"]}).system().coordinate_scale()  # nothing in it has an extent
    np.testing.assert_array_equal(alone, np.ones(6))
    for far in (0.0, 1e3):  # what is fixed to the ground has the distance of the origin for an arm
        at = jnp.array([far, 0.0, 0.0])
        body = lg.RigidBody(1.0, (1, 1, 1), position=at)
        spring = lg.SpringDamper(None, "l", at_a=at + jnp.array([0.0, 0.0, 2.0]), at_b=at, stiffness=1.0)
        system = lg.Model({"l": body}, {}, {"spring": spring}).system()
        close(system.coordinate_scale(), np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0]), 4)
        close(system.distance(system.pose), max(far / 2.0, 1.0), 4)
    # a leaning disc that touches the ground at the origin: no extent, but for round-off, and its radius of gyration
    lean, radius = 0.05, 0.3
    at = radius * np.array([0.0, -np.sin(lean), np.cos(lean)])
    disc = lg.RigidBody(3.0, (0.0675, 0.135, 0.0675), position=at, orientation=turned(lean))
    contact = lg.Rolling("disc", at=at, axis=(0.0, np.cos(lean), np.sin(lean)), radius=radius)
    scale = lg.Model({"disc": disc}, {"contact": contact}).system().coordinate_scale()
    close(scale, np.r_[np.full(3, np.sqrt(0.27 / 3.0 / 3.0)), np.ones(3)], 4)
