"""The end of an explicit Runge–Kutta step, and the linearized step: forward substitution by stages (`_explicit`)."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens._xla import scan
from lgsens.dynamics import (
    AbstractSystem,
    Inertia,
    State,
    constrained,
    constraint_jacobian,
    constraint_velocity,
    factorized_accelerations,
    kkt_product,
    mass_matrix,
    with_shared,
)
from lgsens.integrate._linearized import AbstractLinearizedStep, Variation
from lgsens.liegroups import AbstractLieGroup


class Inner(NamedTuple):
    """What a step finds besides its end, or the rows of it: the stages but the first, stacked, and P and R."""

    x: Float[Array, "s k"]
    v: Float[Array, "s k"]
    vdot: Float[Array, "s k"]
    lam: Float[Array, "s m"]
    y: Float[Array, " k"]
    mu: Float[Array, " m"]
    d: Float[Array, " k"]
    nu: Float[Array, " m"]


def drift(system: AbstractSystem, q, t) -> Float[Array, " m"]:
    """Φ, and zero in the rows of velocity level."""
    violation = system.constraint(q, t)
    return jnp.concatenate([violation, jnp.zeros(system.num_velocity_rows, violation.dtype)])


def ended(inertia: Inertia | None, system: AbstractSystem, q, u, t):
    """The state at the end of a step, y, μ, d and ν that lead there from q* and u, and max |Φ| before."""
    found, projected = (jnp.zeros_like(u), u[:0]) * 2, q
    if system.constraint_names:
        kkt = constrained(inertia, system, q, t)
        position = kkt.solve(found[0], -drift(system, q, t))
        projected = system.group.retract(q, position[0])
        found = *position, *kkt.solve(found[0], -constraint_velocity(system, projected, u, t))
    v = u + found[2]
    vdot, lam = factorized_accelerations(inertia, system, projected, v, t)
    left = lax.stop_gradient(jnp.max(jnp.abs(drift(system, q, t)), initial=0.0))
    return State(projected, v, vdot, lam, vdot), found, left


def corrections(system: AbstractSystem, q, t, found: Inner, projected, u):
    """P and R, each in two rows. (With M and B at hand; their products as derivatives of r and c compile longer.)"""
    matrices = mass_matrix(system), constraint_jacobian(system, q, t)
    (force, rate), (impulse, jump) = (kkt_product(*matrices, *of) for of in ((found.y, found.mu), (found.d, found.nu)))
    velocity = constraint_velocity(system, projected, u, t)
    return (force, rate + drift(system, q, t)), (impulse, jump + velocity)


class ExplicitLinearizedStep(AbstractLinearizedStep):
    """Derivatives at the solution as linear functions of arrays, and the factors of A; of all stages, stacked."""

    scheme: Any = eqx.field(static=True)  # `coefficients`
    group: AbstractLieGroup = eqx.field(static=True)
    begun: Any  # q_n
    end: Any  # q⁺
    factors: Any  # of A, at the stages, the end and q*
    motion: Any  # (q', v') ↦ E', at the stages and the end
    kinematics: Any  # (q_n', x', v') ↦ q' and (T⁻¹ v)', at the stages
    to_end: Any  # (q_n', x') ↦ q*'
    corrected: Any  # (q*', y') ↦ q⁺'
    corrections: Any  # q*' ↦ P' and R'
    velocity: Any  # (q⁺', u') ↦ c'

    def forward(self, shared, node, previous, loads, row):
        group, row = self.group, jax.tree.map(jnp.subtract, row, loads)
        a, b, _ = (node.h * each for each in self.scheme.arrays(node.h.dtype))
        rows: Inner = row.inner
        dq = group.to_ambient(self.begun, previous.w)
        at = lambda tree, which: jax.tree.map(lambda leaf: leaf[which], tree)

        def solve(factors, rows, change):
            return with_shared(shared, factors).solve(*map(jnp.subtract, rows, change))

        def stage(slopes, inputs):
            i, weights, (x, v, *rows), factors, motion, kinematics = inputs
            dx, dv = weights @ slopes[0] + x, previous.v + weights @ slopes[1] + v
            change, rate = kinematics(dq, dx, dv)
            vdot, lam = solve(factors, rows, motion(change, dv))
            return tuple(slope.at[i].set(k) for slope, k in zip(slopes, (rate, vdot))), (dx, dv, vdot, lam)

        count = len(b)
        slopes = tuple(jnp.zeros((count, *k.shape), k.dtype).at[0].set(k) for k in (previous.v, previous.vdot))
        linear = at(self.factors, slice(-2)), at(self.motion, slice(-1)), self.kinematics
        (rates, vdots), stages = scan(stage, slopes, (jnp.arange(1, count), a[1:], tuple(rows[:4]), *linear))

        dq, du = self.to_end(dq, b @ rates), previous.v + b @ vdots
        there = at(self.factors, -1)
        position, (force, rate) = self.corrections(dq)
        y, mu = solve(there, (rows.y, rows.mu), position)
        w = group.from_ambient(self.end, self.corrected(dq, y)) + row.w
        projected = group.to_ambient(self.end, w)
        d, nu = solve(there, (rows.d, rows.nu), (force, rate + self.velocity(projected, du)))
        v = du + d + row.v
        vdot, lam = solve(at(self.factors, -2), (row.vdot, row.lam), at(self.motion, -1)(projected, v))
        return Variation(w, v, vdot, lam, vdot + row.a, Inner(*stages, y, mu, d, nu))
