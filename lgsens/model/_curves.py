"""Springs and dampers with curves: force over extension and force over rate, in place of two numbers."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import number_field, point_field
from lgsens.model._elements import body_fixed
from lgsens.model._forces import AbstractConnection, _distance
from lgsens.model._loads import AbstractClosedFormLoad, LineForce, SpringDamperLoad
from lgsens.model._signal_fields import prescribed_field
from lgsens.model._signals import AbstractSignal, Prescribed, prepared


class CurveLoad(AbstractClosedFormLoad):
    """Tension F = F₀ + f(ℓ − ℓ₀) + g(ℓ̇) along the line between two points.

    At every state it has the force and both tangents of the linear spring and damper that osculates it there: with
    k = f′, c = g′, and the length at which that spring is free its own, F = (F − c ℓ̇) + k (ℓ − ℓ) + c ℓ̇.
    """

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    spring: AbstractSignal | None = eqx.field(metadata={"over": "length"})
    damper: AbstractSignal | None = eqx.field(metadata={"over": "rate"})
    free_length: Float[Array, ""]
    preload: Float[Array, ""]

    balanced = True

    @property
    def drawn(self):
        return "damper" if self.spring is None else "spring"

    def _osculating(self, a, b, va, vb, t) -> SpringDamperLoad:
        zero = jnp.zeros_like(self.preload)
        line = SpringDamperLoad(self.point_a, self.point_b, zero, zero, zero, zero).measure(a, b, va, vb, t)
        (push, stiffness), (drag, damping) = (
            (zero, zero) if curve is None else jax.jvp(curve, (x,), (jnp.ones_like(x),))
            for curve, x in ((self.spring, line.length - self.free_length), (self.damper, line.rate))
        )
        tension = self.preload + push + drag - damping * line.rate
        return SpringDamperLoad(self.point_a, self.point_b, stiffness, damping, line.length, tension)

    def measure(self, a, b, va, vb, t) -> LineForce:
        return self._osculating(a, b, va, vb, t).measure(a, b, va, vb, t)

    def force(self, a, b, va, vb, t):
        return self._osculating(a, b, va, vb, t).force(a, b, va, vb, t)

    def tangents(self, a, b, va, vb, t):
        return self._osculating(a, b, va, vb, t).tangents(a, b, va, vb, t)


class CurveSpringDamper(AbstractConnection):
    """A spring and a damper in parallel between two points by their curves; tension F = F₀ + f(ℓ − ℓ₀) + g(ℓ̇).

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at_a, at_b: the points of attachment in the reference configuration [m], inertial frame, shape (3,).
        spring: f [N] over the extension [m], a signal of it in place of time; None: no spring.
            `Sampled(extensions, tensions, "monotone")` goes through points, C¹, and straight on outside of them.
        damper: g [N] over the rate of extension [m/s], likewise: bump and rebound are its two sides; None: no damper.
        free_length: ℓ₀ [m], shape (); None: the length in the reference configuration.
        preload: F₀ [N], shape (), added at all lengths.

    The force is as smooth as its curves, its tangents one derivative less. Points must not meet. `Trajectory.force`
    gives a `LineForce`. Raises `ValueError` for what is no signal, for neither of two curves and for wrong shapes.
    Source: Dixon, The Shock Absorber Handbook (2nd ed. 2007); of the curves Fritsch & Butland (1984).
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at_a: Float[Array, "3"] = point_field("at_a")
    at_b: Float[Array, "3"] = point_field("at_b")
    spring: Prescribed | None = prescribed_field("spring", over="length")
    damper: Prescribed | None = prescribed_field("damper", over="rate")
    free_length: Float[Array, ""] | None = number_field("free_length", default=None)
    preload: Float[Array, ""] = number_field("preload", default=0.0)

    def __check_init__(self):
        curves = [curve for curve in (self.spring, self.damper) if curve is not None]
        if not curves or not all(isinstance(curve, AbstractSignal) for curve in curves):
            raise ValueError(
                "CurveSpringDamper: `spring` and `damper` must be signals or None, and one of them given, got "
                f"{self.spring!r} and {self.damper!r}; with two numbers it is a SpringDamper."
            )

    preload_shape = ()

    def load(self, a, b):
        return CurveLoad(
            point_a=a.local_point(self.at_a),
            point_b=b.local_point(self.at_b),
            spring=prepared(self.spring),
            damper=prepared(self.damper),
            free_length=_distance(self.at_a, self.at_b) if self.free_length is None else self.free_length,
            preload=self.preload,
        )
