"""The rules that make the derivative of a whole trajectory of the sweeps over its steps.

All are module-level functions of explicit arguments, and keep states only.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme, GeneralizedAlpha, Stats, Variation, earlier, states_of, with_first
from lgsens.linear import LinearEquations, linear_solve
from lgsens.sensitivity._continuous_direct import continuous_direct_sweep
from lgsens.sensitivity._failed import Sound
from lgsens.sensitivity._linearization import (
    Parameters,
    cotangent_to_algebra,
    cotangent_to_ambient,
    matvec,
    to_algebra,
    to_ambient,
)
from lgsens.sensitivity._linearized_steps import LinearStep
from lgsens.sensitivity._log_depth import adjoint_at_once, direct_at_once
from lgsens.sensitivity._sweeps import adjoint_sweep, direct_sweep


def linear_scheme(scheme: AbstractScheme) -> GeneralizedAlpha:
    """What integrates linear equations along a motion: index 3, with the numbers of its scheme where it has them."""
    return dataclasses.replace(scheme, stabilized=False) if isinstance(scheme, GeneralizedAlpha) else GeneralizedAlpha()


# The custom rules see statistics as floats: an integer output of a `custom_vjp` reaches operations that have no
# derivative (`jnp.all`) with a tangent, and JAX refuses. Numbers of the scheme have no derivative where they are data.


@partial(jax.jit, inline=True)  # traced once for the trajectory and its rule
def _marched(scheme, state0, parameters):
    return states_of(scheme, parameters.system, parameters.grid, state0)


def encoded_run(scheme, state0, parameters, found=None):
    states, stats = _marched(scheme, state0, parameters) if found is None else found
    return states, encoded(stats, states.v.dtype)


def encoded(stats: Stats, dtype) -> Stats:
    return jax.tree.map(lambda leaf: leaf.astype(dtype), stats)


def decoded(stats: Stats) -> Stats:
    stats = lax.stop_gradient(stats)
    return stats._replace(iterations=stats.iterations.astype(jnp.int32), converged=stats.converged.astype(bool))


def decoded_run(run: tuple[State, Stats]) -> tuple[State, Stats]:
    states, stats = run
    return states, decoded(stats)


# Direct differentiation. The tangent of the trajectory solves L (δ, p') = (b, p'), b = (δ_0, 0, …, 0). `linear_solve`
# carries the two sweeps side by side: JAX takes the first one forwards, the other one backwards, and for second
# derivatives differentiates `matvec`, that is L itself, never the sweeps.

# Either both sweeps, or what takes all steps at once.


SWEEPS = LinearEquations(
    lambda of, x: matvec(*of[:3], *x),
    lambda of, b: direct_sweep(*of[:3], *b, linear=of[3]),
    lambda of, c: adjoint_sweep(*of[:3], *c, linear=of[3]),
)
AT_ONCE = LinearEquations(
    lambda of, x: matvec(*of[:3], *x, at_once=True),
    lambda of, b: direct_at_once(*of[:3], *b),
    lambda of, c: adjoint_at_once(*of[:3], *c),
)


def linearized_trajectory(
    scheme: AbstractScheme,
    states: State,
    parameters: Parameters,
    b: Variation,
    d: Parameters | None,
    equations: LinearEquations = SWEEPS,
    linear: LinearStep | None = None,
) -> Variation:
    """δ of L (δ, p') = (b, d), or of L δ = b at given p with d None, at the states of a run, differentiable by products
    with L; `linear`: its steps, linearized (`linearized_steps`), without a derivative."""
    return linear_solve(equations, (scheme, states, parameters, linear), (b, d))[0]


def forth(
    scheme: AbstractScheme,
    found: State,
    parameters: Parameters,
    d: tuple[State, Parameters],
    equations: LinearEquations = SWEEPS,
    linear: LinearStep | None = None,
) -> State:
    """The tangents of all states of a run, from those of the initial state and of the parameters."""
    group, sound = parameters.system.group, Sound.of(found, parameters.system)
    states, (d_state0, d_parameters) = sound.states, d
    first = to_algebra(group, jax.tree.map(lambda leaf: leaf[0], states), d_state0)
    b = with_first(first, earlier(Variation.none(states)))
    delta = linearized_trajectory(scheme, states, parameters, b, d_parameters, equations, linear)
    return sound.lost(jax.vmap(partial(to_ambient, group))(states, delta))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def direct_trajectory(equations, scheme, state0, parameters, found):
    return encoded_run(scheme, state0, parameters, found)


@direct_trajectory.defjvp
def _direct_rule(equations, primals, tangents):
    scheme, _, parameters, _ = primals
    _, *d, _ = tangents
    states, stats = direct_trajectory(equations, *primals)
    d_states = forth(scheme, states, parameters, tuple(d), equations)
    return (states, stats), (d_states, jax.tree.map(jnp.zeros_like, stats))


# Direct differentiation of the equations of motion: a rule whose tangent is linear in the input tangents, as it is.


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def continuous_trajectory(scheme, state0, parameters):
    states, stats = encoded_run(scheme, state0, parameters)
    return scheme.physical(parameters.system, states), stats


@continuous_trajectory.defjvp
def _continuous_rule(scheme, primals, tangents):
    state0, parameters = primals
    d_state0, d_parameters = tangents
    states, stats = continuous_trajectory(scheme, state0, parameters)
    group = parameters.system.group
    physical = partial(scheme.physical, parameters.system)
    first = to_algebra(group, physical(state0), physical(d_state0))
    delta = continuous_direct_sweep(linear_scheme(scheme), states, parameters, first, d_parameters)
    d_states = jax.vmap(partial(to_ambient, group))(states, delta)
    return (states, stats), (d_states, jax.tree.map(jnp.zeros_like, stats))


# Adjoint variable method.


@jax.custom_vjp
def adjoint_trajectory(scheme, state0, parameters, found):
    return encoded_run(scheme, state0, parameters, found)


def _adjoint_forward(scheme, state0, parameters, found):
    # Forward mode over this rule needs the derivative of the states, which those that error control has found lack.
    states, stats = direct_trajectory(SWEEPS, scheme, state0, parameters, found)
    return (states, stats), (scheme, states, parameters)


def _adjoint_backward(kept, cotangents):
    scheme, found, parameters = kept
    _, of_state0, of_parameters = back(scheme, found, parameters, cotangents[0])
    return None, of_state0, of_parameters, None


def back(
    scheme: AbstractScheme, found: State, parameters: Parameters, cotangents: State, linear: LinearStep | None = None
) -> tuple[Variation, State, Parameters]:
    """μ and the cotangents of the initial state and of the parameters, from those of all states of a run."""
    group, sound = parameters.system.group, Sound.of(found, parameters.system)
    states = sound.states
    c = jax.vmap(partial(cotangent_to_algebra, group))(states, sound.asked(cotangents))
    mu, bar = adjoint_sweep(scheme, states, parameters, c, jax.tree.map(jnp.zeros_like, parameters), linear)
    state0 = jax.tree.map(lambda leaf: leaf[0], states)
    first = jax.tree.map(lambda leaf: leaf[0], mu)
    return mu, cotangent_to_ambient(group, state0, first), bar


adjoint_trajectory.defvjp(_adjoint_forward, _adjoint_backward)
