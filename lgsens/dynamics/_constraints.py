"""Constraints with time and level: J, Φ̇ and Φ̈ of all rows, in one place.

The rows of a system are m_p at position level and m_v at velocity level (nonholonomic),

    Φ(q, t) = 0,     A(q, t) v + b(q, t) = 0,     λ = [λ_p; λ_v],

and the dynamic equilibrium holds Bᵀλ_p + Aᵀλ_v with DΦ·(q w̃) = B w. Once differentiated along the motion, q̇ = q ṽ, all
of them are affine in v with the same matrix J that the multipliers see:

    c(q, v, t) = [B v + Φ_t; A v + b] = J v + c(q, 0, t),     J = [B; A].

So the rows of a level hold consistently where Φ = 0 and c = 0, and at acceleration level

    d/dt c = Dc·(q ṽ) + J v̇ + c_t = J v̇ + γ(q, v, t),

with γ = [D²Φ·(q ṽ, q ṽ) + 2 DΦ_t·(q ṽ) + Φ_tt; …] one directional derivative of c along (q ṽ, 0, 1): Φ is
differentiated in q and t together, and no derivative is written by hand. Where a row does not depend on t, its tangent
is a symbolic zero of JAX: scenes without a prescribed motion compile what they would compile without t.

At a given (q, t) the velocities that are consistent differ by what J allows: a correction of v is split by the
homogeneous J x = 0, a velocity is made consistent by J v = −c(q, 0, t) (`_initial`).
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics._system import AbstractSparseSystem, AbstractSystem

_BROKEN = 1e-3  # rad, or of the scene: more than given lengths and axes of repeated equations contradict each other
_CALLS = ("jit", "pjit")  # operations of JAX with the program of a function in `jaxpr`


def full_jacobian(system: AbstractSystem, q, t) -> Float[Array, "m k"]:
    """J = [B; A]."""
    if isinstance(system, AbstractSparseSystem):
        return system.sparse_constraint_jacobian(q, t).dense()
    jacobian = system.constraint_jacobian(q, t)
    return jnp.concatenate([jacobian, system.velocity_jacobian(q, t)]) if system.num_velocity_rows else jacobian


def missing(system: AbstractSystem, q, t) -> Float[Array, " r"]:
    """Φ of the equations that were left out, where it is more than numbers of the scene contradict each other; else 0.
    Without derivative."""
    left = lax.stop_gradient(system.repeated_constraint(q, t))
    if not left.size:
        return left
    most = _BROKEN * jnp.minimum(jnp.max(system.coordinate_scale()), 1.0)
    return jnp.where(jnp.abs(left) > lax.stop_gradient(most), left, 0.0)


def violation_of_all(system: AbstractSystem, q, t, violation) -> Float[Array, " m+r"]:
    """Φ = `violation`, 0 for the rows of velocity level, and what is `missing`: in the order of `names_of_all`."""
    return jnp.concatenate([violation, jnp.zeros(system.num_velocity_rows, violation.dtype), missing(system, q, t)])


def names_of_all(system: AbstractSystem) -> tuple[str, ...]:
    """A name for each equation, also of those that were left out."""
    return (*system.constraint_names, *system.repeated_names)


def _with_level(system: AbstractSystem, q, v, t, rate) -> Float[Array, " m"]:
    """The rate of Φ, and the rows of velocity level if there are any."""
    return jnp.concatenate([rate, system.velocity_constraint(q, v, t)]) if system.num_velocity_rows else rate


def constraint_velocity(system: AbstractSystem, q, v, t) -> Float[Array, " m"]:
    """c = [B v + Φ_t; A v + b], without J."""
    motion = system.group.to_ambient(q, v), jnp.ones_like(t)
    return _with_level(system, q, v, t, jax.jvp(system.constraint, (q, t), motion)[1])


def prescribed_velocity(system: AbstractSystem, q, t) -> Float[Array, " m"]:
    """c(q, 0, t) = [Φ_t; b]: what the rows say of a mechanism that does not move; zero where none depends on time."""
    _, rate = jax.jvp(lambda t: system.constraint(q, t), (t,), (jnp.ones_like(t),))
    return _with_level(system, q, jnp.zeros_like(system.reference()[1]), t, rate)


def constraint_acceleration(system: AbstractSystem, q, v, vdot, t) -> Float[Array, " m"]:
    """d/dt c = J v̇ + γ of the motion through (q, v) at t with the acceleration v̇."""
    motion = system.group.to_ambient(q, v), vdot, jnp.ones_like(t)
    return jax.jvp(lambda q, v, t: constraint_velocity(system, q, v, t), (q, v, t), motion)[1]


def constraint_jerk(system: AbstractSystem, q, v, vdot, t) -> Float[Array, " m"]:
    """d²/dt² c at v̈ = 0, of the same motion: J v̈ is what it lacks."""
    motion = system.group.to_ambient(q, v), vdot, jnp.ones_like(t)
    return jax.jvp(lambda q, v, t: constraint_acceleration(system, q, v, vdot, t), (q, v, t), motion)[1]


def of_position_level(system: AbstractSystem, rows: Float[Array, " m"]) -> Float[Array, " m"]:
    """The rows that have position level, 0 in place of the others."""
    return rows.at[-system.num_velocity_rows :].set(0.0) if system.num_velocity_rows else rows


def fixed_velocity_rate(system: AbstractSystem, q, v, t) -> Float[Array, " m"]:
    """γ: d/dt c at v̇ = 0."""
    motion = system.group.to_ambient(q, v), jnp.ones_like(t)
    return jax.jvp(lambda q, t: constraint_velocity(system, q, v, t), (q, t), motion)[1]


def depends_on_time(system: AbstractSystem, q, v, t) -> bool:
    """Whether a row depends on t, as far as its program says (an operation that t enters)."""
    rows = jax.make_jaxpr(lambda q, v, t: _with_level(system, q, v, t, system.constraint(q, t)))(q, v, t).jaxpr
    return any(_reached(rows, [entry is rows.invars[-1] for entry in rows.invars]))


def _reached(program, given: list[bool]) -> list[bool]:
    """Which results of a program some of its arguments enter; calls of others are looked into."""
    reached = {id(entry) for entry, is_given in zip(program.invars, given) if is_given}
    for operation in program.eqns:
        entered = [id(entry) in reached for entry in operation.invars]
        if not any(entered):
            continue
        inner = getattr(operation.params.get("jaxpr"), "jaxpr", None) if operation.primitive.name in _CALLS else None
        results = _reached(inner, entered) if inner is not None else [True] * len(operation.outvars)
        reached.update(id(entry) for entry, is_reached in zip(operation.outvars, results) if is_reached)
    return [id(result) in reached for result in program.outvars]
