"""What acts on the relative coordinates of joints: springs, dampers, motors and curves.

A joint's coordinate s is a function of the pose of its frame on b in that on a (`_relative`), whatever the joint is.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens._validate import number_field, require_setting, suggestion
from lgsens.liegroups import turn_back
from lgsens.model._forces import AbstractForce, Attached, _frame
from lgsens.model._frames import BODY_DIM, Frame, tilted
from lgsens.model._joints import AbstractJoint
from lgsens.model._loads import AbstractClosedFormLoad, LoadTangents
from lgsens.model._relative import Coordinate, but_for_turns
from lgsens.model._signal_fields import prescribed_field, signal_field
from lgsens.model._signals import AbstractSignal, Prescribed, at_time, prepared
from lgsens.model._turns import (
    CountedTurns,
    acting,
    force_along,
    require_half_a_turn,
    unless_closed,
    within_half_a_turn,
)


def frame_seen(a: Frame, b: Frame, on_a: Frame, on_b: Frame) -> Frame:
    """The frame `on_b` of b as seen from the frame `on_a` of a, both in the frames of their bodies."""
    axes_a, axes_b = a.orientation @ on_a.orientation, b.orientation @ on_b.orientation
    return Frame(turn_back(axes_a, b.point(on_b.position) - a.point(on_a.position)), axes_a.T @ axes_b)


def value_and_row(
    value: Callable[..., Float[Array, ""]], frames: Sequence[Frame]
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """A function of some frames, and its derivative by their [u, θ]."""
    zero = jnp.zeros(BODY_DIM * len(frames), frames[0].position.dtype)
    return jax.value_and_grad(lambda x: value(*tilted(frames, x)))(zero)


def attached_frames(joint: AbstractJoint, a: Frame, b: Frame) -> tuple[Frame, Frame]:
    """The frames of a joint in those of its bodies, which have the reference frames a and b."""
    assert joint.frames is not None
    of_a, of_b = joint.frames
    local = lambda body, own: Frame(body.local_point(own.position), body.orientation.T @ own.orientation)
    return local(a, of_a), local(b, of_b)


def coordinate_of(what: str, joint: AbstractJoint, name: str | None) -> Coordinate:
    if not isinstance(joint, AbstractJoint):
        raise ValueError(f"{what}: it needs a joint itself, a RevoluteJoint(…), say, and not its name, got {joint!r}.")
    known = {coordinate.name: coordinate for coordinate in joint.coordinates}
    if not known or joint.frames is None:
        raise ValueError(f"{what}: a {type(joint).__name__} has no relative coordinate; give a RevoluteJoint, say.")
    if name is None and len(known) > 1:
        raise ValueError(f"{what}: a {type(joint).__name__} has the coordinates {list(known)}; give the name of one.")
    if name is not None and name not in known:
        raise ValueError(f"{what}: {suggestion(name, known)}.")
    return known[name or next(iter(known))]


class CoordinateMeasure(NamedTuple):
    """What is moved at one instant: the coordinate, its rate, and the generalized force along it, shape ()."""

    coordinate: Float[Array, ""]
    rate: Float[Array, ""]
    force: Float[Array, ""]

    __repr__ = brief


class CoordinateLoad(AbstractClosedFormLoad):
    """Q = (∂s/∂q)ᵀ f along the coordinate s, f = motor(t) + curve(s) − k (s − s₀) − c ṡ, whose power is f ṡ.

    ∂Q/∂v = −c (∂s/∂q)ᵀ (∂s/∂q).
    """

    on_a: Frame
    on_b: Frame
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    free: Float[Array, ""]
    motor: Prescribed | None
    curve: AbstractSignal | None = eqx.field(metadata={"over": "coordinate"})
    coordinate: Coordinate = eqx.field(static=True)

    balanced = True
    drawn = None

    def value(self, a, b):
        s, row = value_and_row(lambda a, b: self.coordinate.of(frame_seen(a, b, self.on_a, self.on_b)), (a, b))
        return (but_for_turns(s, self.free) if self.coordinate.periodic else s), row

    def _held(self, s):
        """f where nothing moves or drives."""
        force = -self.stiffness * (s - self.free)
        return force if self.curve is None else force + self.curve(s)

    def along(self, s, rate, t) -> CoordinateMeasure:
        force = self._held(s) - self.damping * rate
        return CoordinateMeasure(s, rate, force if self.motor is None else force + at_time(self.motor, t))

    def branch(self, a, b):
        return unless_closed(self._held, self.value(a, b)[0], self.free) if self.coordinate.periodic else None

    def measure(self, a, b, va, vb, t) -> CoordinateMeasure:
        return acting(self, a, b, va, vb, t)[0]

    def force(self, a, b, va, vb, t):
        return force_along(self, a, b, va, vb, t)

    def tangents(self, a, b, va, vb, t):
        zero, (_, row) = jnp.zeros_like(va, shape=2 * BODY_DIM), self.value(a, b)

        def force(x):
            one, other = tilted((a, b), x)
            return self.force(one, other, va, vb, t)

        position = jax.jacfwd(force)(zero)
        return LoadTangents(position, -self.damping * jnp.outer(row, row))


class CoordinateForce(AbstractForce):
    """Spring, damper, motor and a force curve along a coordinate s of a joint: f = M(t) + F(s) − k (s − s₀) − c ṡ.

    It acts on both bodies as Q = (∂s/∂q)ᵀ f: about the axis of a hinge, along that of a slider, on each of the two arms
    of a cross.

    Arguments:
        joint: whose coordinate it is, with its bodies and its geometry; it need not be one of the model's.
        coordinate: the name of the coordinate, static; None: the only one.
        stiffness: k [N/m or N m/rad], shape ().
        damping: c [N s/m or N m s/rad], shape ().
        free: s₀ [m or rad], at which the spring is free, shape (); of an angle within half a turn unless counted. The
            coordinate of a rod is its length, not what it has changed by.
        motor: M(t) [N or N m], a number, shape (), or a signal; None: no motor.
        curve: F [N or N m] over s, a signal of it in place of time: a torque over the angle of a crank. None: none.
        turns: whether an angle is counted over whole turns, by a state "angle" (`Trajectory.states_of`), static. Else
            it is within half a turn of s₀, where the force of a spring jumps; a motion that comes there has failed.
            Without a spring, and with a curve whose period is one turn (`Sampled(…, periodic=True)`), none jumps; one
            of two turns, as the torque of a four-stroke engine, is counted.

    `Trajectory.force` gives the coordinate, its rate, and f. Raises `ValueError` for a joint without the coordinate,
    a larger `free`, `turns` of one that is no angle, a curve that is no signal, and wrong shapes. Source: in minimal
    coordinates the spring, damper and motor of MuJoCo's joints (its documentation, "Computation": passive forces,
    actuation model).
    """

    joint: AbstractJoint
    coordinate: str | None = eqx.field(static=True, default=None)
    stiffness: Float[Array, ""] = number_field("stiffness", default=0.0)
    damping: Float[Array, ""] = number_field("damping", default=0.0)
    free: Float[Array, ""] = number_field("free", default=0.0)
    motor: Prescribed | None = prescribed_field("motor")
    curve: AbstractSignal | None = signal_field("curve", over="coordinate", optional=True)
    turns: bool = eqx.field(static=True, default=False, kw_only=True)

    def __check_init__(self):
        found = coordinate_of("CoordinateForce", self.joint, self.coordinate)
        require_setting(self, "turns", isinstance(self.turns, bool), "True or False")
        if self.turns and not found.periodic:
            raise ValueError(f"CoordinateForce: `turns` are those of an angle; {found.name!r} is none. Leave it out.")
        if found.periodic and not self.turns:
            require_half_a_turn("CoordinateForce", "free", self.free)

    @property
    def bodies(self):
        return (self.joint.a, self.joint.b)

    def loads(self, bodies):
        ends = attached_frames(self.joint, *(_frame(bodies, name, self.stiffness.dtype) for name in self.bodies))
        coordinate = coordinate_of("CoordinateForce", self.joint, self.coordinate)
        free = within_half_a_turn(self.free) if coordinate.periodic and not self.turns else self.free
        follows = prepared(self.motor), prepared(self.curve)
        load = CoordinateLoad(*ends, self.stiffness, self.damping, free, *follows, coordinate)
        return (Attached(CountedTurns(load) if self.turns else load, *self.bodies),)
