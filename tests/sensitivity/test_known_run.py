"""A run whose steps are linearized once: the same numbers as of sweeps that linearize for themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import random_like

import lgsens as lg
from lgsens.dynamics import initial_state
from lgsens.examples import spinning_top
from lgsens.integrate import EqualGrid, Variation
from lgsens.sensitivity import KnownRun, Parameters
from lgsens.sensitivity._linearization import matvec
from lgsens.sensitivity._step_blocks import StepBlocks
from lgsens.sensitivity._sweeps import adjoint_sweep, direct_sweep

STEPS = 67  # a prime: the last block is filled up
# Forward and back substitution over 67 steps, of λ by 1/βh² of 1e6 times q: round-off in another order
RTOL = 1e-8


def alike(actual, expected):
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=RTOL, atol=RTOL * np.abs(b).max(initial=0.0))


def problem(scheme):
    system, t0 = spinning_top(0.7).system(), jnp.asarray(0.1)
    parameters = Parameters(system, EqualGrid(t0, jnp.asarray(2e-3), STEPS))
    return scheme.complete(system, initial_state(system, t0).state), parameters


@pytest.mark.slow  # four sweeps; certificates in the quick run are made of them
@pytest.mark.parametrize("scheme", [lg.GeneralizedAlpha(0.9), lg.GeneralizedAlpha(0.9, stabilized=True), lg.RadauIIA()])
def test_both_modes_are_those_of_the_trajectory(scheme):
    """Against JAX's derivatives of `DirectDifferentiation`, which linearize in blocks."""
    state0, parameters = problem(scheme)
    assert StepBlocks.of(STEPS, scheme.numbers(parameters.system)).padding
    rng = np.random.default_rng(0)

    @jax.jit
    def found(state0, parameters, d, c):
        trajectory = lambda *at: lg.DirectDifferentiation().trajectory(scheme, *at)[0]
        known = KnownRun.of(scheme, state0, parameters)
        forwards, (backwards, bar) = known.forwards(*d), known.backwards(c)[1:]
        expected = jax.jvp(trajectory, (state0, parameters), d)[1], jax.vjp(trajectory, state0, parameters)[1](c)
        return (forwards, (backwards, bar)), expected

    states = jax.eval_shape(lambda *at: lg.DirectDifferentiation().trajectory(scheme, *at)[0], state0, parameters)
    d, c = random_like((state0, parameters), rng), random_like(states, rng)
    alike(*found(state0, parameters, d, c))


@pytest.mark.slow
def test_sweeps_at_given_parameters():
    """d None is d = 0, of both sweeps and of the product, by rows everywhere."""
    scheme = lg.GeneralizedAlpha(0.9)
    state0, parameters = problem(scheme)
    rng = np.random.default_rng(1)

    @jax.jit
    def found(state0, parameters, b):
        known, zero = KnownRun.of(scheme, state0, parameters), jax.tree.map(jnp.zeros_like, parameters)
        of = scheme, known.states, parameters
        return [
            [f(*of, b, d, *linear)[0] for f, linear in ((direct_sweep, own), (adjoint_sweep, own), (matvec, ()))]
            for d, own in ((None, (known.linear,)), (zero, ()))
        ]

    states = jax.eval_shape(lambda *at: KnownRun.of(scheme, *at).states, state0, parameters)
    alike(*found(state0, parameters, random_like(Variation.none(jax.tree.map(jnp.zeros_like, states)), rng)))
