"""How a simulation starts: the system of a model, its consistent initial state or equilibrium, and a scheme's start."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lgsens._validate import as_float
from lgsens._xla import alike
from lgsens.dynamics import (
    RESULTS,
    AbstractSystem,
    Initial,
    State,
    constraint_jacobian,
    equilibrium as _equilibrium,
    finite,
    full_jacobian,
    initial_state as _initial,
)
from lgsens.integrate import AbstractScheme, Start
from lgsens.linear import Matrix
from lgsens.model import Model
from lgsens.simulation._errors import throw_if_failed


def as_system(model: Model | AbstractSystem) -> AbstractSystem:
    if isinstance(model, Model):
        return alike(model.equations())
    if isinstance(model, AbstractSystem):
        return alike(model)
    raise ValueError(f"`model` must be a Model or an AbstractSystem, got {type(model).__name__}.")


def initial_state(model: Model | AbstractSystem, *, t0=0.0, throw: bool = True) -> State:
    """The consistent initial state of a model: q, v, v̇, λ, and a = v̇ (paper eqs. 18–19).

    The reference configuration is assembled if a joint asks for it (a `DistanceJoint` with a length), velocities
    are projected on those that the joints allow, accelerations and multipliers solve

        [[M, Bᵀ], [B, 0]] [v̇; λ] = [−f + ad(v)ᵀMv; −Ḃ v].

    Arguments:
        model: the scene, or an `AbstractSystem`.
        t0: initial time [s], shape ().
        throw: raise if the mechanism cannot be assembled or has redundant constraints.

    Differentiable, by the implicit function theorem. Raises `ValueError` as said under `throw`; inside `jit` the state
    is NaN.
    """
    return _found_state(_initial_jit, model, t0, throw)


def equilibrium(model: Model | AbstractSystem, *, t0=0.0, throw: bool = True) -> State:
    """The static equilibrium near the reference configuration: f(q, 0, t0) + Bᵀλ = 0, Φ(q) = 0.

    Arguments:
        model: the scene, or an `AbstractSystem`. Its velocities are ignored.
        t0: the time at which time-dependent forces are taken and drivers are held [s], shape ().
        throw: raise if no equilibrium is found.

    Returns the state at rest there, to be used as `state0` of `simulate` at the same time. Where drivers have a rate or
    an acceleration at t0, its velocities are those that they give the mechanism at rest, as from an impulse (least
    kinetic energy), its accelerations and multipliers those of the motion that begins. Differentiable, by the implicit
    function theorem; where a body turns freely (a wheel on its hinge) both the state and its derivative are
    those closest to the reference. It need not be a stable one, where the reference is near one that is not: there
    `linearize(model).eigenvalues` have positive real parts. Raises `SimulationError` if none is found; inside `jit` the
    state is NaN.
    """
    return _found_state(_equilibrium_jit, model, t0, throw)


@eqx.filter_jit
def _initial_jit(system, t0) -> Initial:
    return _initial(system, t0)._replace(factors=None)


@eqx.filter_jit
def _equilibrium_jit(system, t0) -> Initial:
    return _equilibrium(system, t0)


def _found_state(find: Callable[..., Initial], model: Model | AbstractSystem, t0, throw: bool) -> State:
    system, t0 = as_system(model), as_float(t0, (), "`t0`")
    initial = find(system, t0)
    if not throw:
        return initial.state
    details = {"violation": initial.violation, "jacobian": full_jacobian(system, initial.state.q, t0)}
    return throw_if_failed(initial.state, initial.result, details, system.constraint_names)


class Begin(NamedTuple):
    """The initial state as the scheme starts from it, and how its computation ended."""

    start: Start
    consistent_v: Float[Array, " k"]  # v_0 without the scheme's O(h²)
    result: Int[Array, ""]
    violation: Float[Array, " m"]
    jacobian: Matrix  # B there, (m, k)


def begin(
    scheme: AbstractScheme, system: AbstractSystem, t0, state0: State | None, initial: Initial | None = None
) -> Begin:
    """The state at t0: `state0` as it is, or the consistent one of the reference configuration, `initial` if known."""
    if state0 is not None:
        jacobian, start = constraint_jacobian(system, state0.q, t0), Start(scheme.resumed(system, state0, t0))
        valid = system.is_valid() & finite(state0)
        result = jnp.where(valid, RESULTS.successful, RESULTS.invalid_numbers).astype(jnp.int32)
        return Begin(start, state0.v, result, system.constraint(state0.q, t0), jacobian)
    initial = _initial(system, t0) if initial is None else initial
    usable = initial.result == RESULTS.successful
    start = jax.tree.map(lambda leaf: jnp.where(usable, leaf, jnp.nan), scheme.start(system, initial, t0))
    jacobian = constraint_jacobian(system, initial.state.q, t0)
    return Begin(start, initial.state.v, initial.result, initial.violation, jacobian)
