"""Where steps of different sizes begin and end, and what they begin with."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._xla import most_of_lanes
from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._grid import AbstractGrid, Resizes, for_each
from lgsens.integrate._linearized import Node

_SAME = 1e4  # round-offs: what sums of sizes leave of them


class Place(NamedTuple):
    """One step of different ones."""

    begin: Float[Array, ""]
    size: Float[Array, ""]  # as given
    h: Float[Array, ""]  # that before, where it is 0
    ratio: Float[Array, ""]
    moving: Float[Array, ""] | None = None


def without_round_off(ratio):
    """Of two sizes: 1 where round-off of sums of them is all that they differ by, of which it is made free."""
    same = jnp.abs(ratio - 1.0) < _SAME * jnp.finfo(ratio.dtype).eps
    return ratio + jax.lax.stop_gradient(jnp.where(same, 1.0 - ratio, 0.0))


@jax.custom_jvp
def _begun_in_turn(scheme: Resizes, system: AbstractSystem, grid: "UnevenGrid", place: Place, state: State) -> State:
    return grid.where_resized(place, lambda state: grid.resized(scheme, system, place, state), state)


@_begun_in_turn.defjvp
def _derivative_of_begun(primals, tangents):
    """That by r is not zero where r is 1."""
    return jax.jvp(lambda scheme, system, grid, *at: grid.resized(scheme, system, *at), primals, tangents)


class UnevenGrid(AbstractGrid):
    """Steps of sizes h from t0 on."""

    t0: Float[Array, ""]
    h: Float[Array, " n"]
    before: Float[Array, ""]  # the size of the step that led to t0, to which the state there belongs
    room: bool = eqx.field(static=True, default=False)  # whether there may be many empty places at the end
    count: Float[Array, ""] | None = None  # of the steps that are not empty, where it is known
    fixed: bool = eqx.field(static=True, default=False)
    restarts: Float[Array, " k"] | None = None
    moving: Float[Array, " n"] | None = None  # 1 for steps whose ratio varies though `fixed`, else 0; None: for none
    with_empty: ClassVar[bool] = True
    num_steps: ClassVar[Any] = property(lambda self: self.h.shape[-1])  # no argument, where the base has a field

    @classmethod
    def first(
        cls, t0, h, *, room: bool = False, count=None, fixed: bool = False, restarts=None, moving=None
    ) -> "UnevenGrid":
        """From a state at t0 that belongs to the first step."""
        return cls(t0=t0, h=h, before=h[0], room=room, count=count, fixed=fixed, restarts=restarts, moving=moving)

    @property
    def resizes(self):
        return True

    def sized(self, scheme, system, place, state, factors=None):
        return scheme.resized(system, state, place.begin, factors).at(system, place.ratio)

    @property
    def begins_pieces(self):
        return self.moving

    @property
    def first_size(self):
        return self.before

    @property
    def taken(self):
        if self.count is not None or not self.room:
            return self.count
        last = jnp.max(jnp.where(self.h != 0.0, jnp.arange(1, self.num_steps + 1, dtype=self.h.dtype), 0.0))
        return most_of_lanes(jax.lax.stop_gradient(last))

    def times(self):
        return self.t0 + jnp.concatenate([jnp.zeros_like(self.h[:1]), jnp.cumsum(self.h)])

    def places(self):
        h = self.h
        last = jax.lax.cummax(jnp.where(h != 0.0, jnp.arange(1, h.shape[0] + 1), 0))
        size = jnp.concatenate([self.before[None], h])[last]
        ratio = without_round_off(size / jnp.concatenate([self.before[None], size[:-1]]))
        if self.fixed:
            constant = jax.lax.stop_gradient(ratio)
            ratio = constant if self.moving is None else jnp.where(self.moving > 0.0, ratio, constant)
        return Place(self.t0 + jnp.cumsum(h) - h, h, size, ratio, self.moving)

    def node(self, place):
        return Node(place.begin, place.begin + place.size, place.h)

    def begun_in_turn(self, scheme, system, place, state):
        if self.fixed:
            return self.begun(scheme, system, place, state)
        return _begun_in_turn(scheme, system, self, place, state)

    def changes(self, place):
        changes = (jax.lax.stop_gradient(place.ratio) != 1.0) | self.renews(place)
        return changes if place.moving is None else changes | (jax.lax.stop_gradient(place.moving) > 0.0)

    def ratio(self, place):
        return place.ratio

    def empty(self, place):
        return place.size == 0.0

    def halved(self):
        count = None if self.count is None else 2.0 * self.count
        h, moving = jnp.repeat(self.h / 2.0, 2), self.moving
        moving = None if moving is None else jnp.stack([moving, jnp.zeros_like(moving)], axis=1).ravel()
        return dataclasses.replace(self, h=h, before=self.before / 2.0, count=count, moving=moving)

    def segments(self, count, length):
        filling = jnp.zeros(count * length - self.num_steps, self.h.dtype)
        filled = lambda steps: jnp.concatenate([steps, filling]).reshape(count, length)
        sizes = jnp.concatenate([self.before[None], self.places().h])
        begins = length * np.arange(count)
        restarts = for_each(count, self.restarts)
        moving = None if self.moving is None else filled(self.moving)
        how = {"fixed": self.fixed, "restarts": restarts, "moving": moving}
        return UnevenGrid(t0=self.times()[begins], h=filled(self.h), before=sizes[begins], **how)
