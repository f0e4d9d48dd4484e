"""Newton's iteration in one step, and all steps in one scan."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._scheme import GeneralizedAlpha, advance, factorize_iteration_matrix


class Stats(NamedTuple):
    """What Newton did in each step (in `take_step`: in one).

    Attributes:
        iterations: Newton iterations of each step, shape (n,), int32; 0 after a failure.
        increment: the last increment of each step, relative as in `GeneralizedAlpha.tolerance`, shape (n,).
        residual: the largest entry of the residual r before that increment [N or N m], shape (n,).
        converged: whether each step converged, shape (n,), bool.
    """

    iterations: Int[Array, " n"]
    increment: Float[Array, " n"]
    residual: Float[Array, " n"]
    converged: Bool[Array, " n"]


class _Iterate(NamedTuple):
    u: Float[Array, " k"]
    lam: Float[Array, " m"]
    increment: Float[Array, ""]
    residual: Float[Array, ""]
    iterations: Int[Array, ""]


class Constants(NamedTuple):
    """What all steps share."""

    mass: Float[Array, "k k"]
    scale: Float[Array, " k"]

    @classmethod
    def of(cls, system: AbstractSystem) -> "Constants":
        return cls(system.mass_matrix(), system.coordinate_scale())


def take_step(
    scheme: GeneralizedAlpha, system: AbstractSystem, constants: Constants, previous: State, running, t, h
) -> tuple[State, Stats]:
    """The state at t = t_n + h and what Newton did; NaN unless `running` and converged."""
    mass, scale = constants
    tolerance = max(scheme.tolerance, 64 * float(jnp.finfo(mass.dtype).eps))

    def body(iterate: _Iterate) -> _Iterate:
        motion = advance(scheme, system, previous, iterate.u, h)
        point = (motion.q, motion.v, motion.vdot, iterate.lam, t)
        residual = system.residual(*point)
        violation = system.constraint(motion.q) / (scheme.beta * h**2)
        factors = factorize_iteration_matrix(scheme, system, system.tangents(*point), mass, motion.x, h)
        du, dlam = factors.solve(residual, violation)
        size = jnp.max(jnp.abs(du) * (scheme.beta * h**2) / scale)
        largest = jnp.max(jnp.abs(residual))
        return _Iterate(iterate.u - du, iterate.lam - dlam, size, largest, iterate.iterations + 1)

    def unfinished(iterate: _Iterate):
        # NaN compares false, and ends the iteration
        return running & (iterate.increment > tolerance) & (iterate.iterations < scheme.max_iterations)

    infinite = jnp.full((), jnp.inf, mass.dtype)
    start = _Iterate(previous.a, previous.lam, infinite, infinite, jnp.zeros((), jnp.int32))
    iterate = lax.while_loop(unfinished, body, start)
    motion = advance(scheme, system, previous, iterate.u, h)
    state = State(q=motion.q, v=motion.v, vdot=motion.vdot, lam=iterate.lam, a=iterate.u)
    finite = jnp.all(jnp.isfinite(iterate.u)) & jnp.all(jnp.isfinite(iterate.lam))
    converged = running & (iterate.increment <= tolerance) & finite
    state = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), state)
    return state, Stats(iterate.iterations, iterate.increment, iterate.residual, converged)


def integrate(
    scheme: GeneralizedAlpha, num_steps: int, system: AbstractSystem, state0: State, t0, h
) -> tuple[State, Stats]:
    """The states at t0 + n h, n = 0 … num_steps, stacked along a leading axis.

    A step that does not converge ends the simulation: it and the steps after it are NaN, and `Stats` says so.
    """
    constants = Constants.of(system)

    def step(carry, n):
        previous, running = carry
        state, stats = take_step(scheme, system, constants, previous, running, t0 + (n + 1) * h, h)
        return (state, stats.converged), (state, stats)

    start = (state0, jnp.ones((), bool))
    _, (states, stats) = lax.scan(step, start, jnp.arange(num_steps, dtype=constants.mass.dtype))
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), state0, states)
    return states, stats
