"""The integrator: coefficients, orders of q, v and λ from the first step, invariants."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import equations, some_quick

import lgsens as lg
from lgsens.dynamics import State
from lgsens.examples import heavy_top, spatial_chain, spinning_top
from lgsens.integrate import EqualGrid, states_of
from lgsens.integrate._alpha import Wear

HEAVY = json.loads((Path(__file__).parents[1] / "data" / "heavy_top_bruls2012.json").read_text())


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9, 0.999])
def test_coefficients(rho):
    """Second order needs γ = ½ + α_f − α_m; the amplification at infinite frequency is ρ∞ (Chung & Hulbert 1993)."""
    scheme = lg.GeneralizedAlpha(rho)
    am, af, beta, gamma = scheme.alpha_m, scheme.alpha_f, scheme.beta, scheme.gamma
    np.testing.assert_allclose(gamma, 0.5 + af - am, rtol=1e-15)
    # A constrained direction, or an oscillator with h ω → ∞, has q = 0 in every step. With h = 1 eq. (27) then gives
    # a' = −v/β − (½ − β) a/β, eq. (28) v'; this map of (v, a) has the double root −ρ∞ for β = (γ + ½)²/4.
    a_next = np.array([-1.0 / beta, -(0.5 - beta) / beta])
    v_next = np.array([1.0, 1.0 - gamma]) + gamma * a_next
    roots = np.linalg.eigvals(np.stack([v_next, a_next]))
    np.testing.assert_allclose(roots, -rho, atol=1e-6)  # a double root is found to the square root of round-off


@pytest.fixture(scope="module")
def heavy_reference():
    """100 µs over 0.1 s is 15 mrad per step; the reference is the same scheme 16 times finer."""
    return lg.simulate(heavy_top(), t1=0.1, num_steps=6400)


@pytest.mark.parametrize(("second_order_start", "order_of_first_multipliers"), some_quick([(True, 2.0), (False, 1.0)]))
def test_orders_on_the_heavy_top(heavy_reference, second_order_start, order_of_first_multipliers):
    """q, v second order; λ second order from the first step with the special start, first order without."""
    integrator = lg.GeneralizedAlpha(0.9, second_order_start=second_order_start)
    errors = []
    for num_steps in (100, 200, 400):
        trajectory = lg.simulate(heavy_top(), t1=0.1, num_steps=num_steps, integrator=integrator)
        every = 6400 // num_steps
        lam = trajectory.multiplier("pivot") - heavy_reference.multiplier("pivot")[::every]
        body, fine = trajectory.body("top"), heavy_reference.body("top")
        errors.append(
            [
                float(jnp.abs(lam).max()),
                float(jnp.abs(lam[-5:]).max()),
                float(jnp.abs(body.velocity - fine.velocity[::every]).max()),
                float(jnp.abs(body.position - fine.position[::every]).max()),
            ]
        )
    rates = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    # the h⁴ term at h Ω = 0.15 is 2 % of the h² term; the first-order case mixes with the reference's own start
    np.testing.assert_allclose(rates[:, 0], order_of_first_multipliers, atol=0.05 if second_order_start else 0.2)
    np.testing.assert_allclose(rates[-1, 1:], 2.0, atol=0.05)


def test_starts_on_a_damper_that_no_step_resolves():
    """10 g on 1e5 N s/m, d h/m = 1e4, let go: v̈_0 is 1e7 times v̇_0/s. Beside a run in steps 20 times shorter."""
    arm = lg.RigidBody(0.01, (1e-5, 1e-5, 1e-5), position=(0.1, 0.0, 0.0))
    damper = lg.SpringDamper(None, "arm", at_a=(0.1, 0.02, 0.3), at_b=(0.1, 0, 0), stiffness=1e6, damping=1e5)
    forces = {"gravity": lg.Gravity((0, 0, -9.81)), "damper": damper}
    model = lg.Model({"arm": arm}, {"pivot": lg.SphericalJoint(None, "arm", at=(0, 0, 0))}, forces)
    # one program: of 2,000 steps, the first hundred of them as long as twenty
    run = jax.jit(lambda t1: lg.simulate(model, t1=t1, num_steps=2000, throw=False).body("arm").position)
    coarse, exact = np.asarray(run(2.0))[:101], np.asarray(run(0.1))
    moved = np.abs(exact - exact[0]).max()
    assert moved > 2e-3  # it swings on the damper
    assert np.abs(coarse - exact[::20]).max() < 2e-5 * moved  # (h w)²/12, w = 14 rad/s, and the h³ of the first step


def test_heavy_top_reaches_the_reference():
    """Position at 0.1 s by the index-reduced reference; Richardson's extrapolation of two runs."""
    runs = [lg.simulate(heavy_top(), t1=0.1, num_steps=n).body("top").position[-1] for n in (400, 800)]
    state = next(s for s in HEAVY["states"] if s["t"] == 0.1)
    errors = [float(jnp.abs(run - np.array(state["x"])).max()) for run in runs]
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), 2.0, atol=0.05)
    # what is left is h⁴: (0.0375 rad per step)² of the error at 400 steps, 1e-3 × 3e-5
    np.testing.assert_allclose((4 * runs[1] - runs[0]) / 3, state["x"], atol=1e-7)


def test_free_body_keeps_its_momenta():
    """No force: spatial angular momentum R J Ω and energy drift at second order, orthogonality at round-off."""
    inertia = np.array([1.0, 2.0, 2.8])
    model = lg.Model({"body": lg.RigidBody(3.0, inertia, velocity=(1.0, 2.0, 3.0), angular_velocity=(0.1, 5.0, 0.2))})
    drift = []
    for num_steps in (500, 1000):
        body = lg.simulate(model, t1=2.0, num_steps=num_steps).body("body")
        momentum = jnp.einsum("nij,nj->ni", body.orientation, inertia[None, :] * body.angular_velocity)
        energy = jnp.sum(inertia[None, :] * body.angular_velocity**2, axis=1) / 2
        drift.append([float(jnp.abs(momentum - momentum[:1]).max()), float(jnp.abs(energy - energy[0]).max())])
        orthogonality = jnp.swapaxes(body.orientation, 1, 2) @ body.orientation - jnp.eye(3)[None]
        # each product of rotations adds a round-off: 1000 × 2e-16
        assert float(jnp.abs(orthogonality).max()) <= 1e-12
        np.testing.assert_allclose(body.position[-1], [2.0, 4.0, 6.0], rtol=1e-13)
    rates = np.log2(np.array(drift[0]) / np.array(drift[1]))
    assert np.all(rates > 1.9)


def test_continuation_is_the_same_run():
    """Two halves, the second from the last state of the first, give the whole."""
    whole = lg.simulate(heavy_top(), t1=0.1, num_steps=100)
    first = lg.simulate(heavy_top(), t1=0.05, num_steps=50)
    second = lg.simulate(heavy_top(), t0=0.05, t1=0.1, num_steps=50, state0=first.state(-1))
    # Constraints are evaluated to round-off, 2e-16 m; accelerations and multipliers follow them by 1/(βh²) = 4e6 1/s²,
    # and the double root −ρ∞ sums errors up to 1/(1 − ρ∞)² = 100 of them: 8e-8 m/s², 1e-6 N of 362 N (full Newton to
    # 1e-14 differs as much).
    for a, b in zip(jax.tree.leaves(second.state(-1)), jax.tree.leaves(whole.state(-1))):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-8 * float(jnp.abs(b).max()))


def test_a_failed_step_ends_the_run():
    """After a failure everything is NaN and no iteration is spent."""
    model = heavy_top()
    scheme = lg.GeneralizedAlpha(0.9, max_iterations=1, tolerance=1e-14, factor_every=0)
    state0 = lg.initial_state(model)
    grid = EqualGrid(jnp.zeros(()), jnp.asarray(0.05), 5)
    states, stats = jax.jit(lambda s: states_of(scheme, model.system(), grid, s))(state0)
    assert isinstance(states, State)
    assert stats.converged.tolist() == [False] * 5
    assert stats.iterations.tolist() == [1, 0, 0, 0, 0]
    assert bool(jnp.all(jnp.isfinite(states.v[0]))) and bool(jnp.all(jnp.isnan(states.v[1:])))


@pytest.mark.parametrize("factor_every", some_quick([7, 1, 1000]))
@pytest.mark.parametrize("scene", some_quick([heavy_top, lambda: spinning_top(0.7), lambda: spatial_chain(2)]))
def test_modified_newton_is_full_newton(scene, factor_every):
    """The age of the matrix changes the iterations, not the motion; the heavy top turns 0.15 rad in a step."""
    full, modified = (
        lg.simulate(scene(), t1=0.05, num_steps=50, integrator=lg.GeneralizedAlpha(0.9, factor_every=every))
        for every in (0, factor_every)
    )
    assert bool(jnp.all(modified.stats.converged))
    assert int(modified.stats.iterations.max()) <= 12 + int(full.stats.iterations.max())
    for a, b in zip(jax.tree.leaves(modified.states), jax.tree.leaves(full.states)):
        # round-off as in the continuation above, relative to accelerations of 7 m/s²
        np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-7 * float(jnp.abs(b).max()))


@pytest.mark.parametrize("factor_every", [0, 20])
def test_what_makes_a_matrix_is_compiled_once(factor_every):
    """One factorization in the program, of modified and full Newton together. No loop that carries its inverse selects
    between the lanes of a batch."""
    system, zero = heavy_top().system(), jnp.zeros(6)
    state = State(q=system.reference()[0], v=zero, vdot=zero, lam=zero[:3], a=zero)
    scheme = lg.GeneralizedAlpha(0.9, factor_every=factor_every)
    grid = EqualGrid(jnp.zeros(()), jnp.asarray(1e-3), 3)
    steps = lambda state: states_of(scheme, system, grid, state)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf])[None], state)
    program = list(equations(jax.make_jaxpr(jax.vmap(jax.vmap(steps)))(batch).jaxpr))
    assert [each.invars[0].aval.shape for each in program if each.primitive.name == "lu"] == [(1, 2, 9, 9)]
    carrying = [
        each.params["cond_jaxpr"].out_avals[0].shape
        for each in program
        if each.primitive.name == "while" and (1, 2, 9, 9) in [leaf.aval.shape for leaf in each.outvars]
    ]
    assert carrying == ([(), ()] if factor_every else [])


@pytest.mark.parametrize("unknowns", [5, 40, 1000])
def test_a_matrix_serves_as_long_as_that_is_cheapest(unknowns):
    """Iterations that grow by one every third step: the average cost per step is the least of all schedules."""
    cost = min(20, 4 + unknowns // 5)
    iterations = [3 + n // 3 for n in range(60)]
    averages = [(cost + sum(iterations[:n])) / n for n in range(1, 60)]
    wear, n = Wear.unused(), 0
    while not wear.out(unknowns):
        wear = wear.after(n == 0, jnp.asarray(iterations[n], jnp.int32))
        n += 1
    best = averages.index(min(averages)) + 1
    assert 1 < best < 30
    assert best <= n <= best + 1  # the next step is taken to be like the last one


@pytest.mark.slow  # `test_orders_on_the_heavy_top` is in the quick run
@pytest.mark.parametrize("scene", ["shaft", pytest.param("hinge on SE(3)", marks=pytest.mark.slow)])
def test_multipliers_converge_where_the_motion_does_not_see_them(scene):
    """A driven shaft, and a hinge on SE(3), whose centres of mass turn by 2 rad in twenty steps: increments of modified
    Newton are zero at once, while multipliers grew to 1e3 times what they are, or were 2e-6 off."""
    body = lg.RigidBody(1.5, (0.1, 0.2, 0.25), position=(0.4, 0.1, 0.0), angular_velocity=(0.0, 10.0, 0.0))
    joints = {"hinge": lg.RevoluteJoint(None, "body", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))}
    options = {"formulation": "SE3"}
    if scene == "shaft":
        law, options = lg.Polynomial((0.0, 10.0)), {}
        joints["motor"] = lg.RotationDriver(None, "body", axis=(0.0, 1.0, 0.0), value=law)
    model = lg.Model({"body": body}, joints, {"gravity": lg.Gravity((0.0, 0.0, -9.81))}, **options)
    run = lg.simulate(model, t1=0.6, num_steps=60)
    needed = 1.5 * (np.asarray(run.body("body").acceleration) + np.array([0.0, 0.0, 9.81]))
    force = np.asarray(run.joint("hinge").force)
    np.testing.assert_allclose(force, needed, rtol=0, atol=3e-8 * np.abs(needed).max())  # _OF_FORCES, one contraction
