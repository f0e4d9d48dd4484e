"""A scheme that lgsens does not ship, said by its equations alone: it has every grid, output and derivative."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from implicit_midpoint import ImplicitMidpoint

import lgsens as lg
from lgsens.accuracy import error_estimate
from lgsens.examples import spinning_top
from lgsens.integrate import AbstractScheme

STEPS = 9


MIDPOINT = ImplicitMidpoint()
GIVEN = lg.GivenSteps(1.0 + 0.5 * np.sin(np.arange(STEPS)), MIDPOINT)
P = jnp.array([0.7, 1.0, 0.3])  # angle, length, end


def side(s):
    return s.body("top").position[0] ** 2 + 1e-5 * s.multiplier("pivot")[2]


def psi(p, num_steps=STEPS, **settings):
    """A criterion of positions and of multipliers, by an angle, a length and the end of the run."""
    run = lg.simulate(spinning_top(p[0], length=p[1]), t1=p[2], num_steps=num_steps, throw=False, **settings)
    if "save" in settings:
        return lg.time_integral(run.t, run.values) * 1e3
    return (
        lg.time_integral(
            run.t,
            jax.vmap(lambda x, lam: x**2 + 1e-5 * lam)(run.body("top").position[:, 0], run.multiplier("pivot")[:, 2]),
        )
        * 1e3
    )


def differences(f):
    """Central differences of sixth order: δ⁶ = 1e-18 × derivatives of size 10, round-off 1e-15/1e-3 of Ψ."""
    compiled = jax.jit(f)
    return np.array([central(lambda s, e=e: compiled(P + s * e), 1e-3) for e in jnp.eye(3)])


@pytest.mark.slow  # `test_radau.py` has a scheme of this kind in the quick run
@pytest.mark.parametrize("integrator", [pytest.param(MIDPOINT, id="equal"), pytest.param(GIVEN, id="given")])
def test_both_modes_on_every_grid(integrator):
    f = lambda p: psi(p, integrator=integrator)
    expected = differences(f)
    assert np.abs(expected).min() > 1e-2
    forward, reverse = jax.jit(lambda p: (jax.jacfwd(f)(p), jax.grad(f)(p)))(P)
    np.testing.assert_allclose(forward, expected, rtol=1e-7)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)  # the same systems, other order of round-off


@pytest.mark.slow  # two programs
def test_adaptive_steps_are_given_steps():
    """The derivative is that on the grid found."""
    adaptive, room = lg.AdaptiveSteps(MIDPOINT, tolerance=1e-2, longest=1.0), 20
    model = spinning_top(P[0], length=P[1])
    found = lg.simulate(model, t1=P[2], num_steps=room, integrator=adaptive)
    assert 3 < int(found.stats.steps) < room
    frozen = lg.GivenSteps.of(found, MIDPOINT)
    f = lambda p: psi(p, room, integrator=adaptive)
    on_grid = lambda p: lg.time_integral(*_sides(p, frozen)) * 1e3
    value, slope = jax.jit(jax.value_and_grad(f))(P)
    expected, expected_slope = jax.jit(jax.value_and_grad(on_grid))(P)
    np.testing.assert_allclose(value, expected, rtol=1e-10)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-8)


def _sides(p, integrator):
    run = lg.simulate(
        spinning_top(p[0], length=p[1]), t1=p[2], num_steps=integrator.num_steps, integrator=integrator, throw=False
    )
    return run.t, run.body("top").position[:, 0] ** 2 + 1e-5 * run.multiplier("pivot")[:, 2]


@pytest.mark.slow  # four programs
@pytest.mark.parametrize(
    ("integrator", "method"),
    [
        (MIDPOINT, lg.DirectDifferentiation()),
        (MIDPOINT, lg.AdjointVariable(checkpoints=2)),
        (GIVEN, lg.DirectDifferentiation()),
        (GIVEN, lg.AdjointVariable(checkpoints=2)),
    ],
)
def test_outputs_and_checkpoints(integrator, method):
    plain = lambda p: psi(p, integrator=integrator)
    saved = lambda p: psi(p, integrator=integrator, save=side, sensitivity=method)
    value, slope = jax.jit(jax.value_and_grad(saved))(P)
    np.testing.assert_allclose(value, jax.jit(plain)(P), rtol=1e-10)
    np.testing.assert_allclose(slope, jax.jit(jax.jacfwd(plain))(P), rtol=1e-8)


@pytest.mark.slow  # two programs
def test_second_derivatives():
    f = lambda p: psi(p, integrator=MIDPOINT)
    hessian = jax.jit(jax.hessian(f))(P)
    expected = differences(jax.grad(f))
    np.testing.assert_allclose(hessian, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.slow  # three programs
def test_its_error_is_estimated():
    """What is left is O(h) of the error, the reference by explicit steps of order 8: those of ε²."""
    model = spinning_top(P[0], length=P[1])
    run = lg.simulate(model, t1=P[2], num_steps=30, integrator=MIDPOINT)
    exact = lg.simulate(model, t1=P[2], num_steps=30, integrator=lg.IndexReducedODE(diffrax.Dopri8()))
    error = exact.states.v - run.states.v
    left = error_estimate(run, MIDPOINT).v - error
    assert np.abs(left).max() < 0.1 * np.abs(error).max()


class OrderUnsaid(AbstractScheme):
    """A scheme of which nobody has said how its errors fall."""

    tolerance: float = eqx.field(static=True, default=1e-10)
    max_iterations: int = eqx.field(static=True, default=10)

    def equations(self, system, node, previous, state):
        return state


def test_an_error_needs_an_order():
    run = lg.simulate(lg.Model({"mass": lg.RigidBody(1.0, None, free="z")}), t1=0.3, num_steps=3)
    with pytest.raises(ValueError, match="OrderUnsaid does not say its `convergence_order`"):
        error_estimate(run, OrderUnsaid())
