"""Equal Runge–Kutta steps: the derivative by hand against JAX's own, and the quadrature of the stages."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import EPS, close

import lgsens as lg
from lgsens.dynamics import Inertia, initial_state
from lgsens.examples import four_bar, spinning_top
from lgsens.integrate._explicit_steps import Numbers, equal_steps

STEPS = 3


@pytest.mark.slow
@pytest.mark.parametrize("model", [spinning_top(0.7), four_bar()], ids=["top", "four_bar"])
def test_derivative_by_hand(model):
    """Every output of the steps, forwards and transposed, against JAX's derivative of the loop itself.

    Three steps of 20 ms, which end off the constraints by 1e-8 and are projected: the derivatives of both projections
    count. Round-off: 1e4 by the condition of the solves, 1e2 by the operations.
    """
    system = model.system()
    start = initial_state(system, jnp.zeros(())).state
    z = (system, start, jnp.asarray(0.1), jnp.asarray(0.02))
    rng = np.random.default_rng(1)
    dz = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), z)
    w = jnp.asarray(rng.normal(size=start.v.shape))
    dz = (dz[0], eqx.tree_at(lambda s: s.q, dz[1], system.group.to_ambient(start.q, w)), *dz[2:])

    def outputs(steps, system, state, t0, h):
        return steps(lg.IndexReducedODE(), STEPS, Numbers(Inertia.of(system), system, t0, h), state)

    by_hand = lambda *z: outputs(equal_steps, *z)
    by_jax = lambda *z: outputs(equal_steps.fun, *z)
    found, change = jax.jit(lambda z, dz: jax.jvp(by_hand, z, dz))(z, dz)
    wanted, wanted_change = jax.jit(lambda z, dz: jax.jvp(by_jax, z, dz))(z, dz)
    for actual, expected in zip(jax.tree.leaves(found), jax.tree.leaves(wanted)):
        close(actual, expected, 1.0)
    for actual, expected in zip(jax.tree.leaves(change), jax.tree.leaves(wanted_change)):
        close(actual, expected, 1e6, max(1.0, np.abs(expected).max(initial=0.0)))
    weights = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), found)
    pulled = jax.jit(lambda z, weights: jax.vjp(by_hand, *z)[1](weights))(z, weights)
    products = [
        sum(float(jnp.vdot(x, y)) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)))
        for a, b in ((weights, change), (pulled, dz))
    ]
    size = sum(float(jnp.sum(jnp.abs(x * y))) for x, y in zip(jax.tree.leaves(weights), jax.tree.leaves(change)))
    assert abs(products[0] - products[1]) < 1e6 * EPS * size


@pytest.mark.parametrize(
    ("solver", "counts", "order"),
    [pytest.param(diffrax.Tsit5(), (8, 16), 5, marks=pytest.mark.slow), (diffrax.Dopri8(), (4, 8), 8)],
)
def test_quadrature_of_the_stages(solver, counts, order):
    """∫ of the square of an acceleration, which Gregory's rule of order 4 would spoil, falls as the motion does.

    Orders by slope, of which one is left to steps that are not small.
    """
    criterion = lg.Criterion(integrand=lambda s, p: s.body("top").acceleration[0] ** 2)

    def psi(num_steps, solver):
        trajectory = lg.simulate(spinning_top(0.7), t1=0.4, num_steps=num_steps, integrator=lg.IndexReducedODE(solver))
        assert trajectory.stages is not None
        assert trajectory.stages.t.shape == trajectory.stages.weights.shape == trajectory.stages.states.v.shape[:1]
        np.testing.assert_allclose(trajectory.stages.weights.sum(), 0.4, rtol=8 * EPS)
        return float(criterion(trajectory))

    exact = psi(64, diffrax.Dopri8())
    coarse, fine = (abs(psi(n, solver) - exact) for n in counts)
    assert np.log2(coarse / fine) > order - 1, (coarse, fine)
