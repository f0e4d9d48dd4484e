"""The result of a simulation, and one instant of it: the same questions, asked of all times or of one."""

import abc
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lgsens._validate import suggestion
from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate import Stages
from lgsens.model import MultibodySystem


class BodyMotion(NamedTuple):
    """The motion of one body; every array has a leading axis over the n + 1 times, at an `Instant` none.

    Attributes:
        position: centre of mass [m], inertial frame, shape (n+1, 3).
        orientation: rotation matrix, body to inertial frame, shape (n+1, 3, 3).
        velocity: velocity of the centre of mass [m/s], inertial frame, shape (n+1, 3).
        angular_velocity: Ω [rad/s], body frame, shape (n+1, 3).
        acceleration: acceleration of the centre of mass [m/s²], inertial frame, shape (n+1, 3).
        angular_acceleration: Ω̇ [rad/s²], body frame, shape (n+1, 3).
    """

    position: Float[Array, "*n 3"]
    orientation: Float[Array, "*n 3 3"]
    velocity: Float[Array, "*n 3"]
    angular_velocity: Float[Array, "*n 3"]
    acceleration: Float[Array, "*n 3"]
    angular_acceleration: Float[Array, "*n 3"]

    def point(self, at) -> Float[Array, "n 3"]:
        """The path [m], inertial frame, of the body's point that is at `at` (inertial frame, shape (3,)) at first.

        Needs a motion with times: that of a `Trajectory`.
        """
        local = self.orientation[0].T @ (jnp.asarray(at, self.position.dtype) - self.position[0])
        return self.position + self.orientation @ local


class StateError(NamedTuple):
    """Errors of the states of a trajectory, estimated; every array has a leading axis over the n + 1 times.

    Attributes:
        w: of the configuration, in Lie-algebra coordinates (the true one is q exp(w̃) or thereabouts), shape (n+1, k).
        v: of the velocity, shape (n+1, k).
        vdot: of the acceleration, shape (n+1, k).
        lam: of the multipliers, shape (n+1, m).
    """

    w: Float[Array, "n+1 k"]
    v: Float[Array, "n+1 k"]
    vdot: Float[Array, "n+1 k"]
    lam: Float[Array, "n+1 m"]


class AbstractMotion(eqx.Module):
    """What `Trajectory` and `Instant` answer alike; arrays of a trajectory have a leading axis n + 1."""

    system: eqx.AbstractVar[AbstractSystem]

    @abc.abstractmethod
    def _kinematics(self) -> tuple[State, Any]:
        """The states and their times."""

    def _multibody(self) -> MultibodySystem:
        if not isinstance(self.system, MultibodySystem):
            raise ValueError(
                f"This is the motion of a {type(self.system).__name__}, which has no named bodies, joints or forces; "
                "use `states` of a trajectory, `state` of an instant."
            )
        return self.system

    def body(self, name: str) -> BodyMotion:
        """The motion of the body `name`. Raises `ValueError` for an unknown name."""
        states, _ = self._kinematics()
        system, *motion = self._multibody().of_parts(states.q, states.v, states.vdot)
        if name not in system.body_names:
            raise ValueError(f"`body`: {suggestion(name, system.body_names)}.")
        return BodyMotion(*system.motion(system.body_names.index(name), *motion))

    def multiplier(self, joint: str) -> Float[Array, "*n rows"]:
        """The Lagrange multipliers of a joint, shape (n+1, its equations); the joint says what they mean.

        Those of a merged `FixedJoint` (`Model.merge_fixed`) are what its bodies need to move as they do.
        Raises `ValueError` for an unknown name.
        """
        system, (states, t) = self._multibody(), self._kinematics()
        return system.multiplier(joint, states.q, states.v, states.vdot, states.lam, t)

    def states_of(self, force: str) -> dict[str, Float[Array, "*n"]]:
        """The states of a force element (`Actuator`, `PIDController`, `MaxwellElement`) by their names, shape (n+1,).

        Raises `ValueError` for an unknown name, or an element without states.
        """
        places, v = self._multibody().places_of_states(), self._kinematics()[0].v
        if force not in places:
            raise ValueError(f"`states_of`: {suggestion(force, places)}, the force elements with states.")
        return {name: v[..., place] for name, place in places[force].items()}

    def force(self, name: str) -> Any:
        """What a force element measures, every array with a leading axis n + 1 if this is a trajectory.

        A `SpringDamper` gives its `LineForce` (length [m], rate [m/s], tension [N]), a `TyreSpring` its normal
        force [N], shape (n+1,); a `TorsionSpringDamper` its `HingeMoment`, a `PIDController` its `ControlSignals`;
        other elements the generalized force [F_a, M_a, F_b, M_b] that they apply.
        Raises `ValueError` for an unknown name, or one of several loads (gravity).
        """
        states, t = self._kinematics()
        system, q, v, _ = self._multibody().of_parts(states.q, states.v, states.vdot)
        measure = partial(system.measure, name)
        if jnp.ndim(t) == 0:
            stacked = measure(*jax.tree.map(lambda leaf: leaf[None], (q, v, t)))
            return jax.tree.map(lambda leaf: leaf[0], stacked)
        return measure(q, v, t)


class Trajectory(AbstractMotion):
    """A simulated motion, a pytree like every other: criteria of it are differentiated as usual.

    Attributes:
        t: the times t0 + n h [s], or those that the integrator chose, shape (n+1,).
        states: the states, stacked along a leading axis.
        result: a value of `RESULTS`, shape (), int32; 0 is success.
        stats: Newton's iterations, increments and residuals; what the integrator says of its steps.
        system: the equations that were integrated.
        error: an estimate of the errors of the states, from integrators that have one (`Richardson`); else None.
        order: 2, or 4 where the states deserve a rule of fourth order: what to give `time_integral`, static.
        stages: those of `IndexReducedODE` without `rtol`, by which a `Criterion` integrates; else None.
    """

    t: Float[Array, " n+1"]
    states: State
    result: Int[Array, ""]
    stats: Any
    system: AbstractSystem
    error: StateError | None = None
    order: int = eqx.field(static=True, default=2)
    stages: Stages | None = None

    def _kinematics(self):
        return self.states, self.t

    def state(self, index: int) -> State:
        """The state at step `index` (negative: from the end), from which a simulation can be continued."""
        return jax.tree.map(lambda leaf: leaf[index], self.states)


class Saved(eqx.Module):
    """What `simulate` returns with `save`: the outputs asked for, and no trajectory.

    Attributes:
        t: the times t0 + n h [s], shape (n+1,).
        values: what `save` returned, every array with a leading axis n + 1.
        final: the state at t1, from which a simulation can be continued.
        result: a value of `RESULTS`, shape (), int32; 0 is success.
        stats: Newton's iterations, increments and residuals.
    """

    t: Float[Array, " n+1"]
    values: Any
    final: State
    result: Int[Array, ""]
    stats: Any


class Instant(AbstractMotion):
    """One instant of a motion: what the integrand of a `Criterion` sees.

    Attributes:
        t: the time [s], shape ().
        state: q, v, v̇, λ (and a).
        system: the equations of motion.
    """

    t: Float[Array, ""]
    state: State
    system: AbstractSystem

    def _kinematics(self):
        return self.state, self.t
