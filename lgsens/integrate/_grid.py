"""Where steps begin and end, as a value: equal steps, and steps of different sizes.

The march and the sweeps know one interface. A grid has *places*, one for each step, stacked: what differs between
steps. `node(place)` is the step in time; it depends on the numbers of the grid as well, so derivatives by t0 and h pass
through both functions.

Steps of different sizes. What a state carries of the step that it ends may belong to the size of that step: the
algorithmic acceleration of generalized-α stands for the acceleration at t_n + Δ h. Each step begins with

    y_n* = `scheme.resized`(y_n) at r_n = h_n/h_{n−1}

in place of y_n. Sizes that differ by round-off are the same, r = 1. There ∂y_n*/∂r is not zero; but where ratios are
constants (`fixed`: sizes are parts of the interval that nothing depends on), a step with r = 1 begins with y_n, to all
derivatives, and nothing is to be done. A step of size 0 leaves everything as it is: a grid
that needs fewer steps than its arrays have places ends with such. For its equations it has the size before it, which
can be divided by.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lgsens._xla import alike, in_any_lane, most_of_lanes
from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._linearized import Node

Tree = TypeVar("Tree")
_SAME = 1e4  # round-offs: what sums of sizes leave of them


class Start(NamedTuple):
    """A state as a step of any size h begins with it: q exp(h² q̃_2), v + h² v_2, a + h a_1; None: nothing."""

    state: State
    q_2: Float[Array, " k"] | None = None
    v_2: Float[Array, " k"] | None = None
    a_1: Float[Array, " k"] | None = None

    def at(self, system: AbstractSystem, h) -> State:
        state = self.state
        return dataclasses.replace(
            state,
            q=state.q if self.q_2 is None else system.group.retract(state.q, h**2 * self.q_2),
            v=state.v if self.v_2 is None else state.v + h**2 * self.v_2,
            a=state.a if self.a_1 is None else state.a + h * self.a_1,
        )


class Resizes(Protocol):
    """What a grid knows of a scheme."""

    def resized(self, system: AbstractSystem, state: State, t, factors: Any = None) -> Start: ...

    def resizing_factors(self, system: AbstractSystem, state: State, t) -> Any: ...


class AbstractGrid(eqx.Module):
    """Where each of the steps begins and ends."""

    t0: eqx.AbstractVar[Float[Array, ""]]
    h: eqx.AbstractVar[Float[Array, "*n"]]
    num_steps: eqx.AbstractVar[int]
    count: eqx.AbstractVar[Float[Array, ""] | None]  # how many of the steps are taken; None: all

    @abc.abstractmethod
    def times(self) -> Float[Array, " n+1"]:
        """t_0 … t_n."""

    @abc.abstractmethod
    def places(self) -> Any:
        """What differs between the steps, stacked."""

    @abc.abstractmethod
    def node(self, place: Any) -> Node:
        """The step at a place."""

    resizes: ClassVar[bool] = False  # whether a step may begin with another state than the last one ended with

    def begun(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State, factors: Any = None) -> State:
        """What the step at a place begins with; `factors`: those below, if they are known."""
        return state

    def resized(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State, factors: Any = None) -> State:
        """`begun`, of a step whose size may differ from that of the one before."""
        return state

    def begun_in_turn(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State) -> State:
        """`begun`, by `where_resized`."""
        return state

    def where_resized(self, place: Any, change: Callable[[Tree], Tree], same: Tree) -> Tree:
        """`change(same)` where the step has another size than the one before; elsewhere it takes no time."""
        return same

    def factors(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State) -> Any:
        """What `begun` is found with; they have no derivative of their own."""
        return None

    def ratio(self, place: Any) -> Any:
        """The size of the step at a place, over that of the one before."""
        return 1.0

    def empty(self, place: Any) -> Bool[Array, ""] | None:
        """Whether the step is none; None: no step of this grid is empty."""
        return None

    def unless_empty(self, place: Any, rows: Any, otherwise: Any) -> Any:
        """`rows`, or, of an empty step, `otherwise`."""
        empty = self.empty(place)
        if empty is None:
            return rows
        return jax.tree.map(lambda row, other: jnp.where(empty, other, row), rows, otherwise)

    @property
    def taken(self) -> Float[Array, ""] | None:
        """A number of steps that those after it leave as it is, because they are empty; None: all may do something."""
        return self.count

    @property
    @abc.abstractmethod
    def first_size(self) -> Float[Array, ""]:
        """The size of the step to which the state at t0 belongs."""

    @abc.abstractmethod
    def halved(self) -> "AbstractGrid":
        """Each step divided into two."""

    @abc.abstractmethod
    def segments(self, count: int, length: int) -> "AbstractGrid":
        """The grids of successive parts of `length` steps each, stacked; what they have too many are any steps."""


class Steps(eqx.Module):
    """A number of steps as a number of the program, which has room for some more."""

    count: Float[Array, ""]
    room: int = eqx.field(static=True)

    @classmethod
    @functools.lru_cache(maxsize=64)
    def of(cls, num_steps: int, dtype) -> "Steps":
        """Room for 256, 1024, 4096, and from there on 6144, 8192, 12288, 16384, …: memory is all that it takes."""
        room = 256
        while room < num_steps:
            power = room & (room - 1) == 0
            room = 4 * room if room < 4096 else room + room // (2 if power else 3)
        return cls(jnp.asarray(num_steps, dtype), room)


class EqualGrid(AbstractGrid):
    """Steps from t0 + n h to t0 + (n + 1) h, of which there may be fewer than there is room for.

    With a `count` all arrays have rows for `num_steps` steps; those after the last one repeat its time, and loops over
    steps end before them.
    """

    t0: Float[Array, ""]
    h: Float[Array, ""]
    num_steps: int = eqx.field(static=True)
    count: Float[Array, ""] | None = None  # of the steps taken; a float, like all leaves. None: all

    @classmethod
    def between(cls, t0, t1, num_steps: int | Steps) -> "EqualGrid":
        """So many steps from t0 to t1."""
        if isinstance(num_steps, int):
            return cls(t0, (t1 - t0) / num_steps, num_steps)
        return cls(t0, (t1 - t0) / num_steps.count, num_steps.room, num_steps.count)

    def times(self):
        return self.t0 + self._counted(self.num_steps + 1, 0) * self.h

    def places(self):
        return self._counted(self.num_steps, 1)

    def _counted(self, rows: int, less: int):
        n = jnp.arange(rows, dtype=self.h.dtype)
        return n if self.count is None else jnp.minimum(n, jax.lax.stop_gradient(self.count) - less)

    def node(self, place):
        return Node(self.t0 + place * self.h, self.t0 + (place + 1) * self.h, self.h)

    @property
    def first_size(self):
        return self.h

    def halved(self):
        count = None if self.count is None else 2.0 * self.count
        return EqualGrid(self.t0, self.h / 2.0, 2 * self.num_steps, count)

    def segments(self, count, length):
        n = length * jnp.arange(count, dtype=self.h.dtype)
        return EqualGrid(self.t0 + n * self.h, jnp.broadcast_to(self.h, (count,)), length)


class Place(NamedTuple):
    """One step of different ones."""

    begin: Float[Array, ""]
    size: Float[Array, ""]  # as given
    h: Float[Array, ""]  # that before, where it is 0
    ratio: Float[Array, ""]


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
    fixed: bool = eqx.field(static=True, default=False)  # whether the ratios of sizes are constants
    resizes: ClassVar[bool] = True
    num_steps: ClassVar[Any] = property(lambda self: self.h.shape[-1])  # no argument, where the base has a field

    @classmethod
    def first(cls, t0, h, *, room: bool = False, count=None, fixed: bool = False) -> "UnevenGrid":
        """From a state at t0 that belongs to the first step."""
        return cls(t0=t0, h=h, before=h[0], room=room, count=count, fixed=fixed)

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
        ratio = jax.lax.stop_gradient(ratio) if self.fixed else ratio
        return Place(self.t0 + jnp.cumsum(h) - h, h, size, ratio)

    def node(self, place):
        return Node(place.begin, place.begin + place.size, place.h)

    def resized(self, scheme, system, place, state, factors=None):
        return scheme.resized(system, state, place.begin, factors).at(system, place.ratio)

    def begun(self, scheme, system, place, state, factors=None):
        change = lambda state: self.resized(scheme, system, place, state, factors)
        return self.where_resized(place, change, state) if self.fixed else change(state)

    def begun_in_turn(self, scheme, system, place, state):
        return (
            self.begun(scheme, system, place, state)
            if self.fixed
            else _begun_in_turn(scheme, system, self, place, state)
        )

    def where_resized(self, place, change, same):
        shapes = jax.eval_shape(change, same)
        resized = in_any_lane(jax.lax.stop_gradient(place.ratio) != 1.0)
        return jax.lax.cond(resized, lambda same: alike(change(same), shapes), lambda same: alike(same, shapes), same)

    def factors(self, scheme, system, place, state):
        found = lambda _: scheme.resizing_factors(system, state, place.begin)
        if not self.fixed:
            return found(None)
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(found, None))
        return self.where_resized(place, found, none)

    def ratio(self, place):
        return place.ratio

    def empty(self, place):
        return place.size == 0.0

    def halved(self):
        count = None if self.count is None else 2.0 * self.count
        h = jnp.repeat(self.h / 2.0, 2)
        return dataclasses.replace(self, h=h, before=self.before / 2.0, count=count)

    def segments(self, count, length):
        h = jnp.concatenate([self.h, jnp.zeros(count * length - self.num_steps, self.h.dtype)]).reshape(count, length)
        sizes = jnp.concatenate([self.before[None], self.places().h])
        begins = length * np.arange(count)
        return UnevenGrid(t0=self.times()[begins], h=h, before=sizes[begins], fixed=self.fixed)


def later(states: Tree) -> Tree:
    """All states but the first."""
    return jax.tree.map(lambda leaf: leaf[1:], states)


def earlier(states: Tree) -> Tree:
    """All states but the last."""
    return jax.tree.map(lambda leaf: leaf[:-1], states)


def with_first(first: Tree, rest: Tree) -> Tree:
    """One instant before a stack of others."""
    return jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), first, rest)


def with_last(rest: Tree, last: Tree) -> Tree:
    """One instant after a stack of others."""
    return jax.tree.map(lambda others, one: jnp.concatenate([others, one[None]]), rest, last)
