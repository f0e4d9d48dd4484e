"""A force element times a number: on the way from a scene with it to one without, or to one in which it is rigid."""

from typing import Any

import jax
from jaxtyping import Array, Float

from lgsens._validate import number_field
from lgsens.model._elements import AbstractElement
from lgsens.model._forces import AbstractForce, Attached
from lgsens.model._loads import AbstractClosedFormLoad, AbstractDynamicLoad, LoadTangents
from lgsens.model._stack import load_tangents


class ScaledForce(AbstractForce):
    """Another force element, its loads times `factor`, shape (); its states obey what they obey."""

    of: AbstractForce
    factor: Float[Array, ""] = number_field("factor")

    @property
    def bodies(self):
        return self.of.bodies

    @property
    def on_merged(self):
        return self.of.on_merged

    @property
    def reads(self):
        return self.of.reads

    def on(self, joints):
        return ScaledForce(self.of.on(joints), factor=self.factor)

    def loads(self, bodies):
        def scaled(load):
            kind: Any = ScaledDynamicLoad if isinstance(load, AbstractDynamicLoad) else ScaledLoad
            return kind(load, self.factor)

        return tuple(Attached(scaled(load), a, b) for load, a, b in self.of.loads(bodies))


class _OfAnother(AbstractElement):
    """What a load times a number has of the load."""

    of: Any
    factor: Float[Array, ""]

    balanced = property(lambda self: self.of.balanced)
    drawn = property(lambda self: self.of.drawn)
    acts_on = property(lambda self: self.of.acts_on)

    def fixed(self, kind, bodies="ab"):
        return self.of.fixed(kind, bodies)

    def branch(self, a, b, *others):
        return self.of.branch(a, b, *others)


class ScaledLoad(_OfAnother, AbstractClosedFormLoad):
    """factor · Q."""

    def force(self, a, b, va, vb, t):
        return self.factor * self.of.force(a, b, va, vb, t)

    def measure(self, a, b, va, vb, t):
        return self.of.measure(a, b, va, vb, t)

    def tangents(self, a, b, va, vb, t):
        parts = load_tangents(self.of, a, b, va, vb, t)
        return LoadTangents(*jax.tree.map(lambda part: self.factor * part, tuple(parts)))


class ScaledDynamicLoad(_OfAnother, AbstractDynamicLoad):
    """factor · Q, and ż = g."""

    states = property(lambda self: self.of.states)
    reads = property(lambda self: self.of.reads)

    def force(self, a, b, va, vb, t, z):
        return self.factor * self.of.force(a, b, va, vb, t, z)

    def rate(self, a, b, va, vb, t, z):
        return self.of.rate(a, b, va, vb, t, z)

    def initial(self, a, b, va, vb, t):
        return self.of.initial(a, b, va, vb, t)

    def size(self, length):
        return self.of.size(length)

    def measure(self, a, b, va, vb, t, z):
        return self.of.measure(a, b, va, vb, t, z)
