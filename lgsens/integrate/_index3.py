"""Index 3: a step satisfies Φ(q⁺) = 0, and B v is O(h²). Newton's equations, and their linearization.

Iteration. With ∂x/∂u = βh², ∂v⁺/∂u = γh and ∂v̇⁺/∂u = c = (1 − α_m)/(1 − α_f) the matrix of eq. (30) is

    S = [[c M + γh C_t + βh² K_t T(x),  Bᵀ],
         [B T(x),                       0 ]]

for the unknowns (u, λ) and the rows (r, Φ/(βh²)); with −diag(c) in the corner where constraints may be redundant, whose
rows are Φ/(βh²) − c λ (`dynamics/_redundant.py`). Where forces depend on λ, ∂r/∂λ stands for Bᵀ, here and below.

Linearization. Let δ_n = (w, v', v̇', λ', a')_n, with q' = q w̃ (eq. 32). Differentiating the step (eqs. 24–29, §6.2),

    x'  = h v'_n + h² ((½ − β) a'_n + β a'_{n+1}) + x_h h'            x_h = v_n + 2h ((½ − β) a_n + β a_{n+1})
    (24)  w_{n+1}  − D(exp x̃) w_n − T(x) x'                                                  = b.w
    (28)  v'_{n+1} − v'_n − h ((1 − γ) a'_n + γ a'_{n+1}) − v_h h'                              = b.v
                                                                       v_h = (1 − γ) a_n + γ a_{n+1}
    (29)  v̇'_{n+1} − ((1 − α_m) a'_{n+1} + α_m a'_n − α_f v̇'_n)/(1 − α_f)                      = b.vdot
    (26)  (B w_{n+1} + Φ_p p')/(βh²)  [− c λ'_{n+1} − 2Φ h'/(βh³), redundant constraints]      = b.lam
    (25)  M v̇'_{n+1} + C_t v'_{n+1} + K_t w_{n+1} + Bᵀλ'_{n+1} + r_p p' + r_t t'               = b.a

The loads are r_p p' + r_t t', Φ_p p', x_h h' and v_h h'.

Forwards (the direct differentiation method). Everything but u' = a'_{n+1} and λ'_{n+1} is known. Let (w, v', v̇')_0 be
eqs. (24), (28), (29) at u' = 0 plus their right-hand sides. Then

    S [u'; λ'] = [ b.a − r_p p' − (M v̇'_0 + C_t v'_0 + K_t w_0);  b.lam − (Φ_p p' + B w_0)/(βh²) ]

with S at the converged state, exact.

Backwards (the discrete adjoint variable method). The columns of L that belong to (w, v', v̇', λ', a')_{n+1} give for the
multipliers μ of the rows (named like them)

    μ.w    + K_tᵀ μ.a + Bᵀ μ.lam/(βh²) = c.w
    μ.v    + C_tᵀ μ.a                  = c.v
    μ.vdot + Mᵀ μ.a                    = c.vdot
    B μ.a                              = c.lam      (∂r/∂λᵀ μ.a where forces depend on λ)
    −βh² Tᵀ μ.w − γh μ.v − c μ.vdot    = c.a

Elimination of the first three leaves the transpose of the iteration matrix, which the continuous method of §7 does not
have (its remark after eq. 40):

    Sᵀ [μ.a; μ.lam] = [ c.a + βh² Tᵀ c.w + γh c.v + c c.vdot;  c.lam ]

The columns of step n then receive, from the same equations,

    c_n.w += Dᵀ μ.w,    c_n.v += h Tᵀ μ.w + μ.v,    c_n.a += h² (½ − β) Tᵀ μ.w + h (1 − γ) μ.v + α_m/(1 − α_f) μ.vdot,
    c_n.vdot += −α_f/(1 − α_f) μ.vdot,

and the loads −μ.a, −μ.lam/(βh²), Tᵀ μ.w and μ.v. Nothing of the paper's Ḃ, Ḟ_λ or d²F_M/dt² is needed, because
accelerations and multipliers are unknowns here like the others.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import (
    AbstractSystem,
    State,
    Tangents,
    factor_size,
    factorized,
    mass_matrix,
    mass_scale,
    multiplier_jacobian,
    softness,
    tangents,
    times_tangent_operator,
)
from lgsens.integrate._alpha import (
    AbstractAlpha,
    AbstractAlphaLinearizedStep,
    AbstractEquations,
    AbstractStep,
    advance,
    increment,
)
from lgsens.integrate._linearized import Node, Variation
from lgsens.integrate._singular import margin_of
from lgsens.linear import LU, Factors, Matrix


def factorize_iteration_matrix(
    scheme: AbstractAlpha,
    system: AbstractSystem,
    tangents: Tangents,
    mass,
    x,
    h,
    kind: Any = LU,
    upper: Matrix | None = None,
) -> Factors:
    """The factors of S above: one LU, which serves Newton, the DDM, and transposed, the AVM. Or its `Inverse`.

    `upper`: ∂r/∂λ; None: Jᵀ."""
    jacobian = tangents.constraint_jacobian
    stiffness, lower = times_tangent_operator(system, x, (tangents.stiffness, jacobian))
    dynamic = scheme.inertia_factor * mass + (scheme.gamma * h) * tangents.damping + (scheme.beta * h**2) * stiffness
    return factorized(
        system, dynamic, jacobian.T if upper is None else upper, lower, mass_scale(mass), kind, softness(system)
    )


class Index3Step(AbstractStep):
    """Eqs. (24)–(29)."""

    shared: "Index3"
    previous: State
    node: Node

    def motion(self, u, lam):
        return advance(self.shared.scheme, self.shared.system, self.previous, u, self.node.h)

    def defect(self, motion, lam):
        system, softness, (_, t, h) = self.shared.system, self.shared.softness, self.node
        residual = system.residual(motion.q, motion.v, motion.vdot, lam, t)
        # Φ is zero at the solution, up to round-off that h' would multiply by 1/h³
        h = lax.stop_gradient(h) if softness is None else h
        violation = system.constraint(motion.q, t) / (self.shared.scheme.beta * h**2)
        return residual, violation if softness is None else violation - softness * lam

    @partial(jax.jit, static_argnames="kind", inline=True)  # traced once for the shape of the factors and for them
    def factors(self, motion, lam, kind=LU):
        shared, (_, t, h) = self.shared, self.node
        at_state = tangents(shared.system, motion.q, motion.v, motion.vdot, lam, t)
        jacobian = at_state.constraint_jacobian
        upper = multiplier_jacobian(shared.system, jacobian, motion.q, motion.v, lam, t)
        matrices = at_state, shared.mass
        factors = factorize_iteration_matrix(shared.scheme, shared.system, *matrices, motion.x, h, kind, upper)
        return factors, margin_of(factors, jacobian, shared.scale)

    def change(self, du, dlam):
        return jnp.abs(du)


class Index3Loads(NamedTuple):
    """What the equations of a step depend on the parameters by."""

    residual: Float[Array, " k"]
    violation: Float[Array, " m"]  # Φ, times (h₀/h)² where it is not zero
    x: Float[Array, " k"]
    v: Float[Array, " k"]


class Index3LinearizedStep(AbstractAlphaLinearizedStep):
    """The equations above, and the factors of S at the converged state."""

    x: Float[Array, " k"]
    tangents: Tangents
    factors: Factors

    def margin(self, scale):
        """See `_singular`."""
        return margin_of(self.factors, self.tangents.constraint_jacobian, scale)

    def forward(self, shared, node, previous, loads, row):
        k_t, c_t, jacobian = self.tangents
        w, v, vdot = carried = self.carried(shared, node.h, previous, loads, row)
        u, lam = self.factors.solve(
            row.a - loads.residual - (shared.mass @ vdot + c_t @ v + k_t @ w),
            row.lam - (loads.violation + jacobian @ w) / (shared.scheme.beta * node.h**2),
        )
        return self.ended(shared, node.h, carried, u, lam)

    def backward(self, shared, node, c, loads):
        k_t, c_t, jacobian = self.tangents
        mu_a, mu_lam = self.factors.solve(self.of_unknown(shared, node.h, c)[0], c.lam, transposed=True)
        mu_phi = mu_lam / (shared.scheme.beta * node.h**2)
        mu_w = c.w - mu_a @ k_t - mu_phi @ jacobian
        mu = Variation(mu_w, c.v - mu_a @ c_t, c.vdot - mu_a @ shared.mass, mu_lam, mu_a)
        previous, mu_x = self.carried_back(shared, node.h, mu)
        return previous, Index3Loads(-mu_a, -mu_phi, mu_x, mu.v), mu


class Index3(AbstractEquations):
    """The equations of index 3."""

    scheme: AbstractAlpha
    system: AbstractSystem
    mass: Matrix  # M, (k, k)
    scale: Float[Array, " k"]
    softness: Float[Array, " m"] | None  # c; None: no constraint may be redundant

    @classmethod
    def of(cls, scheme, system):
        return cls(scheme, system, mass_matrix(system), system.coordinate_scale(), softness(system))

    @staticmethod
    def numbers(scheme, system):
        return factor_size(system)

    def loads(self, previous, state):
        scheme = self.scheme

        def function(system, node):
            h = node.h
            violation = system.constraint(state.q, node.t)
            if self.softness is not None:
                violation = violation * (lax.stop_gradient(h) / h) ** 2
            return Index3Loads(
                system.residual(state.q, state.v, state.vdot, state.lam, node.t),
                violation,
                increment(scheme, previous, state.a, h),
                h * ((1.0 - scheme.gamma) * previous.a + scheme.gamma * state.a),
            )

        return function

    def step(self, previous, node):
        return Index3Step(self, previous, node)

    @partial(jax.jit, inline=True)  # traced once for both sweeps
    def linearized(self, node, previous, state):
        system, h = self.system, node.h
        x = increment(self.scheme, previous, state.a, h)
        at_state = tangents(system, state.q, state.v, state.vdot, state.lam, node.t)
        upper = multiplier_jacobian(system, at_state.constraint_jacobian, state.q, state.v, state.lam, node.t)
        factors = factorize_iteration_matrix(self.scheme, system, at_state, self.mass, x, h, upper=upper)
        return Index3LinearizedStep(x, at_state, factors)
