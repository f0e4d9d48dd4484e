"""A and B of single steps: Radau's stability function, products along rollouts, differences, what is refused."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says, some_quick
from rolling_disc import scene as disc

import lgsens as lg

X, Y, ORIGIN, G = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 9.81
H, RADAU = 0.05, lg.RadauIIA()
MASS, STIFFNESS, DAMPING = 2.0, 300.0, 4.0


def oscillator(u, free=None):
    """A mass on a spring and damper, pulled by u; on a rail, or free along it alone."""
    joints = {} if free else {"rail": lg.PrismaticJoint(None, "mass", at=ORIGIN, axis=X)}
    spring = lg.SpringDamper(
        None, "mass", at_a=(-1.0, 0.0, 0.0), at_b=ORIGIN, stiffness=STIFFNESS, damping=DAMPING, free_length=1.0
    )
    forces = {"spring": spring, "pull": lg.AppliedForce("mass", force=u[0] * jnp.array(X))}
    body = lg.RigidBody(MASS, (1.0, 1.0, 1.0), velocity=(0.3, 0.0, 0.0), free=free)
    return lg.Model({"mass": body}, joints, forces)


@pytest.mark.parametrize("free", some_quick(["x", None]))
def test_of_a_linear_mechanism(free):
    """A = R(h A_c) with Radau's stability function, B = A_c⁻¹ (A − 1) B_c, of [√m x; √m ẋ]."""
    build = partial(oscillator, free=free)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), lg.initial_state(build(jnp.zeros(1))))
    found = lg.step_jacobians(build, states, jnp.zeros((3, 1)), H * np.arange(4))
    continuous = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    z = H * continuous
    one = np.eye(2)
    exact = np.linalg.solve(one - 0.6 * z + 0.15 * z @ z - z @ z @ z / 60, one + 0.4 * z + z @ z / 20)
    by_force = np.linalg.solve(continuous, (exact - one) @ [0.0, 1.0 / np.sqrt(MASS)])
    for n in range(3):  # coordinates have either sign
        sign = np.diag(np.sign(np.asarray(found.charts.position)[[n, n + 1], 0, 0]))
        np.testing.assert_allclose(sign[1, 1] * found.A[n] * sign[0, 0], exact, rtol=1e-10)  # Newton's tolerance 1e-12
        np.testing.assert_allclose(sign[1, 1] * found.B[n][:, 0], by_force, rtol=1e-10)
    assert not np.asarray(found.result).any()


def four_bar(u):
    """A crank whose motor follows its command with a lag, a coupler, and a rocker on a torsion spring that changes."""
    body = lambda at: lg.RigidBody(1.0, (0.1, 0.1, 0.1), position=at)
    bodies = {"crank": body((0.0, 0.0, 0.1)), "coupler": body((0.3, 0.0, 0.35)), "rocker": body((0.6, 0.0, 0.25))}
    joints = {
        "drive": lg.RevoluteJoint(None, "crank", at=ORIGIN, axis=Y),
        "one": lg.RevoluteJoint("crank", "coupler", at=(0.0, 0.0, 0.2), axis=Y),
        "two": lg.SphericalJoint("coupler", "rocker", at=(0.6, 0.0, 0.5)),
        "pin": lg.UniversalJoint(None, "rocker", at=(0.6, 0.0, 0.0), axis_a=Y, axis_b=X),
    }
    motor = lg.Actuator(lg.RotationDriver(None, "crank", axis=Y), command=3.0 * u[0], time_constant=0.1)
    spring = lg.CoordinateForce(joints["pin"], "angle_a", stiffness=20.0 + u[1])
    return lg.Model(bodies, joints, {"gravity": lg.Gravity((0.0, 0.0, -G)), "motor": motor, "spring": spring})


def wheel(u):
    """A disc that rolls, and is pushed."""
    rolling = disc()
    push = lg.AppliedForce("disc", force=u[0] * jnp.array(X))
    return lg.Model(rolling.bodies, rolling.joints, rolling.forces | {"push": push})


def one_step(build, u, state, t0, t1, integrator):
    run = lg.simulate(build(u), t0=t0, t1=t1, num_steps=1, state0=state, integrator=integrator, throw=False)
    return jax.tree.map(lambda leaf: leaf[-1], run.states)


# Scene, controls, f and g: positions and velocities that are free, states of elements with these.
SCENES = {
    "four-bar, Radau": (four_bar, (0.4, 1.0), 1, 2, RADAU),
    "four-bar, explicit": (four_bar, (0.4, 1.0), 1, 2, lg.IndexReducedODE()),
    "rolling": (wheel, (0.7,), 5, 3, RADAU),
}


@pytest.mark.slow  # two programs each
@pytest.mark.parametrize("name", SCENES)
def test_against_differences(name):
    """Central ones, of steps from displaced states, which depart from the joints by e² on both sides alike."""
    build, u, f, g, integrator = SCENES[name]
    u, t, rng, e = jnp.array(u), 0.02 * np.arange(3), np.random.default_rng(0), 1e-4
    states = lg.simulate(build(u), t1=0.04, num_steps=2, integrator=integrator).states
    found = lg.step_jacobians(build, states, jnp.stack([u, u]), t, integrator=integrator)
    assert found.A.shape == (2, f + g, f + g) and found.B.shape == (2, f + g, len(u))
    np.testing.assert_allclose(found.gap, 0.0, atol=1e-10)
    before, after = (jax.tree.map(lambda leaf, i=i: leaf[i], found.charts) for i in (1, 2))

    @jax.jit
    def end(y, du):
        return after.coordinates(one_step(build, u + du, before.displaced(y), t[1], t[2], integrator))

    for _ in range(3):
        y, du = jnp.asarray(rng.normal(size=f + g)), jnp.asarray(rng.normal(size=len(u)))
        difference = (end(e * y, e * du) - end(-e * y, -e * du)) / (2 * e)
        # e² of third derivatives of scales of 0.1, Newton's tolerance over e
        np.testing.assert_allclose(found.A[1] @ y + found.B[1] @ du, difference, rtol=1e-5, atol=1e-5)
    y = 1e-3 * jnp.asarray(rng.normal(size=f + g))
    np.testing.assert_allclose(before.coordinates(before.displaced(y)), y, atol=1e-5)  # squares


@pytest.mark.slow  # programs of a rollout and of its derivative
def test_products_along_a_rollout():
    """The end of ten steps by each control is a product of A and one B, to round-off."""
    u, t = jnp.asarray(np.random.default_rng(1).normal(size=(10, 2))), 0.02 * np.arange(11)

    @jax.jit
    def rollout(u):
        def step(state, at):
            state = one_step(four_bar, at[1], state, at[0], at[0] + 0.02, RADAU)
            return state, state

        first = lg.initial_state(four_bar(u[0] * 0.0))
        _, later = jax.lax.scan(step, first, (jnp.asarray(t[:-1]), u))
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, later)

    found = lg.step_jacobians(four_bar, rollout(u), u, t)
    np.testing.assert_allclose(found.gap, 0.0, atol=1e-12)
    last = jax.tree.map(lambda leaf: leaf[-1], found.charts)
    whole = jax.jacfwd(lambda u: last.coordinates(jax.tree.map(lambda leaf: leaf[-1], rollout(u))))(u)
    product = np.eye(3)
    for n in reversed(range(10)):
        np.testing.assert_allclose(whole[:, n], product @ found.B[n], rtol=1e-10, atol=1e-12)  # round-off × condition
        product = product @ found.A[n]


@pytest.mark.slow
def test_guesses_derivatives_and_failures():
    """A gap where states are none of a motion; A by a number of the scene; a step that fails says when."""
    states = lg.simulate(oscillator(jnp.zeros(1)), t1=2 * H, num_steps=2, integrator=RADAU).states
    still = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[0], leaf.shape), states)
    controls, t = jnp.zeros((2, 1)), H * np.arange(3)
    found = lg.step_jacobians(oscillator, still, controls, t)
    sign = np.sign(float(found.charts.position[0, 0, 0]))
    x = lg.simulate(oscillator(jnp.zeros(1)), t1=2 * H, num_steps=2, integrator=RADAU).body("mass")
    gap = sign * np.sqrt(MASS) * np.array([x.position[1, 0] - x.position[0, 0], x.velocity[1, 0] - x.velocity[0, 0]])
    np.testing.assert_allclose(found.gap[0], gap, rtol=1e-9)
    assert abs(gap[0]) > 1e-3

    hasty = lg.RadauIIA(max_iterations=1)
    with pytest.raises(lg.SimulationError, match="step 1 of 1"):
        lg.step_jacobians(oscillator, still, controls, t, integrator=hasty)
    assert np.asarray(lg.step_jacobians(oscillator, still, controls, t, integrator=hasty, throw=False).result).all()
    traced = jax.jit(lambda t: lg.step_jacobians(oscillator, still, controls, t, integrator=hasty).A)
    assert np.isnan(traced(jnp.asarray(t))).all()

    def trace(stiffness):
        def build(u):
            model = oscillator(u)
            return eqx.tree_at(lambda m: m.forces["spring"].stiffness, model, stiffness)

        return jnp.trace(lg.step_jacobians(build, states, controls, t).A[0])

    slope, e = jax.jit(jax.grad(trace))(STIFFNESS), 1e-2
    difference = (trace(STIFFNESS + e) - trace(STIFFNESS - e)) / (2 * e)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)  # (e/k)², Newton's tolerance over e


def test_bad_input():
    states = lg.initial_state(oscillator(jnp.zeros(1)))
    states = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), states)
    for arguments, settings, message in (
        (
            (states, jnp.zeros((1, 1)), jnp.arange(2.0)),
            {"integrator": lg.GeneralizedAlpha()},
            "GeneralizedAlpha carries",
        ),
        ((states.v, jnp.zeros((1, 1)), jnp.arange(2.0)), {}, "`states` must be a State of all times"),
        ((states, jnp.zeros((2, 1)), jnp.arange(2.0)), {}, "got shapes (2, 1), (2,) and (2, 6) of velocities"),
        ((states, jnp.zeros(1), jnp.arange(2.0)), {}, "`controls` must have shape (n, p)"),
        ((states, jnp.zeros((1, 1)), jnp.arange(2.0)), {"integrator": lg.IndexReducedODE(rtol=1e-6)}, "with `rtol`"),
    ):
        with pytest.raises(ValueError, match=says(message)):
            lg.step_jacobians(oscillator, *arguments, **settings)
