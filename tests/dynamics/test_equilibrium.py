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
    """The state at rest, the gradient of its height, and the forces left."""

    def height(k, m):
        state = lg.equilibrium(hanging_mass(k, m), throw=False)
        return state.q.position[0, 2], state

    (_, state), gradient = jax.value_and_grad(height, argnums=(0, 1), has_aux=True)(stiffness, mass)
    system = hanging_mass(stiffness, mass).system()
    residual = system.residual(state.q, state.v, state.vdot, state.lam, jnp.zeros_like(mass))
    return state, gradient, residual


@pytest.mark.parametrize("stiffness, mass", [(100.0, 2.0), (40.0, 3.0), (1000.0, 0.5)])
def test_mass_on_a_spring(stiffness, mass):
    """z = 2 − ½ − m g/k, dz/dk = m g/k², dz/dm = −g/k; the free rotations stay where they are."""
    k, m = jnp.asarray(stiffness), jnp.asarray(mass)
    state, (by_stiffness, by_mass), residual = rest(k, m)
    # Newton ends at round-off of the scene; forces of k × 1 m set the error of the height, and z is of
    # order 1.
    close(state.q.position[0], [0.0, 0.0, 1.5 - mass * G / stiffness], 32, scale=1.0)
    close(state.q.orientation[0], np.eye(3), 32)
    for zero in (state.v, state.vdot, state.a):
        np.testing.assert_array_equal(zero, np.zeros(6))
    close(residual, np.zeros(6), 32, scale=stiffness)
    close(by_stiffness, mass * G / stiffness**2, 100)
    close(by_mass, -G / stiffness, 100)


def platform(stiffness, load) -> lg.Model:
    """A bar of 2 m on a hinge at its left end, on two springs, and a load on its tip."""
    body = lg.RigidBody(6.0, (0.01, 2.0, 2.0), position=(1.0, 0.0, 0.0))
    springs = {
        name: lg.SpringDamper(
            None, "bar", at_a=(x, 0.0, -0.8), at_b=(x, 0.0, 0.0), stiffness=k, damping=20.0, free_length=0.85
        )
        for name, x, k in (("near", 0.7, stiffness), ("far", 1.6, 400.0))
    }
    return lg.Model(
        {"bar": body},
        {"hinge": lg.RevoluteJoint(None, "bar", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))},
        springs
        | {
            "gravity": lg.Gravity(GRAVITY),
            "tip": lg.AppliedForce("bar", at=(2.0, 0.0, 0.0), force=jnp.stack([0 * load, 0 * load, load])),
        },
    )


def slope_of_platform(stiffness, load):
    """The slope of the bar from the moments about its hinge, in the plane: SciPy's root."""

    def moment(angle):
        total = -6.0 * G * np.cos(angle) + load * 2.0 * np.cos(angle)
        for x, k in ((0.7, stiffness), (1.6, 400.0)):
            end = x * np.array([np.cos(angle), np.sin(angle)])
            line = end - np.array([x, -0.8])
            length = np.linalg.norm(line)
            force = -k * (length - 0.85) * line / length
            total += end[0] * force[1] - end[1] * force[0]
        return total

    return brentq(moment, -0.3, 0.3, xtol=1e-15, rtol=4 * EPS)


@jax.jit
def resting_platform(stiffness, load):
    """The slope of the bar at rest, its derivative by the stiffness, and the state."""

    def slope(k):
        state = lg.equilibrium(platform(k, load), throw=False)
        axis = state.q.orientation[0, :, 0]
        return jnp.arctan2(axis[2], axis[0]), state

    return jax.jvp(slope, (stiffness,), (jnp.ones_like(stiffness),), has_aux=True)


@pytest.mark.parametrize("stiffness, load", [(120.0, 0.0), (300.0, -40.0), (80.0, 30.0)])
def test_platform_on_two_springs(stiffness, load):
    k, f = jnp.asarray(stiffness), jnp.asarray(load)
    slope, rate, _ = resting_platform(k, f)
    expected = slope_of_platform(stiffness, load)
    assert abs(expected) > 0.01
    # The rotational stiffness about the hinge is of the order of the moments themselves.
    close(slope, expected, 100, scale=1.0)
    step = 1e-3 * stiffness
    ahead, behind = slope_of_platform(stiffness + step, load), slope_of_platform(stiffness - step, load)
    # Differences over a thousandth of k: 1e-6/6 × d³/dk³ k³, of the order of the rate × k; round-off is
    # 1e-12 of it.
    difference = (ahead - behind) / (2 * step)
    assert abs(float(rate) - difference) < 3e-6 * max(abs(difference), 0.1 / stiffness)


def test_stays_at_rest():
    """In a simulation from the equilibrium nothing moves but by round-off."""
    k, load = jnp.asarray(120.0), jnp.asarray(30.0)
    model, (_, _, state) = platform(k, load), resting_platform(k, load)
    trajectory = lg.simulate(model, t1=0.5, num_steps=50, state0=state)
    motion = trajectory.body("bar")
    # Residual forces of 100 round-offs of the 100 N at hand, over 6 kg, for half a second: 1e-12.
    assert np.abs(motion.position - state.q.position).max() < 1e-12
    assert np.abs(motion.velocity).max() < 1e-11
    close(trajectory.multiplier("hinge"), np.broadcast_to(state.lam, (51, 5)), 1e5)
    # the predictor is the answer to round-off, which modified Newton confirms once, or twice where it moves by that
    assert set(trajectory.stats.iterations.tolist()) <= {2, 3}


def test_multipliers_carry_the_load():
    """At the hinge of the resting platform the forces of all springs, weight and tip balance."""
    _, _, state = resting_platform(jnp.asarray(120.0), jnp.asarray(30.0))
    bar, total = np.asarray(state.q.position[0]), np.array([0.0, 0.0, -6.0 * G + 30.0])
    direction = np.asarray(state.q.orientation[0, :, 0])
    for x, k in ((0.7, 120.0), (1.6, 400.0)):
        line = bar + (x - 1.0) * direction - np.array([x, 0.0, -0.8])
        length = np.linalg.norm(line)
        total -= k * (length - 0.85) * line / length
    close(state.lam[:3], total, 1000)  # λ is the force on the ground


# The quarter-car.

WHEELS = ("locked", "hinged")


@jax.jit
def trimmed(car):
    """For each wheel the model with trimmed preloads, and at its reference the forces with λ = 0, and B."""

    def at_design(model):
        system = model.system()
        q, v = system.reference()
        zero = jnp.zeros_like(v)
        lam = jnp.zeros(len(system.constraint_names))
        return (
            model,
            system.residual(q, zero, zero, lam, jnp.zeros_like(car.tyre_stiffness)),
            system.constraint_jacobian(q, 0.0),
        )

    return {wheel: at_design(car.model(wheel=wheel)) for wheel in WHEELS}


@pytest.fixture(scope="module")
def car():
    return QuarterCar.load()


@pytest.fixture(scope="module")
def design(car):
    return trimmed(car)


@pytest.mark.parametrize("wheel", WHEELS)
def test_preloads_hold_the_car_at_its_design_position(design, wheel):
    """r(q_ref, 0, 0, λ) = 0 for some λ: the forces that are left lie in the range of Bᵀ."""
    model, force, jacobian = design[wheel]
    assert jacobian.shape == ({"locked": 46, "hinged": 45}[wheel], 48)
    lam = np.linalg.lstsq(jacobian.T, -force)[0]
    # The preloads come from a least-squares solve of condition below 1e6 (that of [Bᵀ, forces of the
    # springs], squared).
    assert np.linalg.cond(jacobian) < 1e3
    close(force + jacobian.T @ lam, np.zeros(48), 1e6, scale=np.abs(lam).max())
    weight = G * sum(float(body.mass) for body in model.bodies.values())
    assert abs(float(model.forces["tyre"].preload) - weight) < 1e6 * EPS * weight  # it carries the whole car
    assert float(model.forces["spring"].preload) < 0  # compressed


def free_lengths(car, model):
    """Free length of the spring and free radius of the tyre that the preloads of `model` amount to."""
    spring, tyre = model.forces["spring"], model.forces["tyre"]
    length = jnp.linalg.norm(car.spring.link_point - car.spring.chassis_point)
    return length - spring.preload / spring.stiffness, car.wheel.centre[2] + tyre.preload / tyre.stiffness


@jax.jit
def settled(car, lengths, rate):
    """Height of the chassis at rest on a spring of another rate, its derivative, and the state."""

    def height(rate):
        softer = eqx.tree_at(lambda car: car.spring.rate, car, rate)
        model = softer.model(wheel="hinged", free_length=lengths[0], free_radius=lengths[1])
        state = lg.equilibrium(model, throw=False)
        return state.q.position[0, 2], state

    return jax.jvp(height, (rate,), (jnp.ones_like(rate),), has_aux=True)


@pytest.mark.slow  # small versions: test_platform_on_two_springs, test_preloads_hold_the_car_at_its_design_position
def test_quarter_car_rests_at_its_design_position(car, design):
    """On its hinge, with the free lengths that the preloads amount to."""
    model = design["hinged"][0]
    _, _, state = settled(car, free_lengths(car, model), car.spring.rate)
    system = model.system()
    moved = np.abs(state.q.position - system.pose.position).max()
    turned = np.abs(state.q.orientation - system.pose.orientation).max(axis=(1, 2))
    # Weight/stiffness is 4 cm, so the round-off of the forces is far below that of the scene: 1e4 round-
    # offs of 1 m.
    assert moved < 1e4 * EPS
    wheel = system.body_names.index("wheel")
    assert np.delete(turned, wheel).max() < 1e4 * EPS
    # The wheel turns without stiffness: the cutoff of the pseudo-inverse is all that holds it.
    assert turned[wheel] < 1e-9
    np.testing.assert_array_equal(state.v, np.zeros(48))
    assert np.abs(system.constraint(state.q, 0.0)).max() < 1e-13  # some hundred round-offs of 1 m


@pytest.mark.slow  # small version: test_platform_on_two_springs
def test_quarter_car_settles_on_a_spring_of_another_rate(car, design):
    lengths, k = free_lengths(car, design["hinged"][0]), car.spring.rate
    z, rate, _ = settled(car, lengths, 0.9 * k)
    assert float(z) < 0.508 - 1e-3  # a softer spring sinks
    step = 1e-4 * k
    difference = (settled(car, lengths, 0.9 * k + step)[0] - settled(car, lengths, 0.9 * k - step)[0]) / (2 * step)
    # Differences over 1e-4 of k err by 1e-8/6 of k³ d³z/dk³, a few times k dz/dk, and by round-off
    # 1e-14/1e-4 of it.
    assert abs(float(rate / difference) - 1.0) < 1e-7


@pytest.mark.parametrize("aside", [0.01, 3.0])
def test_pendulum_comes_to_hang(aside):
    """Its stiffness is that of the joint's force, which the first iteration does not know: (0, 0, −√(1 + a²))."""
    body = lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=(aside, 0.0, -1.0))
    hinge = lg.RevoluteJoint(None, "bob", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    state = lg.equilibrium(lg.Model({"bob": body}, {"hinge": hinge}, {"gravity": lg.Gravity(GRAVITY)}))
    close(state.q.position[0], [0.0, 0.0, -np.hypot(1.0, aside)], 32, scale=np.hypot(1.0, aside))


@pytest.mark.slow  # small version: test_pendulum_comes_to_hang
@pytest.mark.parametrize("links", [3, 8])
def test_a_level_chain_hangs(links):
    """Links of 1 m on hinges, held at one end and level at first: nothing is stiff, and folded chains rest as well. It
    hangs along gravity, so its end turns with it, d x/dg_x = −(n − ½)/g_z."""

    def end(sideways):
        bodies, joints = {}, {}
        for i in range(links):
            bodies[f"{i}"] = lg.RigidBody(1.0, (0.01, 0.1, 0.1), position=(i + 0.5, 0.0, 0.0))
            joints[f"{i}"] = lg.RevoluteJoint(f"{i - 1}" if i else None, f"{i}", at=(i, 0.0, 0.0), axis=(0, 1.0, 0))
        gravity = lg.Gravity(jnp.array([1.0, 0.0, 0.0]) * sideways - jnp.array([0.0, 0.0, G]))
        return lg.equilibrium(lg.Model(bodies, joints, {"gravity": gravity})).q.position[-1]

    place, turn = jax.jvp(end, (0.0,), (1.0,))
    # Newton ends at round-off of the joints' forces, a chain of n amplifies that by n²
    np.testing.assert_allclose(place, [0.0, 0.0, 0.5 - links], atol=1e-12)
    np.testing.assert_allclose(turn, [(links - 0.5) / G, 0.0, 0.0], atol=1e-10)


def cantilever(load, elements):
    """EA = 5e7 N against bending of 1/2000 of it: forces balance to the round-off of places only."""
    section = lg.BeamSection.tube(0.03, 0.003, young=2.1e11, poisson=0.3, density=7850.0)
    beam = lg.Beam("arm", section, [[0, 0, 0], [1.0, 0, 0]], elements=elements)
    push, clamp = lg.AppliedForce(f"arm.{elements}", force=[0, 0, load]), lg.FixedJoint(None, "arm.0", at=[0, 0, 0])
    return section, lg.Model(beam.bodies, {"clamp": clamp}, beam.forces | {"push": push}, merge_fixed=True)


@pytest.mark.slow  # a program of statics
def test_a_stiff_element_bends():
    """The moment in the middle is F L/2: z = F L³/(4 EI) + F L/GA; the rest is of third order, 1e-9."""
    section, model = cantilever(1.0, 1)
    _, _, shear, _, bending, _ = section.stiffness
    found = lg.equilibrium(model).q.position[-1, 2]
    np.testing.assert_allclose(found, 1.0 / (4.0 * bending) + 1.0 / shear, rtol=1e-7)


@pytest.mark.slow  # a program of statics
def test_a_stiff_beam_bends_far():
    """Newton's first step takes the turn of the end for a stretch. By the path of `statics`, in small loads."""
    _, model = cantilever(1e4, 2)
    path = lg.statics(model, loads={"push": np.linspace(0.0, 1.0, 21)})
    found = lg.equilibrium(model).q.position[-1]
    assert found[2] > 0.4
    np.testing.assert_allclose(found, path.body("arm.2").position[-1], atol=1e-9)  # EA eps of 1e4 N on 1e5 N/m


@pytest.mark.slow
def test_a_joint_between_two_bodies_on_stiff_springs():
    """Both sink by their weight over the sum of the rates, and the joint bears what one weighs more than its spring."""
    at, rates = ([0.0, 0.0, 0.0], [0.3, 0.0, 0.0]), (1e9, 3e8)
    bodies = {name: lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=place) for name, place in zip("ab", at)}
    hold = lambda rate: {"stiffness": [rate] * 3, "rotational_stiffness": [rate] * 3}
    forces = {name: lg.Bushing(None, name, at=at[0], **hold(rate)) for name, rate in zip("ab", rates)}
    forces["gravity"] = lg.Gravity((0.0, 0.0, -9.81))
    found = lg.equilibrium(lg.Model(bodies, {"fixed": lg.FixedJoint("a", "b", at=at[0])}, forces))
    sunk = 2 * 9.81 / sum(rates)
    np.testing.assert_allclose(found.q.position[0], [0.0, 0.0, -sunk], rtol=0, atol=1e-6 * sunk)
    # of the joint, along the axis of the body
    bears = 9.81 - rates[1] * sunk
    assert abs(float(np.abs(found.lam[2])) - abs(bears)) < 1e-6 * abs(bears)
