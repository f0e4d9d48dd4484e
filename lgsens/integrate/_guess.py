"""Where the iteration of the next step starts."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import State
from lgsens.integrate._pace import Weights


class Past(NamedTuple):
    """What the next value of a vector x is predicted from.

    The parabola through the last three values predicts p_n = 3 x_{n−1} − 3 x_{n−2} + x_{n−3} and misses x_n by e_n. In
    smooth motion it will miss the next one by as much, and p_{n+1} + e_n is the cubic; where the steps hardly resolve a
    vibration it will miss by something else, by −e_n at worst. So the prediction is p_{n+1} + θ e_n, with the θ that
    would have served best in the last step,

        θ = argmin |e_n − θ e_{n−1}| = e_n · e_{n−1} / e_{n−1} · e_{n−1},   −1 ≤ θ ≤ 1.

    Iterations per step with parabolas (θ = 0), cubics (θ = 1) and this: quarter-car over its bump 3.8, 3.4, 3.4, chain
    of 512 links 5.2, 5.5, 4.5. A second term, θ₂ e_{n−1}, saves 0.2 iterations of the quarter-car and no time.
    """

    last: Float[Array, " n"]  # x_{n−1}
    before: Float[Array, " n"]  # x_{n−2}
    expected: Float[Array, " n"]  # p_n
    missed: Float[Array, " n"]  # e_{n−1}

    @classmethod
    def none(cls, x) -> "Past":
        return cls(x, x, x, jnp.zeros_like(x))

    def predicted(self, x, weights: Weights = None) -> Float[Array, " n"]:
        """x_{n+1}, from x = x_n."""
        missed, square = x - self.expected, jnp.sum(self.missed**2)
        theta = jnp.sum(missed * self.missed) / jnp.where(square > 0.0, square, 1.0)
        # not finite where squares overflow
        theta = jnp.where(jnp.isfinite(theta), jnp.clip(theta, -1.0, 1.0), 0.0)
        return self._parabola(x, weights) + theta * missed

    def after(self, x, weights: Weights = None) -> "Past":
        return Past(x, self.last, self._parabola(x, weights), x - self.expected)

    def _parabola(self, x, weights: Weights):
        if weights is None:
            return 3.0 * (x - self.last) + self.before
        return weights[0] * x + weights[1] * self.last + weights[2] * self.before


class Guess(NamedTuple):
    """Where the next step's iteration starts, from past accelerations and multipliers, and how fast modified Newton
    contracted in this one."""

    a: Past
    lam: Past
    contraction: Float[Array, ""]

    @classmethod
    def first(cls, state0: State) -> "Guess":
        return cls(Past.none(state0.a), Past.none(state0.lam), jnp.ones((), state0.a.dtype))

    def extrapolated(self, state: State, weights: tuple[Weights, Weights]):
        """u and λ."""
        return self.a.predicted(state.a, weights[0]), self.lam.predicted(state.lam, weights[1])

    def after(self, state: State, contraction, weights: tuple[Weights, Weights]) -> "Guess":
        return Guess(self.a.after(state.a, weights[0]), self.lam.after(state.lam, weights[1]), contraction)
