"""Friction of joints from what they carry: Coulomb's law, regularized, and LuGre's, whose bristles are states.

What a joint does to its body b is the wrench of −Bᵀλ. With C the axes of its frame on a (x along its axis), X_b its
point on b and f, m the force and the moment there along these axes, what the joint carries is

    L² = |f|² + |m|²/ℓ²,     N = N₀ + L²/√(L² + ε²):

a moment loads it like a force at the arm ℓ, half the distance of two ends of a bearing; N is smooth where L = 0, and
(ε/L)²/2 of it less than N₀ + L. With [ẋ, ω] the velocity of that frame in the one on a, surfaces slip by

    w = (ẋ_i, r ω_j):     r ω of a hinge, ẋ of a slider, both of a sleeve, the three r ω_j of a ball,
                          r ω about both arms of a cross, each in the body that it is fixed in,

and a force s(w, N) against w acts on b, along ẋ_i and at the radius r about ω_j. Its power is s·w.

r depends on λ beyond Bᵀλ then, ∂r/∂λ = Bᵀ − ∂Q/∂λ (`AbstractSystem.multiplier_jacobian`): that of the iteration matrix
and of both sweeps. Motion and derivatives stay exact; the start is the solution of equations that are not linear in λ.
"""

import abc
import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens._validate import number_field, require_not_negative, require_positive, suggestion
from lgsens.liegroups import cross
from lgsens.model._constraints import AbstractRows, total
from lgsens.model._forces import AbstractForce, Attached, _frame
from lgsens.model._frames import BODY_DIM, ROTATION, ROTATION_B, TRANSLATION_B, Frame
from lgsens.model._joints import AbstractJoint
from lgsens.model._loads import AbstractDynamicLoad
from lgsens.model._stack import constraint_force

_ROUNDING = 9.81e-3  # m/s²
_SLIPS = "x", "y", "z", "turn_x", "turn_y", "turn_z", "turn_x_b", "turn_y_b", "turn_z_b"


class SlidingFriction(NamedTuple):
    """What rubs at one instant: N [N], shape (), the slip w [m/s] and the force on b against it [N], shape (w,)."""

    load: Float[Array, ""]
    slip: Float[Array, " w"]
    force: Float[Array, " w"]

    __repr__ = brief


class Surface(eqx.Module):
    """Where a joint slips, and how it is loaded."""

    constraints: tuple[AbstractRows, ...]  # of the joint; none: N = N₀
    axes: Float[Array, "3 3"]  # C, in the frame of a
    axes_b: Float[Array, "3 3"] | None  # those of the frame on b, in that of b; None: no slip is about one of them
    point: Float[Array, "3"]  # X_b
    radius: Float[Array, ""] | None
    arm: Float[Array, ""] | None
    preload: Float[Array, ""]
    load_rounding: Float[Array, ""]
    slips: tuple[int, ...] = eqx.field(static=True)

    @property
    def reads(self) -> tuple[int, ...]:
        return tuple(constraint.num_rows for constraint in self.constraints)

    def load(self, a: Frame, b: Frame, t, lam) -> Float[Array, ""]:
        """N."""
        if not self.constraints:
            return self.preload
        own = jnp.split(lam, np.cumsum(self.reads)[:-1])
        carried = total(constraint_force(of, a, b, lam, t) for of, lam in zip(self.constraints, own))
        force = carried[TRANSLATION_B]
        square = jnp.sum(force * force)
        if self.arm is not None:
            moment = (carried[ROTATION_B] - cross(self.point, b.local_axis(force))) / self.arm
            square += jnp.sum(moment * moment)
        return self.preload + square / jnp.sqrt(square + self.load_rounding**2)

    def _along(self, a: Frame, b: Frame):
        """The axes of ẋ, ω and of ω once more, those of b, inertial frame, and ∂w/∂[ẋ, ω, ω], which is constant."""
        one = jnp.ones_like(self.preload)
        scale = jnp.stack([one if i < ROTATION.start or self.radius is None else self.radius for i in self.slips])
        axes = a.orientation @ self.axes
        triads = [axes, axes] if self.axes_b is None else [axes, axes, b.orientation @ self.axes_b]
        return triads, scale[:, None] * np.eye(3 * len(triads), dtype=one.dtype)[list(self.slips)]

    def slip(self, a: Frame, b: Frame, va, vb) -> Float[Array, " w"]:
        (axes, *turning), rows = self._along(a, b)
        speed = lambda frame, v, local: v[: ROTATION.start] + frame.axis(cross(v[ROTATION], local))
        linear = speed(b, vb, self.point) - speed(a, va, a.local_point(b.point(self.point)))
        turn = b.axis(vb[ROTATION]) - a.axis(va[ROTATION])
        return rows @ jnp.concatenate([linear @ axes, *(turn @ triad for triad in turning)])

    def force(self, a: Frame, b: Frame, s) -> Float[Array, "12"]:
        """Q of the force s on b along w."""
        triads, rows = self._along(a, b)
        force, *moments = map(jnp.matmul, triads, jnp.split(s @ rows, len(triads)))
        moment = total(moments)
        on_a = a.local_axis(moment) + cross(a.local_point(b.point(self.point)), a.local_axis(force))
        return jnp.concatenate([-force, -on_a, force, b.local_axis(moment) + cross(self.point, b.local_axis(force))])


class CoulombLoad(AbstractDynamicLoad):
    """s = −(μ N/√(w² + w₀²) + c) w."""

    surface: Surface
    coefficient: Float[Array, ""]
    viscous: Float[Array, ""]
    slip_speed: Float[Array, ""]

    balanced = True
    drawn = None
    states = ()

    @property
    def reads(self):
        return self.surface.reads

    def measure(self, a, b, va, vb, t, *z) -> SlidingFriction:
        load, slip = self.surface.load(a, b, t, *z or (None,)), self.surface.slip(a, b, va, vb)
        per_slip = self.coefficient * load / jnp.sqrt(jnp.sum(slip * slip) + self.slip_speed**2) + self.viscous
        return SlidingFriction(load, slip, -per_slip * slip)

    def force(self, a, b, va, vb, t, *z):
        return self.surface.force(a, b, self.measure(a, b, va, vb, t, *z).force)

    def rate(self, a, b, va, vb, t, *z):
        return jnp.zeros(0, self.coefficient.dtype)

    def initial(self, a, b, va, vb, t):
        return self.rate(a, b, va, vb, t)


class LuGreLoad(AbstractDynamicLoad):
    """s = −N (σ₀ z + σ₁ ż) − c w,  ż = w − σ₀ |w| z/μ(w) with w²/√(w² + w₀²) for |w|."""

    surface: Surface
    coefficient: Float[Array, ""]
    static_coefficient: Float[Array, ""]
    stribeck_speed: Float[Array, ""]
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    viscous: Float[Array, ""]
    slip_speed: Float[Array, ""]

    balanced = True
    drawn = None

    @property
    def states(self):
        return tuple(f"bristle_{_SLIPS[i]}" for i in self.surface.slips)

    @property
    def reads(self):
        return self.surface.reads

    def _bristles(self, a, b, va, vb, z):
        """w, z and ż."""
        w, z = self.surface.slip(a, b, va, vb), z[: len(self.states)]
        square = jnp.sum(w * w)
        speed = square / jnp.sqrt(square + self.slip_speed**2)
        more = (self.static_coefficient - self.coefficient) * jnp.exp(-square / self.stribeck_speed**2)
        return w, z, w - self.stiffness * speed / (self.coefficient + more) * z

    def measure(self, a, b, va, vb, t, z) -> SlidingFriction:
        load = self.surface.load(a, b, t, z[len(self.states) :])
        w, z, rate = self._bristles(a, b, va, vb, z)
        return SlidingFriction(load, w, -load * (self.stiffness * z + self.damping * rate) - self.viscous * w)

    def force(self, a, b, va, vb, t, z):
        return self.surface.force(a, b, self.measure(a, b, va, vb, t, z).force)

    def rate(self, a, b, va, vb, t, z):
        return self._bristles(a, b, va, vb, z)[2]

    def initial(self, a, b, va, vb, t):
        return jnp.zeros(len(self.states), self.stiffness.dtype)

    def size(self, length):
        return jnp.full(len(self.states), self.static_coefficient / self.stiffness)


class _AbstractJointFriction(AbstractForce):
    """Friction in a joint of the model."""

    joint: eqx.AbstractVar[str]
    radius: eqx.AbstractVar[Float[Array, ""] | None]
    arm: eqx.AbstractVar[Float[Array, ""] | None]
    preload: eqx.AbstractVar[Float[Array, ""]]
    load_rounding: eqx.AbstractVar[Float[Array, ""] | None]
    own_forces: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def _load(self, surface: Surface) -> AbstractDynamicLoad:
        """The load, given the surface."""

    @property
    def bodies(self):
        return ()

    def on(self, joints):
        what = type(self).__name__
        if self.joint not in joints:
            raise ValueError(f"{what}: `joint`: {suggestion(self.joint, joints)}.")
        joint = joints[self.joint]
        if not joint.slips:
            raise ValueError(
                f"{what}: `joint` {self.joint!r} is a {type(joint).__name__}, of which no friction is known; it must "
                "be a revolute, prismatic, cylindrical, spherical, universal, planar or screw joint."
            )
        if self.radius is None and any(i >= ROTATION.start for i in joint.slips):
            raise ValueError(f"{what}: `radius` is missing; joint {self.joint!r} turns, give where it rubs [m].")
        return _InJoint(self, joint)

    def loads(self, bodies):
        raise ValueError(f"{type(self).__name__}: ask `on(joints)`, which knows the joint {self.joint!r}, for loads.")


class _InJoint(AbstractForce):
    """Friction and its joint."""

    friction: _AbstractJointFriction
    joint: AbstractJoint

    @property
    def reads(self):
        return self.friction.joint if self.friction.own_forces else None

    @property
    def bodies(self):
        return (self.joint.a, self.joint.b)

    def loads(self, bodies):
        of, joint = self.friction, self.joint
        a, b = (_frame(bodies, name, of.preload.dtype) for name in self.bodies)
        assert joint.frames is not None  # a joint that slips has frames
        (_, axes), (point, axes_b) = joint.frames
        constraints = joint.constraints(a, b) if of.own_forces else ()
        surface = Surface(
            constraints=constraints,
            axes=a.orientation.T @ axes,
            axes_b=b.orientation.T @ axes_b if max(joint.slips) >= BODY_DIM else None,
            point=b.local_point(point),
            radius=of.radius,
            arm=of.arm,
            preload=of.preload,
            load_rounding=self._rounding(bodies) if of.load_rounding is None else of.load_rounding,
            slips=joint.slips,
        )
        return (Attached(of._load(surface), *self.bodies),)

    def _rounding(self, bodies) -> Float[Array, ""]:
        """What is small beside the loads of this joint [N]: an absolute number is none in light mechanisms."""
        return _ROUNDING * functools.reduce(jnp.minimum, (bodies[name].mass for name in self.bodies if name))


class JointFriction(_AbstractJointFriction):
    """Coulomb's and viscous friction in a joint, in proportion to what the joint carries.

        s = −(μ N/√(w² + w₀²) + c) w,     N = N₀ + L²/√(L² + ε²),     L² = |f|² + |m|²/ℓ²

    w is the velocity with which the surfaces slip: that of a slider, r times the angular velocity of a hinge or of a
    ball, both together of a sleeve, both rates of a cross; f and m are the force and the moment that the joint carries
    at its point, λ, in the same instant. All derivatives are continuous. Below w₀ the friction is viscous: what it
    holds creeps.

    Arguments:
        joint: name of the joint: revolute, prismatic, cylindrical, spherical, universal, planar or screw.
        coefficient: μ [–], shape ().
        slip_speed: w₀ [m/s], shape (), > 0: μ N is reached to 1 % at 7 w₀.
        radius: r [m], shape (), > 0, at which a joint that turns rubs.
        arm: ℓ [m], shape (), > 0, half the distance of the two ends of a bearing; None: moments do not load it.
        viscous: c [N s/m], shape ().
        preload: N₀ [N], shape (), of a press fit, say.
        load_rounding: ε [N], shape (), > 0: N is 1 % less than L at L = 7 ε. None: 9.81e-3 m/s² × the lighter mass.
        own_forces: whether N depends on L. N = N₀ goes with every integrator and method, L with GeneralizedAlpha, its
            exact derivatives and Richardson.

    Equations that freed bodies cannot violate carry nothing here (`Trajectory.joint`). `Trajectory.force` gives a
    `SlidingFriction`. Raises `ValueError` for an unknown joint or another one, a missing radius, numbers ≤ 0
    (coefficients < 0), and with `Model(redundant="minimum_norm")`. Sources: Haug, Wu & Yang, Mechanism and Machine
    Theory 21 (1986) 401; Pennestrì, Rossi, Salvini & Valentini, Nonlinear Dynamics 83 (2016),
    doi:10.1007/s11071-015-2485-3.
    """

    joint: str = eqx.field(static=True)
    coefficient: Float[Array, ""] = number_field("coefficient")
    slip_speed: Float[Array, ""] = number_field("slip_speed")
    radius: Float[Array, ""] | None = number_field("radius", default=None)
    arm: Float[Array, ""] | None = number_field("arm", default=None)
    viscous: Float[Array, ""] = number_field("viscous", default=0.0)
    preload: Float[Array, ""] = number_field("preload", default=0.0)
    load_rounding: Float[Array, ""] | None = number_field("load_rounding", default=None)
    own_forces: bool = eqx.field(static=True, default=True, kw_only=True)

    def __check_init__(self):
        require_positive(self, "slip_speed", "radius", "arm", "load_rounding")
        require_not_negative(self, "coefficient", "viscous")

    def _load(self, surface):
        return CoulombLoad(surface, self.coefficient, self.viscous, self.slip_speed)


class LuGreFriction(_AbstractJointFriction):
    """Friction in a joint that sticks: the surfaces touch by bristles, which bend by z before they slip.

        s = −N (σ₀ z + σ₁ ż) − c w,     ż = w − σ₀ |w| z/μ(w),     μ(w) = μ_k + (μ_s − μ_k) exp(−w²/w_s²)

    with N and w of `JointFriction`, and |w| = w²/√(w² + w₀²): all derivatives are continuous. At constant w it is
    −N μ(w) − c w but for (w₀/w)²/2; a joint that is loaded by less than μ_s N stays, on springs of N σ₀.

    Arguments:
        joint, radius, arm, viscous, preload, load_rounding, own_forces: as in `JointFriction`.
        coefficient: μ_k [–] of fast slip, shape (), > 0.
        static_coefficient: μ_s [–] of slow slip, shape (), > 0.
        stribeck_speed: w_s [m/s], shape (), > 0.
        stiffness: σ₀ of the bristles, of 1 N of load [1/m], shape (), > 0.
        damping: σ₁ [s/m], shape ().
        slip_speed: w₀ [m/s], shape (), > 0, well below w_s.

    Its states are "bristle_x", …, "bristle_turn_x", … [m] (`Trajectory.states_of`), zero at the start. Raises
    `ValueError` as `JointFriction` does. Source: Canudas de Wit, Olsson, Åström & Lischinsky (1995),
    doi:10.1109/9.376053.
    """

    joint: str = eqx.field(static=True)
    coefficient: Float[Array, ""] = number_field("coefficient")
    static_coefficient: Float[Array, ""] = number_field("static_coefficient")
    stribeck_speed: Float[Array, ""] = number_field("stribeck_speed")
    stiffness: Float[Array, ""] = number_field("stiffness")
    damping: Float[Array, ""] = number_field("damping", default=0.0)
    slip_speed: Float[Array, ""] = number_field("slip_speed")
    radius: Float[Array, ""] | None = number_field("radius", default=None)
    arm: Float[Array, ""] | None = number_field("arm", default=None)
    viscous: Float[Array, ""] = number_field("viscous", default=0.0)
    preload: Float[Array, ""] = number_field("preload", default=0.0)
    load_rounding: Float[Array, ""] | None = number_field("load_rounding", default=None)
    own_forces: bool = eqx.field(static=True, default=True, kw_only=True)

    def __check_init__(self):
        names = "coefficient", "static_coefficient", "stribeck_speed", "stiffness"
        require_positive(self, *names, "slip_speed", "radius", "arm", "load_rounding")

    def _load(self, surface):
        numbers = self.coefficient, self.static_coefficient, self.stribeck_speed, self.stiffness, self.damping
        return LuGreLoad(surface, *numbers, self.viscous, self.slip_speed)
