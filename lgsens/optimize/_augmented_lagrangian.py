"""The outer part of an augmented Lagrangian method in a box: multipliers, penalty, and when a search ends.

The problem is min f(x) with g(x) ≤ 0 in a box; z in [0, 1] are the scaled variables, f is divided by |f(x₀)|. With
a multiplier μ_i ≥ 0 for each constraint (each time step of a path constraint has its own) and slacks s ≥ 0 that
turn them into equations, min over s of f + Σ μ_i (g_i + s_i) + ρ/2 (g_i + s_i)² is at s_i = max(0, −g_i − μ_i/ρ), which
leaves

    L(z; μ, ρ) = f + Σ_i [max(0, μ_i + ρ g_i)² − μ_i²] / (2ρ)
    ∇L = ∇f + Σ_i μ⁺_i ∇g_i,    μ⁺_i = max(0, μ_i + ρ g_i)

∇L is the gradient of the Lagrangian with the multipliers μ⁺, so one evaluation gives all of the Karush–Kuhn–Tucker
conditions of (z, μ⁺):

    stationarity                      ‖P(z − ∇L) − z‖, P the projection on the box
    feasibility and complementarity   σ = max_i |max(g_i, −μ_i/ρ)| = max_i |μ⁺_i − μ_i| / ρ

Inside, L is minimized to a stationarity of min(ω, θ ρ σ), the latter a fraction of what the coming change of μ does to
∇L; then μ ← μ⁺, ω falls, and ρ grows unless σ fell. μ converges linearly, the faster the larger ρ (Nocedal & Wright
2006, §17.4; Birgin & Martínez 2014, Practical Augmented Lagrangian Methods, §4).

Inside, `_reverse_steps` takes one gradient in reverse mode for each evaluation, whatever the number of constraints.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lgsens.optimize._box import Box

PENALTY = 10.0  # ρ at first: f and g are both scaled to about 1
PENALTY_GROWTH = 10.0
LARGEST_PENALTY = 1e4  # the condition of ∇²L grows with ρ; μ does the rest
FALL = 0.25  # σ falls by this from one μ to the next, or ρ grows
INNER_ACCURACY = 0.1  # θ, and ω at first
INNER_FALL = 0.3  # of ω from one μ to the next
INNER_STEPS = 20  # μ follows after so many at the latest
HOPELESS = 0.9  # of σ, with the largest ρ: constraints that contradict each other
NOT_YET, CONVERGED, STALLED, INFEASIBLE = 0, 1, 2, 3  # whether and why a search ended
REASONS = ("steps", "converged", "stalled", "infeasible")

DECREASE = 1e-4  # of L, as a fraction of what a step promises
LARGEST_MOVE = 0.2  # of the box; where a model of L has been wrong, simulations fail
REJECTIONS = 10  # of trials from one point; then curvatures are given up


class Best(NamedTuple):
    """The best design: that of convergence, before it the lowest f of the feasible ones or else the least violation."""

    z: Float[Array, " n"]
    objective: Float[Array, ""]
    constraints: Float[Array, " m"]
    worst: Float[Array, ""]
    step: Int[Array, ""]


class Row(NamedTuple):
    """What one evaluation found."""

    x: Float[Array, " n"]
    objective: Float[Array, ""]
    worst: Float[Array, ""]
    gradient_norm: Float[Array, ""]
    complementarity: Float[Array, ""]


class Trial(NamedTuple):
    """An evaluation at z."""

    z: Float[Array, " n"]
    x: Float[Array, " n"]
    objective: Float[Array, ""]  # f, not scaled
    constraints: Float[Array, " m"]
    gradient: Float[Array, " n"]  # ∇L
    estimate: Float[Array, " m"]  # μ⁺
    finite: Bool[Array, ""]


class Search(NamedTuple):
    """What one evaluation hands to the next."""

    multipliers: Float[Array, " m"]  # μ
    penalty: Float[Array, ""]  # ρ
    accuracy: Float[Array, ""]  # ω
    violation: Float[Array, ""]  # σ at the last change of μ
    inner: Int[Array, ""]  # points accepted since then
    scale: Float[Array, ""]  # |f(x₀)|; 0 until it is known
    step: Int[Array, ""]
    ended: Int[Array, ""]
    best: Best

    @classmethod
    def start(cls, z: Float[Array, " n"], num_constraints: int) -> "Search":
        """The state before the first evaluation, which is at z."""
        none, count = jnp.zeros(num_constraints, z.dtype), jnp.zeros((), jnp.int32)
        penalty, accuracy, infinite = (jnp.asarray(number, z.dtype) for number in (PENALTY, INNER_ACCURACY, jnp.inf))
        best = Best(z, infinite, none, infinite, count)
        return cls(none, penalty, accuracy, infinite, count, jnp.zeros((), z.dtype), count, count, best)

    def scale_of(self, objective: Float[Array, ""]) -> Float[Array, ""]:
        """What f is divided by: |f(x₀)|, which the first evaluation finds, or 1 where that is 0."""
        magnitude = jnp.abs(jax.lax.stop_gradient(objective))
        return jnp.where(self.scale > 0, self.scale, jnp.where(magnitude > 0, magnitude, 1.0))

    def estimate(self, constraints: Float[Array, " m"]) -> Float[Array, " m"]:
        """μ⁺."""
        return jnp.maximum(0.0, self.multipliers + self.penalty * constraints)

    def lagrangian(self, scaled: Float[Array, ""], estimate: Float[Array, " m"]) -> Float[Array, ""]:
        """L, of f/|f(x₀)| and μ⁺."""
        return scaled + jnp.sum(estimate**2 - self.multipliers**2) / (2 * self.penalty)


def round_off(value: Float[Array, ""]) -> Float[Array, ""]:
    """A simulation's of L, 1e-12 in 64 bits."""
    return jnp.finfo(value.dtype).eps ** 0.75 * jnp.abs(value)


def advance(
    search: Search, trial: Trial, accepted: Bool[Array, ""], tolerances: tuple[float, float], box: Box
) -> tuple[Search, Bool[Array, ""], Row]:
    """The state after a trial, whether μ has changed in it, and the row of the trial.

    Arguments:
        tolerances: of the conditions above, and of g.
    """
    tolerance, constraint_tolerance = tolerances
    penalty, count = search.penalty, jnp.ones_like(search.inner)
    worst = jnp.max(trial.constraints, initial=-jnp.inf)
    norm = jnp.linalg.norm(box.descent(trial.z, trial.gradient))
    sigma = jnp.max(jnp.abs(trial.estimate - search.multipliers), initial=0.0) / penalty

    converged = accepted & (worst <= constraint_tolerance) & (sigma <= tolerance) & (norm <= tolerance)
    accuracy = jnp.maximum(tolerance, jnp.minimum(search.accuracy, INNER_ACCURACY * penalty * sigma))
    solved = (norm <= accuracy) | (search.inner >= INNER_STEPS)
    follow = accepted & solved & (sigma > 0) & (search.inner >= 1)  # the first point since a change of μ is z itself
    stiffer = follow & (norm <= accuracy) & (sigma > FALL * search.violation)
    contradiction = follow & (penalty >= LARGEST_PENALTY) & (sigma > HOPELESS * search.violation)
    contradiction &= (worst > constraint_tolerance) & (norm <= jnp.maximum(tolerance, 1e-4))

    best, f = search.best, trial.objective
    feasible, before = worst <= constraint_tolerance, best.worst <= constraint_tolerance
    lower = jnp.where(feasible, f < best.objective, worst < best.worst)
    better = converged | trial.finite & ((feasible & ~before) | ((feasible == before) & lower))
    after = Search(
        multipliers=jnp.where(follow, trial.estimate, search.multipliers),
        penalty=jnp.where(stiffer, jnp.minimum(PENALTY_GROWTH * penalty, LARGEST_PENALTY), penalty),
        accuracy=jnp.where(follow, INNER_FALL * search.accuracy, search.accuracy),
        violation=jnp.where(follow, sigma, search.violation),
        inner=jnp.where(follow, 0 * count, search.inner + accepted.astype(count.dtype)),
        scale=search.scale_of(f),
        step=search.step + count,
        ended=jnp.where(converged, CONVERGED, jnp.where(contradiction, INFEASIBLE, search.ended)),
        best=select(better, Best(trial.z, f, trial.constraints, worst, search.step), best),
    )
    return after, follow, Row(trial.x, f, worst, norm, sigma)


def select(condition, yes, no):
    """One of two pytrees."""
    return jax.tree.map(partial(jnp.where, condition), yes, no)
