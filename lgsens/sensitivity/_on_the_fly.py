"""The direct differentiation method on the fly (§6.3): motion, sensitivities, criteria in one scan, nothing stored.

After Newton's iteration has converged, the step is linearized once for all parameters, each of which costs its loads
and one solve; the scheme may remember the factors for the next step. The criteria and their derivatives,

    F' = F_q w + F_v v' + F_v̇ v̇' + F_λ λ' + F_p         (33)

are accumulated by the trapezoidal rule, so memory does not grow with the number of steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import State, Unseen
from lgsens.integrate import AbstractScheme, Stats, Variation, Walk, over_steps, with_first
from lgsens.sensitivity._criterion_terms import Functional
from lgsens.sensitivity._linearization import (
    Parameters,
    Step,
    node_tangent,
    place_tangents,
    to_algebra,
    to_ambient,
)
from lgsens.sensitivity._linearized_steps import LinearizedSteps


class OnTheFly(NamedTuple):
    """Values (c,), gradients (c, p), Newton's statistics, what tells turns, what `begin` has to say besides."""

    value: Float[Array, " c"]
    gradient: Float[Array, "c p"]
    stats: Stats
    unseen: Unseen  # at all instants
    begun: Any


def direct_on_the_fly(
    scheme: AbstractScheme,
    begin: Callable[[Float[Array, " p"]], tuple[tuple[State, Parameters], Any]],
    functional: Functional,
    p: Float[Array, " p"],
    constant: bool = True,
) -> OnTheFly:
    """Ψ and dΨ/dp of c criteria; `begin(p)` gives the initial state, what the motion depends on, and anything else.

    `constant`: where steps begin and end does not depend on p.
    """
    directions = jnp.eye(p.shape[0], dtype=p.dtype)
    (state0, parameters), (d_state0, d), begun = jax.vmap(
        lambda e: jax.jvp(begin, (p,), (e,), has_aux=True), out_axes=(None, 0, None)
    )(directions)
    system, grid = parameters
    group, walk = system.group, Walk.of(scheme, system)
    equations = LinearizedSteps(scheme, parameters, walk.shared)
    none = Variation.none(state0)

    def with_derivative(function, state: State, t, delta: Variation, d_t):
        """f (c,) and f' (p, c); d_t None: times are constant."""

        def along(e, d_system, delta, d_t):
            state_, d_state = (scheme.physical(system, each) for each in (state, to_ambient(group, state, delta)))
            if d_t is None:
                of = lambda p, system, state: function(p, system, state, t)
                return jax.jvp(of, (p, system, state_), (e, d_system, d_state))
            return jax.jvp(function, (p, system, state_, t), (e, d_system, d_state, d_t))

        return jax.vmap(along, out_axes=(None, 0))(directions, d.system, delta, d_t)

    def step(carry, inputs):
        progress, delta, before, total = carry
        place, d_places = inputs
        node, origin = grid.node(place), progress.state
        progress, stats = walk.on(grid, progress, place)
        linear = equations.linearized(Step(place, origin, progress.state))
        memory, stats = scheme.remembered(walk.shared, progress.memory, linear.equations, node, stats)
        progress = progress._replace(memory=memory)

        def along(delta, d: Parameters, d_place):
            return equations.forward(linear, delta, equations.loads(linear, d, d_place), none, d)

        delta = jax.vmap(along)(delta, d, d_places)
        d_node = (
            None if constant else jax.vmap(lambda d, d_place: node_tangent(grid, d.grid, place, d_place))(d, d_places)
        )
        rate = with_derivative(functional.rate, progress.state, node.t, delta, d_node and d_node.t)
        weigh = lambda h: grid.unless_empty(place, h / 2, jnp.zeros_like(h))
        both = jax.tree.map(jnp.add, before, rate)
        total = jax.tree.map(lambda total, f: total + weigh(node.h) * f, total, both)
        if d_node is not None:
            total = total[0], total[1] + jnp.outer(weigh(d_node.h), both[0])
        return (progress, delta, rate, total), (stats, Unseen.at(system, progress.state, node.t))

    delta0 = jax.vmap(lambda tangent: to_algebra(group, state0, tangent))(d_state0)
    first = with_derivative(functional.rate, state0, grid.t0, delta0, None if constant else d.grid.t0)
    start = (walk.begin(grid, state0, exact=True), delta0, first, jax.tree.map(jnp.zeros_like, first))
    # places are numbered along the first axis, parameters along the second
    d_places = jax.vmap(lambda d: place_tangents(grid, d), out_axes=1)(d.grid)
    first_unseen = Unseen.at(system, state0, grid.t0)
    (end, delta, _, integral), (stats, unseen) = over_steps(
        step, start, (grid.places(), d_places), grid.count, (Stats.none(grid.t0), first_unseen)
    )
    times = lambda grid: grid.times()[-1]
    d_end = None if constant else jax.vmap(lambda d: jax.jvp(times, (grid,), (d,))[1])(d.grid)
    final = with_derivative(functional.final, end.state, times(grid), delta, d_end)
    value, derivative = jax.tree.map(jnp.add, integral, final)
    return OnTheFly(value, derivative.T, stats, with_first(first_unseen, unseen), begun)
