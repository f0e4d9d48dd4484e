"""Loads along one coordinate of two bodies, and the whole turns of those along an angle.

A load along s(q) is Q = (∂s/∂q)ᵀ f(s, ṡ, t), whose power is f ṡ. Poses tell an angle but for whole turns, and f of a
spring, which is not periodic, jumps where s comes to half a turn. Over more turns a state follows the angle,

    ż = ṡ + (s_z − z)/τ,     s_z = s + 2π k,     k = round((z − s)/2π),

and nothing but k depends on it: f(s_z, ṡ, t) and its derivatives are exact while z is right to less than half a turn.
The second term takes out what a scheme loses in z over many turns, and makes z = s_z the equilibrium; τ = 1 s.
"""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import require
from lgsens.liegroups import SO3
from lgsens.model._frames import Frame
from lgsens.model._loads import AbstractDynamicLoad
from lgsens.model._relative import but_for_turns

# Half turns, once around and once more; by a part that keeps off the angles at which curves have samples, where slopes
# jump, and round-off decides on which side one is.
_AROUND = (np.arange(60) + 0.618034) / 30.0 - 1.0 + np.array([[0.0], [2.0]])


class AlongCoordinate(Protocol):
    """A load along a coordinate."""

    @property
    def stiffness(self) -> Float[Array, ""]: ...

    def value(self, a: Frame, b: Frame) -> tuple[Float[Array, ""], Float[Array, "12"]]:
        """s and ∂s/∂q."""
        ...

    def along(self, s, rate, t) -> Any:
        """What is measured there, of which f is the last."""
        ...


def acting(load: AlongCoordinate, a: Frame, b: Frame, va, vb, t, z=None) -> tuple[Any, Float[Array, "12"]]:
    """What is measured of a load, of which f is the last, and ∂s/∂q; z: what tells the turns."""
    s, row = load.value(a, b)
    rate = jnp.sum(row * jnp.concatenate([va, vb]))
    if z is not None:
        s = but_for_turns(s, z)
    return load.along(s, rate, t), row


def force_along(load: AlongCoordinate, a: Frame, b: Frame, va, vb, t, z=None) -> Float[Array, "12"]:
    """Q."""
    found, row = acting(load, a, b, va, vb, t, z)
    return found[-1] * row


def rotation_between(a: Frame, triad_a: Float[Array, "3 3"], b: Frame, triad_b: Float[Array, "3 3"]) -> Array:
    """The rotation vector from axes of a to those of b, |φ| ≤ π: as `AbstractElement.branch`, from π about n it goes to
    −π, by 3.6 rad and more in one component."""
    return SO3().log((a.orientation @ triad_a).T @ b.orientation @ triad_b)


def unless_whole(ratio: Array, teeth: int, angle: Array) -> Array:
    """The angle of a part of which another one has `ratio` times it but for turns divided by `teeth`: 0 where that
    holds over any number of turns (`AbstractElement.branch`)."""
    turns = ratio * teeth
    return jnp.where(jnp.abs(turns - jnp.round(turns)) < 1e-6, 0.0, angle)


def unless_closed(
    of: Callable[[Array], Array], angle: Array, centre: Array | float = 0.0, turn: float | None = None
) -> Array:
    """An angle within half a turn of `centre` that something is a function of: 0 where value and slope of that are the
    same a turn later, wherever that began, the value but for multiples of `turn`, so that it goes on over any number of
    turns (`AbstractElement.branch`). The same is to six digits of what it is in these turns, with what its samples
    lose."""
    around = centre + jnp.pi * jnp.asarray(_AROUND, angle.dtype)
    values, slopes = jax.vmap(jax.vmap(jax.value_and_grad(of)))(around)
    jump, bend = values[1] - values[0], slopes[1] - slopes[0]
    jump = jump if turn is None else but_for_turns(jump, turn=turn)
    small = max(1e-6, float(jnp.finfo(angle.dtype).eps) ** 0.5) * jnp.max(jnp.abs(values) + jnp.abs(slopes))
    closed = jnp.all((jnp.abs(jump) <= small) & (jnp.abs(bend) <= small))
    return jnp.where(closed, 0.0, angle)


def branch_of(load: AlongCoordinate, a: Frame, b: Frame) -> Float[Array, ""]:
    """The angle of a load that jumps with it (`AbstractElement.branch`); 0 where none does, without a spring."""
    return jnp.where(load.stiffness == 0.0, 0.0, load.value(a, b)[0])


def require_half_a_turn(what: str, name: str, free: Float[Array, "*n"]) -> None:
    """Raise `ValueError` for a spring that is free where it is not before its bodies have turned."""
    further = "" if free.ndim else "; a spring that is wound up further counts whole turns, `turns=True`"
    require(
        lambda angle: np.linalg.norm(angle) <= np.pi,
        f"{what}: `{name}` must be within half a turn, as its angle is, got {free} rad (not degrees){further}.",
        free,
    )


def within_half_a_turn(free: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """The same of a number that is traced: one that is larger is none (`invalid_numbers`), as the spring would pull the
    other way."""
    return jnp.where(jnp.sum(free * free) <= (1.0 + 1e-6) * np.pi**2, free, jnp.nan)


class CountedTurns(AbstractDynamicLoad):
    """A load along an angle over any number of turns, since the reference configuration."""

    of: Any  # AlongCoordinate

    balanced = True
    drawn = None
    states = ("angle",)

    @property
    def acts_on(self):
        return self.of.acts_on

    def fixed(self, kind, bodies="ab"):
        return self.of.fixed(kind, bodies)

    def measure(self, a, b, va, vb, t, z):
        return acting(self.of, a, b, va, vb, t, z[0])[0]

    def force(self, a, b, va, vb, t, z):
        return force_along(self.of, a, b, va, vb, t, z[0])

    def rate(self, a, b, va, vb, t, z):
        s, rate, _ = self.measure(a, b, va, vb, t, z)
        return (rate + s)[None] - z

    def initial(self, a, b, va, vb, t):
        s, _ = self.of.value(a, b)
        return but_for_turns(s)[None]
