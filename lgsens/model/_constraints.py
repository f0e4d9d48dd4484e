"""The basic constraints from which joints are made, with closed-form tangents.

Haug's basic constraints (Computer Aided Kinematics and Dynamics of Mechanical Systems, 1989, §9.4):
coincidence of points, orthogonality of two body-fixed axes (dot-1), orthogonality of an axis and the
line between two points (dot-2), and distance of points. Every joint is a sum of these, so a scene
with joints of many types still has at most four kernels.

An element holds numbers only (no names): elements of one type are stacked and evaluated together.
"""

import abc
import dataclasses
from collections.abc import Iterable, Set
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.liegroups import cross, skew
from lgsens.model._elements import AbstractElement, body_fixed
from lgsens.model._frames import (
    ALL,
    ROTATION_A,
    ROTATION_B,
    TURNING_A,
    TURNING_B,
    Frame,
    embedded,
    separation,
    separation_force,
    separation_stiffness,
)
from lgsens.model._free import ROTATIONS, TRANSLATIONS
from lgsens.model._signals import Prescribed, at_time, number_of


class AbstractRows(AbstractElement):
    """Equations between the frames of two bodies, of one level."""

    num_rows: ClassVar[Any] = property(abc.abstractmethod(lambda self: ...))
    """Number of scalar equations, an attribute of the class or a property."""

    relative: ClassVar[Any] = False
    """Whether Φ depends on nothing but t and the pose of one body as seen from the other, as in a joint: it then takes
    as many directions from either body while the other one is held, which the linear solver makes use of."""

    coupled: ClassVar[Any] = (ALL,)
    """Disjoint sets of the coordinates [x_a, θ_a, x_b, θ_b], 0 … 11: the stiffness D_q(Bᵀλ) is zero but for the square
    block of each, and these alone are added to K_t."""

    @property
    def turning(self) -> bool:
        """Whether it is about orientations only."""
        return {*self.acts_on} <= {*TURNING_A, *TURNING_B}

    def here(self, a: Frame, b: Frame) -> "AbstractRows":
        """The same with what it prescribes as it is at these poses, where its equations hold: its forces there."""
        return self

    def violable(self, free: Set[str]) -> tuple[bool, ...]:
        """Which of its equations change where its bodies have these degrees of freedom, one rotation at most, and the
        reference configuration satisfies them all. The others are left out: their rows of B would be zero."""
        return (True,) * self.num_rows


class AbstractConstraint(AbstractRows):
    """A constraint on the frames of two bodies; its tangents come from autodiff."""

    @abc.abstractmethod
    def value(self, a: Frame, b: Frame, t) -> Float[Array, " rows"]:
        """Φ at the given poses and time [s], zero when satisfied."""

    def deviation(self, a: Frame, b: Frame, t) -> Float[Array, " rows"]:
        """By how much what it prescribes is exceeded, in its unit, far from Φ = 0 too."""
        return self.value(a, b, t)


class AbstractVelocityConstraint(AbstractRows):
    """A constraint on the velocities of two bodies that no constraint on their frames says (nonholonomic)."""

    @abc.abstractmethod
    def rate(self, a: Frame, b: Frame, va, vb, t) -> Float[Array, " rows"]:
        """A v + b at the given poses, velocities [ẋ, Ω] of shape (6,) each, and time [s]: affine in the velocities."""


class AbstractClosedFormConstraint(AbstractConstraint):
    """A constraint that brings its own tangents."""

    @abc.abstractmethod
    def jacobian(self, a: Frame, b: Frame, t) -> Float[Array, "rows 12"]:
        """B with δΦ = B [δx_a, δθ_a, δx_b, δθ_b]."""

    @abc.abstractmethod
    def force(self, a: Frame, b: Frame, lam, t) -> Float[Array, "12"]:
        """Bᵀ λ, without B."""

    @abc.abstractmethod
    def geometric_stiffness(self, a: Frame, b: Frame, lam, t) -> Float[Array, "12 12"]:
        """D_q(Bᵀ λ) at fixed λ: what the constraint adds to K_t."""


class Coincidence(AbstractClosedFormConstraint):
    """Two body-fixed points coincide: Φ = x_b + R_b X_b − x_a − R_a X_a; λ is the force of b on a [N]."""

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))

    num_rows = 3
    relative = True
    coupled = (TURNING_A, TURNING_B)

    def violable(self, free):
        # x_b + R_b X_b − x_a − R_a X_a changes along the axis of a rotation by translation only
        return tuple(TRANSLATIONS[i] in free or bool(free & {*ROTATIONS} - {ROTATIONS[i]}) for i in range(3))

    def value(self, a, b, t):
        return b.point(self.point_b) - a.point(self.point_a)

    def jacobian(self, a, b, t):
        return separation(a, b, self.point_a, self.point_b)[1]

    def force(self, a, b, lam, t):
        return separation_force(a, b, self.point_a, self.point_b, lam)

    def geometric_stiffness(self, a, b, lam, t):
        return separation_stiffness(a, b, self.point_a, self.point_b, lam)


class Orthogonality(AbstractClosedFormConstraint):
    """Two body-fixed axes stay orthogonal: Φ = α·β with α = R_a e_a, β = R_b e_b; λ is a moment [N m].

    δα = −R_a ẽ_a δθ_a gives B = [0, −βᵀR_a ẽ_a, 0, −αᵀR_b ẽ_b], that is Bᵀλ = λ [0, ẽ_a R_aᵀβ, 0, ẽ_b R_bᵀα].
    With δ(R_aᵀβ) = (R_aᵀβ)~ δθ_a − R_aᵀR_b ẽ_b δθ_b the geometric stiffness is
    λ [[ẽ_a (R_aᵀβ)~, −ẽ_a R_aᵀR_b ẽ_b], [−ẽ_b R_bᵀR_a ẽ_a, ẽ_b (R_bᵀα)~]] on the rotations.
    """

    axis_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))
    axis_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "b"))

    num_rows = 1
    relative = True
    acts_on = TURNING_A + TURNING_B

    @property
    def coupled(self):
        return (self.acts_on,)

    drawn = None

    def violable(self, free):
        return (bool(free & {*ROTATIONS}),)

    def value(self, a, b, t):
        return jnp.sum(a.axis(self.axis_a) * b.axis(self.axis_b))[None]

    def _row(self, a, b):
        zero = jnp.zeros(3, self.axis_a.dtype)
        row_a = cross(self.axis_a, a.local_axis(b.axis(self.axis_b)))
        row_b = cross(self.axis_b, b.local_axis(a.axis(self.axis_a)))
        return jnp.concatenate([zero, row_a, zero, row_b])

    def jacobian(self, a, b, t):
        return self._row(a, b)[None, :]

    def force(self, a, b, lam, t):
        return self._row(a, b) * lam[0]

    def geometric_stiffness(self, a, b, lam, t):
        e_a, e_b = skew(self.axis_a), skew(self.axis_b)
        coupling = e_a @ (a.orientation.T @ b.orientation) @ e_b
        own_a, own_b = e_a @ skew(a.local_axis(b.axis(self.axis_b))), e_b @ skew(b.local_axis(a.axis(self.axis_a)))
        # −ẽ_b R_bᵀR_a ẽ_a is the transpose of −ẽ_a R_aᵀR_b ẽ_b
        stiffness = (
            embedded(own_a, ROTATION_A, ROTATION_A)
            - embedded(coupling, ROTATION_A, ROTATION_B)
            - embedded(coupling.T, ROTATION_B, ROTATION_A)
            + embedded(own_b, ROTATION_B, ROTATION_B)
        )
        return stiffness * lam[0]


class InPlane(AbstractClosedFormConstraint):
    """The line between two points stays orthogonal to an axis of a: Φ = α·d, α = R_a e_a; λ is a force [N].

    d and D as in `separation`. B = dᵀ(∂α) + αᵀD with ∂α = −R_a ẽ_a on δθ_a, and
    D_q(Bᵀλ) = λ (ẽ_a (R_aᵀd)~ + (∂α)ᵀD + Dᵀ(∂α) + D_q(Dᵀα)|_α), the first term on (δθ_a, δθ_a).
    """

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    axis_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("axis", "a"))

    num_rows = 1
    relative = True
    drawn = None

    def value(self, a, b, t):
        return jnp.sum(a.axis(self.axis_a) * (b.point(self.point_b) - a.point(self.point_a)))[None]

    def _axis_gradient(self, a):
        return embedded(-a.orientation @ skew(self.axis_a), None, ROTATION_A)

    def jacobian(self, a, b, t):
        d, gradient = separation(a, b, self.point_a, self.point_b)
        return (d @ self._axis_gradient(a) + a.axis(self.axis_a) @ gradient)[None, :]

    def force(self, a, b, lam, t):
        d = b.point(self.point_b) - a.point(self.point_a)
        along = separation_force(a, b, self.point_a, self.point_b, a.axis(self.axis_a))
        zero = jnp.zeros(3, d.dtype)
        turning = jnp.concatenate([zero, cross(self.axis_a, a.local_axis(d)), zero, zero])
        return (along + turning) * lam[0]

    def geometric_stiffness(self, a, b, lam, t):
        d, gradient = separation(a, b, self.point_a, self.point_b)
        cross = self._axis_gradient(a).T @ gradient
        stiffness = cross + cross.T
        stiffness += embedded(skew(self.axis_a) @ skew(a.local_axis(d)), ROTATION_A, ROTATION_A)
        stiffness += separation_stiffness(a, b, self.point_a, self.point_b, a.axis(self.axis_a))
        return stiffness * lam[0]


class ConstraintSum(AbstractClosedFormConstraint):
    """A sum of constraints of one row each, less a prescribed s: Φ = Σ Φ_i − s(t); λ is that of each of them."""

    parts: tuple[AbstractClosedFormConstraint, ...]
    prescribed: Prescribed | None = None

    drawn = None
    num_rows = 1

    @property
    def relative(self):
        return self.prescribed is None

    @property
    def acts_on(self):
        return self.parts[0].acts_on

    @property
    def coupled(self):
        return self.parts[0].coupled

    @property
    def driven(self):
        return number_of(self.prescribed)

    def violable(self, free):
        return self.parts[0].violable(free)

    def value(self, a, b, t):
        value = total(part.value(a, b, t) for part in self.parts)
        return value if self.prescribed is None else value - at_time(self.prescribed, t)

    def jacobian(self, a, b, t):
        return total(part.jacobian(a, b, t) for part in self.parts)

    def force(self, a, b, lam, t):
        return total(part.force(a, b, lam, t) for part in self.parts)

    def geometric_stiffness(self, a, b, lam, t):
        return total(part.geometric_stiffness(a, b, lam, t) for part in self.parts)


def total(parts: Iterable[Array]) -> Any:
    """The sum of one array or more."""
    first, *others = parts
    return sum(others, first)


class Distance(AbstractClosedFormConstraint):
    """Two body-fixed points keep their distance: Φ = (d·d/L − L)/2; λ is the tension of the rod [N].

    Where Φ = 0 it has the derivatives of |d| − L, and no root: the start differentiates Φ four times, which for |d| is
    a third of what a gradient with one rod compiles. With n = d/L: B = nᵀD and D_q(Bᵀλ) = λ (DᵀD/L + D_q(Dᵀn)|_n).
    """

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    length: Prescribed

    num_rows = 1
    relative = True
    drawn = "link"

    @property
    def driven(self):
        return number_of(self.length)

    def here(self, a, b):
        return dataclasses.replace(self, length=jnp.linalg.norm(b.point(self.point_b) - a.point(self.point_a)))

    def deviation(self, a, b, t):
        return (at_time(self.here(a, b).length, t) - at_time(self.length, t))[None]

    def value(self, a, b, t):
        d, length = b.point(self.point_b) - a.point(self.point_a), at_time(self.length, t)
        return (0.5 * (jnp.sum(d * d) / length - length))[None]

    def jacobian(self, a, b, t):
        d, gradient = separation(a, b, self.point_a, self.point_b)
        return ((d / at_time(self.length, t)) @ gradient)[None, :]

    def force(self, a, b, lam, t):
        d = b.point(self.point_b) - a.point(self.point_a)
        return separation_force(a, b, self.point_a, self.point_b, d * (lam[0] / at_time(self.length, t)))

    def geometric_stiffness(self, a, b, lam, t):
        d, gradient = separation(a, b, self.point_a, self.point_b)
        tension = lam[0] / at_time(self.length, t)
        return tension * (gradient.T @ gradient) + separation_stiffness(a, b, self.point_a, self.point_b, tension * d)
