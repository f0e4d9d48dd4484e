"""Bodies with some of their degrees of freedom: the same mechanics as with all six, in fewer unknowns."""

from collections import Counter

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_scenes import (
    EQUATIONS,
    embedding,
    in_all_coordinates,
    mixed,
    planar_four_bar,
    random_free_point,
    with_all_freedoms,
)
from helpers import close, equations, everything

import lgsens as lg
from lgsens.dynamics import autodiff_tangents
from lgsens.liegroups import Poses, Power, R3xSO3

MIXED, POINTS = mixed()
WIDTHS = {"held": 0, "lift": 1, "planar": 3, "swing": 1, "top": 3, "whole": 6}  # in the order of their numbers


@eqx.filter_jit
def differentiated(system, point):
    return autodiff_tangents(system, *point)


@eqx.filter_jit
def evaluate(system, point):
    return system.residual(*point), system.constraint(point.q, point.t), system.tangents(*point), system.mass_matrix()


@pytest.fixture(scope="module")
def system():
    return MIXED.system()


# Entries are sums of some ten terms, each of some ten products; the largest belongs to the terms themselves.
ULPS = 500


def test_unknowns_are_the_free_coordinates(system):
    k, m = sum(WIDTHS.values()), sum(EQUATIONS.values())
    assert isinstance(system.group, Poses)
    assert system.group.dim == k == len(system.velocity) == len(system.coordinate_scale()) == 14
    assert [len(own) for own in system.free] == list(WIDTHS.values())
    assert Counter(system.constraint_names) == EQUATIONS and len(system.constraint_names) == m
    # 1 for angles; the translations of lift, planar (x and z) and whole have the length of the scene
    scale = np.asarray(system.coordinate_scale())
    np.testing.assert_array_equal(scale == 1.0, [False, False, False, True] + [True] * 4 + [False] * 3 + [True] * 3)


@pytest.mark.parametrize("seed", range(2))
def test_tangents_equal_autodiff(system, seed):
    point = random_free_point(system, np.random.default_rng(seed))
    _, violation, tangents, _ = evaluate(system, point)
    assert np.abs(violation).max() > 0.1
    expected = differentiated(system, point)
    jax.tree.map(lambda x, y: close(x, y, ULPS), tangents, expected)


@pytest.mark.slow  # `test_tangents_equal_autodiff` is in the quick run
def test_equations_are_those_of_six_coordinates_restricted(system):
    """r = Eᵀ r₆, M = Eᵀ M₆ E, B = B₆ E where the bodies can violate the equation and 0 elsewhere."""
    full = with_all_freedoms(MIXED).system()
    assert isinstance(full.group, Power)
    for seed in range(2):
        point = random_free_point(system, np.random.default_rng(10 + seed))
        E, six = embedding(system, point.q), in_all_coordinates(system, point)
        close(six.v, E @ point.v, 10, scale=10.0)
        residual, value, tangents, mass = evaluate(system, point)
        free_load = jnp.zeros(len(full.constraint_names))
        _, full_value, full_tangents, full_mass = evaluate(full, six._replace(lam=free_load))
        rows, full_rows = np.asarray(tangents.constraint_jacobian), np.asarray(full_tangents.constraint_jacobian) @ E
        lam, kept = np.zeros(len(full_rows)), np.zeros(len(full_rows), bool)
        for i, (name, row) in enumerate(zip(system.constraint_names, rows)):
            difference = np.abs(full_rows - row[None]).max(axis=1)
            own = np.asarray(full.constraint_names) == name
            (j,) = np.flatnonzero(own & (difference < 1e-12) & (np.abs(full_rows).max(axis=1) > 1e-3))
            lam[j], kept[j] = point.lam[i], True
            close(value[i], full_value[j], ULPS, scale=1.0)
        assert kept.sum() == len(rows) < len(full_rows)
        close(full_rows[~kept], np.zeros((sum(~kept), system.group.dim)), 20, scale=1.0)
        close(full_value[~kept], np.zeros(sum(~kept)), 20, scale=1.0)
        close(mass, E.T @ full_mass @ E, 50)
        full_residual = evaluate(full, six._replace(lam=jnp.asarray(lam)))[0]
        close(residual, E.T @ full_residual, ULPS, scale=np.abs(full_residual).max())


def test_mass_matrix_is_the_hessian_of_kinetic_energy(system):
    """Six point masses for each body, which move with the centre of mass: nothing here knows of a pivot's inertia."""
    q = system.pose

    def kinetic_energy(v):
        total = 0.0
        for i, name in enumerate(system.body_names):
            _, rotation, velocity, spin, _, _ = system.motion(i, q, v, v)
            arms = jnp.cross(spin, jnp.asarray(POINTS[name].offsets), axisb=1)
            velocities = velocity[None] + arms @ rotation.T
            total += jnp.sum(POINTS[name].masses * jnp.sum(velocities**2, axis=1)) / 2
        return total

    # T is quadratic, so the point does not matter; six masses, each of some ten operations.
    close(system.mass_matrix(), jax.jit(jax.hessian(kinetic_energy))(jnp.ones(system.group.dim)), 100)


# What is traced.


def shapes(jaxpr):
    """The shapes of all arrays in a jaxpr, also in those inside it."""
    return [getattr(variable.aval, "shape", ()) for each in equations(jaxpr) for variable in each.outvars]


def test_nothing_of_the_six_coordinates_is_traced():
    """Neither 6 N unknowns nor the equations that are dropped: every matrix is of size k and m."""
    model = planar_four_bar(pivots=False)  # 3 bodies, 9 coordinates, 8 equations
    system, full = model.system(), with_all_freedoms(model).system()
    sizes = {}
    for case in (system, full):
        k, m = case.group.dim, len(case.constraint_names)
        q, v, lam, t = case.pose, jnp.zeros(k), jnp.zeros(m), jnp.zeros(())
        traced = [
            jax.make_jaxpr(lambda s, q=q, v=v, lam=lam, t=t: s.residual(q, v, v, lam, t))(case),
            jax.make_jaxpr(lambda s, q=q, v=v, lam=lam, t=t: s.tangents(q, v, v, lam, t))(case),
            jax.make_jaxpr(lambda s: s.mass_matrix())(case),
            jax.make_jaxpr(lambda s, q=q: s.group.retract(q, s.group.tangent_mv(s.velocity, s.velocity)))(case),
        ]
        sizes[k, m] = {shape for jaxpr in traced for shape in shapes(jaxpr.jaxpr)}
    assert {(9, 9), (8, 9)} <= sizes[9, 8]
    assert {(18, 18), (20, 18)} <= sizes[18, 20]  # what the same joints ask of bodies with six coordinates
    matrices = [shape for shape in sizes[9, 8] if len(shape) > 1 and min(shape) > 1]  # (n, 1) are lists of places
    assert not any(18 in shape or 20 in shape for shape in matrices), matrices


def test_a_scene_of_free_bodies_is_as_before():
    """`Power` of all six coordinates, all equations of the joints, and no gather that picks among entries."""
    system = everything().system()
    assert system.group == Power(R3xSO3(), 6)
    assert system.centre is None
    assert all(all(kept) for stack in system.constraints for kept in stack.kept)
    np.testing.assert_array_equal(system.index.ravel(), np.arange(36))


def test_motion_of_bodies_and_what_elements_measure(system):
    """Velocity and acceleration of a centre of mass are the derivatives of its place along the motion."""
    point = random_free_point(system, np.random.default_rng(4))
    state = lg.State(q=point.q, v=point.v, vdot=point.vdot, lam=point.lam, a=point.vdot)
    instant = lg.Instant(point.t, state, system)

    def places(s):  # d²/ds² of exp(s Ω + s²/2 Ω̇) at 0 is Ω̃² + (Ω̇)~
        q = system.group.retract(point.q, s * point.v + s**2 * point.vdot / 2)
        return jnp.stack([system.motion(i, q, point.v, point.vdot)[0] for i in range(len(system.body_names))])

    rate = lambda f: lambda s: jax.jvp(f, (s,), (jnp.ones(()),))[1]
    place, velocity, acceleration = jax.jit(lambda s: (places(s), rate(places)(s), rate(rate(places))(s)))(
        jnp.zeros(())
    )
    for i, name in enumerate(system.body_names):
        motion = instant.body(name)
        close(motion.position, place[i], 10, scale=1.0)
        close(motion.velocity, velocity[i], 50, scale=10.0)
        close(motion.acceleration, acceleration[i], 100, scale=10.0)
    held = instant.body("held")
    np.testing.assert_array_equal(held.velocity, np.zeros(3))
    np.testing.assert_array_equal(held.angular_acceleration, np.zeros(3))
    top = MIXED.bodies["top"]
    close(system.motion(4, system.pose, point.v, point.v)[0], top.position, 10, scale=1.0)
    reach = np.linalg.norm(top.position - top.pivot)  # the centre of mass stays on a sphere
    close(np.linalg.norm(instant.body("top").position - top.pivot), reach, 20)
    # ℓ̇ of the spring is the derivative of its length
    spring = lambda *at: lg.model.measured(system, "spring", *jax.tree.map(lambda x: x[None], (*at, point.t)))
    length = lambda q, v: spring(q, v, state.vdot, state.lam)
    along = jax.jit(lambda s: length(system.group.retract(point.q, s * point.v), point.v).length[0])
    close(instant.force("spring").rate, jax.jvp(along, (jnp.zeros(()),), (jnp.ones(()),))[1], 100, scale=10.0)
