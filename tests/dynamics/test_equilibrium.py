"""Static equilibrium against closed solutions, an independent root, and at rest in a simulation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, GRAVITY, close
from scipy.optimize import brentq

import lgsens as lg
from lgsens.examples import QuarterCar

G = 9.81


def hanging_mass(stiffness, mass) -> lg.Model:
    """A body hung by its centre of mass on a spring of free length 0.5 m from the ceiling at 2 m."""
    body = lg.RigidBody(mass, (0.1, 0.2, 0.2), position=(0.0, 0.0, 1.0), velocity=(1.0, 2.0, 3.0))
    ends = {"at_a": (0.0, 0.0, 2.0), "at_b": (0.0, 0.0, 1.0)}
    spring = lg.SpringDamper(None, "mass", **ends, stiffness=stiffness, damping=4.0, free_length=0.5)
    return lg.Model({"mass": body}, {}, {"spring": spring, "gravity": lg.Gravity(GRAVITY)})


@jax.jit
def rest(stiffness, mass):
    return lg.equilibrium(hanging_mass(stiffness, mass), throw=False)


rest_height = jax.jit(jax.value_and_grad(lambda k, m: rest(k, m).q.position[0, 2], argnums=(0, 1)))


@pytest.mark.parametrize("stiffness, mass", [(100.0, 2.0), (40.0, 3.0), (1000.0, 0.5)])
def test_mass_on_a_spring(stiffness, mass):
    """z = 2 − ½ − m g/k, dz/dk = m g/k², dz/dm = −g/k; it hangs, so the free rotations stay where they are."""
    k, m = jnp.asarray(stiffness), jnp.asarray(mass)
    state = rest(k, m)
    # Newton ends at round-off of the scene; forces of k × 1 m set the error of the height, and z is of order 1.
    close(state.q.position[0], [0.0, 0.0, 1.5 - mass * G / stiffness], 32, scale=1.0)
    close(state.q.orientation[0], np.eye(3), 32)
    for zero in (state.v, state.vdot, state.a):
        np.testing.assert_array_equal(zero, np.zeros(6))
    residual = hanging_mass(k, m).system().residual(state.q, state.v, state.vdot, state.lam, jnp.zeros(()))
    close(residual, np.zeros(6), 32, scale=stiffness)
    _, (by_stiffness, by_mass) = rest_height(k, m)
    close(by_stiffness, mass * G / stiffness**2, 100)
    close(by_mass, -G / stiffness, 100)


def platform(stiffness, load=0.0) -> lg.Model:
    """A bar of 2 m on a hinge at its left end, on two springs, and a load on its tip."""
    body = lg.RigidBody(6.0, (0.01, 2.0, 2.0), position=(1.0, 0.0, 0.0))
    springs = {
        name: lg.SpringDamper(
            None, "bar", at_a=(x, 0.0, -0.8), at_b=(x, 0.0, 0.0), stiffness=k, damping=20.0, free_length=0.9
        )
        for name, x, k in (("near", 0.7, stiffness), ("far", 1.6, 50.0))
    }
    return lg.Model(
        {"bar": body},
        {"hinge": lg.RevoluteJoint(None, "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))},
        springs | {"gravity": lg.Gravity(GRAVITY), "tip": lg.AppliedForce("bar", at=(2.0, 0.0, 0.0), force=(0, 0, load))},
    )


def slope_of_platform(stiffness, load):
    """The slope of the bar from the moments about its hinge, in the plane: SciPy's root, no multibody formula."""

    def moment(angle):
        total = -6.0 * G * np.cos(angle) + load * 2.0 * np.cos(angle)
        for x, k in ((0.7, stiffness), (1.6, 50.0)):
            end = x * np.array([np.cos(angle), np.sin(angle)])
            line = end - np.array([x, -0.8])
            length = np.linalg.norm(line)
            force = -k * (length - 0.9) * line / length
            total += end[0] * force[1] - end[1] * force[0]
        return total

    return brentq(moment, -0.7, 0.7, xtol=1e-15, rtol=4 * EPS)


@jax.jit
def resting_platform(stiffness, load):
    return lg.equilibrium(platform(stiffness, load), throw=False)


@jax.jit
def slope_and_rate(stiffness, load):
    def slope(k):
        axis = resting_platform(k, load).q.orientation[0, :, 0]
        return jnp.arctan2(axis[2], axis[0])

    return jax.jvp(slope, (stiffness,), (jnp.ones_like(stiffness),))


@pytest.mark.parametrize("stiffness, load", [(120.0, 0.0), (300.0, -40.0), (80.0, 30.0)])
def test_platform_on_two_springs(stiffness, load):
    k, f = jnp.asarray(stiffness), jnp.asarray(load)
    slope, rate = slope_and_rate(k, f)
    expected = slope_of_platform(stiffness, load)
    assert abs(expected) > 0.01
    # The rotational stiffness about the hinge is of the order of the moments themselves.
    close(slope, expected, 100, scale=1.0)
    step = 1e-3 * stiffness
    ahead, behind = slope_of_platform(stiffness + step, load), slope_of_platform(stiffness - step, load)
    # Differences over a thousandth of k: 1e-6/6 × d³/dk³ k³, of the order of the rate × k; round-off is 1e-12 of it.
    difference = (ahead - behind) / (2 * step)
    assert abs(float(rate) - difference) < 3e-6 * max(abs(difference), 0.1 / stiffness)


def test_stays_at_rest():
    """In a simulation from the equilibrium nothing moves but by round-off."""
    model = platform(120.0, 30.0)
    state = lg.equilibrium(model)
    trajectory = lg.simulate(model, t1=0.5, num_steps=50, state0=state)
    motion = trajectory.body("bar")
    # Residual forces of 100 round-offs of the 100 N at hand, over 6 kg, for half a second: 1e-12.
    assert np.abs(motion.position - state.q.position[0]).max() < 1e-12
    assert np.abs(motion.velocity).max() < 1e-11
    close(trajectory.multiplier("hinge"), np.broadcast_to(state.lam, (51, 5)), 1e5)
    np.testing.assert_array_equal(trajectory.stats.iterations, np.ones(50))  # the predictor is the answer


def test_multipliers_carry_the_load():
    """At the hinge of the resting platform the forces of all springs, weight and tip balance."""
    model = platform(120.0, 30.0)
    state = lg.equilibrium(model)
    bar, total = np.asarray(state.q.position[0]), np.array([0.0, 0.0, -6.0 * G + 30.0])
    direction = np.asarray(state.q.orientation[0, :, 0])
    for x, k in ((0.7, 120.0), (1.6, 50.0)):
        line = bar + (x - 1.0) * direction - np.array([x, 0.0, -0.8])
        length = np.linalg.norm(line)
        total -= k * (length - 0.9) * line / length
    close(state.lam[:3], total, 1000)  # λ is the force on the ground


# The quarter-car.


@pytest.fixture(scope="module", params=["locked", "hinged"])
def car(request):
    """A car and its wheel, the trimmed model and the free lengths of spring and tyre that this model amounts to."""
    car = QuarterCar.load()
    model = jax.jit(lambda car: car.model(wheel=request.param))(car)
    spring, tyre = model.forces["spring"], model.forces["tyre"]
    length = np.linalg.norm(car.spring.link_point - car.spring.chassis_point) - spring.preload / car.spring.rate
    return car, request.param, model, length, car.wheel.centre[2] + tyre.preload / tyre.stiffness


def test_preloads_hold_the_car_at_its_design_position(car):
    """r(q_ref, 0, 0, λ) = 0 for some λ: the forces that are left lie in the range of Bᵀ."""
    _, _, model, _, _ = car

    @jax.jit
    def unbalanced(model):
        system = model.system()
        q, v = system.reference()
        zero = jnp.zeros_like(v)
        lam = jnp.zeros(len(system.constraint_names))
        return system.residual(q, zero, zero, lam, jnp.zeros(())), system.constraint_jacobian(q)

    force, jacobian = unbalanced(model)
    lam = np.linalg.lstsq(jacobian.T, -force)[0]
    # Forces of 5 kN through a mechanism whose B has condition below 1e3.
    assert np.linalg.cond(jacobian) < 1e3
    close(force + jacobian.T @ lam, np.zeros(48), 1e4, scale=np.abs(lam).max())
    # The tyre carries the whole car, less what the chassis-side half of nothing else could.
    weight = G * sum(float(body.mass) for body in model.bodies.values())
    assert abs(float(model.forces["tyre"].preload) - weight) < 1e-9 * weight
    assert float(model.forces["spring"].preload) < 0  # compressed


@pytest.fixture(scope="module")
def settled(car):
    """Height of the chassis at rest, as a function of k at frozen free lengths, with its derivative and state."""
    quarter_car, wheel, _, length, radius = car

    @jax.jit
    def rest(k):
        def height(k):
            stiffer = eqx.tree_at(lambda c: c.spring.rate, quarter_car, k)
            state = lg.equilibrium(stiffer.model(wheel=wheel, free_length=length, free_radius=radius), throw=False)
            return state.q.position[0, 2], state

        z, rate, state = jax.jvp(height, (k,), (jnp.ones_like(k),), has_aux=True)
        return z, rate, state

    return rest


def test_quarter_car_rests_at_its_design_position(car, settled):
    quarter_car, _, model, _, _ = car
    _, _, state = settled(quarter_car.spring.rate)
    system = model.system()
    # Weight/stiffness is 4 cm and the mechanism amplifies at most tenfold: round-off of the 1 m scene, times 1e4.
    assert np.abs(state.q.position - system.pose.position).max() < 1e-11
    assert np.abs(state.q.orientation - system.pose.orientation).max() < 1e-11
    np.testing.assert_array_equal(state.v, np.zeros(48))
    assert np.abs(system.constraint(state.q)).max() < 1e-14


def test_quarter_car_settles_on_a_spring_of_another_rate(car, settled):
    quarter_car, _, _, _, _ = car
    k = quarter_car.spring.rate
    z, rate, _ = settled(0.9 * k)
    assert float(z) < float(settled(k)[0]) - 1e-3  # a softer spring sinks
    step = 1e-4 * k
    difference = (settled(0.9 * k + step)[0] - settled(0.9 * k - step)[0]) / (2 * step)
    # Differences over 1e-4 of k err by 1e-8/6 of k³ d³z/dk³, a few times k dz/dk, and by 1e-13/1e-4/2 of the 0.5 m.
    assert abs(float(rate / difference) - 1.0) < 1e-7
