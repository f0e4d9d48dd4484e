"""What acts on the relative coordinates of joints: springs, dampers and motors, and couplings between two joints.

A joint's coordinate s is a function of the pose of its frame on b in that on a (`_relative`), whatever the joint is.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens._validate import as_count, as_float, number_field, require, require_setting, suggestion
from lgsens.liegroups import turn_back
from lgsens.model._constraints import AbstractClosedFormConstraint
from lgsens.model._forces import AbstractForce, Attached, _frame
from lgsens.model._frames import BODY_DIM, Frame, tilted
from lgsens.model._joints import AbstractJoint
from lgsens.model._loads import AbstractClosedFormLoad, LoadTangents
from lgsens.model._relative import Coordinate, but_for_turns
from lgsens.model._signal_fields import prescribed_field
from lgsens.model._signals import Prescribed, at_time, prepared
from lgsens.model._turns import (
    CountedTurns,
    acting,
    branch_of,
    force_along,
    require_half_a_turn,
    unless_whole,
    within_half_a_turn,
)


def _seen(a: Frame, b: Frame, on_a: Frame, on_b: Frame) -> Frame:
    """The frame `on_b` of b as seen from the frame `on_a` of a, both in the frames of their bodies."""
    axes_a, axes_b = a.orientation @ on_a.orientation, b.orientation @ on_b.orientation
    return Frame(turn_back(axes_a, b.point(on_b.position) - a.point(on_a.position)), axes_a.T @ axes_b)


def _row(
    value: Callable[..., Float[Array, ""]], frames: Sequence[Frame]
) -> tuple[Float[Array, ""], Float[Array, " n"]]:
    """A function of some frames, and its derivative by their [u, θ]."""
    zero = jnp.zeros(BODY_DIM * len(frames), frames[0].position.dtype)
    return jax.value_and_grad(lambda x: value(*tilted(frames, x)))(zero)


def _attached(joint: AbstractJoint, a: Frame, b: Frame) -> tuple[Frame, Frame]:
    """The frames of a joint in those of its bodies, which have the reference frames a and b."""
    assert joint.frames is not None
    of_a, of_b = joint.frames
    local = lambda body, own: Frame(body.local_point(own.position), body.orientation.T @ own.orientation)
    return local(a, of_a), local(b, of_b)


def _coordinate(what: str, joint: AbstractJoint, name: str | None) -> Coordinate:
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
    """Q = (∂s/∂q)ᵀ f along the coordinate s, f = motor(t) − k (s − s₀) − c ṡ, whose power is f ṡ.

    ∂Q/∂v = −c (∂s/∂q)ᵀ (∂s/∂q).
    """

    on_a: Frame
    on_b: Frame
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    free: Float[Array, ""]
    motor: Prescribed | None
    coordinate: Coordinate = eqx.field(static=True)

    balanced = True
    drawn = None

    def value(self, a, b):
        s, row = _row(lambda a, b: self.coordinate.of(_seen(a, b, self.on_a, self.on_b)), (a, b))
        return (but_for_turns(s, self.free) if self.coordinate.periodic else s), row

    def along(self, s, rate, t) -> CoordinateMeasure:
        force = -self.stiffness * (s - self.free) - self.damping * rate
        return CoordinateMeasure(s, rate, force if self.motor is None else force + at_time(self.motor, t))

    def branch(self, a, b):
        return branch_of(self, a, b) if self.coordinate.periodic else None

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
    """Spring, damper and motor along a relative coordinate s of a joint: f = M(t) − k (s − s₀) − c ṡ.

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
        turns: whether an angle is counted over whole turns, by a state "angle" (`Trajectory.states_of`), static. Else
            it is within half a turn of s₀, where the force of a spring jumps; a motion that comes there has failed.

    `Trajectory.force` gives the coordinate, its rate, and f. Raises `ValueError` for a joint without the coordinate,
    a larger `free`, `turns` of one that is no angle, and wrong shapes. Source: in minimal coordinates the spring,
    damper and motor of MuJoCo's joints (its documentation, "Computation": passive forces, actuation model).
    """

    joint: AbstractJoint
    coordinate: str | None = eqx.field(static=True, default=None)
    stiffness: Float[Array, ""] = number_field("stiffness", default=0.0)
    damping: Float[Array, ""] = number_field("damping", default=0.0)
    free: Float[Array, ""] = number_field("free", default=0.0)
    motor: Prescribed | None = prescribed_field("motor")
    turns: bool = eqx.field(static=True, default=False, kw_only=True)

    def __check_init__(self):
        found = _coordinate("CoordinateForce", self.joint, self.coordinate)
        require_setting(self, "turns", isinstance(self.turns, bool), "True or False")
        if self.turns and not found.periodic:
            raise ValueError(f"CoordinateForce: `turns` are those of an angle; {found.name!r} is none. Leave it out.")
        if found.periodic and not self.turns:
            require_half_a_turn("CoordinateForce", "free", self.free)

    @property
    def bodies(self):
        return (self.joint.a, self.joint.b)

    def loads(self, bodies):
        ends = _attached(self.joint, *(_frame(bodies, name, self.stiffness.dtype) for name in self.bodies))
        motor = None if self.motor is None else prepared(self.motor)
        coordinate = _coordinate("CoordinateForce", self.joint, self.coordinate)
        free = within_half_a_turn(self.free) if coordinate.periodic and not self.turns else self.free
        load = CoordinateLoad(*ends, self.stiffness, self.damping, free, motor, coordinate)
        return (Attached(CountedTurns(load) if self.turns else load, *self.bodies),)


def _values(coordinates: Sequence[Coordinate], ends: Sequence[Frame], attached) -> list[Float[Array, ""]]:
    """Two coordinates, of joints whose frames are attached to these four ends."""
    pairs = zip(coordinates, (ends[:2], ends[2:]), attached)
    return [coordinate.of(_seen(*pair, *own)) for coordinate, pair, own in pairs]


class Coupled(AbstractClosedFormConstraint):
    """Φ = s₁ − Σ c_i s₂ⁱ of two coordinates, less what they are in the reference configuration, `origins`; `roles`:
    which of the frames (a, b, *others) their four ends are.

    Where s₁ is an angle Φ is that but for turns divided by `teeth`.
    """

    first: tuple[Frame, Frame]
    second: tuple[Frame, Frame]
    coefficients: Float[Array, " n"]
    origins: tuple[Any, ...]
    coordinates: tuple[Coordinate, ...] = eqx.field(static=True)  # two
    roles: tuple[int, ...] = eqx.field(static=True)  # four
    teeth: int = eqx.field(static=True)

    drawn = None

    @property
    def num_rows(self):
        return 1

    def _coordinates(self, frames):
        """s₁ and s₂, angles but for whole turns."""
        found = _values(self.coordinates, [frames[role] for role in self.roles], (self.first, self.second))
        return tuple(s if origin is None else s - origin for s, origin in zip(found, self.origins))

    def branch(self, a, b, *others):
        first, second = self.coordinates
        if not second.periodic:
            return None
        angle = self._coordinates((a, b, *others))[1]
        linear = first.periodic and self.coefficients.shape[0] == 1
        return unless_whole(self.coefficients[0], self.teeth, angle) if linear else angle

    def value(self, a, b, t, *others):
        s, x = self._coordinates((a, b, *others))
        total = jnp.zeros_like(x)
        for i in reversed(range(self.coefficients.shape[0])):  # Horner's scheme
            total = (total + self.coefficients[i]) * x
        missing = s - total
        if self.coordinates[0].periodic:
            missing = but_for_turns(missing, turn=2.0 * jnp.pi / self.teeth)
        return missing[None]

    def jacobian(self, a, b, t, *others):
        return _row(lambda a, b, *others: self.value(a, b, t, *others)[0], (a, b, *others))[1][None]

    def force(self, a, b, lam, t, *others):
        return lam[0] * self.jacobian(a, b, t, *others)[0]

    def geometric_stiffness(self, a, b, lam, t, *others):
        frames = (a, b, *others)

        def force(x):
            one, other, *more = tilted(frames, x)
            return self.force(one, other, lam, t, *more)

        return jax.jacfwd(force)(jnp.zeros_like(lam, shape=BODY_DIM * len(frames)))


class CoordinateCoupling(AbstractJoint):
    """The coordinates of two joints move together: s₁ = c₁ s₂ + c₂ s₂² + …; 1 equation between up to four bodies.

    Two fingers of a gripper, a cam, a belt between two joints of an arm, sun and ring of a planetary gear by their
    hinges on a carrier that turns, too. With a *rotor* as one of them, a body that
    only turns about an axis of the ground, it is the inertia of a drive in joint coordinates: the rotor of inertia J
    turns by s₁ = s₂, and adds the kinetic energy ½ J ṡ₂² and nothing else (MuJoCo's `armature`, the motor's inertia
    times the square of its gear ratio).

    Arguments:
        first, second: the joints, with bodies and geometry; they need not be joints of the model, where others hold
            the bodies.
        coefficients: c₁, c₂, …, shape (n,), n ≥ 1. Both coordinates vanish together: in the reference configuration,
            from which lengths of rods are counted, so that two with c₁ = −1 are a rope over a pulley.
        names: the names of the coordinates of both, static; None: the only one.
        teeth: a count for which c₁ · teeth is an integer: those of the first of two gears, as in `GearJoint`. Where c₁
            is the only coefficient angles then turn any number of times; else `second`, if it is an angle, stays within
            half a turn, where a run has failed otherwise, and so it does for the derivative by c₁.

    The multiplier is the generalized force that the coupling takes from s₁ [N or N m]: of ropes over pulleys the
    tension of the first one, −c₁ times which the second one has. Raises `ValueError` for joints
    without the coordinate, coefficients of a wrong shape, a count below 1, or fewer than two bodies. Source: of gears
    on a carrier, Willis's equation: Uicker, Pennock & Shigley, Theory of Machines and Mechanisms (5th ed. 2017), ch. 9.
    """

    first: AbstractJoint
    second: AbstractJoint
    coefficients: Float[Array, " n"]
    names: tuple[str | None, str | None] = eqx.field(static=True)
    teeth: int = eqx.field(static=True)

    assembled = True

    def __init__(
        self,
        first: AbstractJoint,
        second: AbstractJoint,
        coefficients: Any = (1.0,),
        names: tuple[str | None, str | None] = (None, None),
        *,
        teeth: int = 1,
    ):
        if isinstance(names, str) or len(names) != 2:
            raise ValueError(f"CoordinateCoupling: `names` must be two names, of either joint or None, got {names!r}.")
        self.first, self.second, self.names, self.teeth = first, second, names, as_count(teeth, "teeth")
        self.coefficients = as_float(coefficients, None, "CoordinateCoupling: `coefficients`")

    def __check_init__(self):
        for joint, name in zip((self.first, self.second), self.names):
            _coordinate("CoordinateCoupling", joint, name)
        if self.coefficients.ndim != 1 or not self.coefficients.shape[0]:
            raise ValueError(
                f"CoordinateCoupling: `coefficients` must have shape (n,), n ≥ 1, got {self.coefficients.shape}."
            )
        require(lambda c: c.any(), "CoordinateCoupling: `coefficients` are all zero.", self.coefficients)
        if len(self._order) < 2:
            raise ValueError(f"CoordinateCoupling: needs two or more bodies, got {self._ends}.")

    @property
    def _ends(self) -> tuple[str | None, ...]:
        return (self.first.a, self.first.b, self.second.a, self.second.b)

    @property
    def _order(self) -> list[str | None]:
        """Its bodies, each once, the ground first."""
        return sorted(dict.fromkeys(self._ends), key=lambda name: name is not None)

    @property
    def a(self):
        return self._order[0]

    @property
    def b(self):
        return self._order[1]

    @property
    def others(self):
        return tuple(self._order[2:])

    def constraints(self, a, b, *others):
        order, frames = self._order, (a, b, *others)
        roles = tuple(order.index(name) for name in self._ends)
        ends = [frames[role] for role in roles]
        coordinates = tuple(
            _coordinate("CoordinateCoupling", joint, name) for joint, name in zip((self.first, self.second), self.names)
        )
        both = _attached(self.first, *ends[:2]), _attached(self.second, *ends[2:])
        origins = tuple(s if of.absolute else None for s, of in zip(_values(coordinates, ends, both), coordinates))
        return (Coupled(*both, self.coefficients, origins, coordinates, roles, self.teeth),)
