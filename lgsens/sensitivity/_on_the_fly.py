"""The direct differentiation method on the fly (§6.3): motion, sensitivities, criteria in one scan, nothing stored.

After Newton's iteration has converged, the tangents and the factors of eq. (30) are formed once for all parameters,
each of which costs its pseudo-loads and one solve; the same factors serve modified Newton in the next step. The
criteria and their derivatives,

    F' = F_q w + F_v v' + F_v̇ v̇' + F_λ λ' + F_p         (33)

are accumulated by the trapezoidal rule, so memory does not grow with the number of steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import State, unsteady_rate
from lgsens.integrate import Chord, Constants, GeneralizedAlpha, Guess, Stats, margin_of, take_step
from lgsens.linear import LU
from lgsens.sensitivity._criterion_terms import Functional
from lgsens.sensitivity._direct import direct_step
from lgsens.sensitivity._linearization import (
    Linearized,
    Parameters,
    Step,
    Variation,
    linearized,
    pseudo_loads,
    to_algebra,
    to_ambient,
)


class OnTheFly(NamedTuple):
    """Values (c,), gradients (c, p), Newton's statistics, how fast bodies turn, what `begin` has to say besides."""

    value: Float[Array, " c"]
    gradient: Float[Array, "c p"]
    stats: Stats
    rates: Float[Array, " n"]  # `unsteady_rate` after each step
    begun: Any


def direct_on_the_fly(
    scheme: GeneralizedAlpha,
    num_steps: int,
    begin: Callable[[Float[Array, " p"]], tuple[tuple[State, Parameters], Any]],
    functional: Functional,
    p: Float[Array, " p"],
) -> OnTheFly:
    """Ψ and dΨ/dp of c criteria; `begin(p)` gives the initial state, what the motion depends on, and anything else."""
    directions = jnp.eye(p.shape[0], dtype=p.dtype)
    (state0, parameters), (d_state0, d), begun = jax.vmap(
        lambda e: jax.jvp(begin, (p,), (e,), has_aux=True), out_axes=(None, 0, None)
    )(directions)
    system, h = parameters.system, parameters.h
    group, constants = system.group, Constants.of(system)
    none = jax.tree.map(jnp.zeros_like, Variation(state0.v, state0.v, state0.vdot, state0.lam, state0.a))

    def with_derivative(function, state: State, t, delta: Variation):
        """f (c,) and f' (p, c)."""

        def along(e, d_system, delta):
            tangents = (e, d_system, to_ambient(group, state, delta))
            return jax.jvp(lambda p, system, state: function(p, system, state, t), (p, system, state), tangents)

        return jax.vmap(along, out_axes=(None, 0))(directions, d.system, delta)

    def linearized_at(previous: State, state: State, t) -> tuple[Step, Linearized]:
        step = Step(previous, state, t)
        return step, linearized(scheme, parameters, constants.mass, step)

    def step(carry, n):
        previous, guess, factors, running, delta, total = carry
        t = parameters.t0 + (n + 1) * h
        chord = Chord(factors, n == 0) if scheme.factor_every else None
        state, guess, stats, _ = take_step(scheme, system, constants, previous, guess, chord, running, t, h, LU)
        converged, prepared = linearized_at(previous, state, t)
        margin = margin_of(prepared.factors, prepared.tangents.constraint_jacobian, constants.scale)
        stats = stats._replace(margin=margin)

        def along(delta, d: Parameters):
            loads = pseudo_loads(converged, parameters, d)
            return direct_step(scheme, parameters, constants.mass, prepared, loads, delta, none, d.h)

        delta = jax.vmap(along)(delta, d)
        rate = with_derivative(functional.rate, state, t, delta)
        # the last point has the weight h/2
        weight = jnp.where(n == num_steps - 1, h / 2, h)
        total = jax.tree.map(lambda total, f: total + weight * f, total, rate)
        return (state, guess, prepared.factors, stats.converged, delta, total), (
            stats,
            unsteady_rate(system, state.v, state.vdot),
        )

    delta0 = jax.vmap(lambda tangent: to_algebra(group, state0, tangent))(d_state0)
    first = with_derivative(functional.rate, state0, parameters.t0, delta0)
    half = jax.tree.map(lambda f: h / 2 * f, first)
    shapes = jax.eval_shape(lambda: linearized_at(state0, state0, parameters.t0)[1].factors)
    factors = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)  # of no step yet
    start = (state0, Guess.first(state0), factors, jnp.ones((), bool), delta0, half)
    (state, *_, delta, integral), (stats, rates) = lax.scan(step, start, jnp.arange(num_steps, dtype=p.dtype))
    final = with_derivative(functional.final, state, parameters.t0 + num_steps * h, delta)
    value, derivative = jax.tree.map(jnp.add, integral, final)
    return OnTheFly(value, derivative.T, stats, rates, begun)
