"""Constraints by level: rows of positions, of velocities (nonholonomic), and of both (stabilized index 2).

Index 3 keeps Φ(q⁺, t⁺) = 0 and leaves B v + Φ_t = O(h²). A nonholonomic row A v⁺ + b = 0 has velocity level only. A
stabilized system satisfies Φ = 0 and B v + Φ_t = 0 in every step. After Gear, Gupta & Leimkuhler (1985), on the Lie
group Arnold, Cardona & Brüls (A Lie algebra approach to Lie group time integration of constrained systems, 2016) and
Arnold & Hante (2017, doi:10.1115/1.4033441), the increment then receives unknowns η more, for as many equations more:
eq. (27) becomes

    x = h (v − Bᵀη) + h² ((½ − β) a + β u)       there.

Bᵀη is a force, not a velocity: metres and radians are mixed by their numbers, so a scene in mm has another motion, and
so has a body with its frame elsewhere. Here the correction is the velocity that impulses in the joints give, and
its unknown ν is scaled like λ, −h M⁻¹Bᵀη = βh² N ν:

    x = h v + h² ((½ − β) a + β (u + N ν)),      N = M⁻¹ B(q_n, t_n)ᵀ,
    v⁺, v̇⁺ by eqs. (28), (29) from u,
    r(q⁺, v⁺, v̇⁺, λ⁺, t⁺) = 0,   Φ/(βh²) = 0,   (A v⁺ + b)/(γh) = 0,   (B v⁺ + Φ_t)/(γh) = 0.

It is O(h³) of x, ν = O(h): the order stays two. With (δx, δv, δv̇) = (βh² (δu + N δν), γh δu, c δu), J = [B; A], and
V_A, V_B the derivatives of A v + b and B v + Φ_t by the configuration (V w = D(·)·(q w̃)), the iteration matrix for
(u, λ, ν) is

    S₂ = [[c M + γh C_t + βh² K_t T,  Jᵀ,  βh² K_t T N],
          [B T,                       0,   B T N      ],                     g = (βh²)/(γh),
          [A + g V_A T,               0,   g V_A T N  ],
          [B + g V_B T,               0,   g V_B T N  ]]

and does not degenerate as h → 0 either: its limit [[c M, Jᵀ, 0], [J, 0, ·], [B, 0, B N]] is regular where [[M, Jᵀ],
[J, 0]] is. The scaling by the size of M is that of index 3, ν like λ and the rows of velocities like those of
positions. Without stabilized rows there is no ν, without nonholonomic ones no A.

The multipliers of the scheme, `State.lam` within the integrator and the sensitivities, are [λ; ν], its rows those of S₂
below the first. Matrices are dense, or in blocks (`_level_sparse.py`).
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, constraint_velocity, mass_scale, multiplier_jacobian
from lgsens.integrate._alpha import AbstractAlpha, AbstractStep, advance
from lgsens.integrate._level_sparse import SparseLevelFactors
from lgsens.integrate._linearized import Node
from lgsens.linear import LU, Factors, Matrix


class Counts(NamedTuple):
    """How many rows there are of positions, of velocities only, and of both."""

    positions: int
    velocities: int
    both: int

    @classmethod
    def of(cls, scheme: AbstractAlpha, system: AbstractSystem) -> "Counts":
        velocities = system.num_velocity_rows
        positions = len(system.constraint_names) - velocities
        return cls(positions, velocities, positions if scheme.stabilized else 0)

    @property
    def multipliers(self) -> int:
        """λ."""
        return self.positions + self.velocities

    def as_rows(self, violation, rate):
        """The rows of S₂ from Φ and from c, both along the first axis."""
        return jnp.concatenate([violation, rate[self.both :], rate[: self.both]])

    def apart(self, rows):
        """What belongs to Φ and to c."""
        m = self.multipliers
        return rows[: self.positions], jnp.concatenate([rows[m:], rows[self.positions : m]])

    def rate(self, system: AbstractSystem, q, v, t) -> Float[Array, " c"]:
        """c: [B v + Φ_t; A v + b], or its nonholonomic rows."""
        return constraint_velocity(system, q, v, t) if self.both else system.velocity_constraint(q, v, t)


class LevelTangents(NamedTuple):
    """The derivatives of r, Φ and c at one state."""

    stiffness: Matrix  # K_t, (k, k)
    damping: Matrix  # C_t, (k, k)
    jacobian: Matrix  # J, (m, k)
    upper: Matrix  # ∂r/∂λ, (k, m): Jᵀ, unless forces depend on λ
    rate_stiffness: Matrix  # V, (c, k)


def by_configuration(system: AbstractSystem, function, q) -> Float[Array, "r k"]:
    """The derivative of a function of q along the Lie-algebra coordinates w of q w̃, one column for each."""
    column = lambda w: jax.jvp(function, (q,), (system.group.to_ambient(q, w),))[1]
    k = system.group.dim
    return jax.vmap(column, out_axes=1)(jnp.eye(k, dtype=jax.tree.leaves(q)[0].dtype))


class LevelFactors(eqx.Module):
    """The factors of S₂ as those of a matrix with a border for λ, and everything else within it.

    The unknowns there are (u, ν/σ; λ/σ), the rows (r, σ (B v + Φ_t); σ Φ, σ (A v + b)): both scalings are the same.
    """

    factors: Factors
    scale: Float[Array, ""]  # σ
    multipliers: int = eqx.field(static=True)

    def solve(self, force, rows, *, transposed: bool = False):
        """S₂⁻¹ or S₂⁻ᵀ of `force` (k,) and `rows`: of the rows or of the columns below the first."""
        k, m = force.shape[0], self.multipliers
        inside = jnp.concatenate([force, self.scale * rows[m:]])
        inner, outer = self.factors.solve(inside, rows[:m], transposed=transposed)
        return inner[:k], jnp.concatenate([outer, self.scale * inner[k:]])


class LevelStep(AbstractStep):
    """The equations above."""

    shared: Any  # Levels
    previous: State
    node: Node
    before: Matrix  # B_n, (b, k)

    def correction(self, lam):
        """N ν."""
        return self.shared.correction(self.before, lam)

    def change(self, du, dlam):
        return jnp.maximum(jnp.abs(du), jnp.abs(self.correction(dlam)))

    def motion(self, u, lam):
        return advance(self.shared.scheme, self.shared.system, self.previous, u, self.node.h, self.correction(lam))

    def defect(self, motion, lam):
        scheme, system, counts = self.shared.scheme, self.shared.system, self.shared.counts
        t, h = self.node.t, lax.stop_gradient(self.node.h)
        residual = system.residual(motion.q, motion.v, motion.vdot, lam[: counts.multipliers], t)
        positions = system.constraint(motion.q, t) / (scheme.beta * h**2)
        velocities = counts.rate(system, motion.q, motion.v, t) / (scheme.gamma * h)
        return residual, counts.as_rows(positions, velocities)

    def tangents(self, q, v, vdot, lam, t) -> LevelTangents:
        system, counts = self.shared.system, self.shared.counts
        lam = lam[: counts.multipliers]
        if self.shared.plan is not None:
            k_t, c_t, jacobian = system.sparse_tangents(q, v, vdot, lam, t)
            return LevelTangents(k_t, c_t, jacobian, jacobian.T, system.sparse_rate_stiffness(q, v, t))
        k_t, c_t, jacobian = system.tangents(q, v, vdot, lam, t)
        upper = multiplier_jacobian(system, jacobian, q, v, lam, t)
        by_place = by_configuration(system, lambda q: counts.rate(system, q, v, t), q)
        return LevelTangents(k_t, c_t, jacobian, upper, by_place)

    def factors(self, motion, lam, kind=LU):
        at_state = self.tangents(motion.q, motion.v, motion.vdot, lam, self.node.t)
        return self.factorized(at_state, motion.x, kind), self.shared.margin_at(at_state.jacobian)

    def factorized(self, at_state: LevelTangents, x, kind: Any = LU) -> LevelFactors | SparseLevelFactors:
        """The factors of S₂."""
        if self.shared.plan is not None:
            return SparseLevelFactors.of(self, at_state, x, kind)
        scheme, mass, counts, h = self.shared.scheme, self.shared.mass, self.shared.counts, self.node.h
        k_t, c_t, jacobian, border, rate_stiffness = at_state
        k, p, b, m = mass.shape[0], counts.positions, counts.both, counts.multipliers
        scale = mass_scale(mass)
        position, gain = scheme.beta * h**2, (scheme.beta * h**2) / (scheme.gamma * h)
        # of x: r, the rates of both, Φ, the rates of velocities only
        moved = jnp.concatenate([position * k_t, gain * rate_stiffness[:b], jacobian[:p], gain * rate_stiffness[b:]])
        by_x = jax.vmap(partial(self.shared.system.group.tangent_rmv, x))(moved)
        by_nu = scale * (by_x @ (self.shared.inverse_mass @ self.before.T))
        by_v = jnp.concatenate([scheme.inertia_factor * mass + (scheme.gamma * h) * c_t, jacobian[:b]])
        inside = jnp.concatenate([by_v + by_x[: k + b], by_nu[: k + b]], axis=1)
        rows = jnp.concatenate([jnp.ones(k, scale.dtype), jnp.broadcast_to(scale, b)])[:, None]
        upper = jnp.concatenate([border, jnp.zeros((b, m), scale.dtype)])
        below = by_x[k + b :] + jnp.concatenate([jnp.zeros_like(jacobian[:p]), jacobian[p:]])
        lower = jnp.concatenate([below, by_nu[k + b :]], axis=1)
        return LevelFactors(Factors.of(rows * inside, upper, lower, scale, kind=kind), scale, m)
