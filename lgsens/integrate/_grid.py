"""Where steps begin and end, as a value: equal steps, and steps of different sizes.

The march and the sweeps know one interface. A grid has *places*, one for each step, stacked: what differs between
steps. `node(place)` is the step in time; it depends on the numbers of the grid as well, so derivatives by t0 and h pass
through both functions.

Steps of different sizes. What a state carries of the step that it ends may belong to the size of that step: the
algorithmic acceleration of generalized-α stands for the acceleration at t_n + Δ h. Each step begins with

    y_n* = `scheme.resized`(y_n) at r_n = h_n/h_{n−1}

in place of y_n. Sizes that differ by round-off are the same, r = 1. There ∂y_n*/∂r is not zero; but where ratios are
constants (`fixed`: sizes are parts of the interval that nothing depends on), a step with r = 1 begins with y_n, to all
derivatives, and nothing is to be done. A step of size 0 leaves everything as it is: a grid that needs fewer steps than
its arrays have places ends with such. For its equations it has the size before it, which can be divided by.

Steps that begin anew. Where a constraint breaks (a driver whose second or third derivative jumps), what the state
carries of the motion before does not belong to that behind, and the first step that begins there or later begins with
`scheme.renewed`(y_n). On equal steps that is all that differs from y_n.
"""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lgsens._xla import changed_where, in_any_lane
from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._linearized import Node

Tree = TypeVar("Tree")


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

    def renewed(self, system: AbstractSystem, state: State, node: Node, factors: Any = None) -> State: ...


def renewed(restarts: Float[Array, " k"] | None, node: Node, ratio) -> Bool[Array, ""]:
    """Whether a break lies at the begin of a step, or in the one before, r times shorter."""
    if restarts is None:
        return jnp.zeros((), bool)
    return jnp.any((restarts <= node.behind) & (restarts > node.behind - node.h / ratio))


class AbstractGrid(eqx.Module):
    """Where each of the steps begins and ends."""

    t0: eqx.AbstractVar[Float[Array, ""]]
    h: eqx.AbstractVar[Float[Array, "*n"]]
    num_steps: eqx.AbstractVar[int]
    count: eqx.AbstractVar[Float[Array, ""] | None]  # how many of the steps are taken; None: all
    restarts: eqx.AbstractVar[Float[Array, " k"] | None]  # the times after which steps begin anew; None: there are none
    fixed: eqx.AbstractVar[bool]  # whether ratios of sizes are constants: only `changes` begin with another state then
    with_empty: ClassVar[bool] = False  # whether some steps may be none

    @abc.abstractmethod
    def times(self) -> Float[Array, " n+1"]:
        """t_0 … t_n."""

    @abc.abstractmethod
    def places(self) -> Any:
        """What differs between the steps, stacked."""

    @abc.abstractmethod
    def node(self, place: Any) -> Node:
        """The step at a place."""

    @property
    def resizes(self) -> bool:
        """Whether a step may begin with another state than the last one ended with."""
        return self.restarts is not None

    def sized(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State, factors: Any = None) -> State:
        """A state as a step of the size at a place begins with it."""
        return state

    def resized(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State, factors: Any = None) -> State:
        """`begun`, of a step that begins with another state than the last one ended with."""
        found = self.sized(scheme, system, place, state, factors)
        if self.restarts is None:
            return found
        anew = scheme.renewed(system, found, self.node(place), factors)
        return jax.tree.map(lambda one, other: jnp.where(self.renews(place), one, other), anew, found)

    def begun(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State, factors: Any = None) -> State:
        """What the step at a place begins with; `factors`: those below, if they are known."""
        return self.where_varied(place, lambda state: self.resized(scheme, system, place, state, factors), state)

    def begun_in_turn(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State) -> State:
        """`begun`, by `where_resized`."""
        return self.begun(scheme, system, place, state)

    def factors(self, scheme: Resizes, system: AbstractSystem, place: Any, state: State) -> Any:
        """What `begun` is found with; they have no derivative of their own."""
        if not self.resizes:
            return None
        found = lambda _: scheme.resizing_factors(system, state, self.node(place).begin)
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(found, None))
        return self.where_varied(place, found, none)

    def where_varied(self, place: Any, change: Callable[[Tree], Tree], same: Tree) -> Tree:
        """`change(same)` where a step begins with something else than the state before, to all derivatives."""
        return self.where_resized(place, change, same) if self.fixed else change(same)

    def where_resized(self, place: Any, change: Callable[[Tree], Tree], same: Tree) -> Tree:
        """`change(same)` where the step begins with another state; elsewhere it takes no time."""
        if not self.resizes:
            return same
        return changed_where(in_any_lane(self.changes(place)), change, same)

    def changes(self, place: Any) -> Bool[Array, ""]:
        """Whether the step begins with another state than the last one ended with."""
        return self.renews(place)

    def renews(self, place: Any) -> Bool[Array, ""]:
        """Whether the step begins anew."""
        node, ratio = jax.lax.stop_gradient((self.node(place), self.ratio(place)))
        return renewed(self.restarts, node, ratio)

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
    def begins_pieces(self) -> Float[Array, " n"] | None:
        """1 for each step that begins where steps end at a break, else 0; None: they end at none."""
        return None

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
    restarts: Float[Array, " k"] | None = None
    fixed: ClassVar[bool] = True

    @classmethod
    def between(cls, t0, t1, num_steps: int | Steps, restarts=None) -> "EqualGrid":
        """So many steps from t0 to t1."""
        if isinstance(num_steps, int):
            return cls(t0, (t1 - t0) / num_steps, num_steps, restarts=restarts)
        return cls(t0, (t1 - t0) / num_steps.count, num_steps.room, num_steps.count, restarts)

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
        return EqualGrid(self.t0, self.h / 2.0, 2 * self.num_steps, count, self.restarts)

    def segments(self, count, length):
        n = length * jnp.arange(count, dtype=self.h.dtype)
        h, restarts = for_each(count, (self.h, self.restarts))
        return EqualGrid(self.t0 + n * self.h, h, length, restarts=restarts)


def for_each(count: int, tree: Tree) -> Tree:
    """The same of all segments."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), tree)
