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

import abc
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import (
    AbstractSystem,
    State,
    Tangents,
    factorized,
    mass_scale,
    softness,
    tangents,
    times_tangent_operator,
)
from lgsens.integrate._singular import margin_of
from lgsens.linear import LU, Factors, Matrix


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
        iterations: a fixed budget instead, so many iterations in every step and no test between them: of modified
            Newton, with a matrix renewed every `factor_every` steps and at no other time, or of full Newton where that
            is 0. Every step then costs the same, in each lane of a batch too. A step whose last increment is above
            `tolerance` has failed all the same, and `Stats.increment` says what it was; with a larger tolerance the
            motion is off by about the last increment times the contraction of one iteration, and so is its derivative,
            which is that of converged steps. Too few feed their error to the steps that follow: at h = 1 ms a top
            takes 2 full ones, or 4 with a matrix up to 20 steps old (with 3 it diverges). None: as many as it takes.
        factor_every: the most steps that share one inverse of the iteration matrix (modified Newton); a new one is made
            earlier where the iterations that it saves are worth it. Its iterations cost a tenth of a full one, and go
            on until the error left is what full Newton would leave; a step that they do not bring there is finished by
            full Newton. 0: full Newton always. The sensitivities do not depend on it: theirs is always the exact
            matrix of the converged step.
        second_order_start: start with a₀ = v̇₀ + (α_m − α_f) h v̈₀, because a_n stands for the acceleration at
            t_n + (α_m − α_f) h, and with v₀ moved by O(h²) along the constraint directions, where the scheme keeps
            it anyway: positions, velocities and multipliers are then second order from the first step.
            False: a₀ = v̇₀ and v₀ as it is; multipliers are first order in the first steps (Arnold,
            Brüls & Cardona, Numerische Mathematik 129, 2015, doi:10.1007/s00211-014-0633-1).
        stabilized: satisfy B v = 0 in every step besides Φ = 0 (stabilized index 2, after Gear, Gupta & Leimkuhler),
            at the price of m more unknowns in a step; see `_stabilized.py`. Dense. False: index 3, where B v is O(h²).

    All static and hashable. Raises `ValueError` for ρ∞ outside [0, 1), a tolerance that is not positive, fewer than 1
    iteration, a negative `factor_every`, or a `stabilized` that is not a bool. Source: Sonneville & Brüls (2014), §4;
    Brüls, Cardona & Arnold (2012).
    """

    rho_inf: float = eqx.field(static=True, default=0.9)
    tolerance: float = eqx.field(static=True, default=1e-10, kw_only=True)
    max_iterations: int = eqx.field(static=True, default=10, kw_only=True)
    factor_every: int = eqx.field(static=True, default=20, kw_only=True)
    second_order_start: bool = eqx.field(static=True, default=True, kw_only=True)
    iterations: int | None = eqx.field(static=True, default=None, kw_only=True)
    stabilized: bool = eqx.field(static=True, default=False, kw_only=True)

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
        if self.iterations is not None and (not isinstance(self.iterations, int) or self.iterations < 1):
            raise ValueError(
                "GeneralizedAlpha: `iterations` must be an int, at least 1, or None (until they converge), got "
                f"{self.iterations!r}."
            )
        if not isinstance(self.stabilized, bool):
            raise ValueError(
                f"GeneralizedAlpha: `stabilized` must be True (index 2) or False (index 3), got {self.stabilized!r}."
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


def advance(scheme: GeneralizedAlpha, system: AbstractSystem, previous: State, u, h, correction=None) -> Motion:
    """What follows from the unknown u = a_{n+1}; `correction` is added to it in x alone."""
    x = increment(scheme, previous, u if correction is None else u + correction, h)
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


class AbstractStep(eqx.Module):
    """The equations of one step from `previous`, for Newton: the unknowns are u and the multipliers of the scheme."""

    @abc.abstractmethod
    def motion(self, u, lam) -> Motion:
        """What follows from the unknowns."""

    @abc.abstractmethod
    def defect(self, motion: Motion, lam, t) -> tuple[Float[Array, " k"], Float[Array, " m"]]:
        """What is left of the dynamic equilibrium [N or N m], and of the constraints, as accelerations."""

    @abc.abstractmethod
    def factors(self, motion: Motion, lam, t, kind: Any = LU) -> tuple[Any, Float[Array, ""]]:
        """The factors of the iteration matrix, whose solution for the defect is what Newton takes from the unknowns;
        and their margin (`_singular`)."""

    @abc.abstractmethod
    def change(self, du, dlam) -> Float[Array, " k"]:
        """How far increments of the unknowns move the configuration, over βh²."""


class Index3Step(AbstractStep):
    """Eqs. (24)–(29) as above."""

    scheme: GeneralizedAlpha
    system: AbstractSystem
    mass: Matrix
    scale: Float[Array, " k"]
    softness: Float[Array, " m"] | None
    previous: State
    h: Float[Array, ""]

    def motion(self, u, lam):
        return advance(self.scheme, self.system, self.previous, u, self.h)

    def defect(self, motion, lam, t):
        residual = self.system.residual(motion.q, motion.v, motion.vdot, lam, t)
        violation = self.system.constraint(motion.q, t) / (self.scheme.beta * self.h**2)
        return residual, violation if self.softness is None else violation - self.softness * lam

    def factors(self, motion, lam, t, kind=LU):
        at_state = tangents(self.system, motion.q, motion.v, motion.vdot, lam, t)
        factors = factorize_iteration_matrix(self.scheme, self.system, at_state, self.mass, motion.x, self.h, kind)
        return factors, margin_of(factors, at_state.constraint_jacobian, self.scale)

    def change(self, du, dlam):
        return jnp.abs(du)
