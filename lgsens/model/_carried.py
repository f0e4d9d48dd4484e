"""Elements on a part of a body, as elements on the body itself.

The frame of a part is x_p = x + R c, R_p = R C with the constant pose (c, C) of the part in its body, so a point X of
the part is c + C X in the body, an axis e is C e. Elements made of points and axes are rewritten, and cost no more than
on the body itself; others see the frame of the part, and what they do to it is brought back by the transpose of

    [ẋ_p, Ω_p] = [ẋ + R (Ω × c), Cᵀ Ω],     so     [F, M] = [F_p, C M_p + c × Rᵀ F_p].
"""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp

from lgsens.liegroups import cross, turn, turn_back
from lgsens.model._constraints import (
    AbstractConstraint,
    AbstractRows,
    AbstractVelocityConstraint,
    Coincidence,
    Distance,
    InPlane,
    Orthogonality,
)
from lgsens.model._frames import BODY_A, BODY_B, ROTATION, Frame
from lgsens.model._loads import AbstractLoad, PointForce, SpringDamperLoad, TyreLoad

Element = TypeVar("Element", AbstractRows, AbstractLoad)


def carried_constraint(element: AbstractRows, a: Frame | None, b: Frame | None) -> AbstractRows:
    """A constraint between two parts as one between their bodies; `a`, `b`: the poses of the parts there."""
    if a is None and b is None:
        return element
    if isinstance(element, AbstractVelocityConstraint):
        return _CarriedVelocityConstraint(element, a, b)
    if isinstance(element, Coincidence | Distance | InPlane | Orthogonality):
        return _rewritten(element, a, b)
    assert isinstance(element, AbstractConstraint)
    return _CarriedConstraint(element, a, b)


def carried_load(element: AbstractLoad, a: Frame | None, b: Frame | None) -> AbstractLoad:
    """The same of a load."""
    if a is None and b is None:
        return element
    made_of_points = isinstance(element, PointForce | SpringDamperLoad | TyreLoad)
    return _rewritten(element, a, b) if made_of_points else _CarriedLoad(element, a, b)


def _rewritten(element: Element, a: Frame | None, b: Frame | None) -> Element:
    """An element whose points and axes, and moments fixed to b, are those of the bodies."""
    places = [(name, end, Frame.point) for name, end in (("point_a", a), ("point_b", b))]
    places += [(name, end, Frame.axis) for name, end in (("axis_a", a), ("axis_b", b), ("moment", b))]
    for name, end, function in places:
        if end is not None and hasattr(element, name):
            new = function(end, getattr(element, name))
            element = eqx.tree_at(lambda e, name=name: getattr(e, name), element, new)
    return element


def _frame(body: Frame, part: Frame | None) -> Frame:
    if part is None:
        return body
    return Frame(body.point(part.position), body.orientation @ part.orientation)


def _velocity(body: Frame, v, part: Frame | None):
    if part is None:
        return v
    spin = v[ROTATION]
    return jnp.concatenate(
        [v[: ROTATION.start] + body.axis(cross(spin, part.position)), turn_back(part.orientation, spin)]
    )


def _force(body: Frame, force, part: Frame | None):
    if part is None:
        return force
    f, moment = force[: ROTATION.start], force[ROTATION]
    return jnp.concatenate([f, turn(part.orientation, moment) + cross(part.position, body.local_axis(f))])


class _CarriedConstraint(AbstractConstraint):
    element: AbstractConstraint
    a: Frame | None
    b: Frame | None

    @property
    def num_rows(self):
        return self.element.num_rows

    @property
    def relative(self):
        return self.element.relative

    @property
    def acts_on(self):
        return self.element.acts_on

    def value(self, a, b, t):
        return self.element.value(_frame(a, self.a), _frame(b, self.b), t)


class _CarriedVelocityConstraint(AbstractVelocityConstraint):
    element: AbstractVelocityConstraint
    a: Frame | None
    b: Frame | None

    @property
    def num_rows(self):
        return self.element.num_rows

    def rate(self, a, b, va, vb, t):
        frames = _frame(a, self.a), _frame(b, self.b)
        return self.element.rate(*frames, _velocity(a, va, self.a), _velocity(b, vb, self.b), t)


class _CarriedLoad(AbstractLoad):
    element: AbstractLoad
    a: Frame | None
    b: Frame | None

    def force(self, a, b, va, vb, t):
        of_parts = self.element.force(
            _frame(a, self.a), _frame(b, self.b), _velocity(a, va, self.a), _velocity(b, vb, self.b), t
        )
        return jnp.concatenate([_force(a, of_parts[BODY_A], self.a), _force(b, of_parts[BODY_B], self.b)])
