"""Radau IIA against explicit schemes and numbers of high order, its order, and its derivatives."""

import dataclasses
import json
from functools import partial
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from helpers import everything, random_like, says, some_quick
from jax.flatten_util import ravel_pytree
from rolling_disc import scene as rolling_disc
from scipy.spatial.transform import Rotation

import lgsens as lg
from lgsens.dynamics import State
from lgsens.examples import heavy_top, spinning_top
from lgsens.integrate._linearized import Node
from lgsens.integrate._radau_sparse import stage_factors, stage_plan
from lgsens.integrate._radau_stages import RadauStages, left

RADAU = lg.RadauIIA()
HEAVY = json.loads((Path(__file__).parents[1] / "data" / "heavy_top_bruls2012.json").read_text())
SQUARE = lg.Criterion(integrand=lambda s, p: s.body("top").position[0] ** 2)


def stiff_pair(k=1e7):
    """A pendulum on a hinge, and a body that a bushing of k N/m holds at its end: 3e3 rad/s beside 3 rad/s."""
    arm = lg.RigidBody(mass=1.0, inertia=(0.01, 0.1, 0.1), position=(0.5, 0.0, 0.0))
    end = lg.RigidBody(mass=1.0, inertia=(0.01, 0.01, 0.01), position=(1.0, 0.0, 0.1))
    rates = {"stiffness": (k, k, k), "damping": (5e3, 5e3, 5e3)}
    turning = {"rotational_stiffness": (1e5, 1e5, 1e5), "rotational_damping": (50.0, 50.0, 50.0)}
    return lg.Model(
        {"arm": arm, "end": end},
        {"hinge": lg.RevoluteJoint(None, "arm", at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))},
        {
            "gravity": lg.Gravity((0.0, 0.0, -9.81)),
            "bushing": lg.Bushing("arm", "end", at=(1.0, 0.0, 0.0), **rates, **turning),
        },
    )


def ends(run):
    """What the last state is made of, each part in units of the largest number that the reference has."""
    q = run.states.q
    return [
        np.concatenate([np.ravel(q.position[-1]), np.ravel(q.orientation[-1])]),
        run.states.v[-1],
        run.states.lam[-1],
    ]


def errors(model, t1, num_steps, exact):
    found = ends(lg.simulate(model, t1=t1, num_steps=num_steps, integrator=RADAU))
    return np.array([np.abs(f - e).max() / np.abs(e).max() for f, e in zip(found, exact)])


def test_order_five_in_motion_and_multipliers():
    """On the heavy top; 3 × 40 stages leave 4e-6, generalized-α 6e-3 after as many steps."""
    (state,) = (state for state in HEAVY["states"] if state["t"] == 0.2)
    turned = Rotation.from_quat(state["quat_wxyz"], scalar_first=True).as_matrix()
    exact = [np.append(state["x"], turned), np.append(state["xdot"], state["Omega"]), np.array(state["lam"])]
    coarse, fine = (errors(heavy_top(), 0.2, n, exact) for n in (20, 40))
    assert np.log2(coarse / fine).min() > 4.8  # 5, less what the next power of h = 5 ms takes
    assert fine[0] < 2e-5


@pytest.mark.slow  # the reference has 6,500 stages
def test_stiff_pair():
    """3 × 40 stages over half a second, hω = 40, leave 2e-8 in positions; the order is that of the stages, 3.

    The reference, Dopri8 in steps of 0.1 ms, is right to 1e-13 there.
    """
    model = stiff_pair()
    exact = ends(lg.simulate(model, t1=0.5, num_steps=5000, integrator=lg.IndexReducedODE(diffrax.Dopri8())))
    coarse, fine = (errors(model, 0.5, n, exact) for n in (20, 40))
    assert fine[0] < 2e-7
    assert np.log2(coarse / fine)[:2].min() > 2.5


def test_joints_hold_at_both_levels():
    """To Newton's tolerance, 1e-12, and round-off of a hundred steps."""
    run = lg.simulate(spinning_top(0.7), t1=1.0, num_steps=100, integrator=RADAU)
    system = run.system
    violation = jax.vmap(system.constraint)(run.states.q, run.t)
    rate = jax.vmap(lambda q, v, t: system.constraint_jacobian(q, t) @ v)(run.states.q, run.states.v, run.t)
    assert np.abs(violation).max() < 1e-11
    assert np.abs(rate).max() < 1e-10  # velocities of 10 rad/s


P = jnp.array([0.7, 1.0, 0.3])  # angle, length, end


def psi(p):
    run = lg.simulate(spinning_top(p[0], length=p[1]), t1=p[2], num_steps=4, integrator=RADAU, throw=False)
    return 1e3 * SQUARE(run) + run.multiplier("pivot")[-1, 2] * 1e-3


@pytest.mark.slow  # by its equations alone, as the scheme of `test_own_scheme`
def test_both_modes_are_differences():
    """Of sixth order with a step of 1e-3: 1e-18 × derivatives of size 1e2, round-off 1e-15/1e-3 of Ψ."""
    compiled = jax.jit(psi)
    expected = np.array([central(lambda s, e=e: compiled(P + s * e), 1e-3) for e in jnp.eye(3)])
    forward, reverse = jax.jit(lambda p: (jax.jacfwd(psi)(p), jax.grad(psi)(p)))(P)
    np.testing.assert_allclose(forward, expected, rtol=1e-8)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)  # the same systems, other order of round-off


@pytest.mark.slow  # three programs
def test_criteria_are_of_its_order():
    """By its own quadrature, against the explicit scheme's in small steps; value and gradient."""
    build = lambda p: spinning_top(p[0], length=p[1])
    of = lambda n, scheme: lg.differentiate(SQUARE, build, P[:2], t1=1.0, num_steps=n, integrator=scheme)
    exact = of(2000, lg.IndexReducedODE(diffrax.Dopri8()))
    off = lambda found: [
        np.abs(found.value - exact.value) / exact.value,
        np.abs(found.gradient - exact.gradient).max() / np.abs(exact.gradient).max(),
    ]
    coarse, fine = np.array(off(of(25, RADAU))), np.array(off(of(50, RADAU)))
    assert np.log2(coarse / fine).min() > 4.5
    assert fine.max() < 1e-6


def machine():
    """A gear between two hinges that three bodies share, a driven rod, an actuator with a state, a planar body."""
    body = lambda x, **more: lg.RigidBody(1.0, (0.02, 0.03, 0.04), position=(x, 0.0, 0.1), **more)
    hinge = lambda a, b, x: lg.RevoluteJoint(a, b, at=(x, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    joints = {
        "first": hinge(None, "a", 0.0),
        "second": hinge("a", "b", 0.5),
        "ball": lg.SphericalJoint("b", "c", at=(1, 0, 0)),
    }
    joints["gear"] = lg.CoordinateCoupling(joints["first"], joints["second"], (0.3, 0.1))
    joints["rod"] = lg.DistanceJoint(
        "c", "d", at_a=(1.5, 0, 0), at_b=(2.0, 0, 0), length=lg.Harmonic(amplitude=0.1, frequency=3.0, offset=0.5)
    )
    forces = {
        "gravity": lg.Gravity((0.0, 0.0, -9.81)),
        "damper": lg.SpringDamper("a", "d", at_a=(0.2, 0, 0), at_b=(2, 0.1, 0), stiffness=1e3, damping=5.0),
        "maxwell": lg.MaxwellElement("a", "c", at_a=(0.2, 0, 0), at_b=(1, 0.1, 0), stiffness=1e3, damping=5.0),
    }
    bodies = {"a": body(0.2), "b": body(0.7, angular_velocity=(0.1, 0.5, 0.2)), "c": body(1.2)}
    return lg.Model(bodies | {"d": body(2.1, free="x z ry")}, joints, forces)


def beam():
    """Of steel, on a hinge."""
    section = lg.BeamSection.tube(0.03, 0.003, young=2.1e11, poisson=0.3, density=7850.0)
    beam = lg.Beam("arm", section, [[0, 0, 0], [1.0, 0, 0]], elements=3)
    hinge = {"hinge": lg.RevoluteJoint(None, "arm.0", at=(0, 0, 0), axis=(0, 1, 0))}
    return lg.Model(beam.bodies, hinge, beam.forces | {"gravity": lg.Gravity((0.0, 0.0, -9.81))})


def points():
    """Two point masses on a rod, which nothing damps: C_t has no entries."""
    bodies = {"a": lg.RigidBody(1.0, None), "b": lg.RigidBody(2.0, None, (1.0, 0.0, 0.0), velocity=(0.0, 1.0, 0.0))}
    return lg.Model(bodies, {"rod": lg.DistanceJoint("a", "b", at_a=(0, 0, 0), at_b=(1.0, 0, 0))})


def free_points():
    """Two point masses that fall: no joints, no stiffness, no damping."""
    return lg.Model(points().bodies, {}, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})


DENSE, SPARSE = lg.DenseLU(), lg.BlockSparse()
LINEARIZED = [
    (SPARSE, free_points),
    (SPARSE, points),
    (SPARSE, machine),
    (DENSE, lambda: spinning_top(0.7)),
    (SPARSE, everything),
    (SPARSE, beam),
    (DENSE, rolling_disc),
]


@pytest.mark.parametrize("solver, scene", some_quick(LINEARIZED))
def test_factors_are_those_of_the_equations(solver, scene):
    """Anywhere, with μ of the size of λ: F_z times the solution, and F_n, by forward-mode autodiff of the equations."""
    model, rng = scene(), np.random.default_rng(0)
    system, state = dataclasses.replace(model.system(), linear_solver=solver), lg.initial_state(model)
    assert (stage_plan(system) is None) == (solver is DENSE)
    positions = len(state.lam) - system.num_velocity_rows
    node = Node(*(jnp.asarray(x) for x in (0.3, 0.34, 0.04)))
    at = (state.v, state.vdot, state.lam, state.lam[:positions])
    found = RadauStages(*(one[None] + random_like(jnp.zeros((3, *one.shape)), rng) for one in at))

    @jax.jit
    def solved(rows, w, v):
        factors = stage_factors(system, node, state, found)
        solve = partial(factors.exactly, node.h)
        return solve(rows), factors.by_start(node.h, w, v), jax.linear_transpose(solve, rows)(weights)[0]

    def equations(found, w, v):
        begun = State(system.group.retract(state.q, w), state.v + v, state.vdot, state.lam, state.a)
        return left(system, node, begun, found)

    rows, weights, w, v = *random_like((found, found), rng), *random_like((state.v, state.v), rng)
    change, by_start, weighted = solved(rows, w, v)
    none = jnp.zeros_like(w)
    derivative = jax.jit(lambda *tangent: jax.jvp(equations, (found, none, none), tangent)[1])
    flat = lambda tree: ravel_pytree(tree)[0]
    resting = jax.tree.map(jnp.zeros_like, found)
    # round-off of rows for unknowns of size 1, of 1e2 with μ to 1e9 of a beam, in sums of tens of terms
    unit = float(jnp.finfo(float).eps * jnp.abs(flat(by_start)).max())
    np.testing.assert_allclose(flat(derivative(change, none, none)), flat(rows), rtol=0, atol=64 * unit)
    np.testing.assert_allclose(flat(derivative(resting, w, v)), flat(by_start), rtol=0, atol=64 * unit)
    # the same factors: round-off of sums of 1e2 terms that cancel, × 1e2
    np.testing.assert_allclose(flat(weights) @ flat(change), flat(weighted) @ flat(rows), rtol=1e-12)


@pytest.mark.slow  # two programs
def test_a_start_that_stiff_damping_stops():
    """J θ̈ + c θ̇ + k θ = 0 with c/J = 1e5 1/s: v̇ of the start would turn the body by 10 rad in a step of 10 ms."""
    inertia, c, k, speed, t1 = 1e-4, 10.0, 1.0, 2.0, 0.1
    rates = {"rotational_stiffness": (k,) * 3, "rotational_damping": (c,) * 3}
    body = lg.RigidBody(1.0, (inertia,) * 3, angular_velocity=(0.0, speed, 0.0))
    hold = {"pivot": lg.SphericalJoint(None, "b", at=jnp.zeros(3))}
    model = lg.Model({"b": body}, hold, {"bushing": lg.Bushing(None, "b", at=jnp.zeros(3), **rates)})
    run = lg.simulate(model, t1=t1, num_steps=10, integrator=RADAU)
    fast, slow = np.roots([inertia, c, k])
    angle = speed * (np.exp(slow * t1) - np.exp(fast * t1)) / (slow - fast)
    # L-stable: of c h/J = 1e3 the first stages leave its inverse of what is fast
    np.testing.assert_allclose(-run.body("b").orientation[-1, 2, 0], angle, rtol=1e-3)


@pytest.mark.slow  # three programs
def test_blocks_and_nullspaces_take_the_same_steps():
    """A steel beam that falls: motion and derivatives by the direction of gravity, in both modes."""

    def tip(gravity, solver, sensitivity):
        model = beam()
        model = lg.Model(
            model.bodies, model.joints, model.forces | {"gravity": lg.Gravity(gravity)}, linear_solver=solver
        )
        run = lg.simulate(model, t1=0.05, num_steps=5, integrator=RADAU, sensitivity=sensitivity)
        return run.body("arm.3").position[-1] @ jnp.array([1.0, 2.0, 3.0])

    gravity, found = jnp.array([0.3, 0.2, -9.81]), []
    for solver, kind in ((DENSE, "forward"), (SPARSE, "forward"), (SPARSE, "reverse")):
        sensitivity = lg.DirectDifferentiation() if kind == "forward" else lg.AdjointVariable()
        psi = partial(tip, solver=solver, sensitivity=sensitivity)
        gradient = jax.jacfwd(psi) if kind == "forward" else jax.grad(psi)
        found.append(jnp.append(jax.jit(gradient)(gravity), jax.jit(psi)(gravity)))
    # Newton's tolerance 1e-12 of a step, and round-off of its stiffness (h² K/M = 1e6) × 1e-16 in derivatives
    np.testing.assert_allclose(found[1], found[0], rtol=1e-9)
    np.testing.assert_allclose(found[2], found[1], rtol=1e-10)


def test_what_it_cannot():
    with pytest.raises(ValueError, match=says("RadauIIA", "`tolerance`", "between 0 and 0.01", "1.0")):
        lg.RadauIIA(tolerance=1.0)
    model = spinning_top(0.7)
    soft = lg.Model(model.bodies, model.joints, model.forces, redundant="minimum_norm")
    with pytest.raises(ValueError, match=says("RadauIIA", "independent constraints")):
        lg.simulate(soft, t1=0.1, num_steps=2, integrator=RADAU)
