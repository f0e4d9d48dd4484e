"""Forces of hinges and vehicles: torsion springs and motors, anti-roll bars, stops, contact, drag."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import (
    axis_field,
    number_field,
    point_field,
    require,
    require_not_negative,
    require_positive,
    require_setting,
)
from lgsens.liegroups import SO3
from lgsens.model._contacts import PlaneContactLoad
from lgsens.model._curves import CurveLoad
from lgsens.model._forces import AbstractConnection, AbstractForce, Attached, _distance
from lgsens.model._frames import normals
from lgsens.model._signal_fields import prescribed_field
from lgsens.model._signals import AbstractSignal, Prescribed, prepared
from lgsens.model._turning_loads import BallLoad, DragLoad, TorsionLoad
from lgsens.model._turns import CountedTurns, require_half_a_turn, within_half_a_turn


def _torsion(a, b, force, stiffness, free_angle=None, preload=None, motor=None) -> TorsionLoad:
    _, first, second = normals(force.axis)
    axes = a.local_axis(first), a.local_axis(second), b.local_axis(first)
    angle, moment = (jnp.zeros((), first.dtype) if value is None else value for value in (free_angle, preload))
    return TorsionLoad(*axes, stiffness, force.damping, angle, moment, motor)


class TorsionSpringDamper(AbstractConnection):
    """Spring, damper and motor about a hinge axis: the moment M(t) − M₀ − k (θ − θ₀) − c θ̇ on b, its opposite on a.

    θ is the angle by which `b` has turned about the axis, fixed in `a`, since the reference configuration. A hinge
    keeps the axes of both bodies aligned.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        axis: direction of the axis in the reference configuration, inertial frame, shape (3,), any length > 0.
        stiffness: k [N m/rad], shape ().
        damping: c [N m s/rad], shape ().
        free_angle: θ₀, at which the spring is free [rad], shape (); within half a turn unless `turns` are counted.
        preload: the moment M₀ that turns b back in the reference configuration [N m], shape (). θ₀ is then 0.
        motor: the moment M(t) on b [N m], a number, shape (), or a signal; None: no motor.
        turns: whether whole turns are counted, as a clock spring needs it, by a state "angle" (`Trajectory.states_of`),
            static. Else θ is within half a turn of θ₀, where the moment of the spring jumps, and a motion that comes
            there has failed; without a spring it does not matter.

    Give `free_angle` or `preload`, not both. `Trajectory.force` gives the angle [rad], its rate [rad/s] and the moment
    on b [N m]. Raises `ValueError` for both, a larger `free_angle`, a zero axis, or wrong shapes. Source: Haug (1989),
    chapter 6 (rotational spring-damper-actuator).
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    axis: Float[Array, "3"] = axis_field("axis")
    stiffness: Float[Array, ""] = number_field("stiffness", default=0.0)
    damping: Float[Array, ""] = number_field("damping", default=0.0)
    free_angle: Float[Array, ""] | None = number_field("free_angle", default=None)
    preload: Float[Array, ""] | None = number_field("preload", default=None)
    motor: Prescribed | None = prescribed_field("motor")
    turns: bool = eqx.field(static=True, default=False, kw_only=True)

    def __check_init__(self):
        require_setting(self, "turns", isinstance(self.turns, bool), "True or False")
        if self.free_angle is not None and self.preload is not None:
            raise ValueError(
                "TorsionSpringDamper: give `free_angle` or `preload`, not both: each determines the other "
                "(preload = −stiffness · free_angle)."
            )
        if self.free_angle is not None and not self.turns:
            require_half_a_turn("TorsionSpringDamper", "free_angle", self.free_angle)

    @property
    def about(self):
        return self.axis

    preload_shape = ()

    def with_preload(self, preload):
        return dataclasses.replace(self, preload=preload, free_angle=None)

    def load(self, a, b):
        motor = None if self.motor is None else prepared(self.motor)
        free = self.free_angle if self.free_angle is None or self.turns else within_half_a_turn(self.free_angle)
        load = _torsion(a, b, self, self.stiffness, free, self.preload, motor)
        return CountedTurns(load) if self.turns else load


class RotationalSpringDamper(AbstractConnection):
    """Spring and damper against all rotations between two bodies, of a ball joint say: the moment −k φ − c ω on b.

    φ is the rotation vector of `b` in `a`, |φ| < π, and ω their relative angular velocity. A `Bushing` has a stiffness
    about each of three axes.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        stiffness: k [N m/rad], shape ().
        damping: c [N m s/rad], shape ().
        turned: φ in the reference configuration [rad], inertial frame, shape (3,), |φ| ≤ π.

    Raises `ValueError` for wrong shapes and a larger φ. Source: that of a ball joint in MuJoCo ("Computation": passive
    forces); φ and its energy: Géradin & Cardona, Flexible Multibody Dynamics (2001), ch. 4.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    stiffness: Float[Array, ""] = number_field("stiffness", default=0.0)
    damping: Float[Array, ""] = number_field("damping", default=0.0)
    turned: Float[Array, "3"] = point_field("turned", default=(0.0, 0.0, 0.0))

    def __check_init__(self):
        require_half_a_turn("RotationalSpringDamper", "turned", self.turned)

    def load(self, a, b):
        triad_b = b.orientation.T @ SO3().exp(within_half_a_turn(self.turned))
        return BallLoad(a.orientation.T, triad_b, self.stiffness, self.damping)


class AntiRollBar(AbstractConnection):
    """A round bar that is twisted between two bodies: the moment −k θ − c θ̇ on b, k = π G (d⁴ − d_i⁴)/(32 L).

    θ is the angle by which `b` has turned about the bar, fixed in `a`, seen from `a` since the reference configuration;
    within half a turn. The bodies are its two arms, or what turns with them. A bar of given rate, or preloaded, is a
    `TorsionSpringDamper`.

    Arguments:
        a, b: names of the bodies at its two ends.
        axis: direction of the bar in the reference configuration, inertial frame, shape (3,), any length > 0.
        diameter: d [m], shape (), > bore.
        length: L, what is twisted of it [m], shape (), > 0.
        bore: d_i of a tube [m], shape (), ≥ 0.
        shear_modulus: G [Pa], shape (), > 0; that of spring steel.
        damping: c [N m s/rad], shape ().

    `Trajectory.force` gives the angle [rad], its rate [rad/s] and the moment on b [N m]. Raises `ValueError` for a
    wrong shape, a zero axis, or dimensions that no bar has. Source: Milliken & Milliken, Race Car Vehicle Dynamics
    (1995), chapter 21.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    axis: Float[Array, "3"] = axis_field("axis")
    diameter: Float[Array, ""] = number_field("diameter")
    length: Float[Array, ""] = number_field("length")
    bore: Float[Array, ""] = number_field("bore", default=0.0)
    shear_modulus: Float[Array, ""] = number_field("shear_modulus", default=79.3e9)
    damping: Float[Array, ""] = number_field("damping", default=0.0)

    def __check_init__(self):
        require(
            lambda d, bore, length, modulus: d > bore >= 0 and length > 0 and modulus > 0,
            f"AntiRollBar: need `diameter` > `bore` ≥ 0, `length` > 0 and `shear_modulus` > 0, got {self.diameter} m, "
            f"{self.bore} m, {self.length} m and {self.shear_modulus} Pa.",
            self.diameter,
            self.bore,
            self.length,
            self.shear_modulus,
        )

    @property
    def about(self):
        return self.axis

    def load(self, a, b):
        section = jnp.pi * (self.diameter**4 - self.bore**4) / 32.0
        return _torsion(a, b, self, self.shear_modulus * section / self.length)


class StopCurve(AbstractSignal):
    """Tension over extension: −F(x) of a stop in compression, F(x) of one in extension, x what it is squeezed by."""

    gap: Float[Array, ""]
    stiffness: Float[Array, ""]
    rounding: Float[Array, ""]
    progression: Float[Array, ""] | None
    rebound: bool = eqx.field(static=True)

    def __call__(self, t):
        sign = 1.0 if self.rebound else -1.0
        x = jnp.maximum(sign * t - self.gap, 0.0)
        force = self.stiffness * x**3 / (x**2 + self.rounding**2)
        if self.progression is not None:
            force *= 1.0 + (x / self.progression) ** 2
        return sign * force


class BumpStop(AbstractConnection):
    """A stop between two points, which pushes them apart once they have come closer by a gap.

        F = k x³/(x² + w²) (1 + x²/p²),     x = max(0, ℓ₀ − ℓ − gap)

    with the distance ℓ of the points and ℓ₀ in the reference configuration. Two derivatives of F are continuous; the
    rate grows from 0 to k within some w, and goes on growing over p.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at_a, at_b: the points in the reference configuration [m], inertial frame, shape (3,), apart.
        gap: [m], shape (); negative where the stop is squeezed in the reference configuration.
        stiffness: k [N/m], shape ().
        rounding: w [m], shape (), > 0.
        progression: p [m], shape (), > 0; None: not progressive, the second factor is 1.
        rebound: whether it is a rebound stop, which pulls the points together: x = max(0, ℓ − ℓ₀ − gap).

    `Trajectory.force` gives its `LineForce`, of negative tension where it pushes. Raises `ValueError` for wrong shapes,
    a rounding or progression ≤ 0, a stiffness < 0, or points that coincide. Source, of what it is for: Blundell &
    Harty, The Multibody Systems Approach to Vehicle Dynamics (2004), chapter 4; the formula is of this library.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: Float[Array, "3"] = point_field("at_a")
    at_b: Float[Array, "3"] = point_field("at_b")
    gap: Float[Array, ""] = number_field("gap")
    stiffness: Float[Array, ""] = number_field("stiffness")
    rounding: Float[Array, ""] = number_field("rounding")
    progression: Float[Array, ""] | None = number_field("progression", default=None)
    rebound: bool = eqx.field(static=True, default=False, kw_only=True)

    def __check_init__(self):
        require_positive(self, "rounding", "progression")
        require_not_negative(self, "stiffness")
        require(
            lambda a, b: (a != b).any(),
            f"BumpStop: `at_a` and `at_b` coincide at {self.at_a}, so the stop has no direction; move one end.",
            self.at_a,
            self.at_b,
        )

    def load(self, a, b):
        curve = StopCurve(self.gap, self.stiffness, self.rounding, self.progression, self.rebound)
        points, length = (a.local_point(self.at_a), b.local_point(self.at_b)), _distance(self.at_a, self.at_b)
        return CurveLoad(*points, curve, None, length, jnp.zeros_like(length))


class PlaneContact(AbstractConnection):
    """A point of `b` on a plane of `a`, into which it may be pressed and from which it may lift off.

        F = k ⌈x⌉_w ⌈1 + c ẋ⌉_½  along the normal,     x how far it is in the plane

    with ⌈x⌉_w = max(x, 0) but for |x| < w, where it passes from one to the other with two continuous derivatives. So
    two of F are continuous; F grows while the point goes in, is less while it comes out, and never pulls.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: the point of `b` in the reference configuration [m], inertial frame, shape (3,).
        axis: normal of the plane, which turns with `a`, out of it, inertial frame, shape (3,), any length > 0.
        gap: distance of the point from the plane there [m], shape (); negative where it is pressed into it.
        stiffness: k [N/m], shape ().
        rounding: w [m], shape (), > 0.
        damping: c [s/m], shape (): of a speed v ≪ 1/c about the part 2 c v/3 is lost in an impact.
        coefficient: μ of friction [–], shape (), the force μ F u/√(u² + u₀²) against the slip u; None: none.
        slip_speed: u₀ [m/s], shape (), > 0, given with `coefficient`.

    An impact takes about π √(m/k), of which a step may be a small part only: in steps as long as it a point may leave
    faster than it came, which `certify` says. `AdaptiveSteps` finds such steps.

    `Trajectory.force` gives F [N]. Raises `ValueError` for wrong shapes, a zero axis, a rounding or speed ≤ 0, other
    numbers < 0, and one of coefficient and speed without the other. Source: Hunt & Crossley (1975),
    doi:10.1115/1.3423596.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axis: Float[Array, "3"] = axis_field("axis")
    gap: Float[Array, ""] = number_field("gap", default=0.0)
    stiffness: Float[Array, ""] = number_field("stiffness")
    rounding: Float[Array, ""] = number_field("rounding")
    damping: Float[Array, ""] = number_field("damping", default=0.0)
    coefficient: Float[Array, ""] | None = number_field("coefficient", default=None)
    slip_speed: Float[Array, ""] | None = number_field("slip_speed", default=None)

    def __check_init__(self):
        require_positive(self, "rounding", "slip_speed")
        require_not_negative(self, "stiffness", "damping", "coefficient")
        if (self.coefficient is None) != (self.slip_speed is None):
            raise ValueError("PlaneContact: give both `coefficient` and `slip_speed`, or neither.")

    def load(self, a, b):
        unit = self.axis / jnp.linalg.norm(self.axis)
        places = a.local_point(self.at - self.gap * unit), a.local_axis(unit), b.local_point(self.at)
        numbers = self.stiffness, self.damping, self.rounding, self.coefficient, self.slip_speed
        return PlaneContactLoad(*places, *numbers)


class Drag(AbstractForce):
    """Drag of the air on a point of a body: F = −½ ρ A |u| u, u the velocity of the point less that of the wind.

    Arguments:
        body: name of the body.
        at: the point in the reference configuration [m], inertial frame, shape (3,); None: the centre of mass.
        drag_area: A = c_d · frontal area [m²], shape (), the same in all directions.
        density: ρ [kg/m³], shape ().
        wind: [m/s], inertial frame, shape (3,).

    Its derivatives are continuous, its second ones but for u = 0. Raises `ValueError` for wrong shapes, and
    a drag area or density < 0. Source: Hoerner, Fluid-Dynamic Drag (1965), chapter 1.
    """

    body: str = eqx.field(static=True)
    at: Float[Array, "3"] | None = point_field("at", default=None)
    drag_area: Float[Array, ""] = number_field("drag_area")
    density: Float[Array, ""] = number_field("density", default=1.225)
    wind: Float[Array, "3"] = point_field("wind", default=(0.0, 0.0, 0.0))

    def __check_init__(self):
        require_not_negative(self, "drag_area", "density")

    @property
    def bodies(self):
        return (self.body,)

    def loads(self, bodies):
        body = bodies[self.body]
        point = body.frame.local_point(body.position if self.at is None else self.at)
        return (Attached(DragLoad(point, 0.5 * self.density * self.drag_area, self.wind), None, self.body),)
