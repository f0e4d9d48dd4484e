"""Stabilized index 2: positions and velocities satisfy the joints in every step, Φ(q⁺) = 0 and B(q⁺) v⁺ = 0.

Index 3 leaves B v = O(h²). After Gear, Gupta & Leimkuhler (1985), on the Lie group Arnold, Cardona & Brüls (A Lie
algebra approach to Lie group time integration of constrained systems, 2016) and Arnold & Hante (2017,
doi:10.1115/1.4033441), the increment receives m unknowns η more, for the m equations more: eq. (27) becomes

    x = h (v − Bᵀη) + h² ((½ − β) a + β u)       there.

Bᵀη is a force, not a velocity: metres and radians are mixed by their numbers, so a scene in mm has another motion, and
so has a body with its frame elsewhere. Here the correction is the velocity that impulses in the joints give, and
its unknown ν is scaled like λ, −h M⁻¹Bᵀη = βh² N ν:

    x = h v + h² ((½ − β) a + β (u + N ν)),      N = M⁻¹ B(q_n)ᵀ,
    v⁺, v̇⁺ by eqs. (28), (29) from u,
    r(q⁺, v⁺, v̇⁺, λ⁺, t⁺) = 0,   Φ(q⁺)/(βh²) = 0,   B(q⁺) v⁺/(γh) = 0.

It is O(h³) of x, ν = O(h): the order stays two. With (δx, δv, δv̇) = (βh² (δu + N δν), γh δu, c δu) the iteration matrix
for (u, λ, ν) is

    S₂ = [[c M + γh C_t + βh² K_t T,  Bᵀ,  βh² K_t T N],
          [B T,                       0,   B T N      ],          V w = D(B v)·(q w̃),   g = (βh²)/(γh),
          [B + g V T,                 0,   g V T N    ]]

and does not degenerate as h → 0 either: its limit [[c M, Bᵀ, 0], [B, 0, B N], [B, 0, 0]] is regular where [[M, Bᵀ],
[B, 0]] is. The scaling by the size of M is that of index 3, ν like λ and the rows of the velocities like those of the
positions.

The multipliers of the scheme, `State.lam` within the integrator and the sensitivities, are [λ; ν], shape (2 m,), so
that Newton, scans and rules need not know of ν. All matrices are dense.

Linearization, with the rows and columns of `_index3.py` and ν' as the second half of λ'. With y = N ν = M⁻¹ B(q_n)ᵀ ν

    M y' = B_nᵀ ν' + G w_n + g_p p',   G w = D(Bᵀν)·(q w̃) at q_n,   g_p p' = (Bᵀν)_p p' − (M_p p') y
    x'   = h v'_n + h² ((½ − β) a'_n + β (a'_{n+1} + y')) + x_h h',      x_h = v_n + 2h ((½ − β) a_n + β (u + y))
    (B v) (B v'_{n+1} + V w_{n+1} + V_p p')/(γh)                                              = b.nu

with V_p p' = (B v)_p p'; all other rows are as there. Forwards, from (w, v', v̇')_0 at u' = ν' = 0, S₂ exact,

    S₂ [u'; λ'; ν'] = [ b.a − r_p p' − (M v̇'_0 + C_t v'_0 + K_t w_0);
                        b.lam − (Φ_p p' + B w_0)/(βh²);
                        b.nu − (V_p p' + B v'_0 + V w_0)/(γh) ],          w = w_0 + βh² T (u' + N ν').

Backwards, with μ.nu the multiplier of the new row,

    μ.w + K_tᵀ μ.a + Bᵀ μ.lam/(βh²) + Vᵀ μ.nu/(γh) = c.w
    μ.v + C_tᵀ μ.a + Bᵀ μ.nu/(γh)                  = c.v
    −βh² Nᵀ Tᵀ μ.w                                 = c.nu

and the rest as there. Elimination of μ.w, μ.v, μ.vdot leaves

    S₂ᵀ [μ.a; μ.lam; μ.nu] = [ c.a + βh² Tᵀ c.w + γh c.v + c c.vdot;  c.lam;  c.nu + βh² Nᵀ Tᵀ c.w ].

The columns of step n receive besides, with μ_y = βh² M⁻¹ Tᵀ μ.w,

    c_n.w += Gᵀ μ_y,      p̄ += −V_pᵀ μ.nu/(γh) + g_pᵀ μ_y.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, constraint_velocity, mass_scale, require_independent
from lgsens.integrate._alpha import AbstractAlpha, advance, increment
from lgsens.integrate._alpha_step import AbstractEquations, AbstractStep
from lgsens.integrate._linearized import AbstractLinearizedStep, Variation
from lgsens.integrate._singular import margin_by_mass
from lgsens.liegroups import AbstractLieGroup
from lgsens.linear import LU, Factors


def halves(lam) -> tuple[Float[Array, "*n m"], Float[Array, "*n m"]]:
    """λ and ν."""
    m = lam.shape[-1] // 2
    return lam[..., :m], lam[..., m:]


class StabilizedTangents(NamedTuple):
    """The derivatives of r, Φ and B v at one state."""

    stiffness: Float[Array, "k k"]  # K_t
    damping: Float[Array, "k k"]  # C_t
    constraint_jacobian: Float[Array, "m k"]  # B
    velocity_stiffness: Float[Array, "m k"]  # V


def by_configuration(system: AbstractSystem, function, q) -> Float[Array, "r k"]:
    """The derivative of a function of q along the Lie-algebra coordinates w of q w̃, one column for each."""
    column = lambda w: jax.jvp(function, (q,), (system.group.to_ambient(q, w),))[1]
    k = system.group.dim
    return jax.vmap(column, out_axes=1)(jnp.eye(k, dtype=jax.tree.leaves(q)[0].dtype))


class StabilizedFactors(eqx.Module):
    """The factors of S₂ as those of a matrix with the border (Bᵀ, B T) and everything else within it.

    The unknowns there are (u, ν/σ; λ/σ) and the rows (r, σ B v; σ Φ): both scalings are the same.
    """

    factors: Factors
    scale: Float[Array, ""]  # σ

    def solve(self, force, rate, *, transposed: bool = False):
        """S₂⁻¹ or S₂⁻ᵀ of `force` (k,) and `rate` (2 m,): of (r; Φ, B v) or of the columns (u; λ, ν)."""
        k = force.shape[0]
        first, second = halves(rate)
        inner, outer = self.factors.solve(jnp.concatenate([force, self.scale * second]), first, transposed=transposed)
        return inner[:k], jnp.concatenate([outer, self.scale * inner[k:]])


class StabilizedStep(AbstractStep):
    """The equations above."""

    shared: "Stabilized"
    previous: State
    normal: Float[Array, "k m"]  # N
    h: Float[Array, ""]

    def correction(self, lam):
        """N ν."""
        return self.normal @ halves(lam)[1]

    def change(self, du, dlam):
        return jnp.maximum(jnp.abs(du), jnp.abs(self.correction(dlam)))

    def motion(self, u, lam):
        return advance(self.shared.scheme, self.shared.system, self.previous, u, self.h, self.correction(lam))

    def defect(self, motion, lam, t):
        scheme, system, h = self.shared.scheme, self.shared.system, lax.stop_gradient(self.h)
        residual = system.residual(motion.q, motion.v, motion.vdot, halves(lam)[0], t)
        positions = system.constraint(motion.q) / (scheme.beta * h**2)
        velocities = constraint_velocity(system, motion.q, motion.v) / (scheme.gamma * h)
        return residual, jnp.concatenate([positions, velocities])

    def tangents(self, q, v, vdot, lam, t) -> StabilizedTangents:
        system = self.shared.system
        k_t, c_t, jacobian = system.tangents(q, v, vdot, halves(lam)[0], t)
        return StabilizedTangents(
            k_t, c_t, jacobian, by_configuration(system, lambda q: constraint_velocity(system, q, v), q)
        )

    def factors(self, motion, lam, t, kind=LU):
        at_state = self.tangents(motion.q, motion.v, motion.vdot, lam, t)
        return self.factorized(at_state, motion.x, kind), self.shared.margin_at(at_state.constraint_jacobian)

    def factorized(self, at_state: StabilizedTangents, x, kind: Any = LU) -> StabilizedFactors:
        """The factors of S₂."""
        scheme, mass, normal, h = self.shared.scheme, self.shared.mass, self.normal, self.h
        k_t, c_t, jacobian, velocity_stiffness = at_state
        k, m = normal.shape
        scale = mass_scale(mass)
        position, gain = scheme.beta * h**2, (scheme.beta * h**2) / (scheme.gamma * h)
        moved = jnp.concatenate([position * k_t, gain * velocity_stiffness, jacobian])
        by_u = jax.vmap(partial(self.shared.system.group.tangent_rmv, x))(moved)
        by_nu = scale * (by_u @ normal)
        of_u = jnp.concatenate([scheme.inertia_factor * mass + (scheme.gamma * h) * c_t, jacobian]) + by_u[: k + m]
        rows = jnp.concatenate([jnp.ones(k, scale.dtype), jnp.broadcast_to(scale, m)])[:, None]
        dynamic = rows * jnp.concatenate([of_u, by_nu[: k + m]], axis=1)
        upper = jnp.concatenate([jacobian.T, jnp.zeros((m, m), scale.dtype)])
        lower = jnp.concatenate([by_u[k + m :], by_nu[k + m :]], axis=1)
        return StabilizedFactors(Factors.of(dynamic, upper, lower, scale, kind=kind), scale)


class Loads(NamedTuple):
    """What the equations of a step depend on the parameters by."""

    residual: Float[Array, " k"]
    violation: Float[Array, " m"]  # Φ
    rate: Float[Array, " m"]  # B v
    correction: Float[Array, " k"]  # Bᵀν − M y
    x: Float[Array, " k"]
    v: Float[Array, " k"]


class StabilizedLinearizedStep(AbstractLinearizedStep):
    """The equations above, and the factors of S₂ at the converged state."""

    scheme: AbstractAlpha = eqx.field(static=True)
    group: AbstractLieGroup = eqx.field(static=True)
    mass: Float[Array, "k k"]
    inverse_mass: Float[Array, "k k"]
    h: Float[Array, ""]
    x: Float[Array, " k"]
    tangents: StabilizedTangents
    normal: Float[Array, "k m"]  # N
    curvature: Float[Array, "k k"]  # G
    factors: StabilizedFactors

    def margin(self, scale):
        """Not known: that of these factors says nothing."""
        return None

    def forward(self, previous, loads, row):
        scheme, group, h, x = self.scheme, self.group, self.h, self.x
        position, velocity = scheme.beta * h**2, scheme.gamma * h
        k_t, c_t, jacobian, velocity_stiffness = self.tangents
        dy = self.inverse_mass @ (self.curvature @ previous.w + loads.correction)
        dx = h * previous.v + (h**2 * (0.5 - scheme.beta)) * previous.a + loads.x + position * dy
        w = group.Ad_inv_mv(group.exp(x), previous.w) + group.tangent_mv(x, dx) + row.w
        v = previous.v + (h * (1.0 - scheme.gamma)) * previous.a + loads.v + row.v
        vdot = (scheme.alpha_m * previous.a - scheme.alpha_f * previous.vdot) / (1.0 - scheme.alpha_f) + row.vdot
        violations = (
            (loads.violation + jacobian @ w) / position,
            (loads.rate + jacobian @ v + velocity_stiffness @ w) / velocity,
        )
        u, lam = self.factors.solve(
            row.a - loads.residual - (self.mass @ vdot + c_t @ v + k_t @ w), row.lam - jnp.concatenate(violations)
        )
        return Variation(
            w=w + group.tangent_mv(x, position * (u + self.normal @ halves(lam)[1])),
            v=v + velocity * u,
            vdot=vdot + scheme.inertia_factor * u,
            lam=lam,
            a=u,
        )

    def backward(self, c, loads):
        scheme, group, h, x = self.scheme, self.group, self.h, self.x
        position, velocity = scheme.beta * h**2, scheme.gamma * h
        alpha_m, alpha_f = scheme.alpha_m, scheme.alpha_f
        k_t, c_t, jacobian, velocity_stiffness = self.tangents
        turned = position * group.tangent_rmv(x, c.w)
        c_lam, c_nu = halves(c.lam)
        mu_a, mu_lam = self.factors.solve(
            c.a + turned + velocity * c.v + scheme.inertia_factor * c.vdot,
            jnp.concatenate([c_lam, c_nu + turned @ self.normal]),
            transposed=True,
        )
        phi, rate = halves(mu_lam)
        phi, rate = phi / position, rate / velocity
        mu_w = c.w - mu_a @ k_t - phi @ jacobian - rate @ velocity_stiffness
        mu_v = c.v - mu_a @ c_t - rate @ jacobian
        mu_vdot = c.vdot - mu_a @ self.mass
        mu_x = group.tangent_rmv(x, mu_w)
        mu_y = position * (self.inverse_mass @ mu_x)
        previous = Variation(
            w=group.Ad_inv_rmv(group.exp(x), mu_w) + mu_y @ self.curvature,
            v=h * mu_x + mu_v,
            vdot=-(alpha_f / (1.0 - alpha_f)) * mu_vdot,
            lam=jnp.zeros_like(c.lam),
            a=(h**2 * (0.5 - scheme.beta)) * mu_x
            + (h * (1.0 - scheme.gamma)) * mu_v
            + (alpha_m / (1.0 - alpha_f)) * mu_vdot,
        )
        of_loads = Loads(-mu_a, -phi, -rate, mu_y, mu_x, mu_v)
        return previous, of_loads, Variation(mu_w, mu_v, mu_vdot, mu_lam, mu_a)


class Stabilized(AbstractEquations):
    """The equations of stabilized index 2."""

    scheme: AbstractAlpha = eqx.field(static=True)
    system: AbstractSystem
    mass: Float[Array, "k k"]
    inverse_mass: Float[Array, "k k"]
    scale: Float[Array, " k"]

    @classmethod
    def of(cls, scheme, system):
        require_independent(system, "GeneralizedAlpha(stabilized=True)")
        mass = system.mass_matrix()
        return cls(scheme, system, mass, jnp.linalg.inv(mass), system.coordinate_scale())

    @staticmethod
    def complete(state):
        return eqx.tree_at(lambda s: s.lam, state, jnp.concatenate([state.lam, jnp.zeros_like(state.lam)]))

    @staticmethod
    def physical(states):
        return eqx.tree_at(lambda s: s.lam, states, halves(states.lam)[0])

    @staticmethod
    def numbers(system):
        return (system.group.dim + 2 * len(system.constraint_names)) ** 2

    def loads(self, previous, state):
        scheme, before, (lam, nu) = self.scheme, previous.q, halves(state.lam)
        y = self.step(previous, None).correction(state.lam)

        def function(system, node):
            h = node.h
            return Loads(
                residual=system.residual(state.q, state.v, state.vdot, lam, node.t),
                violation=system.constraint(state.q),
                rate=constraint_velocity(system, state.q, state.v),
                correction=nu @ system.constraint_jacobian(before) - system.mass_matrix() @ y,
                x=increment(scheme, previous, state.a + y, h),
                v=h * ((1.0 - scheme.gamma) * previous.a + scheme.gamma * state.a),
            )

        return function

    @property
    def unknowns(self):
        return self.system.group.dim + 2 * len(self.system.constraint_names)

    def step(self, previous, h):
        normal = self.inverse_mass @ self.system.constraint_jacobian(previous.q).T
        return StabilizedStep(self, previous, normal, h)

    def linearized(self, node, previous, state):
        system, h = self.system, node.h
        equations = self.step(previous, h)
        nu = halves(state.lam)[1]
        x = increment(self.scheme, previous, state.a + equations.correction(state.lam), h)
        at_state = equations.tangents(state.q, state.v, state.vdot, state.lam, node.t)
        return StabilizedLinearizedStep(
            scheme=self.scheme,
            group=system.group,
            mass=self.mass,
            inverse_mass=self.inverse_mass,
            h=h,
            x=x,
            tangents=at_state,
            normal=equations.normal,
            curvature=by_configuration(system, lambda q: nu @ system.constraint_jacobian(q), previous.q),
            factors=equations.factorized(at_state, x),
        )

    def margin_at(self, jacobian):
        return margin_by_mass(self.system, self.mass, jacobian, self.scale)

    def margin(self, state):
        return self.margin_at(self.system.constraint_jacobian(state.q))
