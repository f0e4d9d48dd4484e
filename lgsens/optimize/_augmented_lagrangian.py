"""One evaluation of an augmented Lagrangian method in a box; everything traced, so that a whole search compiles once.

The problem is min f(x) with g(x) ≤ 0 in a box; z in [0, 1] are the scaled variables, f is divided by |f(x₀)|. With
a multiplier μ_i ≥ 0 for each constraint (each time step of a path constraint has its own) and slacks s ≥ 0 that
turn them into equations, min over s of f + Σ μ_i (g_i + s_i) + ρ/2 (g_i + s_i)² is at s_i = max(0, −g_i − μ_i/ρ), which
leaves

    L(z; μ, ρ) = f + Σ_i [max(0, μ_i + ρ g_i)² − μ_i²] / (2ρ)
    ∇L = ∇f + Σ_i μ⁺_i ∇g_i,    μ⁺_i = max(0, μ_i + ρ g_i)

with one gradient, in reverse mode, whatever the number of constraints. ∇L is the gradient of the Lagrangian
with the multipliers μ⁺, so one evaluation gives all of the Karush–Kuhn–Tucker conditions of (z, μ⁺):

    stationarity                      ‖P(z − ∇L) − z‖, P the projection on the box
    feasibility and complementarity   σ = max_i |max(g_i, −μ_i/ρ)| = max_i |μ⁺_i − μ_i| / ρ

Inside, L is minimized to a stationarity of min(ω, θ ρ σ), the latter a fraction of what the coming change of μ does to
∇L; then μ ← μ⁺, ω falls, and ρ grows unless σ fell. μ converges linearly, the faster the larger ρ (Nocedal & Wright
2006, §17.4; Birgin & Martínez 2014, Practical Augmented Lagrangian Methods, §4).

The inner method is L-BFGS of optax on the face of the box in which z may move (Bertsekas 1982, SIAM J. Control Optim.
20:221), with a backtracking search along the projected path. Each step is one evaluation, accepted or not. Behind a
constraint that z has not touched L rises steeply, of which the memory knows nothing; so a step that was shortened
limits the next ones, which may double.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from lgsens.optimize._box import Box

PENALTY = 10.0  # ρ at first: f and g are both scaled to about 1
PENALTY_GROWTH = 10.0
LARGEST_PENALTY = 1e4  # the condition of ∇²L grows with ρ; μ does the rest
FALL = 0.25  # σ falls by this from one μ to the next, or ρ grows
INNER_ACCURACY = 0.1  # θ, and ω at first
INNER_FALL = 0.3  # of ω from one μ to the next
INNER_STEPS = 20  # μ follows after so many at the latest
DECREASE = 1e-4  # of the search along the path, as a fraction of what the slope promises (Armijo)
LARGEST_MOVE = 0.2  # of the box; where a model of L has been wrong, simulations fail
REJECTIONS = 10  # of steps along one direction; then the memory is given up
HOPELESS = 0.9  # of σ, with the largest ρ: constraints that contradict each other
NOT_YET, CONVERGED, STALLED, INFEASIBLE = 0, 1, 2, 3  # whether and why a search ended

Memory = Any  # optax.ScaleByLBFGSState; its members are declared as any pytree, here they are arrays
LBFGS: Any = optax.scale_by_lbfgs(memory_size=10)


class Best(NamedTuple):
    """The best design: that of convergence, before it the lowest f of the feasible ones or else the least violation."""

    z: Float[Array, " n"]
    objective: Float[Array, ""]
    constraints: Array
    worst: Float[Array, ""]
    step: Int[Array, ""]


class Row(NamedTuple):
    """What one evaluation found."""

    x: Float[Array, " n"]
    objective: Float[Array, ""]
    worst: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    complementarity: Float[Array, ""]


class Carry(NamedTuple):
    """What one evaluation hands to the next."""

    z: Float[Array, " n"]  # the last point that was accepted
    value: Float[Array, ""]  # L there
    gradient: Float[Array, " n"]  # ∇L there
    memory: Memory  # of points before z
    direction: Float[Array, " n"]  # to the trial
    reach: Float[Array, ""]  # the most that an entry of it may be
    rejected: Int[Array, ""]  # trials from z
    fresh: Bool[Array, ""]  # z is to be evaluated anew: L is another one
    inner: Int[Array, ""]  # accepted since the last change of μ
    multipliers: Array  # μ
    penalty: Float[Array, ""]  # ρ
    accuracy: Float[Array, ""]  # ω
    violation: Float[Array, ""]  # σ at the last change of μ
    scale: Float[Array, ""]  # |f(x₀)|; 0 until it is known
    step: Int[Array, ""]
    ended: Int[Array, ""]
    best: Best


def start(z: Float[Array, " n"], constraints: jax.ShapeDtypeStruct) -> Carry:
    """The carry before the first evaluation, which is at z."""
    zero, count = jnp.zeros((), z.dtype), jnp.zeros((), jnp.int32)
    infinite = jnp.full((), jnp.inf, z.dtype)
    none = jnp.zeros(constraints.shape, z.dtype)
    return Carry(
        z=z,
        value=infinite,
        gradient=jnp.zeros_like(z),
        memory=LBFGS.init(z),
        direction=jnp.zeros_like(z),
        reach=jnp.full((), LARGEST_MOVE, z.dtype),
        rejected=count,
        fresh=jnp.asarray(True),
        inner=count,
        multipliers=none,
        penalty=jnp.full((), PENALTY, z.dtype),
        accuracy=jnp.full((), INNER_ACCURACY, z.dtype),
        violation=infinite,
        scale=zero,
        step=count,
        ended=count,
        best=Best(z, infinite, none, infinite, count),
    )


def make_step(fun: Callable, box: Box, tolerance: float, constraint_tolerance: float) -> Callable[[Carry], tuple]:
    """carry ↦ (carry, row): one evaluation of f, g and ∇L, and what follows from it."""

    def step(carry: Carry) -> tuple[Carry, Row]:
        multipliers, penalty = carry.multipliers, carry.penalty
        trial = jnp.where(carry.fresh, carry.z, jnp.clip(carry.z + carry.direction, 0.0, 1.0))

        def lagrangian(z):
            x = box.value(z)
            f, g = fun(x)
            magnitude = jnp.abs(jax.lax.stop_gradient(f))
            scale = jnp.where(carry.scale > 0, carry.scale, jnp.where(magnitude > 0, magnitude, 1.0))
            pushed = jnp.maximum(0.0, multipliers + penalty * g)
            return f / scale + jnp.sum(pushed**2 - multipliers**2) / (2 * penalty), (x, f, g, scale, pushed)

        (value, (x, f, g, scale, pushed)), gradient = jax.value_and_grad(lagrangian, has_aux=True)(trial)
        finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(g)) & jnp.all(jnp.isfinite(gradient))
        worst = jnp.max(g, initial=-jnp.inf)
        norm = jnp.linalg.norm(jnp.clip(trial - gradient, 0.0, 1.0) - trial)
        sigma = jnp.max(jnp.abs(pushed - multipliers), initial=0.0) / penalty

        move = trial - carry.z
        promised = jnp.vdot(carry.gradient, move)
        noise = jnp.finfo(value.dtype).eps ** 0.75 * jnp.abs(carry.value)  # a simulation's round-off, 1e-12 in 64 bits
        accepted = finite & (carry.fresh | (value <= carry.value + DECREASE * promised + noise))

        met = (worst <= constraint_tolerance) & (sigma <= tolerance)
        converged = accepted & met & (norm <= tolerance)
        accuracy = jnp.maximum(tolerance, jnp.minimum(carry.accuracy, INNER_ACCURACY * penalty * sigma))
        solved = (norm <= accuracy) | (carry.inner >= INNER_STEPS)
        follow = solved & (sigma > 0) & (carry.inner > 0)
        stiffer = follow & (sigma > FALL * carry.violation)
        contradiction = follow & (penalty >= LARGEST_PENALTY) & (sigma > HOPELESS * carry.violation)
        contradiction &= (worst > constraint_tolerance) & (norm <= jnp.maximum(tolerance, 1e-4))
        zero, one = jnp.zeros_like(carry.inner), jnp.ones_like(carry.inner)
        moved = carry._replace(
            z=trial,
            value=value,
            gradient=gradient,
            memory=_next_memory(carry, trial, gradient),
            reach=jnp.where(
                carry.fresh,
                carry.reach,
                jnp.minimum(2 * jnp.where(carry.rejected > 0, jnp.max(jnp.abs(move)), carry.reach), LARGEST_MOVE),
            ),
            rejected=zero,
            fresh=follow,
            inner=jnp.where(follow, zero, carry.inner + one),
            multipliers=jnp.where(follow, pushed, multipliers),
            penalty=jnp.where(stiffer, jnp.minimum(PENALTY_GROWTH * penalty, LARGEST_PENALTY), penalty),
            accuracy=jnp.where(follow, INNER_FALL * carry.accuracy, carry.accuracy),
            violation=jnp.where(follow, sigma, carry.violation),
            scale=scale,
            ended=jnp.where(converged, CONVERGED, jnp.where(accepted & contradiction, INFEASIBLE, carry.ended)),
        )
        # The parabola through L, its slope and L at the trial; half where the trial is not finite.
        ratio = -promised / (2 * (value - carry.value - promised))
        given_up = carry.rejected >= REJECTIONS
        stayed = carry._replace(
            memory=_select(given_up, LBFGS.init(trial), carry.memory),
            direction=carry.direction * jnp.where(finite, jnp.clip(ratio, 0.1, 0.5), 0.5),
            rejected=jnp.where(given_up, zero, carry.rejected + one),
            ended=jnp.where(given_up & (carry.memory.count == 0), STALLED, carry.ended),
        )
        after = _select(accepted, moved, stayed)
        after = _select(accepted | given_up, after._replace(direction=_direction(after)), after)

        best = carry.best
        feasible, before = worst <= constraint_tolerance, best.worst <= constraint_tolerance
        lower = jnp.where(feasible, f < best.objective, worst < best.worst)
        better = converged | finite & ((feasible & ~before) | ((feasible == before) & lower))
        new = Best(trial, f, g, worst, carry.step)
        best = _select(better, new, best)
        return after._replace(best=best, step=carry.step + one), Row(x, f, worst, norm, sigma)

    return step


def _select(condition, yes, no):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _next_memory(carry: Carry, trial, gradient) -> Memory:
    """The memory of the points before the trial, which was accepted.

    The last of them is z, unless the step shows no positive curvature or is across two Lagrangians. Then the point
    before z is shifted so that the difference to it stays: the pair of the last step serves once more.
    """
    move, change = trial - carry.z, gradient - carry.gradient
    shifted = carry.memory._replace(params=carry.memory.params + move, updates=carry.memory.updates + change)
    small = jnp.finfo(move.dtype).eps ** 0.5 * jnp.linalg.norm(move) * jnp.linalg.norm(change)
    with jax.numpy_dtype_promotion("standard"):  # optax mixes its int32 count with floats
        _, usual = LBFGS.update(carry.gradient, carry.memory, carry.z)
    return _select(~carry.fresh & (jnp.vdot(move, change) > small), usual, shifted)


def _direction(carry: Carry) -> Float[Array, " n"]:
    """−H ∇L on the face in which z may move, with the pairs of the memory projected on it, no farther than reach."""
    z, gradient, memory = carry.z, carry.gradient, carry.memory
    free = jnp.where(((z <= 0) & (gradient > 0)) | ((z >= 1) & (gradient < 0)), 0.0, 1.0)
    moves, changes = (free[None] * pairs for pairs in (memory.diff_params_memory, memory.diff_updates_memory))
    curvature = jnp.sum(moves * changes, axis=1)
    on_face = memory._replace(
        params=free * memory.params,
        updates=free * memory.updates,
        diff_params_memory=moves,
        diff_updates_memory=changes,
        weights_memory=jnp.where(curvature > 0, 1.0 / jnp.where(curvature > 0, curvature, 1.0), 0.0),
    )
    slope = free * gradient
    with jax.numpy_dtype_promotion("standard"):
        scaled, _ = LBFGS.update(slope, on_face, free * z)
    descends = jnp.vdot(scaled, slope) > 1e-8 * jnp.linalg.norm(scaled) * jnp.linalg.norm(slope)
    direction = -free * jnp.where(descends & jnp.all(jnp.isfinite(scaled)), scaled, slope)
    largest = jnp.max(jnp.abs(direction))
    return direction * jnp.minimum(1.0, carry.reach / jnp.where(largest > 0, largest, 1.0))
