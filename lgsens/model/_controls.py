"""Force elements with states of their own: an actuator that lags, a PID controller, a spring that relaxes.

Actuator and controller act along what a driver would prescribe: with Φ = s(q) − s_d(t) the equation of the driver and
B its gradient, a force or moment u in the direction of growing s is Q = Bᵀu, whose power is u ṡ.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens._validate import number_field, point_field, require_positive
from lgsens.dynamics import told_breaks
from lgsens.model._constraints import AbstractConstraint
from lgsens.model._elements import body_fixed
from lgsens.model._forces import AbstractConnection, AbstractForce, Attached, _distance, _frame
from lgsens.model._joints import AbstractJoint
from lgsens.model._loads import AbstractDynamicLoad, AbstractLoad, LineForce, SpringDamperLoad
from lgsens.model._signal_fields import prescribed_field
from lgsens.model._signals import AbstractSignal, Prescribed, at_time, prepared
from lgsens.model._stack import constraint_jacobian


class ActuatorLoad(AbstractDynamicLoad):
    """Q = Bᵀz with τ ż = u(t) − z."""

    along: AbstractConstraint
    command: Prescribed
    time_constant: Float[Array, ""]
    start: Float[Array, ""] | None

    balanced = True
    states = ("output",)

    def force(self, a, b, va, vb, t, z):
        return z @ constraint_jacobian(self.along.here(a, b), a, b, t)

    def rate(self, a, b, va, vb, t, z):
        return (at_time(self.command, t) - z) / self.time_constant

    def initial(self, a, b, va, vb, t):
        return (at_time(self.command, t) if self.start is None else self.start)[None]

    def measure(self, a, b, va, vb, t, z) -> Float[Array, ""]:
        return z[0]

    def size(self, length):
        known = _values_of(self.command)
        largest = jnp.max(jnp.abs(known if self.start is None else jnp.append(known, self.start)))
        return lax.stop_gradient(jnp.where(largest > 0.0, largest, 1.0))[None]


def _values_of(command: Prescribed) -> Float[Array, " n"]:
    """A number, or what a signal is at some times of its first second, at its breaks and between them."""
    if not isinstance(command, AbstractSignal):
        return command[None]
    breaks = jnp.ravel(told_breaks(command))
    first = jnp.asarray(np.modf(np.arange(16) * (np.sqrt(5.0) - 1.0) / 2.0)[0], jnp.result_type(float))
    times = jnp.concatenate([first, breaks, (breaks[1:] + breaks[:-1]) / 2.0])
    values = jax.vmap(command)(jnp.where(jnp.isfinite(times), times, 0.0))
    return jnp.where(jnp.isfinite(values), values, 0.0)


class ControlSignals(NamedTuple):
    """What a controller sees and does: error e and its rate ė in the unit of the driver, output u [N] or [N m]."""

    error: Float[Array, ""]
    rate: Float[Array, ""]
    output: Float[Array, ""]

    __repr__ = brief


def _signals(load, a, b, va, vb, t) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, "12"]]:
    """e = −Φ, ė = −(B v + Φ_t), and B, Φ in the unit of what is prescribed."""
    (row,) = constraint_jacobian(load.along.here(a, b), a, b, t)
    value, by_time = jax.jvp(lambda t: load.along.deviation(a, b, t), (t,), (jnp.ones_like(t),))
    return -value[0], -(row @ jnp.concatenate([va, vb]) + by_time[0]), row


class PDLoad(AbstractLoad):
    """Q = Bᵀ(K e + D ė)."""

    along: AbstractConstraint
    proportional: Float[Array, ""]
    derivative: Float[Array, ""]

    balanced = True

    def measure(self, a, b, va, vb, t) -> ControlSignals:
        error, rate, _ = _signals(self, a, b, va, vb, t)
        return ControlSignals(error, rate, self.proportional * error + self.derivative * rate)

    def force(self, a, b, va, vb, t):
        return self.measure(a, b, va, vb, t).output * _signals(self, a, b, va, vb, t)[2]


class PIDLoad(AbstractDynamicLoad):
    """Q = Bᵀu, u_c = K e + I z + D ė with ż = e, and u = u_c, or with a lag another state of τ u̇ = u_c − u."""

    along: AbstractConstraint
    proportional: Float[Array, ""]
    derivative: Float[Array, ""]
    integral: Float[Array, ""] | None
    time_constant: Float[Array, ""] | None
    start: Float[Array, ""]  # of z

    balanced = True

    @property
    def states(self):
        return ("integral",) * (self.integral is not None) + ("output",) * (self.time_constant is not None)

    def _command(self, error, rate, z):
        command = self.proportional * error + self.derivative * rate
        return command if self.integral is None else command + self.integral * z[0]

    def measure(self, a, b, va, vb, t, z) -> ControlSignals:
        error, rate, _ = _signals(self, a, b, va, vb, t)
        return ControlSignals(error, rate, self._command(error, rate, z) if self.time_constant is None else z[-1])

    def force(self, a, b, va, vb, t, z):
        return self.measure(a, b, va, vb, t, z).output * constraint_jacobian(self.along.here(a, b), a, b, t)[0]

    def rate(self, a, b, va, vb, t, z):
        error, rate, _ = _signals(self, a, b, va, vb, t)
        rates = [] if self.integral is None else [error]
        if self.time_constant is not None:
            rates.append((self._command(error, rate, z) - z[-1]) / self.time_constant)
        return jnp.stack(rates)

    def initial(self, a, b, va, vb, t):
        error, rate, _ = _signals(self, a, b, va, vb, t)
        found = [] if self.integral is None else [self.start]
        if self.time_constant is not None:
            found.append(self._command(error, rate, found))
        return jnp.stack(found)

    def size(self, length):
        unit = jnp.ones_like(length) if self.along.turning else length
        output = jnp.abs(self.proportional) * unit
        sizes = [] if self.integral is None else [unit]
        if self.time_constant is not None:
            sizes.append(jnp.where(output > 0.0, output, 1.0))
        return jnp.stack(sizes)


class MaxwellLoad(AbstractDynamicLoad):
    """A spring whose free length r creeps: F = k (ℓ − r), c ṙ = F."""

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    start: Float[Array, ""] | None  # of r

    balanced = True
    states = ("free_length",)

    def _spring(self, z) -> SpringDamperLoad:
        none = jnp.zeros_like(self.stiffness)
        return SpringDamperLoad(self.point_a, self.point_b, self.stiffness, none, z[0], none)

    def measure(self, a, b, va, vb, t, z) -> LineForce:
        return self._spring(z).measure(a, b, va, vb, t)

    def force(self, a, b, va, vb, t, z):
        return self._spring(z).force(a, b, va, vb, t)

    def rate(self, a, b, va, vb, t, z):
        return self.measure(a, b, va, vb, t, z).tension[None] / self.damping

    def initial(self, a, b, va, vb, t):
        return _distance(a.point(self.point_a), b.point(self.point_b))[None] if self.start is None else self.start[None]

    def size(self, length):
        return length[None]


class _AbstractAlong(AbstractForce):
    """A force along what a driver would prescribe."""

    along: eqx.AbstractVar[AbstractJoint]

    @property
    def bodies(self):
        return (self.along.a, self.along.b)

    @property
    def about(self):
        return self.along.about

    @abc.abstractmethod
    def _load(self, along: AbstractConstraint) -> AbstractLoad | AbstractDynamicLoad:
        """The load, given the equation of the driver."""

    def loads(self, bodies):
        a, b = self.bodies
        dtype = next(bodies[name].mass.dtype for name in (a, b) if name is not None)
        rows = self.along.constraints(_frame(bodies, a, dtype), _frame(bodies, b, dtype))
        if len(rows) != 1 or rows[0].num_rows != 1 or not isinstance(rows[0], AbstractConstraint):
            raise ValueError(
                f"{type(self).__name__}: `along` must be a joint of one equation of position, such as RotationDriver, "
                f"TranslationDriver or DistanceJoint, got {type(self.along).__name__}."
            )
        return (Attached(self._load(rows[0]), a, b),)


def _require_driver(what: str, along) -> None:
    if not isinstance(along, AbstractJoint):
        raise ValueError(
            f"{what}: `along` must be a RotationDriver, TranslationDriver or DistanceJoint, got {along!r}; it is not a "
            "joint of the model, and says between what and in which direction the element acts."
        )


class Actuator(_AbstractAlong):
    """A force or moment that follows its command with a first-order lag: τ u̇ = u_c(t) − u.

    Arguments:
        along: between what it acts and how, a driver that is not a joint of the model: a `RotationDriver` for a moment
            [N m] on `b` about the axis and its opposite on `a`, a `TranslationDriver` for a force [N] on `b` along the
            axis, a `DistanceJoint` for a force [N] that pushes its points apart. What it prescribes is not used.
        command: u_c [N] or [N m], a number, shape (), or a signal.
        time_constant: τ [s], shape (), > 0.
        initial: u at the start [N] or [N m], shape (); None: the command then.

    Its state is "output" (`Trajectory.states_of`), also what `Trajectory.force` shows. Raises `ValueError` for a wrong
    shape, a time constant ≤ 0, or another joint.
    """

    along: AbstractJoint
    command: Prescribed = prescribed_field("command")
    time_constant: Float[Array, ""] = number_field("time_constant")
    initial: Float[Array, ""] | None = number_field("initial", default=None)

    def __check_init__(self):
        _require_driver("Actuator", self.along)
        require_positive(self, "time_constant")
        if self.command is None:
            raise ValueError("Actuator: `command` is missing; give a number [N] or [N m], or a signal.")

    def _load(self, along):
        return ActuatorLoad(along, prepared(self.command), self.time_constant, self.initial)


class PIDController(_AbstractAlong):
    """A force or moment that makes the mechanism follow a driver: u = K e + I ∫e dt + D ė, e = s_d(t) − s.

    Arguments:
        along: a driver that is not a joint of the model: what it would prescribe is what the controller follows. With
            a `RotationDriver` e [rad] is an angle and u [N m] the moment on `b`, with a `TranslationDriver` e [m] and
            u [N] the force on `b` along the axis, with a `DistanceJoint` the force that pushes its points apart.
        proportional, derivative: K [N/m] or [N m/rad] and D [N s/m] or [N m s/rad], shape ().
        integral: I [N/(m s)] or [N m/(rad s)], shape (); None: without an integral, which is a state.
        initial_integral: ∫e dt at the start [m s] or [rad s], shape (); `equilibrium` finds the one that holds.
        time_constant: of an actuator between controller and mechanism [s], shape (), > 0, another state, τ u̇ = u_c − u;
            it starts at its command. None: it acts at once.

    Its states are "integral" and "output" (`Trajectory.states_of`), as far as there are such; `Trajectory.force` gives
    `ControlSignals`. Angles are controlled to the nearest turn. Raises `ValueError` for a wrong shape, a time constant
    ≤ 0, or another joint. Source: Åström & Murray, Feedback Systems, chapter 11.
    """

    along: AbstractJoint
    proportional: Float[Array, ""] = number_field("proportional")
    derivative: Float[Array, ""] = number_field("derivative", default=0.0)
    integral: Float[Array, ""] | None = number_field("integral", default=None)
    initial_integral: Float[Array, ""] = number_field("initial_integral", default=0.0)
    time_constant: Float[Array, ""] | None = number_field("time_constant", default=None)

    def __check_init__(self):
        _require_driver("PIDController", self.along)
        require_positive(self, "time_constant")

    def _load(self, along):
        if self.integral is None and self.time_constant is None:
            return PDLoad(along, self.proportional, self.derivative)
        gains = self.proportional, self.derivative, self.integral
        return PIDLoad(along, *gains, self.time_constant, self.initial_integral)


class MaxwellElement(AbstractConnection):
    """A spring and a damper in series between two points, which relaxes: tension F = k (ℓ − r), c ṙ = F.

    Its force decays with the time constant c/k. Beside a `SpringDamper` it is the standard linear solid: rubber, or a
    damper on its rubber mount.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at_a, at_b: the points of attachment in the reference configuration [m], inertial frame, shape (3,).
        stiffness: k [N/m], shape ().
        damping: c [N s/m], shape (), > 0.
        initial: r at the start [m], shape (); None: the length then, so that there is no force.

    Its state is "free_length", r [m] (`Trajectory.states_of`); `Trajectory.force` gives a `LineForce`. Raises
    `ValueError` for a wrong shape or a damping ≤ 0. Source: Simo & Hughes, Computational Inelasticity (1998), §10.2.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: Float[Array, "3"] = point_field("at_a")
    at_b: Float[Array, "3"] = point_field("at_b")
    stiffness: Float[Array, ""] = number_field("stiffness")
    damping: Float[Array, ""] = number_field("damping")
    initial: Float[Array, ""] | None = number_field("initial", default=None)

    def __check_init__(self):
        require_positive(self, "damping")

    def load(self, a, b):
        points = a.local_point(self.at_a), b.local_point(self.at_b)
        return MaxwellLoad(*points, self.stiffness, self.damping, self.initial)
