"""How a simulation starts: the system of a model, its consistent initial state or equilibrium, and a scheme's start."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lgsens._validate import all_finite, as_float, is_concrete
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
    names_of_all,
    prescribed_velocity,
)
from lgsens.integrate import AbstractScheme, Start
from lgsens.linear import Matrix, lost
from lgsens.model import Model, MultibodySystem
from lgsens.simulation._errors import primal_value, throw_if_failed


def as_system(model: Model | AbstractSystem) -> AbstractSystem:
    if isinstance(model, Model):
        return alike(model.equations())
    if isinstance(model, AbstractSystem):
        return alike(model)
    raise ValueError(f"`model` must be a Model or an AbstractSystem, got {type(model).__name__}.")


def initial_state(model: Model | AbstractSystem, *, t0=0.0, state: State | None = None, throw: bool = True) -> State:
    """The consistent initial state of a model: q, v, v̇, λ, and a = v̇ (paper eqs. 18–19).

    The reference configuration is assembled if a joint asks for it (a `DistanceJoint` with a length), velocities
    are projected on those that the joints allow, accelerations and multipliers solve

        [[M, Bᵀ], [B, 0]] [v̇; λ] = [−f + ad(v)ᵀMv; −Ḃ v].

    Arguments:
        model: the scene, or an `AbstractSystem`.
        t0: initial time [s], shape ().
        state: one whose configuration and velocities are taken in place of those of the reference configuration: where
            a run of the same bodies with other joints, drivers or forces ended, as `trajectory.state(-1)`. A driver is
            released by a model without it; a joint that is closed takes velocities as an impulse through it would.
        throw: raise if the mechanism cannot be assembled or has redundant constraints.

    Differentiable, by the implicit function theorem. Raises `ValueError` as said under `throw` and for a `state` of
    other bodies; inside `jit` the state is NaN.
    """
    if state is None:
        return _found_state(_initial_jit, model, t0, throw)
    system = as_system(model)
    q, v = system.reference()
    if not isinstance(state, State):
        raise ValueError(f"`state` must be a State, as `trajectory.state(-1)` is, got {type(state).__name__}.")
    _require_shapes("state", (state.q, state.v), (q, v), "It must be of a model with the same bodies and coordinates.")
    begin = jax.tree.map(lambda leaf: jnp.asarray(leaf, v.dtype), (state.q, state.v))
    return _found_state(_initial_jit, system, t0, throw, begin)


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
    those closest to the reference. Redundant joints share their forces in one way of many. It need not be a stable one,
    where the reference is near one that is not: there `linearize(model).eigenvalues` have positive real parts. Raises
    `SimulationError` if none is found; inside `jit` the state is NaN.
    """
    return _found_state(_equilibrium_jit, model, t0, throw)


@eqx.filter_jit
def _initial_jit(system, t0, *begin) -> Initial:
    return _initial(system, t0, *begin)._replace(kkt=None)


@eqx.filter_jit
def _equilibrium_jit(system, t0) -> Initial:
    return _equilibrium(system, t0)


def _found_state(find: Callable[..., Initial], model: Model | AbstractSystem, t0, throw: bool, *begin) -> State:
    system, t0 = as_system(model), as_float(t0, (), "`t0`")
    initial = find(system, t0, *begin)
    if not throw or (is_concrete(initial.result) and int(initial.result) == RESULTS.successful):
        return initial.state
    details: dict[str, Any] = {"violation": initial.violation}
    details["jacobian"] = full_jacobian(system, initial.state.q, t0)
    if isinstance(system, MultibodySystem) and is_concrete(initial):
        details["moved"] = jnp.linalg.norm(initial.state.q.position - system.reference()[0].position, axis=1)
        details["bodies"] = system.body_names
    return throw_if_failed(initial.state, initial.result, details, names_of_all(system))


def check_state0(
    system: AbstractSystem, state0: State | Start | None, t0, name: str = "state0", exactly: bool = False
) -> None:
    """Raise `ValueError` for what is no state of the system, and for one that is known to be off its joints at t0.

    `name`: of the argument. `exactly`: as in `on_joints`.
    """
    if state0 is None:
        return
    state0 = state0.state if isinstance(state0, Start) else state0
    known = jax.tree.map(primal_value, (system, state0, t0))
    if not is_concrete(known):
        _as_state(system, state0, name)
        return
    if not all_finite(known[1]):
        raise ValueError(
            f"`{name}` is not finite, as states are from the step on at which a run fails: `result` says of that one "
            "whether and why it did."
        )
    off = jax.tree.map(np.asarray, _off_jit(known[0], known[1], known[2], exactly))
    time = f"t0 = {float(known[2]):.6g} s"
    if not off.known:
        raise ValueError(
            f"`{name}` is no configuration: the orientation of a body is not a rotation matrix, as a mean of several "
            "is none. Give a state of this model, `initial_state(model)` or `trajectory.state(i)`."
        )
    for values, most, what, advice in (
        (off.positions, off.most_position, "|Φ|", ""),
        (
            off.velocities,
            off.most_velocity,
            "|Φ̇|",
            " Velocities of your own belong into the model, which projects them on those that the joints allow: "
            "`RigidBody(velocity=…, angular_velocity=…)`.",
        ),
    ):
        beyond = np.abs(values) - most
        if np.max(beyond, initial=0.0) > 0.0:
            i = int(np.argmax(beyond))
            raise ValueError(
                f"`{name}` does not satisfy the joints at {time}: {what} = {abs(values[i]):.3g}, largest in joint "
                f"{system.constraint_names[i]!r}. Give a state of this model at this time: `initial_state(model, "
                "t0=t0)`, `equilibrium(model, t0=t0)`, or `trajectory.state(-1)` with t0 = trajectory.t[-1]." + advice
            )


class _Off(NamedTuple):
    """Φ and c = [B v + Φ_t; A v + b] of a state, what no step leaves of them, and whether q is a configuration.

    Rows are lengths or sines of angles: of Φ a thousandth of the scene, or of 1 in a larger one. Loose tolerances and
    drift leave less, and so does a state written with four digits. In index 3 B v is −h² B c (`GeneralizedAlpha`), some
    hundredths of v at six steps in a period and ρ∞ = 0.9: of c a tenth of the sum of its terms, a hundredth of the
    largest such sum, and what of Φ in a second; `exactly`, where none of that is wanted, of c a thousandth of both.
    """

    positions: Float[Array, " m_p"]
    most_position: Float[Array, ""]
    velocities: Float[Array, " m"]
    most_velocity: Float[Array, " m"]
    known: Bool[Array, ""]

    @classmethod
    def of(cls, system: AbstractSystem, state0: State, t0, jacobian: Matrix, exactly: bool = False) -> "_Off":
        scale = system.coordinate_scale()
        least = 1e-3 * jnp.min(scale[: scale.shape[0] - system.num_states], initial=1.0)
        prescribed = prescribed_velocity(system, state0.q, t0)  # J is known, and this zero in most scenes
        velocities, size = jacobian @ state0.v + prescribed, jax.tree.map(jnp.abs, jacobian)
        terms = size @ jnp.abs(state0.v) + jnp.abs(prescribed)
        own, every = (1e-3, 1e-3) if exactly else (0.1, 0.01)
        most = own * terms + every * jnp.max(terms, initial=0.0) + least
        positions = system.constraint(state0.q, t0)
        return cls(positions, least, velocities, most, system.is_configuration(state0.q))

    @property
    def on_joints(self) -> Bool[Array, ""]:
        off = jnp.any(jnp.abs(self.positions) > self.most_position)
        return ~(off | jnp.any(jnp.abs(self.velocities) > self.most_velocity))


@eqx.filter_jit
def _off_jit(system: AbstractSystem, state0: State, t0, exactly: bool) -> _Off:
    state0 = _as_state(system, state0)
    return _Off.of(system, state0, t0, constraint_jacobian(system, state0.q, t0), exactly)


def on_joints(system: AbstractSystem, state: State, t) -> Bool[Array, ""]:
    """Whether positions and velocities of a state satisfy the joints, exactly: not as index 3 leaves velocities."""
    off = _Off.of(system, state, t, constraint_jacobian(system, state.q, t), exactly=True)
    return off.on_joints & off.known


def _as_state(system: AbstractSystem, state0: Any, name: str = "state0") -> State:
    """A state in the precision of the system; `ValueError` for what is none, or has other shapes than the system's."""
    if not isinstance(state0, State):
        raise ValueError(
            f"`{name}` must be a State: one of `equilibrium` or `initial_state`, or `trajectory.state(-1)` to continue "
            f"in steps of the same size, `trajectory.continued()` in others; got {type(state0).__name__}."
        )
    q, v = system.reference()
    lam = jax.ShapeDtypeStruct((len(system.constraint_names),), v.dtype)
    advice = (
        "Take it from `initial_state(model)` or `trajectory.state(i)` of the same model; of the same bodies with other "
        "joints from `initial_state(model, t0=…, state=trajectory.state(i))`; for a batch of states "
        "jax.vmap(lambda state0: simulate(model, state0=state0, …))(states)."
    )
    given = state0.q, state0.v, state0.vdot, state0.lam, state0.a
    _require_shapes(name, given, (q, v, v, lam, v), advice)
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, v.dtype), state0)


def _require_shapes(name: str, given: tuple, needed: tuple, advice: str) -> None:
    """`ValueError` if q, v, … of a state have other shapes than a system's."""
    shapes = lambda parts: [[jnp.shape(leaf) for leaf in jax.tree.leaves(part)] for part in parts]
    wrong = [
        f"{what} has {', '.join(map(str, found))} and must have {', '.join(map(str, right))}"
        for what, found, right in zip(("q", "v", "vdot", "lam", "a"), shapes(given), shapes(needed))
        if found != right
    ]
    if wrong:
        raise ValueError(
            f"`{name}` must be one state of this model; its shapes are others: {'; '.join(wrong)} (bodies, then states "
            f"of force elements). {advice}"
        )


class Begin(NamedTuple):
    """The initial state as the scheme starts from it, and how its computation ended."""

    start: Start
    consistent_v: Float[Array, " k"]  # v_0 without the scheme's O(h²)
    result: Int[Array, ""]
    violation: Float[Array, " m"]
    jacobian: Matrix  # B there, (m, k)


def begin(
    scheme: AbstractScheme, system: AbstractSystem, t0, state0: State | Start | None, initial: Initial | None = None
) -> Begin:
    """The state at t0: `state0` as it is, or the consistent one of the reference configuration, `initial` if known."""
    if state0 is not None:
        given = state0 if isinstance(state0, Start) else Start(state0)
        given = given._replace(state=_as_state(system, given.state))
        state0, start = given.state, scheme.resumed(system, given, t0)
        jacobian = constraint_jacobian(system, state0.q, t0)
        off = jax.lax.stop_gradient(_Off.of(system, state0, t0, jacobian))
        valid = system.is_valid() & finite(state0) & off.known
        result = jnp.where(off.on_joints, RESULTS.successful, RESULTS.off_joints)
        result = jnp.where(valid, result, RESULTS.invalid_numbers).astype(jnp.int32)
        usable = result == RESULTS.successful
        return Begin(lost(~usable, start), state0.v, result, off.positions, jacobian)
    initial = _initial(system, t0) if initial is None else initial
    usable = initial.result == RESULTS.successful
    start = lost(~usable, scheme.start(system, initial, t0))
    assert initial.kkt is not None  # an equilibrium, which may have none, is a `state0`
    return Begin(start, initial.state.v, initial.result, initial.violation, initial.kkt.jacobian)
