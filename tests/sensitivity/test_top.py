"""The paper's spinning top (§8): the scheme's own values, orders, and every parameter."""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central, every_leaf
from helpers import some_quick

import lgsens as lg
from lgsens.examples import spinning_top

REFERENCE = -0.0021318254254500  # dΨ/dα₀, l = 1 m, α₀ = π/4, converged by three routes
ALPHA = np.pi / 4
DISCRETE = json.loads((Path(__file__).parents[1] / "data" / "spinning_top_discrete_galpha.json").read_text())


def criterion(model, num_steps, integrator=lg.GeneralizedAlpha(0.9), sensitivity=lg.DirectDifferentiation()):
    trajectory = lg.simulate(model, t1=1.0, num_steps=num_steps, integrator=integrator, sensitivity=sensitivity)
    return lg.time_integral(trajectory.t, trajectory.body("top").position[:, 0] ** 2)


def psi(alpha0, num_steps, length=1.0, **settings):
    return criterion(spinning_top(alpha0, length=length), num_steps, **settings)


@pytest.mark.parametrize("step", some_quick([0.02, 0.005, 0.001]))
def test_values_of_the_scheme(step):
    """Ψ and dΨ/dα₀ of the discrete scheme, by an independent implementation with a₀ = v̇₀; l = 0.5 and 1 m."""
    integrator = lg.GeneralizedAlpha(DISCRETE["rho"], second_order_start=False)
    compute = jax.jit(
        jax.value_and_grad(lambda alpha, length: psi(alpha, round(1.0 / step), length, integrator=integrator))
    )
    cases = [case for case in DISCRETE["cases"] if case["h"] == step]
    assert {case["l"] for case in cases} == {0.5, 1.0}
    for case in cases:
        value, slope = compute(ALPHA, case["l"])
        # The reference states round-off of 1e-13 for N ≤ 1000; the sum of 1000 steps loses another digit.
        np.testing.assert_allclose(value, case["Psi"], rtol=1e-11)
        np.testing.assert_allclose(slope, case["dPsi_dalpha0"], rtol=1e-11)


@pytest.fixture(scope="module")
def slopes():
    """dΨ/dα₀ at the three steps of the paper's figure, by the three routes at the first."""
    routes = {
        "DDM": jax.jacfwd(psi),
        "AVM": jax.grad(psi),
        "AdjointVariable": jax.grad(lambda a, n: psi(a, n, sensitivity=lg.AdjointVariable())),
    }
    steps = {"DDM": (500, 1000, 2000), "AVM": (500,), "AdjointVariable": (500,)}
    return {name: [float(route(ALPHA, n)) for n in steps[name]] for name, route in routes.items()}


@pytest.mark.slow
def test_the_three_routes_agree(slopes):
    # The same linear systems solved in another order: round-off 2e-16 × 500 steps × condition 5e2 would be
    # 5e-11 at worst; it does not accumulate in one direction, 1e-11 is asked for.
    np.testing.assert_allclose(slopes["AVM"], slopes["DDM"][:1], rtol=1e-11)
    np.testing.assert_allclose(slopes["AdjointVariable"], slopes["DDM"][:1], rtol=1e-11)


@pytest.mark.slow
def test_error_and_order(slopes):
    error = np.abs(np.array(slopes["DDM"]) / REFERENCE - 1.0)
    assert error[0] <= 1.1e-4  # h = 2e-3
    assert error[2] <= 7e-6  # h = 5e-4
    rate = np.log2(error[:-1] / error[1:])
    np.testing.assert_allclose(rate, 2.0, atol=0.03)  # the h⁴ term is 1e-3 of the h² term here


@pytest.mark.slow
def test_error_with_the_simple_start():
    """With a₀ = v̇₀ the errors are those of the paper's scheme, 9.9e-5 and 6.2e-6."""
    integrator = lg.GeneralizedAlpha(0.9, second_order_start=False)
    error = [abs(float(jax.grad(psi)(ALPHA, n, integrator=integrator)) / REFERENCE - 1.0) for n in (500, 2000)]
    np.testing.assert_allclose(error, [9.9e-5, 6.2e-6], rtol=0.01)  # printed with two digits


PARAMETERS = {"mass": 15.0, "length": 1.0, "spin": 10.0, "gravity": 9.81}


@pytest.mark.slow
def test_scalar_parameters():
    """m, l, ω₀ and g in both modes against differences of the discrete scheme."""
    values = {name: jnp.asarray(value) for name, value in PARAMETERS.items()}
    function = lambda p: criterion(spinning_top(ALPHA, **p), 200)
    compiled = jax.jit(function)
    forward, reverse = jax.jit(jax.jacfwd(function))(values), jax.jit(jax.grad(function))(values)
    for name, value in PARAMETERS.items():
        moved = lambda s, name=name: compiled(values | {name: values[name] + s})
        estimate = central(moved, 1e-3 * value)
        # δ⁶ = 1e-18 of truncation, 1e-15/1e-3 of round-off, relative to derivatives of order Ψ/p
        scale = abs(float(compiled(values))) / value
        np.testing.assert_allclose(forward[name], estimate, rtol=1e-8, atol=1e-8 * scale)
        np.testing.assert_allclose(reverse[name], estimate, rtol=1e-8, atol=1e-8 * scale)


@pytest.mark.slow
def test_every_leaf():
    """m, each entry of J, l, initial position, orientation and velocity, pivot and g, each entry of each."""
    angle = 0.3  # a reference orientation that is not the identity
    model = spinning_top(ALPHA)
    turn = jnp.array([[1.0, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    body = eqx.tree_at(
        lambda b: (b.orientation, b.inertia, b.angular_velocity),
        model.bodies["top"],
        (
            turn,
            jnp.array([[0.2, 0.01, 0.02], [0.01, 0.4, 0.03], [0.02, 0.03, 0.25]]),
            jnp.array([1.0, 6.0, 7.0]),
        ),
    )
    model = eqx.tree_at(lambda m: m.bodies["top"], model, body)
    value = eqx.filter_jit(lambda m: criterion(m, 200))
    gradient = eqx.filter_jit(jax.grad(lambda m: criterion(m, 200)))(model)
    tangent_only = eqx.filter_jit(lambda m, d: jax.jvp(lambda m: criterion(m, 200), (m,), (d,))[1])
    adjoint = eqx.filter_jit(jax.grad(lambda m: criterion(m, 200, sensitivity=lg.AdjointVariable())))(model)
    found = every_leaf(value, model, gradient, lambda name, leaf: 1e-3)
    assert len(found) == 8
    for name, (exact, estimate) in found.items():
        scale = np.abs(estimate).max()
        assert scale > 1e-6, f"{name} has no effect: {estimate}"
        # as above; the velocity is projected, its effect is the smallest
        np.testing.assert_allclose(exact, estimate, rtol=0, atol=1e-8 * max(scale, float(value(model))), err_msg=name)
    for a, b in zip(jax.tree.leaves(adjoint), jax.tree.leaves(gradient)):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * float(jnp.abs(b).max()))
    # forward mode: the same gradient, contracted (dot-product test)
    leaves, structure = jax.tree.flatten(model)
    keys = jax.random.split(jax.random.key(0), len(leaves))
    random = jax.tree.unflatten(structure, [jax.random.normal(k, x.shape) for k, x in zip(keys, leaves)])
    forward = float(tangent_only(model, random))
    terms = [jnp.sum(g * d) for g, d in zip(jax.tree.leaves(gradient), jax.tree.leaves(random))]
    assert abs(forward - float(sum(terms))) <= 1e-11 * float(sum(map(jnp.abs, terms)))


@pytest.mark.slow
@pytest.mark.parametrize("mode", some_quick([jax.grad, jax.jacfwd]))
def test_times_are_differentiated(mode):
    """t0 and t1 are traced: dΨ/dt1 against differences of the discrete scheme, with time-dependent forces."""
    road = lg.BumpRoad(height=2.0, duration=3.0, start=-1.0)
    base = spinning_top(ALPHA)
    push = lg.AppliedForce("top", force=(30.0, 0.0, 0.0), signal=road)
    model = lg.Model(base.bodies, base.joints, base.forces | {"push": push})

    def value(t0, t1):
        trajectory = lg.simulate(model, t0=t0, t1=t1, num_steps=100)
        return lg.time_integral(trajectory.t, trajectory.body("top").position[:, 0] ** 2)

    times = (0.1, 0.9)
    compiled = jax.jit(value)
    estimates = [
        central(lambda s: compiled(times[0] + s, times[1]), 1e-3),
        central(lambda s: compiled(times[0], times[1] + s), 1e-3),
    ]
    np.testing.assert_allclose(jax.jit(mode(value, argnums=(0, 1)))(*times), estimates, rtol=1e-8)


@pytest.mark.slow
def test_taylor_remainder_falls_at_second_order():
    """|Ψ(p + s d) − Ψ(p) − s dΨ·d| ∝ s² in a random direction of the model."""
    model = spinning_top(0.7)
    value = eqx.filter_jit(lambda m: criterion(m, 100))
    gradient = jax.grad(lambda m: criterion(m, 100))(model)
    where = lambda m: (m.bodies["top"].mass, m.bodies["top"].inertia, m.bodies["top"].angular_velocity)
    direction = (jnp.array(2.0), jnp.array([0.02, -0.03, 0.01]), jnp.array([0.3, -0.5, 0.4]))
    slope = sum(jnp.sum(g * d) for g, d in zip(where(gradient), direction))
    base = value(model)
    remainders = []
    for s in (0.1, 0.05, 0.025):
        moved = eqx.tree_at(where, model, tuple(x + s * d for x, d in zip(where(model), direction)))
        remainders.append(abs(float(value(moved) - base - s * slope)))
    rates = np.log2(np.array(remainders[:-1]) / np.array(remainders[1:]))
    np.testing.assert_allclose(rates, 2.0, atol=0.15)  # the cubic term is a few per cent of the quadratic one
