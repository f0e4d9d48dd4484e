"""Accelerations and multipliers with a hand-derived derivative: one factorization for value, tangent and transpose.

The equations of the motion through (q, v) at t, eq. (41), with J and γ of `_constraints`,

    E(v̇, λ; z) = [ r(q, v, v̇, λ, t);  J v̇ + γ(q, v, t) ] = 0,      z = (numbers of the system, q, v, t),

are linear in (v̇, λ) with the matrix A = [[M, Jᵀ], [J, 0]]. Differentiated at the solution,

    A [v̇'; λ'] = −E_z z',

the right-hand side being the derivative of r and of the constraint at acceleration level for fixed v̇ and λ: vectors
only, no derivative of M, J or J̇ as a matrix. A is symmetric, so the transpose of the rule solves with A as well.

M is constant. With N = M⁻¹, made once outside the time loop, and the Cholesky factors of the complement S = J N Jᵀ,

    A [x; μ] = [f; c]:     S μ = J N f − c,     x = N (f − Jᵀ μ),

m³/3 instead of 2 (k + m)³/3 operations: an eighteenth on the quarter-car (k = 48, m = 45). S is scaled to a unit
diagonal, since the rows of J have different units. Where constraints may be redundant, ε is added to it, and the
solution refined (`_redundant`). On long chains blocks of A on the graph of bodies and joints take less time than S,
which a chain fills (`solves_in_blocks`): a third in steps and gradients of one of 64 links.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics._constraints import constraint_acceleration, fixed_velocity_rate, full_jacobian
from lgsens.dynamics._matrices import ConstrainedMass, in_blocks, kkt_product, require_linear
from lgsens.dynamics._redundant import SOFTNESS, refined, softness
from lgsens.dynamics._system import AbstractSparseSystem, AbstractSystem
from lgsens.linear import Graph, LinearEquations, linear_solve, tuned


class Inertia(eqx.Module):
    """M and its inverse: what all evaluations share."""

    mass: Float[Array, "k k"]
    inverse: Float[Array, "k k"]
    blocks: Float[Array, "N 6 6"] | None  # of the inverse, by bodies; None: of a system that is not made of bodies
    redundant: bool = eqx.field(static=True)  # whether constraints may be redundant

    @classmethod
    def of(cls, system: AbstractSystem) -> "Inertia":
        mass = system.mass_matrix()
        # N serves to solve only, and needs no derivative: that of the solution comes from M.
        fixed = lax.stop_gradient(mass)
        inverse = jnp.linalg.solve(fixed, jnp.eye(fixed.shape[0], dtype=fixed.dtype))
        blocks = system.body_blocks(inverse) if isinstance(system, AbstractSparseSystem) else None
        return cls(mass, inverse, blocks, softness(system) is not None)


class ConstrainedInertia(eqx.Module):
    """A = [[M, Jᵀ], [J, 0]] at one configuration, factorized."""

    inertia: Inertia
    jacobian: Float[Array, "m k"]
    factor: Float[Array, "m m"]  # lower triangular, of D S D
    scale: Float[Array, " m"]  # D

    @classmethod
    def of(cls, inertia: Inertia, system: AbstractSystem, q, t) -> "ConstrainedInertia":
        if inertia.blocks is None:
            jacobian = full_jacobian(system, q, t)
            fixed = lax.stop_gradient(jacobian)
            complement = fixed @ inertia.inverse @ fixed.T
        else:
            # S by bodies: a gradient of the reduced quarter-car in 40 steps takes 44 ms, with products of arrays 52
            assert isinstance(system, AbstractSparseSystem)
            sparse = system.sparse_constraint_jacobian(q, t)
            jacobian, complement = sparse.dense(), lax.stop_gradient(sparse).congruence(inertia.blocks)
        scale = lax.rsqrt(jnp.diagonal(complement))
        unit = complement * scale[:, None] * scale[None, :]
        if inertia.redundant:
            unit = unit + SOFTNESS * jnp.eye(unit.shape[0], dtype=unit.dtype)
        factor = jnp.linalg.cholesky(unit, symmetrize_input=False)
        return cls(inertia, jacobian, factor, scale)

    def product(self, unknown):
        """A [x; μ], two parts."""
        return kkt_product(self.inertia.mass, self.jacobian, *unknown)

    def eliminated(self, rhs):
        """x and μ."""
        return refined(self.product, self._eliminated, rhs) if self.inertia.redundant else self._eliminated(rhs)

    def _eliminated(self, rhs):
        (f, c), inverse, jacobian = rhs, self.inertia.inverse, self.jacobian
        free = inverse @ f
        if c.shape[0] == 0:  # XLA compiles no triangular solve of size 0 where it cannot remove it
            return free, c
        mu = self.scale * jsl.cho_solve((self.factor, True), self.scale * (jacobian @ free - c))
        return free - inverse @ (mu @ jacobian), mu

    def solve(self, force, rate) -> tuple[Float[Array, " k"], Float[Array, " m"]]:
        """x and μ of A [x; μ] = [force; rate]; its own transpose, and differentiable through M and J."""
        return linear_solve(_BY_ELIMINATION, self, (force, rate))


_BY_ELIMINATION = LinearEquations(ConstrainedInertia.product, ConstrainedInertia.eliminated)


def equations_of_motion(system: AbstractSystem, q, v, vdot, lam, t):
    """E, two vectors of shape (k,) and (m,): eq. (25), and the constraint at acceleration level."""
    return system.residual(q, v, vdot, lam, t), constraint_acceleration(system, q, v, vdot, t)


def _of_complement(graph: Graph) -> tuple[Graph, float]:
    """The unknowns of A, and half of how long S takes: else not worth up to a half more to compile."""
    return graph, 0.5 * tuned.complement(*graph.sizes)


def solves_in_blocks(system: AbstractSystem) -> bool:
    """Whether blocks of A are estimated to take half the time of S."""
    sparse = in_blocks(system)
    return sparse is not None and sparse.arranged(_of_complement) is not None


def shared_inertia(system: AbstractSystem) -> Inertia | None:
    """What all factorizations of a run share; None: they are in blocks.

    Raises `ValueError` where forces depend on multipliers.
    """
    require_linear(system, "Integration of the index-reduced equations")
    return None if solves_in_blocks(system) else Inertia.of(system)


def constrained(inertia: Inertia | None, system: AbstractSystem, q, t) -> ConstrainedInertia | ConstrainedMass:
    """A at one configuration, factorized; `inertia` None: in blocks."""
    return ConstrainedMass.in_steps(system, q, t) if inertia is None else ConstrainedInertia.of(inertia, system, q, t)


def own_parts(kkt: ConstrainedInertia | ConstrainedMass) -> Any:
    """What A does not share with those at other configurations."""
    return kkt if isinstance(kkt, ConstrainedMass) else (kkt.jacobian, kkt.factor, kkt.scale)


def with_shared(inertia: Inertia | None, own: Any) -> ConstrainedInertia | ConstrainedMass:
    """A, of its parts."""
    return own if inertia is None else ConstrainedInertia(inertia, *own)


def _solved(inertia: Inertia | None, system: AbstractSystem, q, v, t):
    kkt = constrained(inertia, system, q, t)
    force = system.residual(q, v, jnp.zeros_like(v), jnp.zeros(kkt.jacobian.shape[0], v.dtype), t)
    return kkt.solve(-force, -fixed_velocity_rate(system, q, v, t)), kkt


@jax.custom_jvp
def factorized_accelerations(inertia: Inertia | None, system: AbstractSystem, q: Any, v, t):
    """v̇, shape (k,), and λ, shape (m,), of the motion through (q, v) at t; `inertia` is that of the system, None: A is
    factorized in blocks."""
    return _solved(inertia, system, q, v, t)[0]


@factorized_accelerations.defjvp
def _rule(primals, tangents):
    inertia, z = primals[0], primals[1:]
    (vdot, lam), kkt = _solved(inertia, *z)
    equations = lambda system, q, v, t: equations_of_motion(system, q, v, vdot, lam, t)
    _, change = jax.jvp(equations, z, tangents[1:])  # M is one of the numbers of the system
    return (vdot, lam), kkt.solve(*jax.tree.map(jnp.negative, change))
