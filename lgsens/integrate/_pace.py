"""What an iteration knows of the times of the steps before: how past values are extrapolated to the end of a step.

The parabola through three values at the times τ_0 > τ_1 > τ_2 has at τ the value Σ w_i x_i,

    w_i = Π_{j ≠ i} (τ − τ_j)/(τ_i − τ_j),

3, −3, 1 at equal distances. Multipliers belong to the ends t_n of steps, algorithmic accelerations to t_n + Δ h_n.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lgsens.integrate._lanes import renewed_where

_SAME = 2.0  # the change of h up to which modified Newton keeps its matrix

Weights = tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]] | None  # None: 3, −3, 1


class AbstractPace(eqx.Module):
    """How far apart the last three states are."""

    @abc.abstractmethod
    def weights(self, h, delta: float) -> Weights:
        """Of values at t_n + Δ h_n, extrapolated to the end of a step of size h."""

    @abc.abstractmethod
    def after(self, h) -> "AbstractPace":
        """With a step of size h done."""

    @abc.abstractmethod
    def changed(self, h, before) -> Bool[Array, ""] | bool:
        """Whether a matrix made for steps of size `before` is none for steps of size h."""

    @abc.abstractmethod
    def margin(self, made, of_matrix, by_mass: Callable[[], Float[Array, ""]]) -> Float[Array, ""]:
        """The margin (`_singular`) of a step, where it made a matrix: that of the matrix, or one that can be compared
        where steps differ."""


class EqualPace(AbstractPace):
    """Steps of one size."""

    def weights(self, h, delta):
        return None

    def after(self, h):
        return self

    def changed(self, h, before):
        return False

    def margin(self, made, of_matrix, by_mass):
        return of_matrix


class UnevenPace(AbstractPace):
    """Steps of different sizes, in units of the next one: equal ones have the weights 3, −3, 1 to the last bit."""

    h: Float[Array, "3"]  # of the last three steps; 0 before the first: values are alike there, and any size will do

    @classmethod
    def first(cls, dtype) -> "UnevenPace":
        return cls(jnp.zeros(3, dtype))

    def weights(self, h, delta):
        r = jnp.where(self.h > 0.0, self.h / h, 1.0)
        to = (1.0 + delta * (1.0 - r[0]), 1.0 + r[0] + delta * (1.0 - r[1]), 1.0 + r[0] + r[1] + delta * (1.0 - r[2]))
        return (
            to[1] * to[2] / ((to[1] - to[0]) * (to[2] - to[0])),
            to[0] * to[2] / ((to[0] - to[1]) * (to[2] - to[1])),
            to[0] * to[1] / ((to[0] - to[2]) * (to[1] - to[2])),
        )

    def after(self, h):
        return UnevenPace(jnp.concatenate([h[None], self.h[:2]]))

    def changed(self, h, before):
        return (h > _SAME * before) | (_SAME * h < before)

    def margin(self, made, of_matrix, by_mass):
        return renewed_where(jnp.asarray(made), by_mass, jnp.full_like(of_matrix, jnp.nan))
