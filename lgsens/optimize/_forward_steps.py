"""Steps of an augmented Lagrangian method with the Jacobian of all constraints, for few variables.

With J of all constraints, which forward mode gives together with ∇f for about the price of a gradient in reverse mode,

    ∇²L = ∇²(f + Σ μ⁺_i g_i) + ρ J_aᵀ J_a,    a: the constraints with μ_i + ρ g_i > 0

is known but for its first term, and so is how the set a changes along a step d. Where many constraints are nearly
parallel, ρ J_aᵀ J_a is a stiff valley in which a method that learns curvature from gradients zigzags. So only the
first term is learned, B, and the model of L that a step minimizes keeps the rest,

    q(d) = ∇fᵀ d + ½ dᵀ B d + Σ_i max(0, μ_i + ρ (g + J d)_i)² / (2ρ),    z + d in the box, |d_j| ≤ reach

which is the step of a stabilized SQP method (Wright 1998, Comput. Optim. Appl. 11:253; Nocedal & Wright 2006, §18).
A step that lowers L by a small part of what q promises is accepted; reach follows how well q promises, as in a
trust-region method. With f, g, ∇f and J of a point L is known there for every μ, so that a change of μ takes no
evaluation. In the beginning, far from an optimum, the multipliers max(0, μ + ρ (g + J d)) of the model replace μ after
every accepted step, without which a start on a constraint would first leave the feasible designs by μ/ρ.

B is of BFGS, damped by Powell to stay positive definite, from the differences of ∇f + Jᵀ ν with the ν = μ⁺ of the
better of the two points; a trial that is rejected teaches it as well. (The symmetric rank-one formula does better on
small problems and worse on the suspension, where ν changes much from step to step.)
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lgsens.optimize import _augmented_lagrangian as outer
from lgsens.optimize._box import Box
from lgsens.optimize._penalty_model import PenaltyModel, minimum

EAGER = 20  # first evaluations in which μ follows every step
FIRST_MOVE = 0.1  # of the box, where nothing is known but ∇f
DAMPING = 0.2  # of sᵀ B s, the least curvature that B learns
STEEPER = 10.0  # times what B knows, the most that it learns at once
FLATTEST = 1e-3  # of f/|f(x₀)| over the box, the least eigenvalue of B
POOR, GOOD = 0.25, 0.75  # of the promised decrease: reach falls, reach grows


class Point(NamedTuple):
    """f/|f(x₀)|, g and their derivatives."""

    z: Float[Array, " n"]
    objective: Float[Array, ""]
    slope: Float[Array, " n"]  # ∇f
    constraints: Float[Array, " m"]
    jacobian: Float[Array, "m n"]


class Carry(NamedTuple):
    """What one evaluation hands to the next."""

    search: outer.Search
    point: Point  # the last that was accepted
    curvature: Float[Array, "n n"]  # B
    learned: Bool[Array, ""]  # whether B is more than a guess
    renewed: Bool[Array, ""]  # whether B was given up at this point
    reach: Float[Array, ""]
    rejected: Int[Array, ""]  # trials from the point


def start(z: Float[Array, " n"], num_constraints: int) -> Carry:
    """The carry before the first evaluation, which is at z: with zeros for its derivatives q asks for no step."""
    g = jnp.zeros(num_constraints, z.dtype)
    jacobian = jnp.zeros((g.size, z.size), z.dtype)
    return Carry(
        search=outer.Search.start(z, num_constraints),
        point=Point(z, jnp.full((), jnp.inf, z.dtype), jnp.zeros_like(z), g, jacobian),
        curvature=jnp.eye(z.size, dtype=z.dtype),
        learned=jnp.asarray(False),
        renewed=jnp.asarray(False),
        reach=jnp.full((), outer.LARGEST_MOVE, z.dtype),
        rejected=jnp.zeros((), jnp.int32),
    )


def make_step(fun: Callable, box: Box, tolerances: tuple[float, float]) -> Callable[[Carry], tuple[Carry, outer.Row]]:
    """carry ↦ (carry, row): one evaluation of f, g and their derivatives, and what follows from it."""

    def evaluate(z):
        x = box.value(z)
        f, g = fun(x)
        return (f, g), (x, f, g)

    def step(carry: Carry) -> tuple[Carry, outer.Row]:
        search, here = carry.search, carry.point
        estimate = search.estimate(here.constraints)
        model = PenaltyModel(
            slope=here.slope + estimate @ here.jacobian,
            curvature=carry.curvature,
            shifted=search.multipliers + search.penalty * here.constraints,
            jacobian=here.jacobian,
            penalty=search.penalty,
            lower=jnp.maximum(-carry.reach, -here.z),
            upper=jnp.minimum(carry.reach, 1.0 - here.z),
        )
        move, change = minimum(model)
        promised = -change
        z = jnp.clip(here.z + move, 0.0, 1.0)
        (slope, jacobian), (x, f, g) = jax.jacfwd(evaluate, has_aux=True)(z)
        scale = search.scale_of(f)
        there = Point(z, f / scale, slope / scale, g, jacobian)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in there]))

        before = search.lagrangian(here.objective, estimate)
        estimate_there = search.estimate(g)
        gain = before - search.lagrangian(there.objective, estimate_there)
        accepted = finite & (gain >= outer.DECREASE * promised - outer.round_off(before))
        trial = outer.Trial(z, x, f, g, there.slope + estimate_there @ jacobian, estimate_there, finite)
        search, follow, row = outer.advance(search, trial, accepted, tolerances, least=0)
        first = carry.search.step == 0
        eager = accepted & ~follow & ~first & (carry.search.step < EAGER)
        multipliers = jnp.maximum(0.0, model.shifted + model.penalty * (here.jacobian @ move))
        search = search._replace(multipliers=jnp.where(eager, multipliers, search.multipliers))

        # Of L, its slope and L at the trial the parabola; half where the trial is not finite.
        length, descent = jnp.max(jnp.abs(move)), jnp.vdot(model.slope, move)
        share = jnp.where(finite, jnp.clip(descent / (2 * (gain + descent)), 0.1, 0.5), 0.5)
        longer = jnp.where(gain >= GOOD * promised, jnp.maximum(carry.reach, 2 * length), carry.reach)
        longer = jnp.where(gain < POOR * promised, length / 2, longer)
        reach = jnp.minimum(jnp.where(accepted, longer, share * length), outer.LARGEST_MOVE)

        given_up = ~accepted & (carry.rejected >= outer.REJECTIONS)
        after = outer.select(accepted, there, here)
        gradients = jnp.where(accepted, estimate_there, estimate) @ jnp.stack([here.jacobian, jacobian])
        change = there.slope + gradients[1] - here.slope - gradients[0]
        curvature, learned = _learned(carry, move, change, finite & ~first)
        again = first | given_up
        stalled = given_up & carry.renewed
        zero, one = jnp.zeros_like(carry.rejected), jnp.ones_like(carry.rejected)
        return Carry(
            search=search._replace(ended=jnp.where(stalled, outer.STALLED, search.ended)),
            point=after,
            curvature=jnp.where(again, _guess(after.slope), curvature),
            learned=learned & ~again,
            renewed=given_up | (carry.renewed & ~accepted),
            reach=jnp.where(again, outer.LARGEST_MOVE, reach),
            rejected=jnp.where(accepted | given_up, zero, carry.rejected + one),
        ), row

    return step


def _guess(slope) -> Float[Array, "n n"]:
    """A B with which −∇f alone would ask for a step of `FIRST_MOVE`."""
    size = jnp.linalg.norm(slope)
    return jnp.where(size > 0, size, 1.0) / FIRST_MOVE * jnp.eye(slope.size, dtype=slope.dtype)


def _learned(carry: Carry, move, change, known) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """B after the gradient of the Lagrangian changed by `change` along `move`."""
    squared, product = jnp.vdot(move, move), jnp.vdot(move, change)
    safe = lambda number: jnp.where(number > 0, number, 1.0)
    usual = jnp.vdot(change, change) / safe(product)  # the larger curvatures that a first pair shows
    b = jnp.where(carry.learned | (product <= 0), carry.curvature, usual * jnp.eye(move.size, dtype=move.dtype))
    image = b @ move
    curved = jnp.vdot(move, image)
    share = jnp.where(product >= DAMPING * curved, 1.0, (1 - DAMPING) * curved / safe(curved - product))
    damped = share * change + (1 - share) * image
    updated = b + jnp.outer(damped, damped) / safe(jnp.vdot(damped, move)) - jnp.outer(image, image) / safe(curved)
    sound = jnp.vdot(damped, damped) <= STEEPER * jnp.trace(b) * jnp.vdot(damped, move)
    useful = known & sound & (squared > 0) & (curved > 0) & jnp.all(jnp.isfinite(updated))
    # Damping by itself lets the least eigenvalues fall, one by one, to nothing, after which others grow without bound.
    values, vectors = jnp.linalg.eigh(jnp.where(useful, updated, b))
    values = jnp.maximum(values, FLATTEST)
    return jnp.where(useful, (vectors * values[None]) @ vectors.T, carry.curvature), carry.learned | useful
