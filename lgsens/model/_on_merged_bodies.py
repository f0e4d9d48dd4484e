"""Elements on a part of a body, as elements on the body itself.

The frame of a part is x_p = x + R c, R_p = R C with the constant pose (c, C) of the part in its body, so a point X of
the part is c + C X in the body, axes e are C e, a tensor K is C K Cᵀ. Elements that say what of them is fixed to
bodies are rewritten, and cost no more than on the body itself; others see the frame of the part, and what they do to it
is brought back by the transpose of

    [ẋ_p, Ω_p] = [ẋ + R (Ω × c), Cᵀ Ω],     so     [F, M] = [F_p, C M_p + c × Rᵀ F_p].
"""

import dataclasses
from typing import Any

import jax.numpy as jnp

from lgsens.liegroups import cross, turn, turn_back
from lgsens.model._constraints import AbstractConstraint, AbstractVelocityConstraint
from lgsens.model._elements import AbstractElement, fixed_fields
from lgsens.model._frames import BODY_A, BODY_B, ROTATION, Frame
from lgsens.model._loads import AbstractDynamicLoad, AbstractLoad

# How what is fixed to a part is fixed to its body.
_SEEN = {
    "point": Frame.point,
    "axis": Frame.axis,
    "axes": lambda part, columns: part.orientation @ columns,
    "tensor": lambda part, tensor: part.orientation @ tensor @ part.orientation.T,
}


def carried(
    element: AbstractElement, a: Frame | None, b: Frame | None, *others: Frame | None, by_frames: bool = False
) -> Any:
    """A constraint or load between two parts as one between their bodies; `a`, `b`, `others`: the poses of the parts.

    `by_frames`: by the frames of the parts, whatever the element says of its numbers.
    """
    if all(part is None for part in (a, b, *others)):
        return element
    if others:
        assert isinstance(element, AbstractConstraint)
        return _CarriedConstraint(element, a, b, others)
    fields = fixed_fields(element)
    if by_frames or not fields:
        kinds = {
            AbstractConstraint: _CarriedConstraint,
            AbstractVelocityConstraint: _CarriedVelocityConstraint,
            AbstractDynamicLoad: _CarriedDynamicLoad,
        }
        kind: Any = next((kinds[base] for base in kinds if isinstance(element, base)), _CarriedLoad)
        return kind(element, a, b)
    parts = {"a": a, "b": b}
    known = [(name, kind, part) for name, (kind, body) in fields.items() if (part := parts[body]) is not None]
    return dataclasses.replace(
        element, **{name: _SEEN[kind](part, getattr(element, name)) for name, kind, part in known}
    )


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
    others: tuple[Frame | None, ...] = ()

    @property
    def num_rows(self):
        return self.element.num_rows

    @property
    def relative(self):
        return self.element.relative

    @property
    def acts_on(self):
        return self.element.acts_on

    @property
    def driven(self):
        return self.element.driven

    def branch(self, a, b, *others):
        return self.element.branch(_frame(a, self.a), _frame(b, self.b), *map(_frame, others, self.others))

    def value(self, a, b, t, *others):
        return self.element.value(_frame(a, self.a), _frame(b, self.b), t, *map(_frame, others, self.others))


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


def _of_parts(load, a, b, va, vb):
    return _frame(a, load.a), _frame(b, load.b), _velocity(a, va, load.a), _velocity(b, vb, load.b)


def _carried_force(load, a, b, va, vb, *others):
    of_parts = load.element.force(*_of_parts(load, a, b, va, vb), *others)
    return jnp.concatenate([_force(a, of_parts[BODY_A], load.a), _force(b, of_parts[BODY_B], load.b)])


class _CarriedLoad(AbstractLoad):
    element: AbstractLoad
    a: Frame | None
    b: Frame | None

    def force(self, a, b, va, vb, t):
        return _carried_force(self, a, b, va, vb, t)

    def branch(self, a, b):
        return self.element.branch(_frame(a, self.a), _frame(b, self.b))

    def measure(self, a, b, va, vb, t):
        return self.element.measure(*_of_parts(self, a, b, va, vb), t)


class _CarriedDynamicLoad(AbstractDynamicLoad):
    element: AbstractDynamicLoad
    a: Frame | None
    b: Frame | None

    @property
    def states(self):
        return self.element.states

    @property
    def reads(self):
        return self.element.reads

    def force(self, a, b, va, vb, t, z):
        return _carried_force(self, a, b, va, vb, t, z)

    def rate(self, a, b, va, vb, t, z):
        return self.element.rate(*_of_parts(self, a, b, va, vb), t, z)

    def initial(self, a, b, va, vb, t):
        return self.element.initial(*_of_parts(self, a, b, va, vb), t)

    def size(self, length):
        return self.element.size(length)

    def measure(self, a, b, va, vb, t, z):
        return self.element.measure(*_of_parts(self, a, b, va, vb), t, z)
