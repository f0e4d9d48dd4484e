"""The minimum of a convex quadratic function and penalties of linear constraints, in a box.

    q(d) = sᵀ d + ½ dᵀ B d + Σ_i [max(0, c_i + ρ J_i d)² − max(0, c_i)² − 2 ρ max(0, c_i) J_i d] / (2ρ),   l ≤ d ≤ u

with s the gradient at d = 0, so that q(0) = 0. With p = max(0, c), δ = ρ J d and the rise r = max(0, c + δ) − p the sum
is of [r² + 2 p (r − δ)] / (2ρ), which are not negative: nothing cancels, however small d is.

q is convex and piecewise quadratic. A primal active set method: Newton's direction with the entries `held` at their
bounds; along it the minimum up to the first bound, or a lower point bent at bounds; an entry that would leave is held;
those whose gradient points inward are let go where the face has nothing more to give. A library's method for boxes
knows no penalties, and as a quadratic program in slacks this has m unknowns more.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

ITERATIONS = 200
BENT = (1.0, 0.5, 0.25)  # of a direction
BISECTIONS = 50
ACCURACY = 1e-12  # of the promised decrease


class PenaltyModel(NamedTuple):
    """q and its box, which 0 is in."""

    slope: Float[Array, " n"]  # s
    curvature: Float[Array, "n n"]  # B
    shifted: Float[Array, " m"]  # c
    jacobian: Float[Array, "m n"]  # J
    penalty: Float[Array, ""]  # ρ
    lower: Float[Array, " n"]
    upper: Float[Array, " n"]

    def value(self, d: Float[Array, " n"]) -> Float[Array, ""]:
        """q(d)."""
        change = self.penalty * (self.jacobian @ d)
        rise = _rise(self.shifted, change)
        over = rise**2 + 2 * jnp.maximum(0.0, self.shifted) * (rise - change)
        return jnp.vdot(self.slope, d) + jnp.vdot(d, self.curvature @ d) / 2 + jnp.sum(over) / (2 * self.penalty)

    def gradient(self, d: Float[Array, " n"]) -> Float[Array, " n"]:
        """∇q(d)."""
        rise = _rise(self.shifted, self.penalty * (self.jacobian @ d))
        return self.slope + self.curvature @ d + rise @ self.jacobian

    def hessian(self, d: Float[Array, " n"]) -> Float[Array, "n n"]:
        """∇²q(d)."""
        active = jnp.where((self.shifted + self.penalty * (self.jacobian @ d) > 0)[:, None], self.jacobian, 0.0)
        return self.curvature + self.penalty * active.T @ active

    def lowest(self, d, direction, gradient, longest) -> Float[Array, ""]:
        """The α up to `longest` of the least q(d + α direction), by bisection of its slope, which rises with α."""
        shifted, more = (self.penalty * (self.jacobian @ v) for v in (d, direction))
        shifted += self.shifted
        first, second = jnp.vdot(gradient, direction), jnp.vdot(direction, self.curvature @ direction)

        def halve(_, ends):
            middle = (ends[0] + ends[1]) / 2
            rising = first + middle * second + jnp.vdot(_rise(shifted, middle * more), more) / self.penalty > 0
            return jnp.where(rising, ends[0], middle), jnp.where(rising, middle, ends[1])

        return jnp.minimum(longest, jax.lax.fori_loop(0, BISECTIONS, halve, (jnp.zeros_like(longest), 2 * longest))[0])


def _rise(shifted, change):
    """max(0, shifted + change) − max(0, shifted)."""
    return jnp.where(shifted > 0, jnp.maximum(change, -shifted), jnp.maximum(0.0, shifted + change))


class _State(NamedTuple):
    d: Float[Array, " n"]
    value: Float[Array, ""]
    held: Bool[Array, " n"]
    first: Float[Array, ""]  # the most that a direction promised
    count: Int[Array, ""]
    running: Bool[Array, ""]


def minimum(model: PenaltyModel) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """The d of least q, and q there."""
    lower, upper = model.lower, model.upper
    # A step up to a bound may end short of it; the next one would then have no length, and end the search.
    round_off = 4 * jnp.finfo(lower.dtype).eps * jnp.maximum(jnp.abs(lower), jnp.abs(upper))

    def improve(state: _State) -> _State:
        d, held = state.d, state.held
        gradient = model.gradient(d)
        free = jnp.where(held, 0.0, 1.0)
        hessian = free[:, None] * model.hessian(d) * free[None] + jnp.diag(1.0 - free)
        direction = -jnp.linalg.solve(hessian, free * gradient)
        promised = -jnp.vdot(direction, gradient)
        first = jnp.maximum(state.first, promised)

        low, high = d <= lower + round_off, d >= upper - round_off
        leaving = (low & (direction < 0)) | (high & (direction > 0))
        inward = held & ((low & (gradient < 0)) | (high & (gradient > 0)))
        blocked = jnp.any(leaving)
        done = (promised <= ACCURACY * first) & ~blocked

        room = jnp.where(direction > 0, upper - d, lower - d) / jnp.where(direction == 0, 1.0, direction)
        longest = jnp.min(jnp.where(direction == 0, 1.0, jnp.minimum(room, 1.0)))
        straight = model.lowest(d, direction, gradient, longest)
        steps = jnp.concatenate([jnp.asarray(BENT, d.dtype), straight[None]])
        points = jnp.clip(d[None] + steps[:, None] * direction[None], lower[None], upper[None])
        values = jax.vmap(model.value)(points)
        i = jnp.argmin(values)
        lowered = values[i] < state.value
        moves = lowered & ~done & ~blocked
        return _State(
            d=jnp.where(moves, points[i], d),
            value=jnp.where(moves, values[i], state.value),
            held=(held & ~(done & inward)) | leaving,
            first=first,
            count=state.count + 1,
            running=jnp.where(done, jnp.any(inward), blocked | lowered),
        )

    none, zero = jnp.zeros_like(lower), jnp.zeros((), lower.dtype)
    held = ((lower >= 0) & (model.slope > 0)) | ((upper <= 0) & (model.slope < 0))
    state = _State(none, zero, held, zero, jnp.zeros((), jnp.int32), jnp.asarray(True))
    state = jax.lax.while_loop(lambda s: s.running & (s.count < ITERATIONS), improve, state)
    return state.d, state.value
