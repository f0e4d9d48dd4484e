"""Motions of bodies with some of their degrees of freedom: those of bodies with all six, and derivatives of both."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from free_scenes import about_y, planar_four_bar
from helpers import close

import lgsens as lg
from lgsens.dynamics import accelerations
from lgsens.examples import QuarterCar, four_bar


def simulate(model, t1=0.5, num_steps=100):
    return lg.simulate(model, t1=t1, num_steps=num_steps)


def test_planar_body_flies():
    """ẍ = g and a constant spin, which the scheme integrates exactly."""
    body = lg.RigidBody(
        2.0, (0.3, 0.5, 0.4), (0.1, 0.2, 0.3), velocity=(1.0, 0, 2.0), angular_velocity=(0, -3.0, 0), free="x z ry"
    )
    trajectory = simulate(lg.Model({"body": body}, {}, {"gravity": lg.Gravity((0.0, 5.0, -9.81))}), num_steps=20)
    motion, t = trajectory.body("body"), np.asarray(trajectory.t)
    assert trajectory.states.v.shape == (21, 3)
    # twenty steps, each of a few roundings of numbers up to 5
    path = np.stack([0.1 + t, 0.2 + 0 * t, 0.3 + 2 * t - 9.81 * t**2 / 2], axis=1)
    close(motion.position, path, 200, scale=5.0)
    close(motion.velocity[:, 2], 2 - 9.81 * t, 200, scale=5.0)
    close(motion.orientation, np.stack([about_y(-3 * s) for s in t]), 200)


@pytest.fixture(scope="module")
def linkages():
    """The four-bar linkage in 18, 9 and 5 coordinates."""
    scenes = {18: four_bar(), 9: planar_four_bar(pivots=False), 5: planar_four_bar(pivots=True)}
    assert {k: (s.system().group.dim, len(s.system().constraint_names)) for k, s in scenes.items()} == {
        18: (18, 17),
        9: (9, 8),
        5: (5, 4),
    }
    return scenes


@pytest.mark.slow
def test_planar_linkage_moves_as_in_space(linkages):
    space, plane, pivots = (simulate(linkages[k]) for k in (18, 9, 5))
    for name in ("crank", "coupler", "rocker"):
        for field, actual, expected in zip(lg.BodyMotion._fields, plane.body(name), space.body(name)):
            # The discrete equations are the same but for rows and columns of zeros. A step is solved to a
            # round-off of 1e-16 in positions, of 1e-16/h in velocities and 2e-16/(βh²) = 3e-11 in accelerations (up to
            # 200 m/s²), of which the double root −ρ∞ adds up 1/(1 − ρ∞)² = 100, in each of a few digits lost.
            tolerance = 1e-7 if "acceleration" in field else 1e-11
            np.testing.assert_allclose(actual, expected, rtol=0, atol=tolerance, err_msg=f"{name} {field}")
    # the pins carry the same forces in the plane
    np.testing.assert_allclose(plane.multiplier("B"), space.multiplier("B")[:, :2], rtol=0, atol=1e-7)
    assert plane.multiplier("C").shape == (101, 2)
    # A body on a pivot is another discretization of the same motion: second order. Same times, half the step.
    finer = [simulate(linkages[k], t1=0.25) for k in (9, 5)]
    gap = lambda one, other: np.abs(one.body("coupler").position - other.body("coupler").position)
    coarse, fine = gap(plane, pivots)[:51].max(), gap(*finer)[::2].max()
    assert 1e-9 < coarse < 1e-2
    assert 3.0 < coarse / fine < 5.0


def test_accelerations_on_a_pivot_are_those_on_a_joint(linkages):
    """v̇ is a matter of the equations and not of the scheme: equal to round-off."""

    @jax.jit
    def start(system):
        q, v = system.reference()
        return q, v, accelerations(system, q, v, jnp.zeros(()))[0]

    space, pivots = linkages[18].system(), linkages[5].system()
    assert space.body_names == pivots.body_names
    for i in range(3):
        for expected, actual in zip(space.motion(i, *start(space)), pivots.motion(i, *start(pivots))):
            close(actual, expected, 4000, scale=100.0)  # accelerations up to 100 m/s², matrices of condition up to 1e3


def test_equilibrium_and_preload_of_reduced_bodies():
    """A bar on a pivot, held level by a spring: m g L/2 = F a; released, it comes to rest where moments balance."""
    bar = lg.RigidBody(2.0, (0.01, 0.7, 0.7), position=(1.0, 0.0, 0.0), free="ry", pivot=(0.0, 0.0, 0.0))
    lift = lg.RigidBody(3.0, (1.0, 1.0, 1.0), position=(0.0, 2.0, 0.0), free="z")
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -9.81)),
        "spring": lg.SpringDamper(None, "bar", at_a=(1.5, 0.0, 1.0), at_b=(1.5, 0.0, 0.0), stiffness=400.0),
        "hanger": lg.SpringDamper(None, "lift", at_a=(0.0, 2.0, 1.0), at_b=(0.0, 2.0, 0.0), stiffness=300.0),
    }
    model = lg.Model({"bar": bar, "lift": lift}, {}, forces)
    loaded, unbalanced = lg.static_preload(model, ("spring", "hanger"))
    close(unbalanced, 0.0, 100, scale=30.0)
    close(loaded.forces["spring"].preload, 2.0 * 9.81 / 1.5, 20)
    close(loaded.forces["hanger"].preload, 3.0 * 9.81, 20)
    rest = lg.equilibrium(model)
    system = model.system()
    close(rest.q.position[1], (0.0, 2.0, -3.0 * 9.81 / 300.0), 100, scale=1.0)
    assert float(jnp.abs(system.residual(rest.q, rest.v, rest.v, rest.lam, jnp.zeros(()))).max()) < 1e-9  # of 30 N m
    assert 0.0 < float(rest.q.orientation[0][0, 2]) < 0.1  # 20 N m against 900 N m/rad


# The quarter-car.

CAR = QuarterCar.load()
DESIGN = {"free_length": 0.31, "free_radius": 0.32}


@pytest.fixture(scope="module")
def cars():
    """The car over the first 0.2 s of a bump, and the derivative of its motion by the spring rate, by chassis."""

    def ride(rate, chassis):
        car = eqx.tree_at(lambda car: car.spring.rate, CAR, rate)
        trajectory = lg.simulate(car.model(chassis=chassis, **DESIGN), t1=0.2, num_steps=20)
        chassis, wheel = trajectory.body("chassis"), trajectory.body("wheel")
        return chassis.position, wheel.position, chassis.acceleration, trajectory.force("tyre")

    def both(rate, chassis):
        return jax.jvp(lambda rate: ride(rate, chassis), (rate,), (jnp.ones(()),))

    return [jax.jit(both, static_argnums=1)(CAR.spring.rate, chassis) for chassis in ("guided", "heave")]


@pytest.mark.slow
def test_heaving_chassis_is_the_guided_one(cars):
    guided, heave = cars
    # The same discrete equations. Steps are solved to round-off: 1e-16 m in positions and 1e-16/h² = 1e-12 m/s² in
    # accelerations at h = 10 ms, with the condition 5e2 of the iteration matrix and 20 steps. In the derivatives the
    # same, relative to their size.
    for actual, expected in zip(jax.tree.leaves(heave), jax.tree.leaves(guided)):
        largest = np.abs(expected).max()
        assert largest > 0
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-9 * largest)


def test_reduced_quarter_car():
    """19 coordinates and 16 equations instead of 48 and 45; mass, its centre and the static forces are the same."""
    full, reduced = CAR.model(**DESIGN), CAR.model(chassis="heave", links="rods")
    summary = reduced.summary()
    assert (summary.coordinates, summary.constraints, summary.degrees_of_freedom) == (19, 16, 3)
    assert (full.summary().coordinates, full.summary().constraints) == (48, 45)
    locked = CAR.model(wheel="locked", chassis="heave", links="rods", **DESIGN).summary()
    assert (locked.coordinates, locked.constraints, locked.degrees_of_freedom) == (19, 17, 2)
    rods = set(CAR.links) - {CAR.spring.link}
    assert CAR.spring.link == CAR.damper.link and CAR.spring.link in reduced.bodies
    assert not rods & set(reduced.bodies)
    assert all(isinstance(reduced.joints[name], lg.DistanceJoint) for name in rods)
    total = {}
    for name, model in (("full", full), ("reduced", reduced)):
        masses = np.array([body.mass for body in model.bodies.values()])
        places = np.array([body.position for body in model.bodies.values()])
        total[name] = np.array([masses.sum(), *(masses @ places)])
    close(total["reduced"], total["full"], 20)
    # The reference's free length and radius are printed with 12 digits: 1e-12 m × 1.5e5 N/m
    at_rest = json.loads((Path(__file__).parents[1] / "data" / "five_link_quarter_car.json").read_text())["states"][0]
    np.testing.assert_allclose(reduced.forces["spring"].preload, at_rest["spring_force_tension"], rtol=1e-10)
    np.testing.assert_allclose(reduced.forces["tyre"].preload, at_rest["tire_normal_force"], rtol=1e-10)
    # the knuckle with half of each rod as a point mass at its joint: J about the centre of mass of all
    knuckle, part = reduced.bodies["knuckle"], CAR.knuckle
    points = [(float(CAR.links[name].mass) / 2, np.asarray(CAR.links[name].knuckle)) for name in rods]
    expected = np.diag(part.inertia)
    for mass, place in [(float(part.mass), np.asarray(part.centre)), *points]:
        arm = place - np.asarray(knuckle.position)
        expected = expected + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    close(knuckle.inertia_matrix, expected, 20)


# Derivatives.


def swinging(length, pivot, rate):
    """A crank on a pivot, a rod on it in the plane, and a spring."""
    pin, end = pivot + jnp.array([0.6, 0.0, 0.0]), pivot + jnp.stack([0.6 + 0 * length, 0 * length, -length])
    bodies = {
        "crank": lg.RigidBody(
            1.0, (0.1, 0.2, 0.2), (pivot + pin) / 2, angular_velocity=(0, 2.0, 0), free="ry", pivot=pivot
        ),
        "rod": lg.RigidBody(0.5, (0.1, 0.1, 0.1), (pin + end) / 2, velocity=(0, 0, -1.2), free="x z ry"),
    }
    spring = lg.SpringDamper("rod", None, at_a=end, at_b=(1.5, 0.0, -1.0), stiffness=rate, damping=0.3, free_length=0.2)
    forces = {"gravity": lg.Gravity((0.0, 0.0, -9.81)), "spring": spring}
    return lg.Model(bodies, {"pin": lg.SphericalJoint("crank", "rod", at=pin)}, forces)


@pytest.mark.slow
def test_gradients_of_reduced_bodies():
    """DDM = AVM = central differences, also by the place of a pivot."""
    parameters = jnp.asarray(0.8), jnp.array([0.1, 0.0, 0.2]), jnp.asarray(12.0)

    def psi(sensitivity, *parameters):
        trajectory = lg.simulate(swinging(*parameters), t1=0.5, num_steps=25, sensitivity=sensitivity)
        rod, crank = trajectory.body("rod"), trajectory.body("crank")
        integrand = rod.acceleration[:, 0] ** 2 + 10 * crank.position[:, 2] + trajectory.multiplier("pin")[:, 1] ** 2
        return lg.time_integral(trajectory.t, integrand)

    value = jax.jit(lambda *p: psi(lg.DirectDifferentiation(), *p))
    direct = jax.jit(jax.jacfwd(lambda *p: psi(lg.DirectDifferentiation(), *p), argnums=(0, 1, 2)))(*parameters)
    adjoint = jax.jit(jax.grad(lambda *p: psi(lg.AdjointVariable(), *p), argnums=(0, 1, 2)))(*parameters)
    for forward, reverse in zip(direct, adjoint):
        # transposes of one another, each of 25 solves of condition 1e3 and accelerations of 1e-16/h² = 3e-13
        np.testing.assert_allclose(reverse, forward, rtol=1e-9, atol=1e-9 * max(map(lambda x: np.abs(x).max(), direct)))
    step = 1e-4
    for i, unit in ((0, 1.0), (1, jnp.array([1.0, 0.0, 0.0])), (1, jnp.array([0.0, 0.0, 1.0])), (2, 10.0)):
        moved = lambda s, i=i, unit=unit: value(*(p + s * unit if j == i else p for j, p in enumerate(parameters)))
        slope = (8 * (moved(step) - moved(-step)) - (moved(2 * step) - moved(-2 * step))) / (12 * step)
        # fourth order: step⁴ = 1e-16 of the fifth derivative; round-off 1e-13/step of Ψ
        np.testing.assert_allclose(slope, np.sum(direct[i] * unit), rtol=1e-7, atol=1e-7)
    assert all(np.abs(np.asarray(g)).max() > 1e-3 for g in direct)
    # moving everything sideways out of the plane changes nothing
    assert float(direct[1][1]) == pytest.approx(0.0, abs=1e-9)
