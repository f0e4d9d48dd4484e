"""The formulas of generalized-α that position and velocity follow, whatever its constraints: eqs. (24), (27)–(29)."""

from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._scheme import AbstractScheme


class AbstractAlpha(AbstractScheme):
    """The numbers of generalized-α, and the settings of its Newton iteration; see `GeneralizedAlpha`.

    α_m = (2ρ − 1)/(ρ + 1),  α_f = ρ/(ρ + 1),  γ = ½ + α_f − α_m,  β = (γ + ½)²/4
    """

    rho_inf: eqx.AbstractVar[float]
    stabilized: eqx.AbstractVar[bool]
    factor_every: eqx.AbstractVar[int]
    iterations: eqx.AbstractVar[int | None]

    @property
    def alpha_m(self) -> float:
        return (2.0 * self.rho_inf - 1.0) / (self.rho_inf + 1.0)

    @property
    def alpha_f(self) -> float:
        return self.rho_inf / (self.rho_inf + 1.0)

    @property
    def gamma(self) -> float:
        return 0.5 + self.alpha_f - self.alpha_m

    @property
    def beta(self) -> float:
        return (self.gamma + 0.5) ** 2 / 4.0

    @property
    def inertia_factor(self) -> float:
        """c = ∂v̇⁺/∂u."""
        return (1.0 - self.alpha_m) / (1.0 - self.alpha_f)


class Motion(NamedTuple):
    """The increment and the kinematic state that u gives, eqs. (24), (27)–(29)."""

    x: Float[Array, " k"]
    q: Any
    v: Float[Array, " k"]
    vdot: Float[Array, " k"]


def increment(scheme: AbstractAlpha, previous: State, u, h) -> Float[Array, " k"]:
    """x of eq. (27)."""
    return h * previous.v + h**2 * ((0.5 - scheme.beta) * previous.a + scheme.beta * u)


def advance(scheme: AbstractAlpha, system: AbstractSystem, previous: State, u, h, correction=None) -> Motion:
    """What follows from the unknown u = a_{n+1}; `correction` is added to it in x alone."""
    x = increment(scheme, previous, u if correction is None else u + correction, h)
    v = previous.v + h * ((1.0 - scheme.gamma) * previous.a + scheme.gamma * u)
    vdot = ((1.0 - scheme.alpha_m) * u + scheme.alpha_m * previous.a - scheme.alpha_f * previous.vdot) / (
        1.0 - scheme.alpha_f
    )
    return Motion(x, system.group.retract(previous.q, x), v, vdot)
