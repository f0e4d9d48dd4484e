"""The linearized step of the explicit Runge–Kutta scheme: forward substitution, stage by stage (`_explicit`)."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import ConstrainedInertia, Inertia
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


class ExplicitLinearizedStep(AbstractLinearizedStep):
    """Derivatives at the solution as linear functions of arrays, and the factors of A; of all stages, stacked."""

    group: AbstractLieGroup = eqx.field(static=True)
    inertia: Inertia
    a: Float[Array, "s s+1"]  # h a_ij, h b_j
    b: Float[Array, " s+1"]
    begun: Any  # q_n
    end: Any  # q⁺
    factors: Any  # of A, at the stages, the end and q*
    motion: Any  # (q', v') ↦ E', at the stages and the end
    kinematics: Any  # (q_n', x', v') ↦ q' and (T⁻¹ v)', at the stages
    to_end: Any  # (q_n', x') ↦ q*'
    corrected: Any  # (q*', y') ↦ q⁺'
    corrections: Any  # q*' ↦ P' and R'
    velocity: Any  # (q⁺', u') ↦ c'

    def forward(self, previous, loads, row):
        group, row = self.group, jax.tree.map(jnp.subtract, row, loads)
        rows: Inner = row.inner
        dq = group.to_ambient(self.begun, previous.w)
        at = lambda tree, which: jax.tree.map(lambda leaf: leaf[which], tree)

        def solve(factors, rows, change):
            return ConstrainedInertia(self.inertia, *factors).solve(*map(jnp.subtract, rows, change))

        def stage(slopes, inputs):
            i, weights, (x, v, *rows), factors, motion, kinematics = inputs
            dx, dv = weights @ slopes[0] + x, previous.v + weights @ slopes[1] + v
            change, rate = kinematics(dq, dx, dv)
            vdot, lam = solve(factors, rows, motion(change, dv))
            return tuple(slope.at[i].set(k) for slope, k in zip(slopes, (rate, vdot))), (dx, dv, vdot, lam)

        count = len(self.b)
        slopes = tuple(jnp.zeros((count, *k.shape), k.dtype).at[0].set(k) for k in (previous.v, previous.vdot))
        linear = at(self.factors, slice(-2)), at(self.motion, slice(-1)), self.kinematics
        (rates, vdots), stages = lax.scan(stage, slopes, (jnp.arange(1, count), self.a, tuple(rows[:4]), *linear))

        dq, du = self.to_end(dq, self.b @ rates), previous.v + self.b @ vdots
        there = at(self.factors, -1)
        position, (force, rate) = self.corrections(dq)
        y, mu = solve(there, (rows.y, rows.mu), position)
        w = group.from_ambient(self.end, self.corrected(dq, y)) + row.w
        projected = group.to_ambient(self.end, w)
        d, nu = solve(there, (rows.d, rows.nu), (force, rate + self.velocity(projected, du)))
        v = du + d + row.v
        vdot, lam = solve(at(self.factors, -2), (row.vdot, row.lam), at(self.motion, -1)(projected, v))
        return Variation(w, v, vdot, lam, vdot + row.a, Inner(*stages, y, mu, d, nu))
