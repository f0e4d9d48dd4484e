"""Where steps begin and end, as a value: equal steps, and steps of different sizes.

The march and the sweeps know one interface. A grid has *places*, one for each step, stacked: what differs between
steps. `node(place)` is the step in time; it depends on the numbers of the grid as well, so derivatives by t0 and h pass
through both functions.

Steps of different sizes. What a state carries of the step that it ends may belong to the size of that step: the
algorithmic acceleration of generalized-α stands for the acceleration at t_n + Δ h. Each step begins with

    a_n* = `scheme.resized`(v̇_n, a_n, r_n),     r_n = h_n/h_{n−1},

linear in v̇_n and a_n, in place of a_n. A step of size 0 leaves everything as it is: a grid that needs fewer steps than
its arrays have places ends with such. For its equations it has the size before it, which can be divided by.
"""

import abc
import dataclasses
import functools
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lgsens.dynamics import State
from lgsens.integrate._linearized import Node, Variation


class Resizes(Protocol):
    """What a grid knows of a scheme."""

    def resized(self, vdot, a, ratio) -> Float[Array, " k"]: ...


class StepLink(eqx.Module):
    """How a step follows the one before, linearized; stacked, all of them. Between equal steps nothing changes."""

    scheme: Any = eqx.field(static=True, default=None)  # None, like the others: steps are equal
    ratio: Any = None  # of the sizes, shape ()
    by_ratio: Any = None  # ∂a*/∂r, shape (k,)
    empty: Any = None  # whether the step is, shape ()

    def begun(self, previous: Variation, d_place: Any) -> Variation:
        """The variation of what the step begins with."""
        if self.ratio is None:
            return previous
        a = self.scheme.resized(previous.vdot, previous.a, self.ratio)
        return previous._replace(a=a + d_place.ratio * self.by_ratio)

    def begun_transposed(self, begun: Variation) -> tuple[Variation, Float[Array, ""] | None]:
        """The cotangents of δ_n and of the ratio, from that of what the step begins with."""
        if self.ratio is None:
            return begun, None
        zero = jnp.zeros_like(begun.a)
        transposed = jax.linear_transpose(lambda vdot, a: self.scheme.resized(vdot, a, self.ratio), zero, zero)
        vdot, a = transposed(begun.a)
        ratio = jnp.where(self.empty, 0.0, jnp.dot(begun.a, self.by_ratio))
        return begun._replace(vdot=begun.vdot + vdot, a=a), ratio

    def unless_empty(self, rows: Any, otherwise: Any) -> Any:
        """`rows`, or, of an empty step, `otherwise`."""
        if self.empty is None:
            return rows
        return jax.tree.map(lambda row, other: jnp.where(self.empty, other, row), rows, otherwise)


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

    def link(self, scheme: Resizes, place: Any, previous: State) -> StepLink:
        """How the step at a place follows the state before it."""
        return StepLink()

    def begun(self, scheme: Resizes, place: Any, state: State) -> State:
        """What the step at a place begins with."""
        return state

    def empty(self, place: Any) -> Bool[Array, ""] | None:
        """Whether the step is none; None: no step of this grid is empty."""
        return None

    @property
    @abc.abstractmethod
    def first_size(self) -> Float[Array, ""]:
        """The size of the step to which the a at t0 belongs."""

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

    def segments(self, count, length):
        n = length * jnp.arange(count, dtype=self.h.dtype)
        return EqualGrid(self.t0 + n * self.h, jnp.broadcast_to(self.h, (count,)), length)


class Place(NamedTuple):
    """One step of different ones."""

    begin: Float[Array, ""]
    size: Float[Array, ""]  # as given
    h: Float[Array, ""]  # that before, where it is 0
    ratio: Float[Array, ""]


class UnevenGrid(AbstractGrid):
    """Steps of sizes h from t0 on."""

    t0: Float[Array, ""]
    h: Float[Array, " n"]
    before: Float[Array, ""]  # the size of the step that led to t0, to which the a there belongs
    num_steps: ClassVar[Any] = property(lambda self: self.h.shape[-1])  # no argument, where the base has a field
    count: ClassVar[None] = None

    @classmethod
    def first(cls, t0, h) -> "UnevenGrid":
        """From a state at t0 whose a belongs to the first step."""
        return cls(t0, h, h[0])

    @property
    def first_size(self):
        return self.before

    def times(self):
        return self.t0 + jnp.concatenate([jnp.zeros_like(self.h[:1]), jnp.cumsum(self.h)])

    def places(self):
        h = self.h
        last = jax.lax.cummax(jnp.where(h != 0.0, jnp.arange(1, h.shape[0] + 1), 0))
        size = jnp.concatenate([self.before[None], h])[last]
        ratio = size / jnp.concatenate([self.before[None], size[:-1]])
        return Place(self.t0 + jnp.cumsum(h) - h, h, size, ratio)

    def node(self, place):
        return Node(place.begin, place.begin + place.size, place.h)

    def link(self, scheme, place, previous):
        by_ratio = jax.jacfwd(lambda ratio: scheme.resized(previous.vdot, previous.a, ratio))(place.ratio)
        return StepLink(scheme, place.ratio, by_ratio, self.empty(place))

    def begun(self, scheme, place, state):
        return dataclasses.replace(state, a=scheme.resized(state.vdot, state.a, place.ratio))

    def empty(self, place):
        return place.size == 0.0

    def segments(self, count, length):
        h = jnp.concatenate([self.h, jnp.zeros(count * length - self.num_steps, self.h.dtype)]).reshape(count, length)
        sizes = jnp.concatenate([self.before[None], self.places().h])
        begins = length * np.arange(count)
        return UnevenGrid(self.times()[begins], h, sizes[begins])


Tree = TypeVar("Tree")


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
