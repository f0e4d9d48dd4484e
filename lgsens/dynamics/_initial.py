"""Consistent initial state, eqs. (18)–(19), and the accelerations and multipliers that go with it."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens._xla import while_loop
from lgsens.dynamics._constraints import (
    constraint_jerk,
    fixed_velocity_rate,
    full_jacobian,
    of_position_level,
    prescribed_velocity,
    violation_of_all,
)
from lgsens.dynamics._matrices import (
    ConstrainedMass,
    dense,
    factorized,
    for_once,
    mass_scale,
    multiplier_jacobian,
)
from lgsens.dynamics._redundant import softness
from lgsens.dynamics._results import RESULTS
from lgsens.dynamics._system import AbstractSystem, State, finite
from lgsens.linear import Inverse, Matrix, SparseMatrix, diagonal

_MAX_ITERATIONS = 30


class Initial(NamedTuple):
    """An initial state and how its computation ended."""

    state: State
    result: Int[Array, ""]  # a value of RESULTS
    violation: Float[Array, " m+r"]  # after assembly, that of all equations (`violation_of_all`)
    kkt: ConstrainedMass | None = None  # there; None: not known


def split_velocity(system: AbstractSystem, q, v, t) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """A change of velocity as the sum of what the constraints allow and what they do not, M-orthogonal to each other.

    [[M, Jᵀ], [J, 0]] [v_tangential; μ] = [M v; 0]
    """
    kkt = ConstrainedMass.of(system, q, t)
    tangential, _ = kkt.solve(kkt.mass @ v, jnp.zeros(kkt.jacobian.shape[0], v.dtype))
    return tangential, v - tangential


def consistent_velocity(system: AbstractSystem, q, v, t, kkt: ConstrainedMass | None = None) -> Float[Array, " k"]:
    """What an impulse through the joints and drivers makes of v: M (x − v) + Jᵀμ = 0, J x + c(q, 0, t) = 0.

    `kkt`: that at q, if it is known, as in `accelerations`: M and J that several of them share are differentiated once.
    """
    kkt = ConstrainedMass.of(system, q, t) if kkt is None else kkt
    return kkt.solve(kkt.mass @ v, -prescribed_velocity(system, q, t))[0]


def given_way(system: AbstractSystem, q, lam, t) -> Float[Array, " k"] | None:
    """The least displacement, in the metric of M, with Φ = c λ: what joints of a `softness` c give way under λ."""
    soft = softness(system)
    if soft is None:
        return None
    gap = of_position_level(system, soft * lam)
    return ConstrainedMass.of(system, q, t).solve(jnp.zeros(system.group.dim, lam.dtype), gap)[0]


def accelerations(system: AbstractSystem, q, v, t, kkt: ConstrainedMass | None = None):
    """v̇ and λ of the motion through (q, v) at time t, eq. (41).

    M v̇ + Jᵀλ = ad(v)ᵀ M v − f(q, v, t),     J v̇ = −γ(q, v, t)
    """
    if system.reads_multipliers:
        jacobian = full_jacobian(system, q, t) if kkt is None else kkt.jacobian
        return _implicit_accelerations(system, q, v, t, dense(jacobian))
    kkt = ConstrainedMass.of(system, q, t) if kkt is None else kkt
    zero, lam_zero = jnp.zeros_like(v), jnp.zeros(kkt.jacobian.shape[0], v.dtype)
    force = -system.residual(q, v, zero, lam_zero, t)
    return kkt.solve(force, -fixed_velocity_rate(system, q, v, t))


def _implicit_accelerations(system: AbstractSystem, q, v, t, jacobian):
    """The same where f depends on λ: r(q, v, v̇, λ, t) = 0 and J v̇ + γ = 0 by Newton's iteration, and its derivative."""
    k, scale = v.shape[0], mass_scale(system.mass_matrix())  # of the equations of acceleration, and of λ
    drift = fixed_velocity_rate(system, q, v, t)

    def equation(y):
        residual = system.residual(q, v, y[:k], scale * y[k:], t)
        return jnp.concatenate([residual, scale * (jacobian @ y[:k] + drift)])

    def newton(equation, y):
        def body(carry):
            y, _, iteration = carry
            step = jnp.linalg.solve(_scaled_matrix(system, jacobian, q, v, scale * y[k:], t), equation(y))
            return y - step, jnp.max(jnp.abs(step)), iteration + 1

        def unfinished(carry):
            y, size, iteration = carry
            small = 16 * jnp.finfo(y.dtype).eps * (1.0 + jnp.max(jnp.abs(y)))
            return (size > small) & (iteration < _MAX_ITERATIONS)

        return while_loop(unfinished, body, (y, jnp.full((), jnp.inf, y.dtype), jnp.zeros((), jnp.int32)))[0]

    tangent_solve = lambda linear, rhs: jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros_like(rhs)), rhs)
    start = jnp.zeros(k + jacobian.shape[0], v.dtype)
    y = lax.custom_root(equation, start, newton, tangent_solve)
    return y[:k], scale * y[k:]


def _scaled_matrix(system: AbstractSystem, jacobian, q, v, lam, t) -> Float[Array, "n n"]:
    """[[M, σ ∂r/∂λ], [σ J, 0]], with σ the size of M: the derivative of r and σ (J v̇ + γ) by v̇ and λ/σ."""
    mass, none = system.mass_matrix(), jnp.zeros((jacobian.shape[0],) * 2, v.dtype)
    scale, by_lam = mass_scale(mass), multiplier_jacobian(system, jacobian, q, v, lam, t)
    return jnp.block([[mass, scale * by_lam], [scale * jacobian, none]])


def jerk(system: AbstractSystem, q, v, vdot, lam, t) -> Float[Array, " k"]:
    """v̈ of the motion through (q, v) at t with v̇ and λ:

        M v̈ + ∂r/∂λ λ̇ = −dr/dt,     J v̈ = −d/dt (J v̇ + γ)

    with d/dt of r and γ at constant v̇ and λ.
    """
    motion = system.group.to_ambient(q, v), vdot, jnp.ones_like(t)
    _, force = jax.jvp(lambda q, v, t: system.residual(q, v, vdot, lam, t), (q, v, t), motion)
    rate = constraint_jerk(system, q, v, vdot, t)
    if not system.reads_multipliers:
        return ConstrainedMass.of(system, q, t).solve(-force, -rate)[0]
    matrix = _scaled_matrix(system, full_jacobian(system, q, t), q, v, lam, t)
    missing = jnp.concatenate([force, mass_scale(system.mass_matrix()) * rate])
    return -jnp.linalg.solve(matrix, missing)[: v.shape[0]]


def assemble(system: AbstractSystem, t, begin: tuple[Any, Array] | None = None):
    """The configuration closest to the reference, or to that of `begin`, that satisfies Φ(q, t) = 0, and its last
    violation; the reference and NaN where none is found.

    q = q_ref exp((N μ)~) with N = M⁻¹B(q_ref)ᵀ: the motion that an impulse along the constraint directions
    would give. The m_p equations Φ = 0 determine μ; the implicit function theorem, its derivative.
    """
    q_ref, v_ref = system.reference() if begin is None else begin
    if system.assembled or len(system.constraint_names) == system.num_velocity_rows:
        return q_ref, system.constraint(q_ref, t)
    group, mass = system.group, system.mass_matrix()
    jacobian = system.constraint_jacobian(q_ref, t)
    normal = jnp.linalg.solve(mass, jacobian.T)
    scale = system.coordinate_scale()
    tolerance = 16 * jnp.finfo(v_ref.dtype).eps
    # Redundant equations leave μ open, not q: the shortest μ will do, in the derivative too.
    solve = jnp.linalg.solve if softness(system) is None else _shortest

    def place(mu):
        return group.retract(q_ref, normal @ mu)

    def newton(equation, mu):
        def body(carry):
            mu, _, iteration = carry
            x = normal @ mu
            q = group.retract(q_ref, x)
            slope = jax.vmap(lambda row: group.tangent_rmv(x, row))(system.constraint_jacobian(q, t)) @ normal
            step = solve(slope, equation(mu))
            # Far from assembly a full step may leave the branch: at most a fifth of the scene at a time.
            size = jnp.max(jnp.abs(normal @ step) / scale)
            step = step * jnp.minimum(1.0, 0.2 / jnp.maximum(size, 0.2))
            return mu - step, size, iteration + 1

        def unfinished(carry):
            _, size, iteration = carry
            return (size > tolerance) & (iteration < _MAX_ITERATIONS)

        start = (mu, jnp.full((), jnp.inf, mu.dtype), jnp.zeros((), jnp.int32))
        return while_loop(unfinished, body, start)[0]

    def tangent_solve(linear, rhs):
        return solve(jax.jacfwd(linear)(jnp.zeros_like(rhs)), rhs)

    mu = lax.custom_root(
        lambda mu: system.constraint(place(mu), t),
        jnp.zeros(jacobian.shape[0], v_ref.dtype),
        newton,
        tangent_solve,
    )
    q = place(mu)
    lost = ~finite(q)  # by equations that contradict each other: those of the reference say which
    at = jax.tree.map(lambda own, reference: jnp.where(lost, reference, own), q, q_ref)
    return at, system.constraint(q, t)


def _shortest(matrix, rhs):
    """The shortest solution of consistent equations."""
    return jnp.linalg.pinv(matrix, rtol=1e-8 if matrix.dtype == jnp.float64 else 1e-4) @ rhs


def is_redundant(system: AbstractSystem, jacobian: Matrix) -> Bool[Array, ""]:
    """Whether rows of B are linearly dependent; B from `constraint_jacobian`.

    In the QR of B̂, B with unit rows, redundant rows leave |R_ii| at round-off, independent ones near a singular
    configuration well above it. Sparse: the complements of [[I, B̂ᵀ], [B̂, 0]] are −R_ii² or combinations of them;
    round-off leaves nothing of those below eps^0.8.
    """
    (jacobian,) = for_once(lax.stop_gradient(jacobian))
    dtype = jacobian.dtype
    if not isinstance(jacobian, SparseMatrix):
        m, k = jacobian.shape
        if m == 0 or m > k:
            return jnp.asarray(m > k)
        unit = jacobian / jnp.maximum(jnp.linalg.norm(jacobian, axis=1), jnp.finfo(dtype).tiny)[:, None]
        return jnp.min(jnp.abs(jnp.diagonal(jnp.linalg.qr(unit.T, mode="r")))) < jnp.finfo(dtype).eps ** 0.6
    ones = jnp.ones(jacobian.shape[1], dtype)
    unit = jacobian.with_unit_rows()
    factors = factorized(system, diagonal(ones), unit.T, unit, jnp.ones((), dtype), Inverse, once=True, exact=True)
    return ~(factors.largest_inverse() < jnp.finfo(dtype).eps ** -0.8)  # NaN is redundant


def initial_state(system: AbstractSystem, t, begin: tuple[Any, Array] | None = None) -> Initial:
    """q, v, v̇, λ consistent with the constraints at position, velocity and acceleration level; a = v̇. From `begin`,
    q and v, or the reference.

    Velocities are projected with the metric of kinetic energy (`consistent_velocity`): what an impulse through the
    joints leaves of v_ref, and what the rates of drivers add.
    """
    q, violation = assemble(system, t, begin)
    violation = violation_of_all(system, q, t, violation)
    _, v_ref = system.reference() if begin is None else begin
    kkt = ConstrainedMass.of(system, q, t)
    v = system.settled(q, consistent_velocity(system, q, v_ref, t, kkt), t)
    vdot, lam = accelerations(system, q, v, t, kkt)
    state = State(q=q, v=v, vdot=vdot, lam=lam, a=vdot)
    redundant = softness(system) is None and is_redundant(system, kkt.jacobian)
    largest = jnp.max(jnp.abs(violation), initial=0.0)
    assembled = largest <= system.constraint_round_off()  # NaN is not assembled
    result = jnp.where(finite(state), RESULTS.successful, RESULTS.invalid_numbers)
    result = jnp.where(redundant, RESULTS.redundant_constraints, result)
    result = jnp.where(assembled | (jnp.isnan(largest) & redundant), result, RESULTS.assembly_failed)
    result = jnp.where(system.is_valid(), result, RESULTS.invalid_numbers).astype(jnp.int32)
    return Initial(state, result, violation, kkt)
