"""Static equilibrium: r(q, 0, 0, λ, t) = 0, Φ(q, t) = 0 and b(q, t) = 0, drivers held where they are at t.

Rows of velocity level hold at rest wherever the mechanism is, if b = 0; their λ_v may carry load. So there are m_v
equations less than unknowns (a wheel on springs may rest wherever it was rolled to), and in place of each the equation
0 = 0, which leaves the shortest solution. b ≠ 0 forbids rest.

Drivers go on from there: where rows depend on time, the state is that of the motion which begins in this place. v is
the velocity of least kinetic energy with c(q, v, t) = 0, v̇ and λ are those of (q, v): at rest, in static balance, where
drivers have neither rate nor acceleration. With v = 0 the first steps would give them their rate, by a force ∝ 1/h that
alternates from step to step.

States z of elements do not vanish at rest, their rates do: of their coordinates the velocity is unknown and not the
place, and C_t has the columns of their derivatives.

Far from equilibrium Newton's iteration may lead nowhere (a chain that is to hang and starts level has no stiffness at
all), or far away to a rest that no one meant. Then the mechanism sinks through a viscous medium, M ẋ = −(f + Bᵀλ), by
implicit Euler steps: K_t + μ M stands for K_t, μ = 1/Δτ. Steps move a tenth of a radian or of the scene; where they
move less, near equilibrium, μ falls by half each, and the iteration becomes Newton's again (pseudo-transient
continuation: Kelley & Keyes, SIAM J. Numer. Anal. 35 (1998) 508). What it finds is stable.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens._xla import while_loop
from lgsens.dynamics._constraints import depends_on_time, violation_of_all
from lgsens.dynamics._initial import Initial, accelerations, consistent_velocity, is_redundant
from lgsens.dynamics._matrices import ConstrainedMass, mass_scale
from lgsens.dynamics._redundant import softness
from lgsens.dynamics._results import RESULTS
from lgsens.dynamics._system import AbstractSystem, State

_MAX_ITERATIONS = 60
_MAX_SINKING = 400
_STRIDE = 0.1  # of a step that sinks, rad or lengths of the scene
_FAR = 1.5  # the path of Newton's iteration, likewise


class _Search(NamedTuple):
    """How far an iteration has come."""

    z: Float[Array, " k+m"]
    first: Float[Array, ""]  # the largest of what the equations leave at the start
    mu: Float[Array, ""]  # μ, 0 as long as it is Newton's
    size: Float[Array, ""]  # of the last step
    path: Float[Array, ""]  # the sum of the largest motions of all steps
    iteration: Int[Array, ""]
    done: Bool[Array, ""]
    stiffest: Float[Array, ""]  # of the last matrix


def equilibrium(system: AbstractSystem, t) -> Initial:
    """The static equilibrium near the reference configuration, as an initial state.

    Newton's iteration on x and λ in q = q_ref exp(x̃), with the matrix [[K_t T, Jᵀ], [B T, 0]] at v = 0. A mechanism
    may turn freely about some axis (a wheel on its hinge): the step and the derivative are the shortest
    that solve the equations, found through the pseudo-inverse. The derivative is that of the implicit
    function theorem; it does not pass through the iteration.
    """
    group = system.group
    q_ref, v_ref = system.reference()
    k, m, dtype = v_ref.shape[0], len(system.constraint_names), v_ref.dtype
    zero, unsaid = jnp.zeros_like(v_ref), jnp.zeros(system.num_velocity_rows, dtype)
    scale = lax.stop_gradient(system.coordinate_scale())
    weight = mass_scale(system.mass_matrix())
    eps = float(jnp.finfo(dtype).eps)
    round_off = 16.0 * eps * lax.stop_gradient(system.distance(q_ref))
    states = np.arange(k) >= k - system.num_states
    begun = system.settled(q_ref, zero, t) if system.num_states else zero

    def split(z):
        # Multipliers in units of the mass scale × 1 m/s², so that both parts of z are of order one.
        x, lam = z[:k] * scale, z[k:] * weight
        return (jnp.where(states, 0.0, x), begun + jnp.where(states, x, 0.0), lam) if states.any() else (x, zero, lam)

    def equation(z):
        x, v, lam = split(z)
        q = group.retract(q_ref, x)
        force = system.residual(q, v, zero, lam, t)
        return jnp.concatenate([force * scale / weight, system.constraint(q, t), unsaid])

    def matrix(z):
        x, v, lam = split(z)
        tangents = system.tangents(group.retract(q_ref, x), v, zero, lam, t)
        by_x = jax.vmap(lambda row: group.tangent_rmv(x, row))
        jacobian = tangents.constraint_jacobian
        stiffness = by_x(tangents.stiffness)
        if states.any():
            stiffness = jnp.where(states, tangents.damping, stiffness)
        upper = jnp.concatenate([stiffness * scale[None, :], jacobian.T * weight], axis=1)
        positions = by_x(jacobian) * scale[None, :]
        if unsaid.size:
            positions = positions.at[-unsaid.size :].set(0.0)
        lower = jnp.concatenate([positions, jnp.zeros((m, m), dtype)], axis=1)
        return jnp.concatenate([upper * (scale / weight)[:, None], lower], axis=0)

    largest = lambda z: jnp.max(jnp.abs(z[k:]), initial=0.0)
    stiffest = lambda slope: jnp.max(jnp.sum(jnp.abs(slope[:k, :k]), axis=1), initial=0.0)

    def balanced(z, left, stiffest):
        """To √eps of the largest joint force or moment, taken as mass scale × 1 m/s² at least; and to what stiff forces
        make of round-off of a place, 16 eps of 1 rad or the length of the scene, or of its distance from the origin:
        EA eps of a beam is more."""
        return jnp.max(jnp.abs(left)) <= jnp.sqrt(eps) * (1.0 + largest(z)) + round_off * stiffest

    def shortest(slope, right, solve):
        """The shortest solution, by `solve` of scaled rows and columns: constraints by the root of the stiffest. Of a
        joint between two bodies that springs hold, with K each, the matrix has else the singular value 1/K, which is
        no freedom to turn beside K."""
        stiff = jnp.sqrt(jnp.maximum(lax.stop_gradient(stiffest(slope)), 1.0))
        unit = jnp.where(np.arange(k + m) < k, 1.0, stiff)
        return unit * solve(unit[:, None] * slope * unit[None, :], unit * right)

    least_squares = lambda slope, right: jnp.linalg.lstsq(slope, right, rcond=1e3 * eps)[0]

    # Not of states: that which counts the turns of a spring must follow it.
    inertia = system.mass_matrix() * scale[:, None] * jnp.where(states, 0.0, scale)[None, :] / weight
    viscous = jnp.zeros((k + m, k + m), dtype).at[:k, :k].set(lax.stop_gradient(inertia))

    def newton(equation, begin):
        def body(carry: _Search) -> _Search:
            """A step; the state that the last one came to is judged here, where its equations are compiled anyway."""
            z, left, slope = carry.z, equation(carry.z), matrix(carry.z)
            stiff = stiffest(slope)
            first = jnp.where(carry.iteration == 0, jnp.max(jnp.abs(left)), carry.first)
            small = carry.size <= jnp.sqrt(eps)
            done = small & balanced(z, left, stiff)
            lost = (carry.mu == 0.0) & ~done & (small | (carry.path > _FAR) | (carry.iteration >= _MAX_ITERATIONS))
            # Newton is quadratic: one step from √eps is at round-off.
            step = shortest(slope + jnp.where(done, 0.0, carry.mu) * viscous, left, least_squares)
            # Multipliers too: where joint forces alone are stiff, as in a pendulum, the first step moves nothing.
            size = jnp.max(jnp.abs(step) / jnp.where(np.arange(k + m) < k, 1.0, 1.0 + largest(z)))
            moved = jnp.max(jnp.abs(step[: k - system.num_states]))
            # At most 0.2 rad or a fifth of the scene at a time.
            z = z - step * jnp.minimum(1.0, 0.2 / jnp.maximum(moved, 0.2))
            again = lambda new, old: jnp.where(lost, new, old)
            mu = again(first / _STRIDE, carry.mu * jnp.clip(moved / _STRIDE, 0.5, 4.0))
            path, count = carry.path + jnp.minimum(moved, 0.2), carry.iteration + 1
            return _Search(again(begin, z), first, mu, again(jnp.inf, size), path, count, done, stiff)

        def unfinished(carry: _Search):
            return ~carry.done & (carry.iteration < _MAX_ITERATIONS + _MAX_SINKING)

        none, far = jnp.zeros((), dtype), jnp.full((), jnp.inf, dtype)
        start = _Search(begin, none, none, far, none, jnp.zeros((), jnp.int32), jnp.zeros((), bool), none)
        found = while_loop(unfinished, body, start)
        return found.z, found.stiffest

    def tangent_solve(linear, rhs):
        slope = jax.jacfwd(linear)(jnp.zeros_like(rhs))
        return shortest(slope, rhs, lambda slope, rhs: jnp.linalg.pinv(slope, rtol=1e3 * eps) @ rhs)

    z, stiff = lax.custom_root(equation, jnp.zeros(k + m, dtype), newton, tangent_solve, has_aux=True)
    x, v, lam = split(z)
    q, vdot = group.retract(q_ref, x), zero
    rests = balanced(z, jnp.concatenate([equation(z), system.velocity_constraint(q, v, t)]), stiff)
    result = jnp.where(rests, RESULTS.successful, RESULTS.equilibrium_failed).astype(jnp.int32)
    if depends_on_time(system, q, v, t):
        kkt = ConstrainedMass.of(system, q, t)
        v = consistent_velocity(system, q, v, t, kkt)
        vdot, lam = accelerations(system, q, v, t, kkt)
        if softness(system) is None:
            redundant = (result == RESULTS.successful) & is_redundant(system, kkt.jacobian)
            result = jnp.where(redundant, RESULTS.redundant_constraints, result).astype(jnp.int32)
    violation = violation_of_all(system, q, t, system.constraint(q, t))
    apart = jnp.any(violation[m:] != 0.0) & (result == RESULTS.successful)
    result = jnp.where(apart, RESULTS.joints_apart, result)
    result = jnp.where(system.is_valid(), result, RESULTS.invalid_numbers).astype(jnp.int32)
    return Initial(State(q=q, v=v, vdot=vdot, lam=lam, a=vdot), result, violation)
