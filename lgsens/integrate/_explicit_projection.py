"""From where an explicit step would end to the constraints: P and R of `_explicit.py`, with one factorization."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, ConstrainedInertia, Inertia, constraint_velocity, full_jacobian
from lgsens.integrate._explicit_linearized import Inner


class Projection(NamedTuple):
    """The unknowns of P and R, and q⁺."""

    y: Float[Array, " k"]
    mu: Float[Array, " m"]
    d: Float[Array, " k"]
    nu: Float[Array, " m"]
    q: Any


def drift(system: AbstractSystem, q, t) -> Float[Array, " m"]:
    """Φ, and zero in the rows of velocity level."""
    violation = system.constraint(q, t)
    return jnp.concatenate([violation, jnp.zeros(system.num_velocity_rows, violation.dtype)])


def projection(inertia: Inertia, system: AbstractSystem, q, v, t) -> Projection:
    """One step of Newton's iteration for q, then v, with one factorization."""
    still = jnp.zeros_like(v)
    if not system.constraint_names:
        return Projection(still, still[:0], still, still[:0], q)
    kkt = ConstrainedInertia.of(inertia, system, q, t)
    y, mu = kkt.solve(still, -drift(system, q, t))
    projected = system.group.retract(q, y)
    return Projection(y, mu, *kkt.solve(still, -constraint_velocity(system, projected, v, t)), projected)


def of_position(system: AbstractSystem, q, t, found: Inner):
    """P, its two rows."""
    jacobian = full_jacobian(system, q, t)
    return system.mass_matrix() @ found.y + found.mu @ jacobian, jacobian @ found.y + drift(system, q, t)


def of_velocity(system: AbstractSystem, q, t, found: Inner, projected, u):
    """R, its two rows."""
    jacobian = full_jacobian(system, q, t)
    rate = constraint_velocity(system, projected, u, t)
    return system.mass_matrix() @ found.d + found.nu @ jacobian, jacobian @ found.d + rate
