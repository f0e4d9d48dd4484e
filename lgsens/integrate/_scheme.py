"""The Lie-group generalized-α scheme as a value, eqs. (24)–(30).

With u = a_{n+1}, one step from (q, v, v̇, a) at t_n solves for u and λ

    x   = h v + h² ((½ − β) a + β u)                      (27)
    q⁺  = q exp(x̃)                                       (24)
    v⁺  = v + h ((1 − γ) a + γ u)                         (28)
    v̇⁺  = ((1 − α_m) u + α_m a − α_f v̇) / (1 − α_f)       (29)
    r(q⁺, v⁺, v̇⁺, λ⁺, t⁺) = 0,   Φ(q⁺)/(βh²) = 0          (25), (26)

The unknown is u and not x, and the constraint is divided by βh²: with ∂x/∂u = βh² the matrix of eq. (30)
becomes

    S = [[c M + γh C_t + βh² K_t T(x),  Bᵀ],
         [B T(x),                       0 ]],      c = (1 − α_m)/(1 − α_f),

which does not degenerate as h → 0 (Bottasso, Bauchau & Cardona 2007; its condition at h = 1e-3 would
else be 1e18). Its constraint rows and multipliers are further scaled by the size of M. Where constraints may be
redundant, Φ(q⁺)/(βh²) − c λ⁺ = 0, with −diag(c) in the corner of S (`dynamics/_redundant.py`).
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, Tangents, factorized, mass_scale, softness, times_tangent_operator
from lgsens.linear import LU, Factors


class GeneralizedAlpha(eqx.Module):
    """The generalized-α integrator: numerical damping and the settings of its Newton iteration.

        α_m = (2ρ − 1)/(ρ + 1),  α_f = ρ/(ρ + 1),  γ = ½ + α_f − α_m,  β = (γ + ½)²/4

    Arguments:
        rho_inf: spectral radius ρ∞ at infinite frequency, in [0, 1): 0 damps the fastest modes in one step,
            values near 1 keep energy and let noise in the multipliers persist.
        tolerance: the last Newton increment of a configuration, relative to 1 rad or the length of the
            scene, at which a step has converged. The error left is its square; below 64 round-offs
            it is raised to that (single precision).
        max_iterations: full Newton iterations per step before the step has failed.
        factor_every: steps that share one inverse of the iteration matrix (modified Newton). Its iterations cost a
            tenth of a full one, and go on until the error left is what full Newton would leave; a step that they do
            not bring there is finished by full Newton. 0: full Newton always. The sensitivities do not depend on it:
            theirs is always the exact matrix of the converged step.
        second_order_start: start with a₀ = v̇₀ + (α_m − α_f) h v̈₀, because a_n stands for the acceleration at
            t_n + (α_m − α_f) h, and with v₀ moved by O(h²) along the constraint directions, where the scheme keeps
            it anyway: positions, velocities and multipliers are then second order from the first step.
            False: a₀ = v̇₀ and v₀ as it is; multipliers are first order in the first steps (Arnold,
            Brüls & Cardona, Numerische Mathematik 129, 2015, doi:10.1007/s00211-014-0633-1).

    All static and hashable. Raises `ValueError` for ρ∞ outside [0, 1), a tolerance that is not positive, fewer than 1
    iteration, or a negative `factor_every`. Source: Sonneville & Brüls (2014), §4; Brüls, Cardona & Arnold (2012).
    """

    rho_inf: float = eqx.field(static=True, default=0.9)
    tolerance: float = eqx.field(static=True, default=1e-10, kw_only=True)
    max_iterations: int = eqx.field(static=True, default=10, kw_only=True)
    factor_every: int = eqx.field(static=True, default=20, kw_only=True)
    second_order_start: bool = eqx.field(static=True, default=True, kw_only=True)

    def __check_init__(self):
        if not isinstance(self.rho_inf, int | float) or not 0.0 <= self.rho_inf < 1.0:
            raise ValueError(
                f"GeneralizedAlpha: `rho_inf` must be a number in [0, 1), got {self.rho_inf!r}; 0.9 damps little, "
                "0 most."
            )
        if not isinstance(self.tolerance, int | float) or not 0.0 < self.tolerance < math.inf:
            raise ValueError(
                f"GeneralizedAlpha: `tolerance` must be positive, got {self.tolerance!r}; 1e-10 is the default."
            )
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise ValueError(
                f"GeneralizedAlpha: `max_iterations` must be an int, at least 1, got {self.max_iterations!r}."
            )
        if not isinstance(self.factor_every, int) or self.factor_every < 0:
            raise ValueError(
                "GeneralizedAlpha: `factor_every` must be an int, at least 0 (0: full Newton always), got "
                f"{self.factor_every!r}."
            )

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


def increment(scheme: GeneralizedAlpha, previous: State, u, h) -> Float[Array, " k"]:
    """x of eq. (27)."""
    return h * previous.v + h**2 * ((0.5 - scheme.beta) * previous.a + scheme.beta * u)


def advance(scheme: GeneralizedAlpha, system: AbstractSystem, previous: State, u, h) -> Motion:
    """What follows from the unknown u = a_{n+1}."""
    x = increment(scheme, previous, u, h)
    v = previous.v + h * ((1.0 - scheme.gamma) * previous.a + scheme.gamma * u)
    vdot = ((1.0 - scheme.alpha_m) * u + scheme.alpha_m * previous.a - scheme.alpha_f * previous.vdot) / (
        1.0 - scheme.alpha_f
    )
    return Motion(x, system.group.retract(previous.q, x), v, vdot)


def missed_increment(scheme: GeneralizedAlpha, system: AbstractSystem, v, vdot, jerk) -> Float[Array, " k"]:
    """c: with exact values and a_n = v̇(t_n + Δ h), Δ = α_m − α_f, the increment (27) misses the true one by h³ c.

    The true one is h v + h²/2 v̇ + h³ (v̈/6 + ad(v) v̇/12), from ẋ = T⁻¹(x) v and T⁻¹ = I + ½ ad(x) + …; hence
    c = (1/6 − β − Δ/2) v̈ + ad(v) v̇/12.
    """
    delta = scheme.alpha_m - scheme.alpha_f
    return (1.0 / 6.0 - scheme.beta - delta / 2.0) * jerk + system.group.ad_mv(v, vdot) / 12.0


def factorize_iteration_matrix(
    scheme: GeneralizedAlpha, system: AbstractSystem, tangents: Tangents, mass, x, h, kind: Any = LU
) -> Factors:
    """The factors of S above: one LU, which serves Newton, the DDM, and transposed, the AVM. Or its `Inverse`."""
    jacobian = tangents.constraint_jacobian
    stiffness, lower = times_tangent_operator(system, x, (tangents.stiffness, jacobian))
    dynamic = scheme.inertia_factor * mass + (scheme.gamma * h) * tangents.damping + (scheme.beta * h**2) * stiffness
    return factorized(system, dynamic, jacobian.T, lower, mass_scale(mass), kind, softness(system))
