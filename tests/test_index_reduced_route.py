"""The index-reduced equations as an integrator: order, derivatives, drift, error control, failures, bad input."""

import dataclasses
import functools
import json
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, close, equations, everything, random_point, says, some_quick
from jaxtyping import Array, Float

import lgsens as lg
from lgsens.dynamics import Inertia, accelerations, autodiff_tangents, constraint_velocity, factorized_accelerations
from lgsens.examples import four_bar, spinning_top
from lgsens.liegroups import Rn

TSIT5 = lg.IndexReducedODE()


def load(name):
    return json.loads((Path(__file__).parent / "data" / f"{name}.json").read_text())


@pytest.mark.slow  # `test_top` is in the quick run
@pytest.mark.parametrize("blocks", some_quick([True, False]))
def test_hand_derived_rule_on_every_joint_and_force(blocks):
    """Value, derivative and transpose against JAX's derivative of the plain solve, in every number, q, v and t.

    Condition of the solve: 1e4 or so, by the random bodies; both methods have its round-off.
    """
    system = dataclasses.replace(everything().system(), linear_solver=lg.BlockSparse())
    rng = np.random.default_rng(3)
    q, v, _, _, t = random_point(system, rng)
    z = (system, q, v, t)
    by_hand = lambda *z: factorized_accelerations(None if blocks else Inertia.of(z[0]), *z)
    random_like = lambda tree: jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), tree)
    dz = random_like(z)
    # tangents in the tangent space, as all that a simulation meets
    dz = (dz[0], system.group.to_ambient(q, jnp.asarray(rng.normal(size=v.shape))), *dz[2:])
    weights = random_like(jax.eval_shape(by_hand, *z))

    @jax.jit
    def derivatives(z, dz, weights):
        return jax.jvp(accelerations, z, dz), jax.jvp(by_hand, z, dz), jax.vjp(by_hand, *z)[1](weights)

    (wanted, wanted_change), (found, change), pulled = derivatives(z, dz, weights)
    for actual, expected in zip((*found, *change), (*wanted, *wanted_change)):
        close(actual, expected, 1e6)
    inner = lambda a, b: sum(float(jnp.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))
    size = sum(float(jnp.sum(jnp.abs(x * y))) for x, y in zip(jax.tree.leaves(dz), jax.tree.leaves(pulled)))
    assert abs(inner(weights, change) - inner(pulled, dz)) < 1e6 * EPS * size


def factorizations(function, *arguments) -> list[tuple[int, ...]]:
    """The shapes of the matrices that a program factorizes."""
    program = jax.make_jaxpr(function)(*arguments).jaxpr
    kinds = ("cholesky", "lu", "qr")
    return [each.invars[0].aval.shape for each in equations(program) if each.primitive.name in kinds]


# A mass on a circle, as a system of a user's own: small enough for everything that compiles often.


class Pendulum(lg.AbstractSystem):
    """A point mass in the plane, held at a distance from the origin; a spring of its own along x."""

    mass: Float[Array, ""]
    gravity: Float[Array, ""]
    stiffness: Float[Array, ""]
    held: bool = eqx.field(static=True, default=True)
    assembled: bool = eqx.field(static=True, default=True)

    @property
    def group(self):
        return Rn(2)

    @property
    def constraint_names(self):
        return ("rod",) * self.held

    def reference(self):
        return jnp.array([1.0, 0.0]), jnp.zeros(2)

    def coordinate_scale(self):
        return jnp.ones(2)

    def mass_matrix(self):
        return self.mass * jnp.eye(2)

    def residual(self, q, v, vdot, lam, t):
        force = jnp.stack([-self.stiffness * q[0], -self.mass * self.gravity])
        return self.mass * vdot - force + lam @ self.constraint_jacobian(q, t)

    def constraint(self, q, t):
        return jnp.stack([(q @ q - 1.0) / 2.0] * self.held) if self.held else q[:0]

    def constraint_jacobian(self, q, t):
        return q[None] if self.held else jnp.zeros((0, 2))

    def tangents(self, q, v, vdot, lam, t):
        return autodiff_tangents(self, q, v, vdot, lam, t)


def pendulum(gravity=9.81, stiffness=0.0, **settings):
    return Pendulum(jnp.asarray(2.0), jnp.asarray(gravity), jnp.asarray(stiffness), **settings)


def swing(gravity, num_steps=40, integrator=TSIT5, **settings):
    return lg.simulate(pendulum(gravity), t1=1.0, num_steps=num_steps, integrator=integrator, **settings)


def end(gravity, *arguments):
    states = swing(gravity, *arguments).state(-1)
    return jnp.concatenate([states.q, states.v, states.vdot, states.lam])


@functools.cache
def end_and_slope(num_steps, integrator):
    """State, accelerations and force after 1 s and their derivative, shape (2, 7)."""
    both = lambda gravity: jax.jvp(lambda gravity: end(gravity, num_steps, integrator), (gravity,), (1.0,))
    return np.stack(jax.jit(both)(9.81))


EXACT = (80, lg.IndexReducedODE(diffrax.Dopri8()))  # 1e-13 away


@pytest.mark.slow
def test_order_of_the_scheme():
    """Order 5, by slope, of state, accelerations, force, and of their derivatives: 20 of 2⁵ = 32 are asked for."""
    exact = end_and_slope(*EXACT)
    coarse, fine = (np.abs(end_and_slope(n, TSIT5) - exact).max(axis=1) for n in (10, 20))
    assert np.all(coarse / fine > 20.0), (coarse, fine)


def test_energy_and_constraints():
    """The rod's length at every output time to round-off, whatever the drift of a step; v perpendicular to it."""
    trajectory = swing(9.81)
    assert trajectory.order == 4 and trajectory.t.shape == (41,)
    states, stats = trajectory.states, trajectory.stats
    assert 1e-10 < stats.drift.max() < 1e-5  # what Tsit5 at h = 25 ms leaves, (ω h)⁵ with ω up to 5 rad/s
    np.testing.assert_allclose(np.linalg.norm(states.q, axis=1), 1.0, rtol=0, atol=4 * EPS)
    np.testing.assert_allclose(np.sum(states.q * states.v, axis=1), 0.0, atol=1e-12)  # drift times correction
    energy = np.sum(states.v**2, axis=1) / 2 + 9.81 * states.q[:, 1]
    np.testing.assert_allclose(energy, 0.0, atol=1e-5)  # 9.81 times the error of the motion
    np.testing.assert_array_equal(states.a, states.vdot)


@pytest.mark.slow  # each is taken of the top by the default scheme
def test_every_transformation():
    """Equal steps: forwards, backwards, twice and in a batch, all the same; differences agree."""

    def psi(gravity):
        trajectory = swing(gravity, 10)
        return lg.time_integral(trajectory.t, trajectory.states.lam[:, 0] ** 2, order=4)

    step = 1e-3 * 9.81
    gravities = 9.81 + step * jnp.arange(-2.0, 3.0)
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(psi)))(gravities)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(psi))(9.81), slopes[2], rtol=1e-12)
    # differences of fourth order: δ⁴ of the relative step, 1e-12, and EPS/δ
    weights = jnp.array([1.0, -8.0, 0.0, 8.0, -1.0]) / (12.0 * step)
    np.testing.assert_allclose(slopes[2], weights @ values, rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.hessian(psi))(9.81), weights @ slopes, rtol=1e-9)


def test_one_factorization_serves_value_and_derivatives():
    """In value, tangents of three parameters and transpose: one of S for each evaluation, none of it in a batch."""
    system = pendulum()
    q, v = jnp.array([0.6, 0.8]), jnp.array([0.8, -0.6])
    inertia = Inertia.of(system)
    solve = lambda system, q, v: factorized_accelerations(inertia, system, q, v, jnp.zeros(()))
    assert factorizations(solve, system, q, v) == [(1, 1)]
    assert factorizations(jax.jacfwd(solve, argnums=(0, 1, 2)), system, q, v) == [(1, 1)]
    assert factorizations(jax.jacrev(solve, argnums=(0, 1, 2)), system, q, v) == [(1, 1)]


def test_without_constraints():
    """A falling mass on a spring, x = cos ω t: the same route with nothing to hold."""
    free = pendulum(stiffness=8.0, held=False)
    trajectory = lg.simulate(free, t1=1.0, num_steps=20, integrator=lg.IndexReducedODE(diffrax.Dopri8()))
    t = trajectory.t
    wanted = np.stack([np.cos(2.0 * t), -9.81 * t**2 / 2], axis=1)
    np.testing.assert_allclose(trajectory.states.q, wanted, rtol=0, atol=1e-12)  # (ω h)⁸/8!·n = 1e-11/8!·20
    assert trajectory.states.lam.shape == (21, 0)


def test_continued_from_a_state():
    """Two runs in a row are one, bit for bit nearly: the state holds all there is."""
    whole = swing(9.81)
    rest = lg.simulate(pendulum(), t0=0.5, t1=1.0, num_steps=20, integrator=TSIT5, state0=whole.state(20))
    np.testing.assert_allclose(rest.states.v[-1], whole.states.v[-1], rtol=1e-13)


# Error control.


@pytest.mark.slow
def test_error_control():
    """Few output times: each interval is divided as needed. Both modes give the same derivative."""

    def observe(gravity, mode):
        trajectory = swing(gravity, 4, lg.IndexReducedODE(rtol=1e-9, mode=mode))
        states = trajectory.state(-1)
        return jnp.concatenate([states.q, states.v, states.vdot, states.lam]), trajectory

    exact, exact_slope = end_and_slope(*EXACT)
    forwards, _ = jax.jit(jax.jacfwd(functools.partial(observe, mode="forward"), has_aux=True))(9.81)
    backwards, trajectory = jax.jit(jax.jacrev(functools.partial(observe, mode="reverse"), has_aux=True))(9.81)
    np.testing.assert_allclose(forwards, backwards, rtol=1e-10)  # sums of the same terms in another order
    assert np.all(trajectory.stats.steps > 4)
    # tolerance × steps × the 30 N and 50 rad/s² that the largest entries have
    np.testing.assert_allclose(observe(9.81, "reverse")[0], exact, rtol=0, atol=1e-6)
    np.testing.assert_allclose(backwards, exact_slope, rtol=0, atol=1e-6)


# Multibody scenes against independent references.

TOP = load("spinning_top_brulls")


@pytest.mark.slow  # the four-bar is below
def test_top():
    """x, λ and ∂x/∂α₀ at t = 1 s, l = 0.5 m, of the file; joint and rotations hold."""

    def observe(alpha0):
        trajectory = lg.simulate(spinning_top(alpha0, length=0.5), t1=1.0, num_steps=80, integrator=TSIT5)
        position = trajectory.body("top").position[-1]
        return position, (position, trajectory)

    slope, (position, trajectory) = jax.jit(jax.jacrev(observe, has_aux=True))(np.pi / 4)
    last = load("spinning_top_brulls")["states"][-1]
    # (ω h)⁵ of 10 rad/s and 12.5 ms is 3e-5; the constant of Tsit5 is small
    np.testing.assert_allclose(position, last["x"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(slope, last["dx_dalpha0"], rtol=0, atol=1e-5)
    np.testing.assert_allclose(trajectory.multiplier("pivot")[-1], last["lam"], rtol=0, atol=1e-6 * 150.0)
    system, states = trajectory.system, trajectory.states
    violation, rate = jax.jit(
        jax.vmap(lambda q, v: (system.constraint(q, 0.0), constraint_velocity(system, q, v, 0.0)))
    )(states.q, states.v)
    assert np.abs(violation).max() < 1e2 * EPS
    assert np.abs(rate).max() < 1e-10  # drift times correction
    orientation = trajectory.body("top").orientation
    close(orientation @ jnp.swapaxes(orientation, 1, 2), np.tile(np.eye(3), (81, 1, 1)), 1e3)


@pytest.mark.slow
def test_four_bar():
    """A closed loop: criteria of position and acceleration of the file, by Gregory's rule."""
    reference = load("four_bar_spring")["value"]
    trajectory = lg.simulate(four_bar(), t1=2.0, num_steps=400, integrator=TSIT5)
    coupler = trajectory.body("coupler")
    offset = np.asarray(coupler.position)[:, :2] - np.array([0.5, 0.45])
    psi = [np.sum(offset**2, axis=1), np.sum(np.asarray(coupler.acceleration) ** 2, axis=1)]
    for integrand, name in zip(psi, ("Psi1", "Psi2")):
        # what Gregory's rule leaves at h = 5 ms: (ω h)⁴ with ω up to 15 rad/s
        np.testing.assert_allclose(lg.time_integral(trajectory.t, integrand, order=4), reference[name], rtol=3e-5)
    assert np.abs(trajectory.system.constraint(trajectory.state(-1).q, 0.0)).max() < 1e3 * EPS
    assert np.all(trajectory.stats.converged)


# Failures and bad input.


def test_unstable_steps_fail():
    """A spring of 1e8 N/m and steps of 0.1 s: numbers overflow. Data are finite before, NaN from there on."""
    stiff = pendulum(stiffness=1e9, held=False)
    settings = {"t1": 10.0, "num_steps": 100, "integrator": TSIT5}
    parts = ("left the finite numbers", "more `num_steps`", "GeneralizedAlpha", "interval", "of 100", "`throw=False`")
    with pytest.raises(lg.SimulationError, match=says(*parts)):
        lg.simulate(stiff, **settings)
    trajectory = lg.simulate(stiff, throw=False, **settings)
    assert trajectory.result == lg.RESULTS.integration_failed
    reached = int(np.sum(trajectory.stats.converged))
    assert 0 < reached < 100
    for leaf in jax.tree.leaves(trajectory.states):
        finite = np.isfinite(leaf).reshape(101, -1)
        assert np.all(finite[: reached + 1]) and not np.any(finite[reached + 1 :])
    with pytest.raises(lg.SimulationError, match=says("left the finite numbers", f"interval {reached + 1} of 100")):
        lg.raise_if_failed(jax.jit(lambda: lg.simulate(stiff, **settings))())


def test_too_few_steps_for_the_tolerance():
    with pytest.raises(lg.SimulationError, match=says("`max_steps`", "interval 1 of 4, from t = 0 s on, in 2 steps")):
        swing(9.81, 4, lg.IndexReducedODE(rtol=1e-10, max_steps=2))


@pytest.mark.slow
def test_mechanism_that_cannot_be_assembled():
    bob = lg.RigidBody(2.0, (0.1, 0.2, 0.3), position=(0.0, 0.0, -1.0))
    rod = lg.DistanceJoint(None, "bob", at_a=(1.0, 0.0, -1.0), at_b=(0.0, 0.0, -1.0), length=5.0)
    joints = {"pivot": lg.SphericalJoint(None, "bob", at=(0.0, 0.0, 0.0)), "rod": rod}
    with pytest.raises(ValueError, match=says("cannot be assembled", "largest in joint 'rod'")):
        lg.simulate(lg.Model({"bob": bob}, joints), t1=1.0, num_steps=2, integrator=TSIT5)


CRITERION = lg.Criterion(terminal=lambda s, p: s.state.q[0])
CONTROLLED = lg.IndexReducedODE(rtol=1e-6)


@pytest.mark.parametrize(
    ("attempt", "message"),
    [
        (lambda: lg.IndexReducedODE(diffrax.Kvaerno5()), says("`solver` must be an explicit", "diffrax.Tsit5()")),
        (lambda: lg.IndexReducedODE("RK4"), says("`solver` must be an explicit", "'RK4'")),
        (lambda: lg.IndexReducedODE(rtol=0.0), says("`rtol` must be positive", "0.0", "1e-6")),
        (lambda: lg.IndexReducedODE(rtol=1e-6, atol=-1.0), says("`atol` must be positive", "-1.0")),
        (lambda: lg.IndexReducedODE(atol=1e-6), says("`atol` = 1e-06 needs `rtol`")),
        (lambda: lg.IndexReducedODE(max_steps=0), says("`max_steps` must be at least 1", "0")),
        (lambda: lg.IndexReducedODE(mode="both"), says("`mode` must be one of", "'both'")),
        (
            lambda: swing(9.81, 2, CONTROLLED, sensitivity=lg.AdjointVariable()),
            says("`sensitivity` = AdjointVariable()", "`mode`", "leave `rtol` out"),
        ),
        (lambda: swing(9.81, 2, CONTROLLED, save=lambda s: s.t), says("`save`", "leave `rtol` out")),
        (
            lambda: lg.differentiate(CRITERION, pendulum, 9.81, t1=1.0, num_steps=2, integrator=CONTROLLED),
            says("`rtol` = 1e-06", "`mode`", "Leave `rtol` out"),
        ),
        (lambda: lg.AdaptiveSteps(CONTROLLED), says("`rtol` = 1e-06", "Leave `rtol` out")),
        (lambda: lg.Richardson(TSIT5), says("`integrator` must be of second order", "as it is")),
    ],
)
def test_bad_input(attempt, message):
    with pytest.raises(ValueError, match=message):
        attempt()


def test_is_a_hashable_value():
    assert hash(lg.IndexReducedODE(diffrax.Dopri8(), rtol=1e-6)) == hash(
        lg.IndexReducedODE(diffrax.Dopri8(), rtol=1e-6)
    )
    assert lg.IndexReducedODE() == TSIT5 != lg.IndexReducedODE(rtol=1e-6)
