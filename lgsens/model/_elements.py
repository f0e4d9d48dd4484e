"""What joints and forces are made of, basic constraints and loads, and what they say of themselves.

What the rest of the library wants to know of an element is asked of the element, and nobody asks for its type.
"""

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.model._frames import ALL, Frame


def of_length(element: Any, method: str, value: Any, length: int, of: str) -> Any:
    """What a method of an element returns. Raises `ValueError` unless it has this length; `of`: what it stands for.

    A shorter one would be broadcast, or leave numbers out, wherever elements are put together.
    """
    if jnp.shape(value) != (length,):
        raise ValueError(
            f"{type(element).__name__}.{method} must return {of}, shape ({length},), got shape {jnp.shape(value)}."
        )
    return value


def body_fixed(kind: str, body: str) -> dict[str, Any]:
    """What a field of an element says whose number is fixed to a body, in its frame: `eqx.field(metadata=…)`.

    It is a "point", an "axis", "axes" as columns or a "tensor" of "a" or "b". Points place the element in plots and in
    the scale of coordinates. An element that says so of one number says so of all: on a part of a merged body it
    becomes the same element on that body, without a change of frames at every instant. `lgsens.testing` compares both.
    """
    return {"fixed": (kind, body)}


class AbstractElement(eqx.Module):
    """A law between the frames of two bodies a and b, and numbers for it; no names, so that elements can be stacked.

    `drawn` is what is drawn from its first point to its last: a "joint" or "link" that holds bodies, a "beam"
    (bent, its axes at both ends with the first along it, in the colour of the `stress` that it measures, if any), a
    "spring", a "damper", a "wheel" on its `road`, or a "tyre" by its `radius` and axis; None: nothing.
    """

    drawn: ClassVar[Any] = "joint"

    acts_on: ClassVar[Any] = ALL
    """The coordinates 0 … 11, [x_a, θ_a, x_b, θ_b], that it acts on: B has no other columns, and the generalized force
    no other entries. Of a constraint, which then depends on no others, all of them or the six rotations."""

    @property
    def driven(self) -> Float[Array, ""] | None:
        """The number, a leaf, that `kinematics` and `statics` prescribe: a constraint has ∂Φ/∂s = −1, a load is
        multiplied by it; None: there is none."""
        return None

    def branch(self, a: Frame, b: Frame, *others: Frame) -> Float[Array, "*w"] | None:
        """Angles that poses tell within half a turn, and with which its force or Φ jumps there; None: of none."""
        return None

    def fixed(self, kind: str, bodies: str = "ab") -> list[Array]:
        """Its points, axes or tensors, in the frames of these bodies."""
        return [getattr(self, name) for name, (of, body) in fixed_fields(self).items() if of == kind and body in bodies]


def fixed_fields(element: AbstractElement) -> dict[str, tuple[str, str]]:
    """Kind and body of each number of an element that is fixed to a body, by the name of its field."""
    fields = dataclasses.fields(element)
    return {field.name: field.metadata["fixed"] for field in fields if "fixed" in field.metadata}
