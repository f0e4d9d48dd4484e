"""Newton's iteration for the stages of a Radau step, with a matrix that steps share.

To make the matrix and its factors takes as long as two iterations with it on a top, and as nine on the quarter-car;
with the matrix of its first guess an iteration contracts by 1e-2 to 1e-4. So an iteration takes the one at hand, that
of an earlier step too. A new one is made, there, where an increment is more than `_SLOW` times the one before; where it
is even larger, it belongs to a matrix that does not fit, and is not taken. (With 0.3 for 0.1 the top takes 11 % longer,
the quarter-car as long.) An iteration is the last one where the next would take away less than `_LEFT` tolerances, of
which those of a hundred steps add up to one, or where increments fall no longer, which is round-off.

The guess continues w and λ of the last step's stages, three values at (c_j − 1) h_n, to the next ones; from w follow v,
x ≈ h Σ a_ij v_j and ξ = T⁻¹(x) v. With constant ones instead the quarter-car takes an iteration more, a fifth of its
time. Where that w would move a body by more than 0.3 rad, or lengths of the scene, it is 0: v̇ of a start out of balance
that stiff damping stops would turn it many times.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lgsens._xla import in_any_lane, renewed_where, while_loop
from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._linearized import Node
from lgsens.integrate._radau_sparse import stage_factors
from lgsens.integrate._radau_stages import A, AbstractStageFactors, C, RadauStages, advanced, left
from lgsens.integrate._scheme import Memory, Stats

_SLOW = 0.1
_LEFT = 0.01
_ROUGH = 0.25
_FAR = 0.3  # rad, or lengths of the scene


class KeptFactors(NamedTuple):
    """The matrix of an earlier iteration in factors."""

    factors: AbstractStageFactors
    stale: Bool[Array, ""]  # whether it contracted too slowly, or is none yet


def no_memory(system: AbstractSystem, node: Node, state: State) -> Memory:
    """That of the beginning: the size of the last step, 0 before the first, and the factors."""
    like = jax.eval_shape(lambda: stage_factors(system, node, state, state.inner))
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)
    return Memory(jnp.zeros_like(node.h), KeptFactors(zeros, jnp.ones((), bool)))


class _Iterate(NamedTuple):
    found: RadauStages
    size: Float[Array, ""]  # of the last increment
    rest: Float[Array, ""]
    count: Int[Array, ""]
    due: Bool[Array, ""]
    going: Bool[Array, ""]


def solved(
    scheme: Any, system: AbstractSystem, node: Node, begun: State, memory: Memory, running
) -> tuple[RadauStages, Memory, Stats]:
    """The stages of a step, what the next one knows of it, and what the iteration did."""
    scale = system.coordinate_scale()
    tolerance = max(scheme.tolerance, 64 * float(jnp.finfo(scale.dtype).eps))

    def corrected(carry: tuple[_Iterate, AbstractStageFactors]) -> tuple[_Iterate, AbstractStageFactors]:
        iterate, factors = carry
        due = in_any_lane(iterate.due & iterate.going)  # where one lane of a batch makes a matrix, all have the time to
        factors = renewed_where(due, lambda: stage_factors(system, node, begun, iterate.found), factors)
        rest = left(system, node, begun, iterate.found)
        step = factors.solve(node.h, rest)
        size = jnp.max(jnp.abs(advanced(node.h, begun.v, step)[0]) / scale[None])
        count = iterate.count + 1
        slow, astray = ~(size <= _SLOW * iterate.size), ~due & (size > iterate.size)
        found = jax.tree.map(lambda old, less: jnp.where(astray, old, old - less), iterate.found, step)
        worth = (size**2 > _LEFT * tolerance * iterate.size) & (size < _ROUGH * iterate.size)
        going = ((size > tolerance) | worth) & (count < scheme.max_iterations)  # NaN compares false
        new = _Iterate(found, size, jnp.max(jnp.abs(rest.v)), count, slow, going)
        return jax.tree.map(lambda new, old: jnp.where(iterate.going, new, old), new, iterate), factors

    infinite = jnp.full_like(node.h, jnp.inf)
    guess, none = _continued(system, node, begun, memory.past, scale), jnp.zeros((), jnp.int32)
    iterate = _Iterate(guess, infinite, infinite, none, memory.matrix.stale, running)
    start = iterate, memory.matrix.factors
    iterate, factors = while_loop(lambda carry: in_any_lane(carry[0].going), corrected, start)
    stats = Stats(
        iterations=jnp.where(running, iterate.count, 0),
        increment=iterate.size,
        residual=iterate.rest,
        converged=running & (iterate.size <= tolerance),
        margin=infinite,
    )
    return iterate.found, Memory(node.h, KeptFactors(factors, iterate.due)), stats


def _continued(system: AbstractSystem, node: Node, begun: State, past, scale) -> RadauStages:
    """The first guess; `past`: the size of the last step, 0: there was none. `scale`: of the coordinates."""
    known, h = past > 0.0, node.h
    to = 1.0 + jnp.where(known, h / jnp.where(known, past, 1.0), 0.0) * jnp.asarray(C, h.dtype)
    others = [[C[i] for i in range(3) if i != j] for j in range(3)]
    weights = jnp.stack([(to - a) * (to - b) / ((c - a) * (c - b)) for c, (a, b) in zip(C.tolist(), others)], axis=1)
    ahead = lambda stages, last: jnp.where(known, weights @ stages, last[None])
    vdot, lam = ahead(begun.inner.v, begun.vdot), ahead(begun.inner.lam, begun.lam)
    a = h * jnp.asarray(A, h.dtype)
    way = jnp.max(jnp.abs(a @ a @ vdot) / scale[None], initial=0.0)
    vdot = jnp.where(way <= _FAR, vdot, 0.0)
    v = begun.v[None] + a @ vdot
    return RadauStages(jax.vmap(system.group.tangent_inv_mv)(a @ v, v), vdot, lam, jnp.zeros_like(begun.inner.mu))
