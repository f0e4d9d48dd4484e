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
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, constraint_velocity, mass_scale
from lgsens.integrate._scheme import AbstractStep, GeneralizedAlpha, advance
from lgsens.integrate._singular import margin_by_mass
from lgsens.linear import LU, Factors


def with_corrections(scheme: GeneralizedAlpha, state: State) -> State:
    """A state with the multipliers of the scheme: ν = 0 where it has them."""
    if not scheme.stabilized:
        return state
    return dataclasses.replace(state, lam=jnp.concatenate([state.lam, jnp.zeros_like(state.lam)]))


def without_corrections(scheme: GeneralizedAlpha, states: State) -> State:
    """A state, or stacked ones, with the multipliers of the joints only."""
    return dataclasses.replace(states, lam=halves(states.lam)[0]) if scheme.stabilized else states


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

    scheme: GeneralizedAlpha
    system: AbstractSystem
    mass: Float[Array, "k k"]
    previous: State
    normal: Float[Array, "k m"]  # N
    h: Float[Array, ""]

    @classmethod
    def of(cls, scheme, system: AbstractSystem, mass, inverse_mass, previous: State, h, t) -> "StabilizedStep":
        return cls(scheme, system, mass, previous, inverse_mass @ system.constraint_jacobian(previous.q, t).T, h)

    def correction(self, lam):
        """N ν."""
        return self.normal @ halves(lam)[1]

    def change(self, du, dlam):
        return jnp.maximum(jnp.abs(du), jnp.abs(self.correction(dlam)))

    def motion(self, u, lam):
        return advance(self.scheme, self.system, self.previous, u, self.h, self.correction(lam))

    def defect(self, motion, lam, t):
        scheme, system, h = self.scheme, self.system, self.h
        residual = system.residual(motion.q, motion.v, motion.vdot, halves(lam)[0], t)
        positions = system.constraint(motion.q, t) / (scheme.beta * h**2)
        velocities = constraint_velocity(system, motion.q, motion.v, t) / (scheme.gamma * h)
        return residual, jnp.concatenate([positions, velocities])

    def tangents(self, q, v, vdot, lam, t) -> StabilizedTangents:
        system = self.system
        k_t, c_t, jacobian = system.tangents(q, v, vdot, halves(lam)[0], t)
        return StabilizedTangents(
            k_t, c_t, jacobian, by_configuration(system, lambda q: constraint_velocity(system, q, v, t), q)
        )

    def factors(self, motion, lam, t, kind=LU):
        at_state = self.tangents(motion.q, motion.v, motion.vdot, lam, t)
        jacobian = at_state.constraint_jacobian
        margin = margin_by_mass(self.system, self.mass, jacobian, self.system.coordinate_scale())
        return self.factorized(at_state, motion.x, kind), margin

    def factorized(self, at_state: StabilizedTangents, x, kind: Any = LU) -> "StabilizedFactors":
        """The factors of S₂."""
        scheme, normal, h = self.scheme, self.normal, self.h
        k_t, c_t, jacobian, velocity_stiffness = at_state
        k, m = normal.shape
        scale = mass_scale(self.mass)
        position, gain = scheme.beta * h**2, (scheme.beta * h**2) / (scheme.gamma * h)
        moved = jnp.concatenate([position * k_t, gain * velocity_stiffness, jacobian])
        by_u = jax.vmap(partial(self.system.group.tangent_rmv, x))(moved)
        by_nu = scale * (by_u @ normal)
        of_u = jnp.concatenate([scheme.inertia_factor * self.mass + (scheme.gamma * h) * c_t, jacobian]) + by_u[: k + m]
        rows = jnp.concatenate([jnp.ones(k, scale.dtype), jnp.broadcast_to(scale, m)])[:, None]
        dynamic = rows * jnp.concatenate([of_u, by_nu[: k + m]], axis=1)
        upper = jnp.concatenate([jacobian.T, jnp.zeros((m, m), scale.dtype)])
        lower = jnp.concatenate([by_u[k + m :], by_nu[k + m :]], axis=1)
        return StabilizedFactors(Factors.of(dynamic, upper, lower, scale, kind=kind), scale)
