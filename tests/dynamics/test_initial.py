"""Consistent initial states, assembly and accelerations against their defining equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, GRAVITY, close, random_body
from scipy.linalg import null_space

import lgsens as lg
from lgsens.dynamics import accelerations, initial_state, jerk
from lgsens.dynamics._initial import assemble


def double_pendulum(seed) -> lg.Model:
    """A body on a ball joint, another hinged to it, a damper, and velocities that fit neither joint."""
    rng = np.random.default_rng(seed)
    upper, lower = (
        random_body(rng, velocity=rng.normal(size=3), angular_velocity=3 * rng.normal(size=3)) for _ in range(2)
    )
    joints = {
        "ball": lg.SphericalJoint(None, "upper", at=rng.uniform(-1, 1, 3)),
        "hinge": lg.RevoluteJoint("upper", "lower", at=rng.uniform(-1, 1, 3), axis=rng.normal(size=3)),
    }
    ends = {"at_a": rng.uniform(1, 2, 3), "at_b": rng.uniform(-2, -1, 3)}
    forces = {
        "gravity": lg.Gravity(GRAVITY),
        "damper": lg.SpringDamper("upper", "lower", **ends, stiffness=20.0, damping=1.0),
        "push": lg.AppliedForce("lower", force=rng.normal(size=3), signal=lg.BumpRoad(height=5.0, duration=1.0)),
    }
    return lg.Model({"upper": upper, "lower": lower}, joints, forces)


TIME = jnp.asarray(0.2, dtype=float)
start = jax.jit(lambda model: initial_state(model.system(), TIME))


@jax.jit
def matrices(model, state):
    """M, B and r."""
    system = model.system()
    residual = system.residual(state.q, state.v, state.vdot, state.lam, TIME)
    return system.mass_matrix(), system.constraint_jacobian(state.q, 0.0), residual


@pytest.fixture(scope="module", params=range(3))
def pendulum(request):
    """A model, its initial state, M, B, r, and by how much the equations of the state amplify round-off."""
    model = double_pendulum(request.param)
    initial = start(model)
    mass, jacobian, residual = map(np.asarray, matrices(model, initial.state))
    condition = np.linalg.cond(jacobian @ np.linalg.solve(mass, jacobian.T))
    assert condition < 1e5
    return model, initial, mass, jacobian, residual, condition


def test_reference_of_joints_is_kept(pendulum):
    model, initial, *_ = pendulum
    assert initial.result == lg.RESULTS.successful
    # by JAX as the state's: NumPy, which has the numbers outside of `jit`, rounds them differently
    pose = jax.jit(lambda model: model.system().pose)(model)
    jax.tree.map(np.testing.assert_array_equal, initial.state.q, pose)


def test_velocity_is_the_closest_that_the_joints_allow(pendulum):
    """B v = 0, and M (v − v_ref) does no work on a velocity that they allow: v is nearest in energy."""
    model, initial, mass, jacobian, _, condition = pendulum
    wanted, v = np.asarray(model.system().velocity), np.asarray(initial.state.v)
    size = np.abs(wanted).max()
    assert np.abs(jacobian @ wanted).max() > 0.1
    # v solves a linear system of that condition; B and M enlarge what is left of it by their norm.
    allowed = 10 * condition * size * np.linalg.norm(mass)
    close(jacobian @ v, np.zeros(len(jacobian)), 10 * condition, scale=size * np.linalg.norm(jacobian))
    tangents = null_space(jacobian)
    assert tangents.shape[1] == 4
    close(tangents.T @ mass @ (v - wanted), np.zeros(4), 1, scale=allowed)
    # And so by the definition: every other allowed velocity is farther.
    distance = lambda v: (v - wanted) @ mass @ (v - wanted)
    rng = np.random.default_rng(0)
    assert all(distance(v + 1e-3 * tangents @ rng.normal(size=4)) > distance(v) for _ in range(20))


def test_accelerations_satisfy_the_equations_of_motion(pendulum):
    _, initial, mass, jacobian, residual, _ = pendulum
    state = initial.state
    forces = np.abs(mass @ state.vdot).max() + np.abs(jacobian.T @ state.lam).max()
    # LU is backward stable: the residual is that many round-offs of the terms, whatever the condition.
    close(residual, np.zeros(12), 100, scale=forces)
    np.testing.assert_array_equal(state.a, state.vdot)


@jax.jit
def along(model, state):
    """Φ and its first two time derivatives along q exp(s v + s²/2 v̇), the motion to second order."""
    system = model.system()

    def value(s):
        return system.constraint(system.group.retract(state.q, s * state.v + s**2 / 2 * state.vdot), 0.0)

    rate = lambda s: jax.jvp(value, (s,), (jnp.ones_like(s),))[1]
    return value(0.0 * TIME), *jax.jvp(rate, (0.0 * TIME,), (jnp.ones_like(TIME),))


def test_constraints_hold_to_their_second_derivative(pendulum):
    model, initial, _, jacobian, _, condition = pendulum
    for order, derivative in enumerate(along(model, initial.state)):
        scale = np.linalg.norm(jacobian) * (1.0, np.abs(initial.state.v).max(), np.abs(initial.state.vdot).max())[order]
        close(derivative, np.zeros(8), 10 * condition, scale=scale)


@jax.jit
def slope(model, q0, x, v, t):
    """ẋ and v̇ of the motion at q₀ exp(x̃), v, t."""
    system = model.system()
    return system.group.tangent_inv_mv(x, v), accelerations(system, system.group.retract(q0, x), v, t)[0]


def fly(model, q0, v, h, count):
    """v̇ after each of `count` Runge-Kutta steps of size h: nothing in it is the integrator's."""
    y, t, seen = np.stack([np.zeros_like(v), v]), float(TIME), []
    rate = lambda y, t: np.stack(slope(model, q0, *y, jnp.asarray(t)))
    for _ in range(count):
        k1 = rate(y, t)
        k2 = rate(y + h / 2 * k1, t + h / 2)
        k3 = rate(y + h / 2 * k2, t + h / 2)
        k4 = rate(y + h * k3, t + h)
        y, t = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), t + h
        seen.append(rate(y, t)[1])
    return seen


def test_jerk_is_the_rate_of_the_accelerations(pendulum):
    model, initial, *_ = pendulum
    h = 1e-3
    (f1, f2), (b1, b2) = (fly(model, initial.state.q, initial.state.v, step, 2) for step in (h, -h))
    differences = (8 * (f1 - b1) - (f2 - b2)) / (12 * h)
    state = initial.state
    found = jerk(model.system(), state.q, state.v, state.vdot, state.lam, TIME)
    size = np.abs(found).max()
    assert size > 1
    # Rates w are below 30 rad/s: the formula errs by (w h)⁴/30 < 3e-8 of the jerk, a Runge-Kutta step by (w
    # h)⁵/120 of the velocity, that is w² (w h)⁴/120 /w² of the jerk: less. Round-off: EPS · condition/h of
    # the accelerations, 1e-8.
    assert np.abs(found - differences).max() < 1e-7 * size


def test_accelerations_of_the_top_are_eulers():
    """About a fixed point I_O Ω̇ + Ω × I_O Ω is the moment of the weight, with Steiner's I_O."""
    rng = np.random.default_rng(4)
    spin = rng.normal(size=3)
    body = random_body(rng, angular_velocity=spin)
    pivot = rng.uniform(-1, 1, 3)
    arm = np.asarray(body.orientation).T @ (np.asarray(body.position) - pivot)  # pivot to centre, body frame
    model = lg.Model({"top": body}, {"pivot": lg.SphericalJoint(None, "top", at=pivot)}, {"g": lg.Gravity(GRAVITY)})
    state = start(model).state
    mass, inertia = float(body.mass), np.asarray(body.inertia)
    about_pivot = inertia + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    # The projected spin is that of an impulse at the pivot: I_O Ω = J Ω_ref, for a centre of mass at rest.
    omega = np.linalg.solve(about_pivot, inertia @ spin)
    weight = np.asarray(body.orientation).T @ (mass * np.array(GRAVITY))
    moment = np.cross(arm, weight) - np.cross(omega, about_pivot @ omega)
    condition = np.linalg.cond(about_pivot)
    assert condition < 1e3
    close(state.v[3:], omega, 10 * condition)
    close(state.vdot[3:], np.linalg.solve(about_pivot, moment), 10 * condition)
    # The joint's force on the ground, which is body `a`, is what the body's weight and acceleration ask for.
    close(state.lam, mass * (np.array(GRAVITY) - np.asarray(state.vdot[:3])), 10 * condition)


# Assembly.


def lift(length) -> lg.Model:
    """A slider on a vertical rail, on a rod from (1, 0, 0): its height is √(length² − 1)."""
    body = lg.RigidBody(2.0, (0.1, 0.2, 0.2), position=(0.0, 0.0, 1.0))
    joints = {
        "rail": lg.PrismaticJoint(None, "slider", at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0)),
        "rod": lg.DistanceJoint(None, "slider", at_a=(1.0, 0.0, 0.0), at_b=(0.0, 0.0, 1.0), length=length),
    }
    return lg.Model({"slider": body}, joints)


@jax.jit
def height_and_rate(length):
    def height(length):
        initial = initial_state(lift(length).system(), TIME)
        return initial.state.q.position[0, 2], (initial.violation, initial.result)

    return jax.value_and_grad(height, has_aux=True)(length)


@pytest.mark.parametrize("length", [1.02, 1.3, np.sqrt(2.0), 2.0, 3.5])
def test_a_rod_of_another_length_is_assembled(length):
    length = jnp.asarray(length, dtype=float)
    (z, (violation, result)), rate = height_and_rate(length)
    expected = np.sqrt(length**2 - 1)
    assert result == lg.RESULTS.successful
    assert np.abs(violation).max() <= 1e-12
    # Φ to a few round-offs of the length; dz/dL amplifies them by L/z.
    slope = float(length / expected)
    close(z, expected, 32, scale=slope * float(length))
    assert abs(float(rate) - slope) <= 100 * EPS * slope**3  # d²z/dL² is about −slope³/L
    step = 1e-4
    (ahead, _), _ = height_and_rate(length + step)
    (behind, _), _ = height_and_rate(length - step)
    # step² d³z/dL³ / 6, d³z = 3 L/z⁵ ≤ 3 slope⁵/L⁴, and the 32 round-offs above over the step
    bound = step**2 * slope**5 + 64 * EPS * slope * float(length) / step
    assert abs(float(ahead - behind) / (2 * step) - slope) <= bound


def tripod(lengths) -> lg.Model:
    """A free body on three rods to the ground, longer or shorter than in its reference configuration."""
    rng = np.random.default_rng(8)
    body = random_body(rng, position=(0.0, 0.0, 1.0))
    feet, ends = rng.uniform(-1, 1, (3, 3)), rng.uniform(-0.3, 0.3, (3, 3))
    feet[:, 2] -= 2.0
    ends[:, 2] += 1.0
    distances = np.linalg.norm(ends - feet, axis=1)
    joints = {
        f"rod{i}": lg.DistanceJoint(None, "plate", at_a=feet[i], at_b=ends[i], length=distances[i] + lengths[i])
        for i in range(3)
    }
    return lg.Model({"plate": body}, joints)


@jax.jit
def assembled(model):
    """The assembled pose as x with q = q_ref exp(x̃), Φ there, and M and B at the reference."""
    system = model.system()
    group = system.group
    q, violation = assemble(system, 0.0)
    x = group.log(group.compose(group.inverse(system.pose), q))
    return x, violation, system.mass_matrix(), system.constraint_jacobian(system.pose, 0.0)


def test_assembly_moves_along_the_constraint_directions():
    """M x lies in the row space of B(q_ref): the motion that an impulse of the rods would give."""
    x, violation, mass, jacobian = map(np.array, assembled(tripod(np.array([0.1, -0.05, 0.2]))))
    assert np.abs(violation).max() <= 1e-12
    assert np.abs(x).max() > 0.05
    # log costs a few round-offs of R, and M multiplies them
    close(null_space(jacobian).T @ mass @ x, np.zeros(3), 50, scale=np.linalg.norm(mass))
