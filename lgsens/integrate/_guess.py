"""Where the iteration of the next step starts: past values, extrapolated to its end.

The parabola through three values at the times τ_0 > τ_1 > τ_2 has at τ the value Σ w_i x_i,

    w_i = Π_{j ≠ i} (τ − τ_j)/(τ_i − τ_j),

3, −3, 1 at equal distances. Multipliers belong to the ends t_n of steps, algorithmic accelerations to t_n + Δ h_n.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lgsens.dynamics import State

_SAME = 2.0  # the change of h up to which modified Newton keeps its matrix

Weights = tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]] | None  # None: 3, −3, 1


class Pace(NamedTuple):
    """How far apart the last three states are; h None: steps are equal.

    In units of the next step: equal ones have the weights 3, −3, 1 to the last bit.
    """

    h: Float[Array, "3"] | None  # of the last three steps; 0 before the first, where values are alike and any size does

    def weights(self, h, delta: float) -> Weights:
        """Of values at t_n + Δ h_n, extrapolated to the end of a step of size h."""
        if self.h is None:
            return None
        r = jnp.where(self.h > 0.0, self.h / h, 1.0)
        to = (1.0 + delta * (1.0 - r[0]), 1.0 + r[0] + delta * (1.0 - r[1]), 1.0 + r[0] + r[1] + delta * (1.0 - r[2]))
        return (
            to[1] * to[2] / ((to[1] - to[0]) * (to[2] - to[0])),
            to[0] * to[2] / ((to[0] - to[1]) * (to[2] - to[1])),
            to[0] * to[1] / ((to[0] - to[2]) * (to[1] - to[2])),
        )

    def after(self, h) -> "Pace":
        """With a step of size h done."""
        return self if self.h is None else Pace(jnp.concatenate([h[None], self.h[:2]]))

    def changed(self, h, before) -> Bool[Array, ""] | bool:
        """Whether a matrix made for steps of size `before` is none for steps of size h."""
        return False if self.h is None else (h > _SAME * before) | (_SAME * h < before)


class PastValues(NamedTuple):
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
    def none(cls, x) -> "PastValues":
        return cls(x, x, x, jnp.zeros_like(x))

    def predicted(self, x, weights: Weights = None) -> Float[Array, " n"]:
        """x_{n+1}, from x = x_n."""
        missed, square = x - self.expected, jnp.sum(self.missed**2)
        theta = jnp.sum(missed * self.missed) / jnp.where(square > 0.0, square, 1.0)
        # not finite where squares overflow
        theta = jnp.where(jnp.isfinite(theta), jnp.clip(theta, -1.0, 1.0), 0.0)
        return self._parabola(x, weights) + theta * missed

    def after(self, x, weights: Weights = None) -> "PastValues":
        return PastValues(x, self.last, self._parabola(x, weights), x - self.expected)

    def _parabola(self, x, weights: Weights):
        if weights is None:
            return 3.0 * (x - self.last) + self.before
        return weights[0] * x + weights[1] * self.last + weights[2] * self.before


class Guess(NamedTuple):
    """Where the next step's iteration starts, from past accelerations and multipliers, and how fast modified Newton
    contracted in this one."""

    a: PastValues
    lam: PastValues
    contraction: Float[Array, ""]
    pace: Pace

    @classmethod
    def first(cls, state0: State, *, uneven: bool) -> "Guess":
        dtype = state0.a.dtype
        pace = Pace(jnp.zeros(3, dtype) if uneven else None)
        return cls(PastValues.none(state0.a), PastValues.none(state0.lam), jnp.ones((), dtype), pace)

    def weights(self, h, delta: float) -> tuple[Weights, Weights]:
        """Those of a and of λ in a step of size h."""
        return self.pace.weights(h, delta), self.pace.weights(h, 0.0)

    def extrapolated(self, state: State, weights: tuple[Weights, Weights]):
        """u and λ."""
        return self.a.predicted(state.a, weights[0]), self.lam.predicted(state.lam, weights[1])

    def after(self, state: State, contraction, weights: tuple[Weights, Weights], h) -> "Guess":
        """After the step of size h that `state` began."""
        pasts = self.a.after(state.a, weights[0]), self.lam.after(state.lam, weights[1])
        return Guess(*pasts, contraction, self.pace.after(h))
