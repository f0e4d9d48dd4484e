"""Stabilized index 2 and the fixed budget of Newton's iterations: constraints, orders, derivatives, multipliers."""

import dataclasses
import re
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from helpers import EPS, everything, says, some_quick

import lgsens as lg
from lgsens.dynamics import State, accelerations, constraint_velocity
from lgsens.examples import four_bar, heavy_top, spinning_top
from lgsens.integrate import EqualGrid, Node, states_of

STABILIZED = lg.GeneralizedAlpha(0.9, stabilized=True)


@jax.jit
def violations(trajectory):
    """The largest entries of Φ and of B v at the steps, the first state left out."""
    system, states = trajectory.system, jax.tree.map(lambda leaf: leaf[1:], trajectory.states)
    position = jax.vmap(lambda q: system.constraint(q, 0.0))(states.q)
    velocity = jax.vmap(lambda q, v: constraint_velocity(system, q, v, 0.0))(states.q, states.v)
    return jnp.abs(position).max(), jnp.abs(velocity).max()


# Runs of 50 and 100 steps of one structure: compiled once, they serve most tests below.


@pytest.mark.parametrize(("scene", "drift"), some_quick([(lambda: spinning_top(0.7), 1e-5), (four_bar, 1e-6)]))
def test_velocities_satisfy_the_joints(scene, drift):
    """B v = 0 to round-off in every step; index 3 leaves h² times a constant."""
    run = lambda scheme, n: violations(lg.simulate(scene(), t1=0.1, num_steps=n, integrator=scheme))
    position, velocity = run(STABILIZED, 100)
    # arms of 1 m: the last increments leave a fraction of round-off in q, and that divided by h = 1 ms in v
    assert position <= 4 * EPS
    assert velocity <= EPS / 1e-3
    coarse, fine = (run(lg.GeneralizedAlpha(0.9), n)[1] for n in (50, 100))
    assert fine > drift
    np.testing.assert_allclose(np.log2(coarse / fine), 2.0, atol=0.1)  # the h³ term at 0.02 rad per step


def test_orders():
    """q, v and λ are of second order from the first step: q and v against extrapolated runs of index 3 (order 4),
    λ against what the equations of motion give for the same q and v."""

    def run(scheme, n):
        found = lg.simulate(spinning_top(0.7), t1=0.2, num_steps=n, integrator=scheme)
        body = found.body("top")
        return found, [leaf[:: n // 50] for leaf in (body.position, body.velocity)]

    (_, coarse), (_, fine) = (run(lg.GeneralizedAlpha(0.9), n) for n in (50, 100))
    exact = [(4.0 * better - worse) / 3.0 for worse, better in zip(coarse, fine)]
    errors = []
    for n in (50, 100):
        found, motion = run(STABILIZED, n)
        _, lam = jax.jit(jax.vmap(partial(accelerations, found.system)))(found.states.q, found.states.v, found.t)
        pairs = [*zip(motion, exact), (found.states.lam, lam)]
        errors.append([float(jnp.abs(mine - theirs).max()) for mine, theirs in pairs])
    np.testing.assert_allclose(np.log2(np.divide(*errors)), 2.0, atol=0.15)  # h³ at 0.04 rad per step


def roughness(trajectory):
    """The largest second difference of the multipliers [N]: h² λ̈ of the motion, four times what alternates."""
    return float(jnp.abs(jnp.diff(trajectory.multiplier("pivot"), 2, axis=0)).max())


def test_oscillations_of_multipliers():
    """The heavy top at h = 1 ms, 0.15 rad per step, ρ∞ = 0.9. Its pivot carries 361 N, and h² λ̈ is 1 N.

    From a₀ = v̇₀ the α-scheme is off by h (α_m − α_f) v̈₀. Index 3 must take that out through the positions, and λ swings
    by 115 N for dozens of steps; B v⁺ = 0 takes it out of one step.
    """
    start = lg.initial_state(heavy_top())
    run = lambda scheme, **kw: roughness(lg.simulate(heavy_top(), t1=0.1, num_steps=100, integrator=scheme, **kw))
    assert run(lg.GeneralizedAlpha(0.9), state0=start) > 400.0  # measured: 453 N
    assert run(STABILIZED, state0=start) < 4.0
    assert run(lg.GeneralizedAlpha(0.9)) > 2.0  # the consistent start, measured: 3.6 N; a ripple of 0.6 N
    assert run(STABILIZED) < 1.2  # the motion itself, 1.05 N


def test_units():
    """The same top in mm, t, N: what corrects positions does not know of units."""
    run = lambda *scene: lg.simulate(heavy_top(*scene), t1=0.1, num_steps=100, integrator=STABILIZED)
    metres = run()
    millimetres = run(15e-3, 234.375, 468.75, 234.375, 1e3, 150.0, -4.61538, 9810.0)
    here, there = metres.body("top"), millimetres.body("top")
    # convergence leaves a fraction of round-off in 1 m, which turns, in 100 steps, at 15 rad: 1e-13
    np.testing.assert_allclose(there.position / 1e3, here.position, rtol=0, atol=1e-12)
    np.testing.assert_allclose(there.orientation, here.orientation, rtol=0, atol=1e-12)
    # multipliers as round-off over βh²: 1e-9 m/s² of 15 kg, summed up by ρ∞
    np.testing.assert_allclose(millimetres.multiplier("pivot"), metres.multiplier("pivot"), rtol=0, atol=1e-6)


def test_iteration_matrix():
    """It is the derivative of the defect, and its condition does not grow as h → 0."""
    system = heavy_top().system()
    state = lg.initial_state(heavy_top())
    rng = np.random.default_rng(1)
    unknowns = jnp.concatenate([state.a + rng.normal(size=6), jnp.asarray(rng.normal(size=6))])
    unit, t = np.eye(12), jnp.zeros(())

    @jax.jit
    def matrix_and_factors(h):
        step = STABILIZED.shared(system).step(state, Node(t, t, h))
        defect = lambda x: jnp.concatenate(step.defect(step.motion(x[:6], x[6:]), x[6:]))
        factors, _ = step.factors(step.motion(unknowns[:6], unknowns[6:]), unknowns[6:])
        matrix = jax.jacfwd(defect)(unknowns)
        columns = jax.vmap(lambda x: jnp.concatenate(factors.solve(x[:6], x[6:])), 1, 1)
        rows = jax.vmap(lambda x: jnp.concatenate(factors.solve(x[:6], x[6:], transposed=True)))
        return columns(matrix), rows(matrix), factors.factors.factors.lu

    conditions = []
    for h in (1e-2, 1e-3, 1e-5):
        columns, rows, lu = matrix_and_factors(jnp.asarray(h))
        np.testing.assert_allclose(columns, unit, atol=1e-9)  # round-off × condition
        np.testing.assert_allclose(rows, unit, atol=1e-9)
        conditions.append(np.linalg.cond((np.tril(lu, -1) + unit) @ np.triu(lu)))
    assert max(conditions) <= 1e4  # the heavy top: 15 kg, 0.23 kg m², 1 m
    np.testing.assert_allclose(conditions[1:], conditions[-1], rtol=0.2)


def driven(x, solver=None):
    """Two links on a hinge, a driven rod to a body in the plane, springs and dampers: blocks that are not alike."""
    body = lambda place, **more: lg.RigidBody(1.0, (0.02, 0.03, 0.04), position=(place, 0.0, 0.1), **more)
    bodies = {"a": body(0.2, angular_velocity=(0, 1, 0)), "b": body(0.7), "c": body(2.1, free="x z ry")}
    length = lg.Harmonic(amplitude=0.1, frequency=3.0, offset=1.0 * x[0])
    joints = {
        "hinge": lg.RevoluteJoint(None, "a", at=(0, 0, 0), axis=(0, 1, 0)),
        "ball": lg.SphericalJoint("a", "b", at=jnp.stack([0.5 * x[0], 0.0 * x[0], 0.0 * x[0]])),
        "rod": lg.DistanceJoint("b", "c", at_a=(1.0, 0, 0), at_b=(2.0, 0, 0), length=length),
    }
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -9.81)),
        "spring": lg.SpringDamper("a", "c", at_a=(0.2, 0, 0), at_b=(2, 0.1, 0), stiffness=1e3 * x[1], damping=5.0),
        "foot": lg.SpringDamper(None, "c", at_a=(2, 0, -1), at_b=(2, 0, 0), stiffness=1e5, damping=20.0),
    }
    return lg.Model(bodies, joints, forces, linear_solver=solver)


@pytest.mark.slow  # `test_iteration_matrix` is in the quick run
@pytest.mark.parametrize("scene", some_quick([lambda: driven(jnp.ones(2)), everything]))
def test_blocks_are_those_of_the_iteration_matrix(scene):
    """The derivative of the defect, in both directions, where steps are long beside the stiffness, and short."""
    system = dataclasses.replace(scene().system(), linear_solver=lg.BlockSparse())
    state, rng = lg.initial_state(scene()), np.random.default_rng(1)
    k, m = len(state.v), len(state.lam)
    x = jnp.asarray(rng.normal(size=k + 2 * m)) + jnp.concatenate([state.a, state.lam, 0.0 * state.lam])

    @jax.jit
    def products(h):
        shared = STABILIZED.shared(system)
        step = shared.step(state, Node(0.3 + 0.0 * h, 0.3 + h, h))
        defect = lambda x: jnp.concatenate(step.defect(step.motion(x[:k], x[k:]), x[k:]))
        factors, _ = step.factors(step.motion(x[:k], x[k:]), x[k:])
        matrix = jax.jacfwd(defect)(x)
        columns = jax.vmap(lambda x: jnp.concatenate(factors.solve(x[:k], x[k:])), 1, 1)
        rows = jax.vmap(lambda x: jnp.concatenate(factors.solve(x[:k], x[k:], transposed=True)))
        return columns(matrix), rows(matrix)

    assert STABILIZED.shared(system).plan is not None
    for h in (0.05, 1e-3, 1e-5):
        for product in products(jnp.asarray(h)):
            np.testing.assert_allclose(product, np.eye(k + 2 * m), atol=1e-8)  # round-off × condition, 1e6 at 0.05 s


def end_of_driven(x, solver, sensitivity):
    settings = {"integrator": STABILIZED, "sensitivity": sensitivity}
    found = lg.simulate(driven(x, solver), t1=0.1 * x[2], num_steps=10, **settings)
    q, last = found.states.q, found.states
    end = jnp.concatenate([jnp.ravel(leaf[-1]) for leaf in (q.position, q.orientation, last.v, 1e-2 * last.lam)])
    return jnp.asarray(np.random.default_rng(0).normal(size=end.shape)) @ end


@pytest.mark.slow  # five programs
def test_blocks_give_what_arrays_give():
    """Values and derivatives, by a driven length, a place, a stiffness and the step, forward and reverse."""
    x, forward, reverse = jnp.ones(3), lg.DirectDifferentiation(), lg.AdjointVariable()
    of = lambda solver, method, mode: jax.jit(mode(lambda x: end_of_driven(x, solver, method)))(x)
    value, gradient = of(lg.BlockSparse(), reverse, jax.value_and_grad)
    dense, by_dense = of(lg.DenseLU(), reverse, jax.value_and_grad)
    # multipliers carry round-off/(βh²) = 1e-11, and what follows of them is of their size
    np.testing.assert_allclose(value, dense, rtol=1e-9)
    np.testing.assert_allclose(gradient, by_dense, rtol=1e-8)
    np.testing.assert_allclose(gradient, of(lg.BlockSparse(), forward, jax.jacfwd), rtol=1e-9)
    both = jax.jit(lambda x: end_of_driven(x, lg.BlockSparse(), forward))
    slopes = [central(lambda s, e=e: both(x + s * e), 1e-3) for e in jnp.eye(3)]
    np.testing.assert_allclose(gradient, slopes, rtol=1e-6)  # sixth order; round-off of multipliers over δ


def top(x, sensitivity=lg.DirectDifferentiation()):
    """Four criteria of position, velocity and multipliers; of angle, mass, inertia, length and final time."""
    model = spinning_top(x[0], mass=15.0 * x[1], inertia=jnp.array([0.2, 0.4, 0.2]) * x[2], length=x[3])
    found = lg.simulate(model, t1=0.1 * x[4], num_steps=10, integrator=STABILIZED, sensitivity=sensitivity)
    body, pivot = found.body("top"), found.multiplier("pivot")
    return jnp.stack(
        [
            lg.time_integral(found.t, body.position[:, 0] ** 2) * 1e3,
            body.velocity[-1, 2],
            lg.time_integral(found.t, jnp.sum(pivot**2, axis=1)) * 1e-3,
            body.acceleration[5, 1],
        ]
    )


def linkage(x):
    """Two criteria of the four-bar; of the hardpoint of its crank and the mass of its coupler."""
    model = four_bar(a=0.3 * x[0], m3=2.0 * x[1])
    found = lg.simulate(model, t1=0.2, num_steps=12, integrator=STABILIZED)
    coupler = found.body("coupler")
    acceleration = lg.time_integral(found.t, jnp.sum(coupler.acceleration**2, axis=1))
    return jnp.stack([coupler.position[-1, 0], acceleration * 1e-2, found.multiplier("B")[-1, 0] * 1e-2])


TOP, LINKAGE = jnp.array([0.7, 1.0, 1.0, 1.0, 1.0]), jnp.ones(2)


@pytest.mark.slow
@pytest.mark.parametrize(("function", "x"), [(top, TOP), (linkage, LINKAGE)], ids=["top", "four_bar"])
def test_gradient(function, x):
    """Forward and reverse against each other and against finite differences."""
    all_of = jax.jit(lambda x: (function(x), jax.jacfwd(function)(x), jax.jacrev(function)(x)))
    value = lambda x: all_of(x)[0]
    differences = np.stack([central(lambda s, e=e: np.asarray(value(x + s * e)), 1e-3) for e in jnp.eye(len(x))], 1)
    _, forward, backward = all_of(x)
    scale = np.abs(differences).max(axis=1, keepdims=True)
    # sixth order, δ = 1e-3: round-off of multipliers and accelerations, EPS/(βh²) = 1e-11, over δ
    np.testing.assert_allclose(forward / scale, differences / scale, rtol=0, atol=2e-8)
    np.testing.assert_allclose(backward / scale, forward / scale, rtol=0, atol=1e-11)  # condition × 12 steps


@pytest.mark.slow
def test_batches_and_explicit_adjoint():
    """Lane by lane the gradients of single designs, by either method."""
    gradient, explicit = (
        jax.jit(jax.grad(lambda x, method=method: top(x, sensitivity=method)[2]))
        for method in (lg.DirectDifferentiation(), lg.AdjointVariable())
    )
    designs = TOP[None] * jnp.array([[1.0, 1.0, 1.0, 1.0, 1.0], [1.1, 0.9, 1.0, 1.05, 1.2]])
    for lanes in (jax.jit(jax.vmap(gradient))(designs), jax.jit(jax.vmap(explicit))(designs)):
        for lane, x in zip(lanes, designs):
            np.testing.assert_allclose(lane, gradient(x), rtol=1e-10, atol=1e-10)  # a batched LU rounds differently


@pytest.mark.slow
def test_hessian():
    """Second derivatives, through L itself, against differences of the gradient."""
    criterion = lambda x: jnp.sum(top(x)[:3])
    gradient = jax.jit(jax.grad(criterion))
    hessian = np.asarray(jax.jit(jax.hessian(criterion))(TOP))
    expected = np.stack([central(lambda s, e=e: np.asarray(gradient(TOP + s * e)), 1e-3) for e in jnp.eye(5)], 1)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(hessian, expected, rtol=0, atol=1e-7 * scale)  # as above, one order higher
    np.testing.assert_allclose(hessian, hessian.T, rtol=0, atol=1e-10 * scale)


@pytest.mark.slow
def test_saved_outputs_and_differentiate():
    """What `save` and `differentiate` give is what the trajectory gives."""
    criterion = lg.Criterion(terminal=lambda s, p: s.body("top").velocity[2])
    build = lambda p: spinning_top(p["angle"])
    found = lg.differentiate(
        criterion, build, {"angle": 0.7}, t1=0.1, num_steps=10, integrator=STABILIZED, method=lg.DirectDifferentiation()
    )
    slope = lambda x: jax.jacfwd(top)(x)[1, 0]
    np.testing.assert_allclose(found.gradient["angle"], slope(TOP), rtol=1e-12)

    def saved(angle):
        run = lg.simulate(spinning_top(angle), t1=0.1, num_steps=10, integrator=STABILIZED, save=height)
        assert run.final.lam.shape == (3,)
        return run.values[-1]

    value, gradient = jax.value_and_grad(saved)(0.7)
    np.testing.assert_allclose([value, gradient], [top(TOP)[1], found.gradient["angle"]], rtol=1e-12)


def height(instant):
    return instant.body("top").velocity[2]


def test_what_is_refused():
    for name, value, said in (("stabilized", 1, "True"), ("iterations", 0, "at least 1"), ("iterations", 2.0, "int")):
        bad: dict[str, Any] = {name: value}
        with pytest.raises(ValueError, match=says(f"GeneralizedAlpha: `{name}` must be", said, f"got {value!r}")):
            lg.GeneralizedAlpha(**bad)


@pytest.mark.parametrize(("iterations", "factor_every"), some_quick([(2, 0), (8, 20)]))
def test_fixed_budget(iterations, factor_every):
    """So many iterations in every step, and the motion of converged steps where they are enough.

    Increments of 1e-10 are 4e-4 in accelerations, over βh². With a matrix 20 steps (0.2 rad) old five iterations leave
    1e-5 of that, and each further one a twentieth of what was left.
    """
    budget = lg.GeneralizedAlpha(0.9, iterations=iterations, factor_every=factor_every)
    run = lambda scheme: lg.simulate(spinning_top(0.7), t1=0.1, num_steps=100, integrator=scheme)
    fixed, free = run(budget), run(lg.GeneralizedAlpha(0.9))
    assert fixed.stats.iterations.tolist() == [iterations] * 100
    assert float(fixed.stats.increment.max()) <= budget.tolerance
    for a, b in zip(jax.tree.leaves(fixed.states), jax.tree.leaves(free.states)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-7 * float(jnp.abs(b).max()))  # round-off over βh²


@pytest.mark.slow
def test_a_budget_that_is_too_small():
    """It fails with the increment that is left, unless the tolerance allows it."""
    run = lambda **kw: lg.simulate(
        spinning_top(0.7),
        t1=0.1,
        num_steps=5,
        integrator=lg.GeneralizedAlpha(0.9, iterations=1, factor_every=0, **kw),
        throw=False,
    )
    failed, allowed = run(), run(tolerance=1e-2)
    assert int(failed.result) == lg.RESULTS.newton_failed
    assert failed.stats.iterations.tolist() == [1, 0, 0, 0, 0]
    assert int(allowed.result) == lg.RESULTS.successful
    # 0.2 rad per step: the first increment is h³ v̈ and more, what is left its square or so
    assert 1e-6 < float(allowed.stats.increment.max()) < 1e-2


@pytest.mark.slow  # `test_fixed_budget` is in the quick run
def test_a_budget_has_no_loop_that_waits():
    """No `while` in the program of full Newton; of modified Newton one, whose predicate a batch does not share."""

    def loops(scheme):
        system = heavy_top().system()
        zero = jnp.zeros(6)
        state = State(q=system.reference()[0], v=zero, vdot=zero, lam=zero[:3], a=zero)
        grid = EqualGrid(jnp.zeros(()), jnp.asarray(1e-3), 3)
        steps = lambda s: states_of(scheme, system, grid, scheme.complete(system, s))
        batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
        return re.findall(r"= while\[", str(jax.make_jaxpr(jax.vmap(steps))(batch)))

    for stabilized in (False, True):
        budget = partial(lg.GeneralizedAlpha, 0.9, iterations=2, stabilized=stabilized)
        assert len(loops(budget(factor_every=0))) == 0
        assert len(loops(budget(factor_every=20))) == 1
