"""Bodies that turn by more than π in a step: right where Ω is constant, else said to be unresolved."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, random_body, says
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.dynamics import unsteady_rate
from lgsens.examples import heavy_top

H, STEPS = 6.3e-4, 20  # s
TILTED = np.array([0.6, 0.48, 0.64])


def top(turn):
    """A heavy top with a level axis that turns by so much in a step."""
    spin = jnp.asarray(turn / H) * jnp.array([0.0, 1.0, 0.0])
    body = lg.RigidBody(15.0, (0.2, 0.4, 0.2), position=(0.0, 1.0, 0.0), angular_velocity=spin)
    gravity = {"gravity": lg.Gravity((0.0, 0.0, -9.81))}
    return lg.Model({"top": body}, {"pivot": lg.SphericalJoint(None, "top", at=(0.0, 0.0, 0.0))}, gravity)


def run(turn, num_steps=STEPS, integrator=lg.GeneralizedAlpha(), **options):
    return lg.simulate(top(turn), t1=num_steps * H, num_steps=num_steps, integrator=integrator, **options)


def height(instant):
    return instant.body("top").position[2]


UNRESOLVED = says("turns by more than π in a step", "by 10 rad in step 1 of 20, t = 0.00063 s: try num_steps = 667.")


def test_a_top_that_is_not_resolved_raises():
    with pytest.raises(lg.SimulationError, match=UNRESOLVED):
        run(10.0)
    found = run(10.0, throw=False)
    assert found.result == lg.RESULTS.turn_not_resolved
    assert jnp.all(jnp.isfinite(found.body("top").position))
    assert run(0.3).result == lg.RESULTS.successful


ROUTES = {
    "saved": lambda turn: run(turn, save=height),
    "saved, with checkpoints": lambda turn: run(turn, save=height, sensitivity=lg.AdjointVariable(checkpoints="sqrt")),
    "given steps": lambda turn: run(turn, integrator=lg.GivenSteps(np.ones(STEPS))),
    "stabilized": lambda turn: run(turn, integrator=lg.GeneralizedAlpha(stabilized=True)),
    "on the fly": lambda turn: lg.differentiate(
        lg.Criterion(terminal=lambda s, p: height(s)), top, turn, t1=STEPS * H, num_steps=STEPS,
        method=lg.DirectDifferentiation(),
    ),
}  # fmt: skip


@pytest.mark.slow  # a program each
@pytest.mark.parametrize("route", ROUTES)
def test_so_it_does_by_every_route(route):
    with pytest.raises(lg.SimulationError, match=UNRESOLVED):
        ROUTES[route](10.0)
    ROUTES[route](0.3)


@pytest.mark.parametrize("turn", [3.5, 10.0, 50.0])  # at 2π T(x) is singular, and Newton may fail
def test_a_balanced_rotor_may_turn_by_any_angle(turn):
    """In a tilted bearing, away from its centre of mass and under its weight: steady, and exact."""
    inertia = 0.3 * np.eye(3) + 0.2 * np.outer(TILTED, TILTED)
    rotor = lg.RigidBody(5.0, inertia, position=2.0 * TILTED, angular_velocity=turn / H * TILTED)
    bearing = lg.RevoluteJoint(None, "rotor", at=jnp.zeros(3), axis=TILTED)
    scene = lg.Model({"rotor": rotor}, {"bearing": bearing}, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
    found = lg.simulate(scene, t1=STEPS * H, num_steps=STEPS).body("rotor").orientation[-1]
    exact = Rotation.from_rotvec(STEPS * turn * TILTED).as_matrix()
    # the angle is rounded to ε in each step; its rate is off by the round-off of multipliers, ε/(βh) over the run
    np.testing.assert_allclose(found, exact, rtol=0, atol=16 * EPS * STEPS * (turn + 4.0 * STEPS))


def test_a_pendulum_that_turns_over_is_not_resolved():
    """Its axis is fixed, and its weight has another moment at every angle: Ω × Ω̇ = 0 says nothing."""
    spin = 50.0 / H
    body = lg.RigidBody(
        2.0,
        (0.1, 0.2, 0.3),
        (0.0, -1.0, 0.0),
        velocity=(spin, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, spin),
        free="x y rz",
    )
    hinge = lg.RevoluteJoint(None, "bob", at=jnp.zeros(3), axis=(0.0, 0.0, 1.0))
    scene = lg.Model({"bob": body}, {"hinge": hinge}, {"gravity": lg.Gravity((0.0, -9.81, 0.0))})
    found = lg.simulate(scene, t1=STEPS * H, num_steps=STEPS, throw=False)
    assert found.result == lg.RESULTS.turn_not_resolved


@pytest.mark.slow
def test_error_control_resolves_turns_whatever_the_tolerance():
    """An error of 1000 rad and steps of any length are allowed."""
    settings = lg.AdaptiveSteps(tolerance=1e3, longest=1.0)
    found = run(0.5, num_steps=20, integrator=settings)
    sizes = np.diff(found.t)
    rates = unsteady_rate(found.system, found.states.v[1:], found.states.vdot[1:])
    # at most a quarter turn in each, and no more steps than four fifths of one make of 10 rad but for the first two
    assert np.all(sizes * rates <= np.pi / 2)
    assert 10.0 / (np.pi / 2) <= int(found.stats.steps) <= 2 + 10.0 / (0.8 * np.pi / 2)


@pytest.mark.slow  # of three stages; the small one is above
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_a_spinning_top_by_radau_at_coarse_tolerances(tolerance):
    """150 rad/s for 2 s; by errors alone steps turned it by 3 to 4 rad."""
    end = lambda tolerance: lg.simulate(
        heavy_top(), t1=2.0, num_steps=1000, integrator=lg.AdaptiveSteps(lg.RadauIIA(), tolerance=tolerance)
    ).body("top").position[-1]  # fmt: skip
    # quarter turns at order 5 leave 2e-3 (seen), the tolerance in each of 240 steps allows more
    np.testing.assert_allclose(end(tolerance), end(1e-8), rtol=0, atol=5e-3)


def test_the_rate_is_that_of_the_fastest_unsteady_body():
    rng = np.random.default_rng(1)
    system = lg.Model({name: random_body(rng) for name in "abc"}).system()
    twist, rate = np.zeros((3, 6)), np.zeros((3, 6))
    twist[:, 3:] = [(3.0, 4.0, 0.0), (0.0, 6.0, 8.0), (0.0, 0.0, 50.0)]
    rate[:, :3] = 7.0  # translations say nothing
    found = lambda: float(unsteady_rate(system, jnp.asarray(twist.ravel()), jnp.asarray(rate.ravel())))
    assert found() == 0.0
    rate[0, 3:] = 1e-8
    assert found() == 5.0
    rate[1, 3:] = 1e-8 * twist[1, 3:]  # along Ω
    assert found() == 10.0
    rate[2, 4] = EPS * 50.0**2  # round-off
    assert found() == 10.0
    twist[:] = np.nan  # after a failure
    assert found() == 0.0
