"""Force elements as the user writes them: by the names of bodies, in the reference configuration."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import as_called
from lgsens._validate import number_field, point_field, require_positive
from lgsens.model._body import RigidBody
from lgsens.model._contacts import TyreLoad
from lgsens.model._frames import Frame, ground_frame
from lgsens.model._joints import AbstractJoint
from lgsens.model._loads import (
    AbstractDynamicLoad,
    AbstractLoad,
    PointForce,
    SpringDamperLoad,
    Weight,
)
from lgsens.model._roads import FlatRoad
from lgsens.model._signal_fields import signal_field
from lgsens.model._signals import AbstractSignal, Constant, prepared
from lgsens.model._turning_loads import FixedMoment, FollowingForce, LoadSum


class Attached(NamedTuple):
    """A load and the two bodies that it acts between; None is the ground."""

    load: AbstractLoad | AbstractDynamicLoad
    a: str | None
    b: str | None


class AbstractForce(eqx.Module):
    """A force element. One of one's own has leaves for its numbers, and `bodies` and `loads`.

    Each load (`lgsens.model.AbstractLoad`, with equations of its own `AbstractDynamicLoad`) acts between two bodies a
    and b, None the ground, and returns twelve numbers,

        Q = [F_a, M_a, F_b, M_b],     with the power  F_a·ẋ_a + M_a·Ω_a + F_b·ẋ_b + M_b·Ω_b:

    F the force on a body [N] in the inertial frame, M its moment [N m] about the origin of the body frame (the centre
    of mass, or the `pivot`), in the body frame; what it says of the ground is not used. A force f of the inertial frame
    at the body's point X (body frame) is F = f, M = X × Rᵀf. A load is given the `Frame` (x, R) of each body and its
    velocity [ẋ, Ω], ẋ in the inertial frame, Ω in that of the body. `lgsens.testing.check_force` checks a force.

    `preload_shape` is that of its `preload`, in which its force is linear, for `static_preload`; None: it has none.
    `preload_rates` are those with which its members grow as it yields; None: it takes what equilibrium asks of it.
    `on_merged` says whether its loads on bodies that fixed joints merge are one load on what they are merged to;
    `reads` is the name of the joint whose multipliers its loads depend on (`AbstractDynamicLoad`), None for almost all.
    """

    preload_shape: ClassVar[Any] = None
    preload_rates: ClassVar[Any] = None
    on_merged: ClassVar[bool] = False
    reads: ClassVar[Any] = None

    __repr__ = as_called

    @property
    @abc.abstractmethod
    def bodies(self) -> tuple[str | None, ...]:
        """The bodies that it names; None is the ground."""

    @property
    def about(self) -> Float[Array, "3"] | None:
        """The axis of the turn that it resists, inertial frame, that of the hinge between its bodies; None: of none."""
        return None

    def with_preload(self, preload) -> "AbstractForce":
        """The same element with this preload in the reference configuration."""
        return dataclasses.replace(self, preload=preload)

    def on(self, joints: Mapping[str, AbstractJoint]) -> "AbstractForce":
        """The same element, given the joints of the model, one of which it may act in."""
        return self

    def with_factor(self, factor) -> "AbstractForce | None":
        """The same element multiplied by a number in place of a signal; None: no signal multiplies it."""
        return None

    def as_joint(self, kind: str | None, what: str) -> tuple[AbstractJoint, "AbstractForce", "AbstractForce | None"]:
        """The joint that it becomes if it does not yield; what it does as it yields, and what the joint leaves out."""
        raise ValueError(
            f"{what}: no joint takes the place of a {type(self).__name__}; one does of a Bushing and of a BeamElement."
        )

    @abc.abstractmethod
    def loads(self, bodies: Mapping[str, RigidBody]) -> tuple[Attached, ...]:
        """The loads of the element, given the bodies in their reference configuration.

        Points fixed to a body are given in its frame, `bodies[name].frame`, which `RigidBody.pivot` may move.
        """


class AbstractConnection(AbstractForce):
    """A force between two bodies a and b, whose load follows from its own numbers and their frames."""

    a: eqx.AbstractVar[str | None]
    b: eqx.AbstractVar[str | None]

    @property
    def bodies(self):
        return (self.a, self.b)

    @abc.abstractmethod
    def load(self, a: Frame, b: Frame) -> AbstractLoad | AbstractDynamicLoad:
        """The load, given the frames of its bodies in their reference configuration."""

    def loads(self, bodies):
        """As in `AbstractForce`, of one alone; many that are alike are made by one program (`_assemble`)."""
        dtype = next(bodies[name].mass.dtype for name in self.bodies if name is not None)
        return (Attached(self.load(*(_frame(bodies, name, dtype) for name in self.bodies)), self.a, self.b),)


def _distance(a, b):
    """|b − a|; of points that coincide, where it has no derivative, the mean of those to both sides: zero."""
    square = jnp.sum((b - a) ** 2)
    apart = square > 0.0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, square, 1.0)), 0.0)


def _frame(bodies: Mapping[str, RigidBody], name: str | None, dtype) -> Frame:
    return ground_frame(dtype) if name is None else bodies[name].frame


class Gravity(AbstractForce):
    """Uniform gravity on every body: F = m g at the centre of mass.

    Arguments:
        acceleration: the vector g [m/s²], inertial frame, shape (3,), e.g. (0, 0, −9.81).
    """

    acceleration: Float[Array, "3"] = point_field("acceleration")

    def __init__(self, acceleration):
        self.acceleration = acceleration

    @property
    def bodies(self):
        return ()

    on_merged = True  # the weights of the parts of a body are a weight at its centre of mass

    def loads(self, bodies):
        return tuple(Attached(self._weight(body), None, name) for name, body in bodies.items())

    def _weight(self, body: RigidBody) -> AbstractLoad:
        if body.pivot is None:
            return Weight(body.mass, self.acceleration)
        no_moment = jnp.zeros_like(self.acceleration)
        return PointForce(body.centre, body.mass * self.acceleration, no_moment, _one())


class SpringDamper(AbstractConnection):
    """A spring and a damper in parallel between two points; tension F = F₀ + k (ℓ − ℓ₀) + c ℓ̇.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at_a, at_b: the points of attachment in the reference configuration [m], inertial frame, shape (3,).
        stiffness: spring stiffness k [N/m], shape ().
        damping: damping c [N s/m], shape ().
        free_length: length ℓ₀ at which the spring is free [m], shape ().
        preload: tension F₀ in the reference configuration [N], shape (); negative for a compressed spring.
            ℓ₀ is then the reference length.

    Give `free_length` or `preload`, not both; with neither the spring is free in the reference
    configuration. Points that coincide at rest exchange no force, and as reference give ℓ₀ = 0 the derivative zero;
    those that part do in the direction in which they do. Raises `ValueError` for both, or wrong shapes.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: Float[Array, "3"] = point_field("at_a")
    at_b: Float[Array, "3"] = point_field("at_b")
    stiffness: Float[Array, ""] = number_field("stiffness")
    damping: Float[Array, ""] = number_field("damping", default=0.0)
    free_length: Float[Array, ""] | None = number_field("free_length", default=None)
    preload: Float[Array, ""] | None = number_field("preload", default=None)

    def __check_init__(self):
        if self.free_length is not None and self.preload is not None:
            raise ValueError(
                "SpringDamper: give `free_length` or `preload`, not both: each determines the other "
                "(preload = stiffness · (reference length − free_length))."
            )

    preload_shape = ()

    def with_preload(self, preload):
        return dataclasses.replace(self, preload=preload, free_length=None)

    def load(self, a, b):
        return SpringDamperLoad(
            point_a=a.local_point(self.at_a),
            point_b=b.local_point(self.at_b),
            stiffness=self.stiffness,
            damping=self.damping,
            free_length=_distance(self.at_a, self.at_b) if self.free_length is None else self.free_length,
            preload=jnp.zeros_like(self.stiffness) if self.preload is None else self.preload,
        )


class TyreSpring(AbstractForce):
    """A tyre as a vertical spring on a road: F_z = F₀ + k (z_road(t) + ℓ₀ − z), on a point of a body.

    Arguments:
        body: name of the wheel.
        at: the wheel centre in the reference configuration [m], inertial frame, shape (3,).
        stiffness: vertical stiffness k [N/m], shape ().
        road: height of the road under the wheel over time [m], an `AbstractSignal` (default: flat at 0).
        free_radius: height ℓ₀ of the wheel centre over the road at which the tyre is free [m], shape ().
        preload: force F₀ in the reference configuration on a road of height 0 [N], shape (). ℓ₀ is then the
            reference height of the wheel centre.
        rounding: w [m], shape (), > 0, of a tyre that lifts off: within ±w of the height at which it is free its force
            passes to zero with two continuous derivatives, and outside it is F_z or none, no less. None: see below.

    Give `free_radius` or `preload`, not both; with neither the tyre is free in the reference
    configuration. Without `rounding` the spring also pulls: bound its force from below (eq. 48) to keep contact. z is
    vertical. Raises `ValueError` for both, a rounding ≤ 0 or wrong shapes. Source: Sonneville & Brüls (2014), §9.
    """

    body: str = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    stiffness: Float[Array, ""] = number_field("stiffness")
    road: AbstractSignal = signal_field("road", default_factory=FlatRoad)
    free_radius: Float[Array, ""] | None = number_field("free_radius", default=None)
    preload: Float[Array, ""] | None = number_field("preload", default=None)
    rounding: Float[Array, ""] | None = number_field("rounding", default=None)

    def __check_init__(self):
        require_positive(self, "rounding")
        if self.free_radius is not None and self.preload is not None:
            raise ValueError(
                "TyreSpring: give `free_radius` or `preload`, not both: each determines the other "
                "(preload = stiffness · (free_radius − reference height))."
            )

    @property
    def bodies(self):
        return (self.body,)

    preload_shape = ()

    def with_preload(self, preload):
        return dataclasses.replace(self, preload=preload, free_radius=None)

    def loads(self, bodies):
        load = TyreLoad(
            point_b=bodies[self.body].frame.local_point(self.at),
            stiffness=self.stiffness,
            free_radius=self.at[2] if self.free_radius is None else self.free_radius,
            preload=jnp.zeros((), self.at.dtype) if self.preload is None else self.preload,
            road=prepared(self.road),
            rounding=self.rounding,
        )
        return (Attached(load, None, self.body),)


def _one() -> FlatRoad:
    return FlatRoad(height=jnp.ones(()))


class AppliedForce(AbstractForce):
    """A given force on a point of a body and given moments on it, times a signal: s(t) f, s(t) m and s(t) m₀.

    Arguments:
        body: name of the body.
        at: point of application in the reference configuration [m], inertial frame, shape (3,); None: the
            centre of mass.
        force: the force f [N], inertial frame, shape (3,).
        moment: the moment m [N m], body frame, shape (3,), which turns with the body.
        fixed_moment: the moment m₀ [N m], inertial frame, shape (3,), which does not; None: 0.
        signal: the factor s(t) [–], an `AbstractSignal` (default: 1).
        follows: whether the force turns with the body; f is then that in the reference configuration.

    Raises `ValueError` for wrong shapes.
    """

    body: str = eqx.field(static=True)
    at: Float[Array, "3"] | None = point_field("at", default=None)
    force: Float[Array, "3"] = point_field("force", default=(0.0, 0.0, 0.0))
    moment: Float[Array, "3"] = point_field("moment", default=(0.0, 0.0, 0.0))
    fixed_moment: Float[Array, "3"] | None = point_field("fixed_moment", default=None)
    signal: AbstractSignal = signal_field("signal", default_factory=_one)
    follows: bool = eqx.field(static=True, default=False, kw_only=True)

    def with_factor(self, factor):
        return dataclasses.replace(self, signal=Constant(value=factor))

    @property
    def bodies(self):
        return (self.body,)

    def loads(self, bodies):
        frame = bodies[self.body].frame
        kind, force = (FollowingForce, frame.local_axis(self.force)) if self.follows else (PointForce, self.force)
        at = bodies[self.body].position if self.at is None else self.at
        signal = prepared(self.signal)
        if self.fixed_moment is None:
            load = kind(frame.local_point(at), force, self.moment, signal)
        else:
            once = _one()
            parts = kind(frame.local_point(at), force, self.moment, once), FixedMoment(self.fixed_moment, once)
            load = LoadSum(parts, signal)
        return (Attached(load, None, self.body),)
