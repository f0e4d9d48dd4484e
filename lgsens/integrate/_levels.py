"""The step of `_level_step.py`, linearized, and what all steps share.

The rows and columns are those of `_index3.py`, with ν' as the last part of λ'. With y = N ν

    M y' = B_nᵀ ν' + G w_n + g_p p',   G w = D(Bᵀν)·(q w̃) at q_n,   g_p p' = (Bᵀν)_p p' − (M_p p') y
    x'   = h v'_n + h² ((½ − β) a'_n + β (a'_{n+1} + y')) + x_h h',      x_h = v_n + 2h ((½ − β) a_n + β (u + y))
    (c) (C v'_{n+1} + V w_{n+1} + c_p p')/(γh) = b.lam there,      c = [B v + Φ_t; A v + b], C = ∂c/∂v, V by q

all other rows are as there. Forwards, from (w, v', v̇')_0 at u' = ν' = 0, S₂ exact,

    S₂ [u'; λ'; ν'] = [ b.a − r_p p' − (M v̇'_0 + C_t v'_0 + K_t w_0);
                        b.lam − [(Φ_p p' + B w_0)/(βh²); (c_p p' + C v'_0 + V w_0)/(γh)] ]

and w = w_0 + βh² T (u' + N ν').

Backwards, with μ_Φ and μ_c the multipliers of the rows over βh² and γh,

    μ.w + K_tᵀ μ.a + Bᵀ μ_Φ + Vᵀ μ_c = c.w
    μ.v + C_tᵀ μ.a + Cᵀ μ_c          = c.v
    −βh² Nᵀ Tᵀ μ.w                   = c.nu

and the rest as there. Elimination of μ.w, μ.v, μ.vdot leaves

    S₂ᵀ [μ.a; μ.lam] = [ c.a + βh² Tᵀ c.w + γh c.v + c c.vdot;  c.lam;  c.nu + βh² Nᵀ Tᵀ c.w ].

The columns of step n receive besides, with μ_y = βh² M⁻¹ Tᵀ μ.w,

    c_n.w += Gᵀ μ_y,      p̄ += −c_pᵀ μ_c + g_pᵀ μ_y.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import State, require_independent
from lgsens.integrate._alpha import AbstractAlpha, AbstractAlphaLinearizedStep, AbstractEquations, increment
from lgsens.integrate._level_sparse import SparseLevelFactors, level_plan
from lgsens.integrate._level_step import Counts, LevelFactors, LevelStep, LevelTangents, by_configuration
from lgsens.integrate._linearized import Variation
from lgsens.integrate._singular import margin_by_mass
from lgsens.linear import Elimination, Matrix


class LevelLoads(NamedTuple):
    """What the equations of a step depend on the parameters by."""

    residual: Float[Array, " k"]
    violation: Float[Array, " p"]  # Φ
    rate: Float[Array, " c"]  # c
    correction: Float[Array, " k"]  # Bᵀν − M y
    x: Float[Array, " k"]
    v: Float[Array, " k"]


class LevelLinearizedStep(AbstractAlphaLinearizedStep):
    """The equations above, and the factors of S₂ at the converged state."""

    x: Float[Array, " k"]
    tangents: LevelTangents
    before: Matrix  # B_n, (b, k)
    curvature: Matrix  # G, (k, k)
    factors: LevelFactors | SparseLevelFactors

    def margin(self, scale):
        """Not known: that of these factors says nothing."""
        return None

    def _jacobians(self, counts: Counts):
        """B and C."""
        jacobian = self.tangents.jacobian
        if not counts.velocities:
            return jacobian, jacobian
        return jacobian[: counts.positions], jacobian[counts.positions - counts.both :]

    def forward(self, shared, node, previous, loads, row):
        counts, h = shared.counts, node.h
        position, velocity = shared.scheme.beta * h**2, shared.scheme.gamma * h
        k_t, c_t, *_, rate_stiffness = self.tangents
        of_positions, of_rates = self._jacobians(counts)
        dy = shared.inverse_mass @ (self.curvature @ previous.w + loads.correction)
        w, v, vdot = carried = self.carried(shared, h, previous, loads, row, position * dy)
        left = counts.as_rows(
            (loads.violation + of_positions @ w) / position, (loads.rate + of_rates @ v + rate_stiffness @ w) / velocity
        )
        u, lam = self.factors.solve(row.a - loads.residual - (shared.mass @ vdot + c_t @ v + k_t @ w), row.lam - left)
        return self.ended(shared, h, carried, u, lam, shared.correction(self.before, lam))

    def backward(self, shared, node, c, loads):
        counts, h = shared.counts, node.h
        m = counts.multipliers
        position, velocity = shared.scheme.beta * h**2, shared.scheme.gamma * h
        k_t, c_t, *_, rate_stiffness = self.tangents
        of_positions, of_rates = self._jacobians(counts)
        of_unknown, by_x = self.of_unknown(shared, h, c)
        of_lam = jnp.concatenate([c.lam[:m], c.lam[m:] + self.before @ (shared.inverse_mass @ by_x)])
        mu_a, mu_lam = self.factors.solve(of_unknown, of_lam, transposed=True)
        phi, rate = counts.apart(mu_lam)
        phi, rate = phi / position, rate / velocity
        mu_w = c.w - mu_a @ k_t - phi @ of_positions - rate @ rate_stiffness
        mu = Variation(mu_w, c.v - mu_a @ c_t - rate @ of_rates, c.vdot - mu_a @ shared.mass, mu_lam, mu_a)
        previous, mu_x = self.carried_back(shared, h, mu)
        mu_y = position * (shared.inverse_mass @ mu_x)
        previous = previous._replace(w=previous.w + mu_y @ self.curvature)
        return previous, LevelLoads(-mu_a, -phi, -rate, mu_y, mu_x, mu.v), mu


class Levels(AbstractEquations):
    """The equations of a step with rows of velocity level."""

    scheme: AbstractAlpha
    counts: Counts = eqx.field(static=True)
    plan: Elimination | None = eqx.field(static=True)  # None: all matrices are dense
    system: Any
    mass: Matrix  # (k, k)
    inverse_mass: Matrix  # (k, k)
    scale: Float[Array, " k"]

    @classmethod
    def of(cls, scheme, system: Any):
        require_independent(system, "A step with constraints of velocity level (`stabilized`, nonholonomic)")
        plan = level_plan(scheme, system)
        mass: Any = system.mass_matrix() if plan is None else system.sparse_mass_matrix()
        return cls(
            scheme=scheme,
            counts=Counts.of(scheme, system),
            plan=plan,
            system=system,
            mass=mass,
            inverse_mass=jnp.linalg.inv(mass) if plan is None else mass.inverse(),
            scale=system.coordinate_scale(),
        )

    @staticmethod
    def numbers(scheme, system):
        counts, plan = Counts.of(scheme, system), level_plan(scheme, system)
        return plan.numbers if plan is not None else (system.group.dim + counts.multipliers + counts.both) ** 2

    def correction(self, before: Matrix, lam):
        """N ν, with B_n."""
        if not self.counts.both:
            return jnp.zeros_like(self.scale)
        return self.inverse_mass @ (lam[self.counts.multipliers :] @ before)

    def _before(self, system: Any, q, t) -> Matrix:
        """B, without rows unless they are stabilized."""
        if not self.counts.both:
            return jnp.zeros_like(self.scale, shape=(0, len(self.scale)))
        jacobian = system.constraint_jacobian if self.plan is None else system.sparse_constraint_jacobian
        return jacobian(q, t)

    def _curvature(self, previous: State, nu, t) -> Matrix:
        """G."""
        q, system = previous.q, self.system
        if self.plan is None:
            return by_configuration(system, lambda q: nu @ self._before(system, q, t), q)
        stiffness = lambda lam: system.sparse_tangents(q, previous.v, previous.vdot, lam, t)[0]
        return jax.jvp(stiffness, (nu,), (nu,))[1]  # linear in λ, with Bᵀλ

    def loads(self, previous, state):
        scheme, counts, before = self.scheme, self.counts, previous.q
        lam, nu = state.lam[: counts.multipliers], state.lam[counts.multipliers :]

        def function(system, node):
            h = node.h
            force = nu @ self._before(system, before, node.begin)
            y = lax.stop_gradient(self.inverse_mass @ force)
            return LevelLoads(
                residual=system.residual(state.q, state.v, state.vdot, lam, node.t),
                violation=system.constraint(state.q, node.t),
                rate=counts.rate(system, state.q, state.v, node.t),
                correction=force - (system.mass_matrix() if self.plan is None else system.sparse_mass_matrix()) @ y,
                x=increment(scheme, previous, state.a + y, h),
                v=h * ((1.0 - scheme.gamma) * previous.a + scheme.gamma * state.a),
            )

        return function

    def step(self, previous, node):
        return LevelStep(self, previous, node, self._before(self.system, previous.q, node.begin))

    def linearized(self, node, previous, state):
        equations = self.step(previous, node)
        x = increment(self.scheme, previous, state.a + equations.correction(state.lam), node.h)
        at_state = equations.tangents(state.q, state.v, state.vdot, state.lam, node.t)
        return LevelLinearizedStep(
            x=x,
            tangents=at_state,
            before=equations.before,
            curvature=self._curvature(previous, state.lam[self.counts.multipliers :], node.begin),
            factors=equations.factorized(at_state, x),
        )

    def margin_at(self, jacobian):
        return margin_by_mass(self.system, self.mass, jacobian, self.scale)
