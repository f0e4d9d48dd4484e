"""The result of a simulation, and one instant of it: the same questions, asked of all times or of one."""

import abc
import os
from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lgsens._brief import brief, listed, roster, shown
from lgsens._validate import as_float, is_concrete, suggestion
from lgsens.dynamics import RESULTS, AbstractSystem, State
from lgsens.integrate import Stages, Start
from lgsens.model import MultibodySystem, SE3System, measured, motion_at, scene_of
from lgsens.sensitivity import Sound
from lgsens.simulation._body_motion import BodyMotion, PointMotion
from lgsens.simulation._continued import start_in_any_steps
from lgsens.simulation._joint_motion import JointMotion, joint_motions
from lgsens.simulation._reached import Reached
from lgsens.simulation._tables import to_csv, to_pandas, to_xarray


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

    __repr__ = brief


def _ending(result: Any) -> str:
    """How a simulation ended, or how many of a batch did so."""
    if not is_concrete(result):
        return "traced"
    codes, counts = np.unique(np.asarray(result), return_counts=True)
    one = np.ndim(result) == 0
    return ", ".join(RESULTS(code).name + ("" if one else f" {count}") for code, count in zip(codes, counts))


def _of_each(question: Callable) -> Callable:
    """A question that a batch of motions, as it comes out of `vmap`, is asked one by one: answers have its axes first.

    All leaves of what `vmap` returns have the axes of the batch, those of the system too.
    """

    @wraps(question)
    def asked(motion: "AbstractMotion", *about, **more):
        if jnp.ndim(motion._kinematics()[1]) > motion._axes_of_time:
            return jax.vmap(lambda one: asked(one, *about, **more))(motion)
        states, t = motion._kinematics()
        if not motion._axes_of_time or is_concrete(states.v):
            return question(motion, *about, **more)
        # of rows before a step that failed there are derivatives, backwards too
        sound, where = Sound.of(states, motion.system), lambda motion: motion.states
        found = question(eqx.tree_at(where, motion, sound.states), *about, **more)
        over_time = lambda leaf: eqx.is_inexact_array(leaf) and leaf.shape[:1] == t.shape
        rows, others = eqx.partition(found, over_time)
        answer, is_dict = eqx.combine(sound.lost(rows), others), lambda node: isinstance(node, dict)
        in_order = lambda own, new: {name: new[name] for name in own} if is_dict(own) else new  # which trees forget
        return jax.tree.map(in_order, found, answer, is_leaf=is_dict)

    return asked


class AbstractMotion(eqx.Module):
    """What `Trajectory` and `Instant` answer alike; arrays of a trajectory have a leading axis n + 1, and those of a
    batch of motions its axes before."""

    system: eqx.AbstractVar[AbstractSystem]
    _axes_of_time: ClassVar[int] = 0

    @abc.abstractmethod
    def _kinematics(self) -> tuple[State, Any]:
        """The states and their times."""

    def __repr__(self) -> str:
        states, t = self._kinematics()
        system, result = self.system, getattr(self, "result", None)
        sizes = [getattr(array, "shape", (None,))[-1] for array in (getattr(states, of, None) for of in ("v", "lam"))]
        if not hasattr(t, "shape") or None in sizes:  # a tree of something else than arrays
            return super().__repr__()
        fields = {"t": f"{shown(t)} s"}
        if hasattr(self, "stats"):
            fields = {"steps": str(t.shape[-1] - 1)} | fields
        if result is not None:
            fields["result"] = _ending(result)
        reached = getattr(self, "reached", None)
        if reached is not None:
            fields["reached"] = reached.brief
        if (scene := scene_of(system)) is not None:
            whole = scene.whole
            fields |= {"bodies": roster(whole.body_names), "joints": roster(scene.joints)}
            fields["forces"] = roster(dict.fromkeys(owner for stack in whole.loads for owner in stack.owners))
        unknowns = f"{sizes[0]} coordinates, {sizes[1]} multipliers of"
        return listed(type(self).__name__, fields | {"states": f"{unknowns} {type(system).__name__}"})

    def of_bodies(self) -> tuple[MultibodySystem, State, Any]:
        """The motion on R³ × SO(3), whatever the formulation of the model: equations, states and times.

        Raises `ValueError` for the motion of equations that are not those of a `Model`.
        """
        system, (states, t) = self.system, self._kinematics()
        scene = scene_of(system)
        if scene is None:
            raise ValueError(
                f"This is the motion of a {type(system).__name__}, which has no named bodies, joints or forces; "
                "use `states` of a trajectory, `state` of an instant."
            )
        return scene, system.state_of_bodies(states) if isinstance(system, SE3System) else states, t

    @_of_each
    def body(self, name: str) -> BodyMotion:
        """The motion of the body `name`. Raises `ValueError` for an unknown name."""
        system, states, _ = self.of_bodies()
        system, *motion = system.of_parts(states.q, states.v, states.vdot)
        if name not in system.body_names:
            raise ValueError(f"`body`: {suggestion(name, system.body_names)}.")
        return BodyMotion(*system.motion(system.body_names.index(name), *motion))

    @_of_each
    def point(self, body: str, at) -> PointMotion:
        """The motion of a point of a body (a marker).

            x + R X,   ẋ + R (Ω × X),   ẍ + R (Ω̇ × X + Ω × (Ω × X)),     X = R₀ᵀ(at − x₀)

        Arguments:
            body: name of the body.
            at: where the point is in the reference configuration [m], inertial frame, shape (3,), like the hardpoints
                of joints; x₀ and R₀ are the body's there. The motion is differentiable by it.

        Raises `ValueError` for an unknown name or a wrong shape.
        """
        x, orientation, velocity, spin, acceleration, change = self.body(body)
        local = self.of_bodies()[0].reference_frame(body).local_point(as_float(at, (3,), "`at`"))
        twist, rate = (jnp.concatenate(parts, axis=-1) for parts in ((velocity, spin), (acceleration, change)))
        return PointMotion(*motion_at(local, x, orientation, twist, rate))

    @_of_each
    def multiplier(self, joint: str) -> Float[Array, "*n rows"]:
        """The Lagrange multipliers of a joint, shape (n+1, its equations); the joint says what they mean.

        Those of a merged `FixedJoint` (`Model.merge_fixed`) are what its bodies need to move as they do.
        Raises `ValueError` for an unknown name.
        """
        system, states, t = self.of_bodies()
        return system.multiplier(joint, states.q, states.v, states.vdot, states.lam, t)

    @_of_each
    def states_of(self, force: str) -> dict[str, Float[Array, "*n"]]:
        """The states of a force element (`Actuator`, `PIDController`, `MaxwellElement`) by their names, shape (n+1,).

        Raises `ValueError` for an unknown name, or an element without states.
        """
        system, states, _ = self.of_bodies()
        places = system.places_of_states()
        if force not in places:
            raise ValueError(f"`states_of`: {suggestion(force, places)}, the force elements with states.")
        return {name: states.v[..., place] for name, place in places[force].items()}

    @_of_each
    def force(self, name: str) -> Any:
        """What a force element measures, every array with a leading axis n + 1 if this is a trajectory.

        A `SpringDamper` gives its `LineForce` (length [m], rate [m/s], tension [N]), a `TyreSpring` its normal
        force [N], shape (n+1,); a `TorsionSpringDamper` its `HingeMoment`, a `PIDController` its `ControlSignals`;
        other elements the generalized force [F_a, M_a, F_b, M_b] that they apply.
        Raises `ValueError` for an unknown name, or one of several loads (gravity).
        """
        return self._asked(measured, name)

    @_of_each
    def joint(self, name: str) -> JointMotion:
        """The motion of the joint `name`: angle, displacement, their rates, force and moment on its body b.

        The force is −Bᵀλ of all its equations, so each of its multipliers is found there again. Equations that freed
        bodies cannot violate (`RigidBody.free`) transmit nothing here: what holds such bodies in the coordinates that
        they do not have is no joint.

        Raises `ValueError` for an unknown name. Source: Haug (1989), §11.4 (reaction forces).
        """
        return self._joint_motions((name,))[name]

    def _joint_motions(self, names: Iterable[str]) -> dict[str, JointMotion]:
        known = self.of_bodies()[0].joints
        for name in names:
            if name not in known:
                raise ValueError(f"`joint`: {suggestion(name, known)}.")
        return self._asked(joint_motions, tuple(names))

    def _asked(self, question: Callable, about: Any) -> Any:
        """`question(system, about, q, v, v̇, λ, t)` of a motion, and of an instant as of a motion of one."""
        system, states, t = self.of_bodies()
        at = states.q, states.v, states.vdot, states.lam, t
        if jnp.ndim(t):
            return question(system, about, *at)
        found = question(system, about, *jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], at))
        return jax.tree.map(lambda leaf: leaf[0], found)


class AbstractRun(AbstractMotion):
    """What motions over time answer besides, those of `simulate` and of `kinematics`."""

    t: eqx.AbstractVar[Float[Array, " n+1"]]
    result: eqx.AbstractVar[Int[Array, ""]]
    _axes_of_time: ClassVar[int] = 1

    def _besides(self) -> dict[str, Array]:
        """What a table has besides, by name, a number without unit for each time."""
        return {}

    def to_xarray(self) -> Any:
        """An `xarray.Dataset` over the dimension "time": all bodies, joints and states of force elements.

        Variables are "top.position" (time, axis), "top.orientation" (time, axis, body_axis), … as in `BodyMotion`;
        "hinge.angle", "hinge.angle_rate", …, "hinge.force", "hinge.moment" as in `JointMotion`, "hinge.multiplier";
        "motor.output" as in `states_of`; of `statics` "load.factor", "stable", "snapped". Each has its unit as
        attribute `units`, but for multipliers and states, whose meaning their elements say.

        Raises `ImportError` without xarray (`pip install "lgsens[data]"`), and `ValueError` for a motion that is traced
        or a batch.
        """
        return to_xarray(self)

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame` with the times as index and a column for each number, "top.position.x".

        Contents and errors are those of `to_xarray`; units by column are in `attrs["units"]`.
        """
        return to_pandas(self)

    def to_csv(self, path: str | os.PathLike) -> None:
        """Write a table with a line for each time and a column for each number, "top.position.x [m]", in full
        precision: what `to_xarray` has, without any package; nan from where a motion failed.

        Arguments:
            path: of the file, which is overwritten.

        Raises `ValueError` for a motion that is traced or a batch.
        """
        to_csv(self, path)


class Trajectory(AbstractRun):
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
        reached: what `simulate` with `accuracy` says of it; else None.
    """

    t: Float[Array, " n+1"]
    states: State
    result: Int[Array, ""]
    stats: Any
    system: AbstractSystem
    error: StateError | None = None
    order: int = eqx.field(static=True, default=2)
    stages: Stages | None = None
    reached: Reached | None = eqx.field(static=True, default=None)

    def _kinematics(self):
        return self.states, self.t

    @_of_each
    def state(self, index: int) -> State:
        """The state at step `index` (negative: from the end); a run in steps of the same size continues from it.

        Raises `IndexError` for an int that is out of range; a traced one is taken to the nearest state.
        """
        count = self.t.shape[0]
        if isinstance(index, float | str):
            raise IndexError(f"`index` must be a whole number, that of a step, got {index!r}.")
        if isinstance(index, int | np.integer) and not -count <= index < count:
            raise IndexError(f"`index` must be from {-count} to {count - 1}, as there are {count} states; got {index}.")
        return jax.tree.map(lambda leaf: leaf[index], self.states)

    @_of_each
    def continued(self, index: int = -1) -> Start:
        """What a run in steps of any size continues from at step `index` (negative: from the end), by any integrator:
        a `state0` of `simulate` with this time as t0, or of `differentiate`. What of v and a belongs to the size of a
        step is by itself there (Brüls & Arnold 2008, doi:10.1115/1.2960475). Raises as `state`.
        """
        return start_in_any_steps(self.system, self.t, self.state(index), self.t[index])

    def instant(self, index: int) -> "Instant":
        """Step `index` (negative: from the end) as the integrand of a `Criterion` sees it. Raises as `state`."""
        return Instant(state=self.state(index), t=self.t[..., index], system=self.system)  # of a batch, too


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

    def __repr__(self) -> str:
        fields = {"t": f"{shown(self.t)} s", "result": _ending(self.result), "values": shown(self.values)}
        return listed("Saved", fields)


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
