"""Motions of merged bodies: those of one body to round-off, those of separate bodies to the order of the scheme."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import every_leaf
from helpers import GRAVITY, PointMasses, close, equations, random_rotation

import lgsens as lg
from lgsens.linear import programs_in

ORIGIN = (0.0, 0.0, 0.0)
SPIN = np.array([1.0, -2.0, 4.0])  # inertial frame
LAST = np.array([0.9, 0.4, 0.6])


def union(parts):
    """The point masses of bodies, (points, position, orientation) each, as those of one body in the inertial frame."""
    masses = np.concatenate([points.masses for points, _, _ in parts])
    places = np.concatenate([position + points.offsets @ orientation.T for points, position, orientation in parts])
    centre = masses @ places / masses.sum()
    return PointMasses(masses, places - centre), centre


def top(count=3):
    """A top of `count` fixed parts, held by a ball joint and a spring; and the same as one body, from its point masses.

    The body frame of the latter is that of the first part.
    """
    rng = np.random.default_rng(7)
    place = lambda: np.array([0.2, 0.1, 0.3]) + 0.3 * rng.normal(size=3)
    given = [(PointMasses.random(rng), place(), random_rotation(rng)) for _ in range(count)]
    bodies, joints = {}, {}
    for i, (points, position, orientation) in enumerate(given):
        bodies[f"part{i}"] = lg.RigidBody(
            points.masses.sum(),
            points.inertia,
            position,
            orientation,
            velocity=np.cross(SPIN, position),
            angular_velocity=orientation.T @ SPIN,
        )
        if i:
            joints[f"weld{i}"] = lg.FixedJoint(f"part{i - 1}", f"part{i}", at=position)
    points, centre = union(given)
    turned = given[0][2]
    whole = lg.RigidBody(
        points.masses.sum(),
        PointMasses(points.masses, points.offsets @ turned).inertia,
        centre,
        turned,
        velocity=np.cross(SPIN, centre),
        angular_velocity=turned.T @ SPIN,
    )

    def held(first, last):
        bump = lg.BumpRoad(height=1.0, duration=0.6, start=-0.1)
        ends = {"at_a": (0.0, 1.0, 1.0), "at_b": LAST}
        return {
            "gravity": lg.Gravity(GRAVITY),
            "spring": lg.SpringDamper(None, last, stiffness=40.0, damping=1.0, free_length=0.8, **ends),
            "push": lg.AppliedForce(first, at=LAST, force=(1.0, 2.0, 3.0), signal=bump),
        }

    pivot = lambda name: {"pivot": lg.SphericalJoint(None, name, at=ORIGIN)}
    parts = lg.Model(bodies, joints | pivot("part1"), held("part0", f"part{count - 1}"), merge_fixed=True)
    return parts, lg.Model({"top": whole}, pivot("top"), held("top", "top"))


@pytest.mark.slow
def test_motion_is_that_of_the_one_body():
    merged, whole = top()
    assert merged.system().body_names == ("part0 + part1 + part2",)
    found, expected = (lg.simulate(model, t1=0.5, num_steps=50) for model in (merged, whole))
    one = expected.body("top")
    for name, part in merged.bodies.items():
        motion = found.body(name)
        # the scheme adds up the round-off of its steps, 1e-16/(βh²) = 4e-12 in accelerations, with digits lost
        np.testing.assert_allclose(motion.position, one.point(part.position), rtol=0, atol=1e-12)
        turn = np.asarray(one.orientation[0]).T @ np.asarray(part.orientation)
        np.testing.assert_allclose(motion.orientation, one.orientation @ turn, rtol=0, atol=1e-12)
        np.testing.assert_allclose(motion.angular_velocity, one.angular_velocity @ turn, rtol=0, atol=1e-11)
        swing = np.cross(np.einsum("nij,nj->ni", one.orientation, one.angular_velocity), motion.position - one.position)
        np.testing.assert_allclose(motion.velocity, one.velocity + swing, rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.multiplier("pivot"), expected.multiplier("pivot"), rtol=0, atol=1e-8)
    for actual, wanted in zip(found.force("spring"), expected.force("spring")):
        np.testing.assert_allclose(actual, wanted, rtol=0, atol=1e-10)


def operations(jaxpr):
    """Every operation in a jaxpr with the shapes it works on, also in those inside it."""
    for equation in equations(jaxpr):
        # what holds other operations may pass numbers on, those of the parts too
        holds = list(programs_in(equation))
        yield equation.primitive.name, *([] if holds else [getattr(v.aval, "shape", ()) for v in equation.outvars])


def test_nothing_of_the_parts_is_traced():
    """The programs of the equations of motion and of a simulation are those of the one body, operation by operation."""
    cases = [model.system() for model in top()]
    assert [case.group.dim for case in cases] == [6, 6]
    programs = []
    for case in cases:
        q, v, lam, t = case.pose, jnp.zeros(6), jnp.zeros(3), jnp.zeros(())
        traced = [
            jax.make_jaxpr(lambda s, q=q, v=v, lam=lam, t=t: s.residual(q, v, v, lam, t))(case),
            jax.make_jaxpr(lambda s, q=q, v=v, lam=lam, t=t: s.tangents(q, v, v, lam, t))(case),
            jax.make_jaxpr(lambda s: lg.simulate(s, t1=0.1, num_steps=4, throw=False).states)(case),
        ]
        programs.append([Counter(operations(program.jaxpr)) for program in traced])
    assert programs[0] == programs[1]
    assert all(sum(program.values()) > 50 for program in programs[0])


@pytest.mark.slow
def test_motion_tends_to_that_of_separate_bodies():
    """Two discretizations of one motion: their difference falls by four with half the step."""
    merged, _ = top(count=2)
    separate = lg.Model(merged.bodies, merged.joints, merged.forces)
    gaps = []
    for num_steps in (40, 80):
        one, other = (lg.simulate(model, t1=0.4, num_steps=num_steps) for model in (merged, separate))
        every = num_steps // 40
        gaps.append(
            [
                np.abs(one.body("part1").position - other.body("part1").position)[::every].max(),
                # the multipliers of the weld, after the first steps
                np.abs(one.multiplier("weld1") - other.multiplier("weld1"))[10 * every :: every].max(),
            ]
        )
    coarse, fine = np.array(gaps)
    assert np.all((coarse > 1e-7) & (coarse < 1e-1))
    assert np.all((coarse / fine > 3.0) & (coarse / fine < 5.0))


@pytest.mark.slow
def test_gradients_by_every_number():
    """DDM = AVM = differences, also of what a weld carries, by every number of every part and joint."""
    merged, _ = top(count=2)

    def psi(model, sensitivity):
        trajectory = lg.simulate(model, t1=0.3, num_steps=15, sensitivity=sensitivity)
        force = trajectory.multiplier("weld1") @ jnp.array([1.0, -0.5, 0.3, 2.0, 1.0, -1.0])
        place = trajectory.body("part0").position @ jnp.array([1.0, 2.0, 3.0])
        return lg.time_integral(trajectory.t, force + place**2 + trajectory.body("part1").acceleration[:, 1])

    value, direct = jax.jit(jax.value_and_grad(lambda model: psi(model, lg.DirectDifferentiation())))(merged)
    adjoint = jax.jit(jax.grad(lambda model: psi(model, lg.AdjointVariable())))(merged)
    scale = max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(direct))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-11 * scale), adjoint, direct)
    function = jax.jit(lambda model: psi(model, lg.DirectDifferentiation()))
    found = every_leaf(function, merged, direct, lambda name, leaf: 2e-3 * max(1.0, float(np.abs(leaf).max())))
    for name, (gradient, estimate) in found.items():
        # sixth order: (2e-3)⁶ = 6e-17 of the seventh derivative; round-off 1e-12 of Ψ over 2e-3
        np.testing.assert_allclose(gradient, estimate, rtol=1e-8, atol=1e-8 * scale, err_msg=name)
    assert {name for name, (gradient, _) in found.items() if np.abs(gradient).max() < 1e-6} == set()
    assert np.isfinite(value)


@pytest.mark.slow
def test_equilibrium_preload_and_ground():
    """A bar of two parts, one of which a spring holds; its support and a weight on it are fixed to the ground."""
    bodies = {
        "bar": lg.RigidBody(2.0, (0.01, 0.7, 0.7), position=(1.0, 0.0, 0.0)),
        "tip": lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=(2.0, 0.0, 0.0)),
        "post": lg.RigidBody(5.0, (1.0, 1.0, 1.0), position=(0.0, 0.0, -1.0), velocity=(1.0, 0.0, 0.0)),
        "load": lg.RigidBody(3.0, (1.0, 1.0, 1.0), position=(0.0, 1.0, -1.0)),
    }
    joints = {
        "hinge": lg.RevoluteJoint("post", "bar", at=ORIGIN, axis=(0.0, 1.0, 0.0)),
        "weld": lg.FixedJoint("bar", "tip", at=(1.5, 0.0, 0.0)),
        "foot": lg.FixedJoint(None, "post", at=(0.0, 0.0, -2.0)),
        "strap": lg.FixedJoint("post", "load", at=(0.0, 0.5, -1.0)),
    }
    forces = {
        "gravity": lg.Gravity(GRAVITY),
        "spring": lg.SpringDamper("post", "bar", at_a=(1.5, 0.0, -1.0), at_b=(1.5, 0.0, 0.0), stiffness=400.0),
        "push": lg.AppliedForce("load", force=(0.0, 0.0, -7.0)),
    }
    model = lg.Model(bodies, joints, forces, merge_fixed=True)
    assert (model.summary().coordinates, model.summary().constraints) == (6, 5)
    loaded, unbalanced = lg.static_preload(model, ("spring",))
    close(unbalanced, 0.0, 100, scale=40.0)
    pull = -(2.0 * 9.81 * 1.0 + 1.0 * 9.81 * 2.0) / 1.5
    close(loaded.forces["spring"].preload, pull, 20)
    rest = lg.simulate(loaded, t1=0.1, num_steps=5)
    close(rest.body("tip").position[-1], (2.0, 0.0, 0.0), 1000)
    close(rest.body("post").velocity[0], ORIGIN, 1)
    # λ is the force of b on a: of the tip on the bar its weight, with its moment about the weld
    weld = np.asarray(rest.multiplier("weld")[0])
    np.testing.assert_allclose(weld[:3], (0.0, 0.0, -9.81), rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.abs(weld[3:]).max(), 9.81 * 0.5, rtol=1e-10)
    np.testing.assert_allclose(rest.multiplier("strap")[0, :3], (0.0, 0.0, -3.0 * 9.81 - 7.0), rtol=0, atol=1e-10)
    # the ground carries everything
    np.testing.assert_allclose(rest.multiplier("foot")[0, :3], (0.0, 0.0, -11.0 * 9.81 - 7.0), rtol=0, atol=1e-9)
    settled = lg.equilibrium(model)
    motion = lg.Instant(jnp.zeros(()), settled, model.system()).body("tip")
    assert -0.3 < float(motion.position[2]) < -0.05


@pytest.mark.slow
def test_transformations_and_saved_runs():
    """`vmap` of a gradient over designs, with a weld asked for in `save`; and in a `Criterion`."""
    merged, _ = top(count=2)

    def scene(mass):
        tip = merged.bodies["part1"]
        part = lg.RigidBody(mass, tip.inertia, tip.position, tip.orientation, tip.velocity, tip.angular_velocity)
        return lg.Model(merged.bodies | {"part1": part}, merged.joints, merged.forces, merge_fixed=True)

    asked = lambda s: s.multiplier("weld1")
    run = lambda mass: lg.simulate(scene(mass), t1=0.1, num_steps=5, save=asked).values[-1, 2]
    masses = jnp.array([1.0, 2.0])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(run)))(masses)
    criterion = lg.Criterion(terminal=lambda s, p: s.multiplier("weld1")[2])
    found = lg.differentiate(criterion, scene, masses[0], t1=0.1, num_steps=5, method=lg.DirectDifferentiation())
    np.testing.assert_allclose([values[0], slopes[0]], [found.value, found.gradient], rtol=1e-9)


@pytest.mark.slow
def test_states_are_those_of_the_merged_body():
    """A simulation continues from its last state, and other names are refused as ever."""
    merged, _ = top(count=2)
    first = lg.simulate(merged, t1=0.1, num_steps=4)
    assert first.states.v.shape == (5, 6)
    on = lg.simulate(merged, t0=0.1, t1=0.2, num_steps=4, state0=first.state(-1))
    close(on.body("part0").position[0], first.body("part0").position[-1], 4)
    close(on.multiplier("weld1")[0], first.multiplier("weld1")[-1], 4)
    with pytest.raises(ValueError, match=r"`body`: 'part0 \+ part1' is not one of"):
        first.body("part0 + part1")
