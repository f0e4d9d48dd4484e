"""Couplings between the relative coordinates of two joints (`_relative`), whatever the joints are."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import as_count, as_float, require
from lgsens.model._constraints import AbstractClosedFormConstraint
from lgsens.model._coordinates import attached_frames, coordinate_of, frame_seen, value_and_row
from lgsens.model._frames import BODY_DIM, Frame, tilted
from lgsens.model._joints import AbstractJoint
from lgsens.model._relative import Coordinate, but_for_turns
from lgsens.model._signal_fields import signal_field
from lgsens.model._signals import AbstractSignal, Polynomial, prepared
from lgsens.model._turns import unless_closed


def _values(coordinates: Sequence[Coordinate], ends: Sequence[Frame], attached) -> list[Float[Array, ""]]:
    """Two coordinates, of joints whose frames are attached to these four ends."""
    pairs = zip(coordinates, (ends[:2], ends[2:]), attached)
    return [coordinate.of(frame_seen(*pair, *own)) for coordinate, pair, own in pairs]


class Coupled(AbstractClosedFormConstraint):
    """Φ = s₁ − f(s₂) of two coordinates, less what they are in the reference configuration, `origins`; `roles`:
    which of the frames (a, b, *others) their four ends are.

    Where s₁ is an angle Φ is that but for turns divided by `teeth`.
    """

    first: tuple[Frame, Frame]
    second: tuple[Frame, Frame]
    relation: AbstractSignal = eqx.field(metadata={"over": "coordinate"})  # f
    origins: tuple[Any, ...]
    coordinates: tuple[Coordinate, ...] = eqx.field(static=True)  # two
    roles: tuple[int, ...] = eqx.field(static=True)  # four
    teeth: int = eqx.field(static=True)

    drawn = None
    num_rows = 1

    def _coordinates(self, frames):
        """s₁ and s₂, angles but for whole turns."""
        found = _values(self.coordinates, [frames[role] for role in self.roles], (self.first, self.second))
        return tuple(s if origin is None else s - origin for s, origin in zip(found, self.origins))

    def branch(self, a, b, *others):
        first, second = self.coordinates
        if not second.periodic:
            return None
        return unless_closed(self.relation, self._coordinates((a, b, *others))[1], turn=self._turn(first))

    def _turn(self, first: Coordinate) -> float | None:
        """What s₁ is known but for whole multiples of."""
        return 2.0 * jnp.pi / self.teeth if first.periodic else None

    def value(self, a, b, t, *others):
        s, x = self._coordinates((a, b, *others))
        missing, turn = s - self.relation(x), self._turn(self.coordinates[0])
        return (missing if turn is None else but_for_turns(missing, turn=turn))[None]

    def jacobian(self, a, b, t, *others):
        return value_and_row(lambda a, b, *others: self.value(a, b, t, *others)[0], (a, b, *others))[1][None]

    def force(self, a, b, lam, t, *others):
        return lam[0] * self.jacobian(a, b, t, *others)[0]

    def geometric_stiffness(self, a, b, lam, t, *others):
        frames = (a, b, *others)

        def force(x):
            one, other, *more = tilted(frames, x)
            return self.force(one, other, lam, t, *more)

        return jax.jacfwd(force)(jnp.zeros_like(lam, shape=BODY_DIM * len(frames)))


class CoordinateCoupling(AbstractJoint):
    """The coordinates of two joints move together: s₁ = c₁ s₂ + c₂ s₂² + … or s₁ = f(s₂); 1 equation between up to
    four bodies.

    Two fingers of a gripper, a belt between two joints of an arm, sun and ring of a planetary gear by their
    hinges on a carrier that turns, too; by a curve a cam and what follows it, or gears that are not round. With a
    *rotor* as one of them, a body that only turns about an axis of the ground, it is the inertia of a drive in joint
    coordinates: the rotor of inertia J turns by s₁ = s₂, and adds the kinetic energy ½ J ṡ₂² and nothing else
    (MuJoCo's `armature`, the motor's inertia times the square of its gear ratio).

    Arguments:
        first, second: the joints, with bodies and geometry; they need not be joints of the model, where others hold
            the bodies.
        coefficients: c₁, c₂, …, shape (n,), n ≥ 1; None, without a curve, is 1. Both coordinates vanish together: in
            the reference configuration, from which lengths of rods are counted, so that two with c₁ = −1 are a rope
            over a pulley.
        names: the names of the coordinates of both, static; None: the only one.
        teeth: a count for which c₁ · teeth is an integer: those of the first of two gears, as in `GearJoint`. Where c₁
            is the only coefficient angles then turn any number of times; else `second`, if it is an angle, stays within
            half a turn, where a run has failed otherwise, and so it does for the derivative by c₁.
        curve: f over s₂, a signal of it in place of time; then there are no coefficients. Over an angle it is that of a
            cam, and this turns any number of times, if f closes after a turn: `Sampled(angles, lifts, "cubic",
            periodic=True)`, with angles from 0 to 2π (a cam at half the speed of a crank has a shaft of its own); or if
            it closes but for whole turns of s₁, itself an angle. Derivatives by its period are none then. Unless
            f(0) = 0 the mechanism is assembled before it moves. Where f″ jumps (a "monotone" one) accelerations do;
            where f‴ does (a "cubic" one, at samples), derivatives of forces are of first order.

    The multiplier is the generalized force that the coupling takes from s₁ [N or N m]: of ropes over pulleys the
    tension of the first one, −c₁ times which the second one has. Raises `ValueError` for joints
    without the coordinate, coefficients of a wrong shape or beside a curve, one that is no signal or follows straight
    lines, a count below 1, or fewer than two bodies. Source: Uicker, Pennock & Shigley, Theory of Machines and
    Mechanisms (5th ed. 2017), ch. 6 (cams), ch. 9 (Willis's equation, of gears on a carrier).
    """

    first: AbstractJoint
    second: AbstractJoint
    coefficients: Float[Array, " n"] | None
    names: tuple[str | None, str | None] = eqx.field(static=True)
    teeth: int = eqx.field(static=True)
    curve: AbstractSignal | None = signal_field("curve", over="coordinate", optional=True, driven=True)

    def __init__(
        self,
        first: AbstractJoint,
        second: AbstractJoint,
        coefficients: Any = None,
        names: tuple[str | None, str | None] = (None, None),
        *,
        teeth: int = 1,
        curve: AbstractSignal | None = None,
    ):
        if isinstance(names, str) or len(names) != 2:
            raise ValueError(f"CoordinateCoupling: `names` must be two names, of either joint or None, got {names!r}.")
        self.first, self.second, self.names, self.teeth = first, second, names, as_count(teeth, "teeth")
        if curve is not None and coefficients is not None:
            raise ValueError("CoordinateCoupling: `coefficients` and `curve` are two relations; leave one of them out.")
        self.curve = curve
        if curve is None:
            given = (1.0,) if coefficients is None else coefficients
            self.coefficients = as_float(given, None, "CoordinateCoupling: `coefficients`")
        else:
            self.coefficients = None

    def __check_init__(self):
        for joint, name in zip((self.first, self.second), self.names):
            coordinate_of("CoordinateCoupling", joint, name)
        if self.coefficients is not None:
            if self.coefficients.ndim != 1 or not self.coefficients.shape[0]:
                raise ValueError(
                    f"CoordinateCoupling: `coefficients` must have shape (n,), n ≥ 1, got {self.coefficients.shape}."
                )
            require(lambda c: c.any(), "CoordinateCoupling: `coefficients` are all zero.", self.coefficients)
        if len(self._order) < 2:
            raise ValueError(f"CoordinateCoupling: needs two or more bodies, got {self._ends}.")

    @property
    def assembled(self):
        return self.curve is None

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
            coordinate_of("CoordinateCoupling", joint, name)
            for joint, name in zip((self.first, self.second), self.names)
        )
        both = attached_frames(self.first, *ends[:2]), attached_frames(self.second, *ends[2:])
        origins = tuple(s if of.absolute else None for s, of in zip(_values(coordinates, ends, both), coordinates))
        c = self.coefficients
        relation = prepared(self.curve) if c is None else Polynomial(jnp.concatenate([jnp.zeros_like(c[:1]), c]))
        return (Coupled(*both, relation, origins, coordinates, roles, self.teeth),)
