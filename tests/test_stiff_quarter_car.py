"""Bushings at rest, and the quarter-car with stiff ones: as stiff as ball joints in the limit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from helpers import close, random_rotation, says

import lgsens as lg
from lgsens.examples import QuarterCar, stiff_quarter_car

CAR = QuarterCar.load()


@pytest.mark.parametrize("merge", [False, True])
def test_preload_of_a_bushing(merge):
    """A beam of 4 kg, a bushing at one end and a spring at the other: half its weight each."""
    weight = 4.0 * 9.81
    post = lg.RigidBody(1.0, (1.0, 1.0, 1.0), orientation=random_rotation(np.random.default_rng(0)))
    beam = lg.RigidBody(4.0, (0.1, 0.3, 0.3), position=(1.0, 0.0, 0.0))
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -9.81)),
        "bushing": lg.Bushing("post", "beam", at=(0.0, 0.0, 0.0), stiffness=(1e6, 2e6, 3e6)),
        "spring": lg.SpringDamper("beam", None, at_a=(2.0, 0.0, 0.0), at_b=(2.0, 0.0, 1.0), stiffness=1e3),
    }
    scene = lg.Model(
        {"post": post, "beam": beam}, {"weld": lg.FixedJoint(None, "post", at=(0, 0, 0))}, forces, merge_fixed=merge
    )
    loaded, unbalanced = lg.static_preload(scene, ("bushing", "spring"))
    # a linear system of a dozen unknowns
    assert unbalanced <= 1e-12 * weight
    close(loaded.forces["spring"].preload, weight / 2, ulps=100)
    close(loaded.forces["bushing"].preload, [0.0, 0.0, -weight / 2], ulps=100)


def test_unknown_link():
    with pytest.raises(ValueError, match=says("`bushings`", "'wishbon'", "wishbone")):
        CAR.model(bushings=("wishbon",))


def designed(p):
    """Spring and damper times p[0] and p[1]; an end of either link with a bushing moved up by p[2] and p[3]."""
    up = jnp.asarray([0.0, 0.0, 1.0])
    where = lambda car: (
        car.spring.rate,
        car.damper.rate,
        car.links["wishbone"].chassis,
        car.links["guide_link"].knuckle,
    )
    spring, damper, chassis, knuckle = where(CAR)
    return eqx.tree_at(where, CAR, (p[0] * spring, p[1] * damper, chassis + p[2] * up, knuckle + p[3] * up))


def stiff(p, stiffness):
    return stiff_quarter_car(designed(p), chassis="heave", links="rods", bushing_stiffness=stiffness)


def rigid(p, stiffness):
    """The same bodies on ball joints."""
    model = stiff(p, stiffness)
    forces = {name: force for name, force in model.forces.items() if not isinstance(force, lg.Bushing)}
    bushings = [force for force in model.forces.values() if isinstance(force, lg.Bushing)]
    balls = {f"{b.b}_knuckle": lg.SphericalJoint(b.a, b.b, at=b.at) for b in bushings}
    assert len(balls) == 2
    return lg.Model(model.bodies, model.joints | balls, forces)


@pytest.mark.slow
def test_stiff_bushings_are_ball_joints():
    """Ψ₀ and its gradient by rates and hardpoints, of the whole bump: at a distance of 1/k from ball joints.

    At any step: an infinitely stiff bushing lets the scheme see a constraint, and its force is the multiplier.
    """

    def psi(scene):
        def value(p, stiffness):
            trajectory = lg.simulate(scene(p, stiffness), t1=0.3, num_steps=60)
            return lg.time_integral(trajectory.t, trajectory.body("chassis").acceleration[:, 2] ** 2)

        return jax.jit(lambda p, k: jnp.concatenate([v.reshape(-1) for v in jax.value_and_grad(value)(p, k)]))

    start = jnp.asarray([1.0, 1.0, 0.0, 0.0])
    of_stiff = psi(stiff)
    joints = np.asarray(psi(rigid)(start, 1e8))
    # p[2] and p[3] are metres: a change of 0.1 m is of the order of the rates' own
    scale = np.array([1.0, 1.0, 1.0, 0.1, 0.1])
    soft, harder, hardest = ((np.asarray(of_stiff(start, k)) - joints) * scale for k in (1e7, 1e8, 1e9))
    distance = np.abs(harder).max()
    assert 1e-4 < distance < 0.02
    # the next term of the series in 1/k, known from 1e7 to 1e8: a tenth of its share there
    np.testing.assert_allclose(10 * hardest, harder, atol=0.2 * np.abs(soft / 10 - harder).max() + 1e-3 * distance)
    # sixth-order differences: truncation 1e-12, round-off 1e-12/step of Ψ
    slopes = [central(lambda s, e=e: float(of_stiff(start + s * e, 1e8)[0]), 1e-3) for e in jnp.diag(scale[1:])]
    np.testing.assert_allclose(slopes, np.asarray(of_stiff(start, 1e8))[1:] * scale[1:], rtol=0, atol=1e-7 * joints[0])


@pytest.mark.slow
def test_rest_of_the_stiff_car():
    """On a flat road the car stays where it is, for another design too."""

    @jax.jit
    def motion(p):
        car = eqx.tree_at(lambda car: car.bump_height, designed(p), 0.0)
        trajectory = lg.simulate(stiff_quarter_car(car, chassis="heave", links="rods"), t1=0.1, num_steps=20)
        return trajectory.body("wheel").position, trajectory.body("chassis").acceleration

    position, acceleration = motion(jnp.asarray([1.3, 0.8, 0.01, -0.01]))
    # round-off of forces of 6 kN on 40 kg
    assert np.abs(acceleration).max() < 1e-9
    np.testing.assert_allclose(position, position[:1] + 0 * position, rtol=0, atol=1e-12)
