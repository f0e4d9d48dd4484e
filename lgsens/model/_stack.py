"""Elements of one type, stacked and evaluated together.

Elements are grouped by the structure of their numbers and by which side is the ground; each group is one
vmapped kernel, so what is compiled grows with the number of element types, not of elements.
"""

from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens.liegroups import Pose
from lgsens.linear import chosen
from lgsens.model._constraints import (
    AbstractClosedFormConstraint,
    AbstractConstraint,
    AbstractRows,
    AbstractVelocityConstraint,
)
from lgsens.model._elements import of_length
from lgsens.model._evaluate_by_kind import StackRow, joined
from lgsens.model._frames import (
    ALL,
    BODY_A,
    BODY_B,
    BODY_DIM,
    ROTATION,
    TURNING_A,
    TURNING_B,
    Frame,
    ground_frame,
    tilted,
)
from lgsens.model._loads import (
    AbstractClosedFormLoad,
    AbstractDynamicLoad,
    AbstractLoad,
    LoadTangents,
    generalized_force,
    num_states,
    places_of_states,
)
from lgsens.model._topology import Ends

Element = TypeVar("Element", AbstractRows, AbstractLoad | AbstractDynamicLoad)


class Placed(NamedTuple, Generic[Element]):
    """An element or a `StackRow`, the numbers of its two bodies (None: the ground), the name of its owner; of a
    constraint, which of its equations are kept, which one of its joint's it is, and further bodies; of a load, what
    carries its states, and the joint whose multipliers it reads.
    """

    element: Element | StackRow
    a: int | None
    b: int | None
    owner: str
    kept: tuple[bool, ...] = ()
    place: int = 0
    carriers: tuple[int, ...] = ()
    joint: str | None = None


class AtEnds(NamedTuple):
    """What bodies have at the ends of a stack: positions, orientations, …, with a leading axis; None: the ground.
    `others`: the frames of further bodies.
    """

    a: tuple[Array, ...] | None
    b: tuple[Array, ...] | None
    others: tuple[Frame, ...] = ()


class Stack(eqx.Module, Generic[Element]):
    """Elements of one type between bodies `a` and `b`; `a` or `b` is None where all of them are on the ground."""

    elements: Element  # leaves with a leading axis
    a: tuple[int, ...] | None = eqx.field(static=True)
    b: tuple[int, ...] | None = eqx.field(static=True)
    owners: tuple[str, ...] = eqx.field(static=True)
    kept: tuple[tuple[bool, ...], ...] = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    carriers: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())  # of states, or others; as `a` and `b`
    joints: tuple[str, ...] = eqx.field(static=True, default=())  # whose multipliers its elements read, if any

    def __check_init__(self):
        name, acts_on = type(self.elements).__name__, self.elements.acts_on
        if not isinstance(self.elements, AbstractRows):
            if list(acts_on) != sorted(set(acts_on) & set(ALL)) or not acts_on:
                raise ValueError(
                    f"{name}: `acts_on` must be increasing places from 0 to 11; got {acts_on!r}. Leave it out where "
                    "any entry of the force may be other than zero."
                )
            return
        if acts_on not in (ALL, TURNING_A + TURNING_B):
            raise ValueError(
                f"{name}: `acts_on` of a constraint must be {ALL} or the rotations {TURNING_A + TURNING_B}; got "
                f"{acts_on!r}. Leave it out where Φ depends on a position."
            )
        sets = self.elements.coupled
        every = [coordinate for group in sets for coordinate in group]  # one in two sets would be added to K_t twice
        if any(list(group) != sorted(group) for group in sets) or len(set(every)) < len(every) or set(every) - set(ALL):
            raise ValueError(
                f"{name}: `coupled` must be disjoint, increasing sets of places from 0 to 11; "
                f"got {sets!r}. Leave it out where all twelve may be coupled."
            )

    def acting(self, arrays: Float[Array, "... n"]) -> Float[Array, "... p"]:
        """The entries that belong to bodies and that the element acts on, in the order of `Topology`'s columns."""
        ends = self.ends
        return entries_at(arrays, ends.own[ends.places(ends.acts_on)])

    def inputs(self, twist: Float[Array, "N 6"], lam, read: np.ndarray) -> tuple[Float[Array, "e s"], ...]:
        """The states of its elements, from [ẋ, Ω] of the bodies, and the multipliers that they `read`, if any."""
        parts = []
        if self.carriers:
            translations = [twist[np.asarray(of), : ROTATION.start] for of in self.carriers]
            parts.append(jnp.concatenate(translations, axis=1)[:, : num_states(self.elements)])
        if read.size:
            parts.append(chosen(lam, read))
        return (jnp.concatenate(parts, axis=1),) if len(parts) > 1 else tuple(parts)

    def others(self, q: Pose) -> tuple[Frame, ...]:
        """The frames of the further bodies of constraints (`AbstractJoint.others`)."""
        if not isinstance(self.elements, AbstractRows):
            return ()
        return tuple(Frame(q.position[np.asarray(of)], q.orientation[np.asarray(of)]) for of in self.carriers)

    @property
    def ends(self) -> Ends:
        found = Ends(self.a, self.b, self.owners, self.kept, acts_on=self.elements.acts_on)
        if not isinstance(self.elements, AbstractRows):
            places = places_of_states(num_states(self.elements))
            read = tuple((joint, cast(Any, self.elements).reads) for joint in self.joints)
            return found._replace(carriers=self.carriers, acts_on=(*found.acts_on, *places), read=read)
        velocity = isinstance(self.elements, AbstractVelocityConstraint)
        if self.carriers:
            every = tuple(range(BODY_DIM * (2 + len(self.carriers))))
            found = found._replace(carriers=self.carriers, acts_on=every)
            return found._replace(coupled=(every,), velocity=velocity, nth=self.places)
        relative, coupled = self.elements.relative, self.elements.coupled
        return found._replace(relative=relative, coupled=coupled, velocity=velocity, nth=self.places)

    def only(self, *which: int) -> "Stack[Element]":
        """The stack of some of its elements."""
        own = lambda of: tuple(of[i] for i in which)
        a, b = (None if side is None else own(side) for side in (self.a, self.b))
        elements = jax.tree.map(lambda leaf: jnp.take(leaf, np.asarray(which), 0, mode="clip"), self.elements)
        carriers, joints = tuple(map(own, self.carriers)), own(self.joints) if self.joints else ()
        return Stack(elements, a, b, own(self.owners), own(self.kept), own(self.places), carriers, joints)

    def map(self, function, ends: AtEnds, extra: Sequence[Any] = ()):
        """`function(element, frame_a, frame_b, *(side_a, side_b)…, *extra, *others)` for each; `ends`: of `at_ends`.

        A ground side gets the inertial frame and zeros. Each of `extra` has a leading axis over the elements, or is a
        scalar.
        """
        known = ends.a or ends.b
        assert known is not None  # not both are the ground
        dtype = known[0].dtype
        ground = (*ground_frame(dtype), *(jnp.zeros(array.shape[1:], dtype) for array in known[2:]))
        arrays = [item for pair in zip(ends.a or ground, ends.b or ground) for item in pair]
        axes = [None if end is None else 0 for end in ends[:2]] * len(ground)
        extra_axes = [*(0 if jnp.ndim(value) else None for value in extra), *(0 for _ in ends.others)]

        def each(element, position_a, position_b, orientation_a, orientation_b, *others):
            return function(element, Frame(position_a, orientation_a), Frame(position_b, orientation_b), *others)

        return jax.vmap(each, in_axes=(0, *axes, *extra_axes))(self.elements, *arrays, *extra, *ends.others)


def at_ends(stacks: Sequence[Stack], q: Pose, *arrays) -> list[AtEnds]:
    """The poses q of the bodies, and what (bodies, …) `arrays` have of them, at the ends of the elements of each stack.

    One gather for each side of all stacks: its transpose is one scatter, of which each takes XLA as long as ten other
    operations. Not one for both: XLA would make the bodies' poses again for each end, inside of the only operation that
    reads them (a step of a chain of 512 links took 5.8 instead of 2.9 ms).
    """

    def at(sides):
        known = [np.asarray(bodies) for bodies in sides if bodies is not None]
        if not known:
            return [None] * len(sides)
        index, sizes = np.concatenate(known), [len(bodies) for bodies in known]
        pieces = zip(*(lax.split(array[index], sizes) for array in (*q, *arrays)))
        return [None if bodies is None else next(pieces) for bodies in sides]

    sides = zip(at([stack.a for stack in stacks]), at([stack.b for stack in stacks]))
    return [AtEnds(a, b, stack.others(q)) for stack, (a, b) in zip(stacks, sides)]


def state_coordinates(stack: Stack, index: np.ndarray) -> np.ndarray:
    """Which coordinates have the states of each element as velocities, shape (elements, s), given those of bodies."""
    every = [index[list(of), : ROTATION.start] for of in stack.carriers]
    return np.concatenate(every, axis=1)[:, : num_states(stack.elements)]


def stack(placed: Sequence[Placed[Element]]) -> tuple[Stack[Element], ...]:
    """Group elements by type and ground side, keeping their order within a group; rows of velocity level are last."""
    groups: dict[Any, list[Placed[Element]]] = {}
    for item in placed:
        of, axes = (item.element.of, 1) if isinstance(item.element, StackRow) else (item.element, 0)
        leaves, structure = jax.tree.flatten(of)
        key = (structure, tuple((leaf.shape[axes:], leaf.dtype) for leaf in leaves), item.a is None, item.b is None)
        groups.setdefault(key, []).append(item)
    stacks = []
    for members in groups.values():
        first = members[0]
        stacks.append(
            Stack(
                elements=joined([m.element for m in members]),
                a=None if first.a is None else tuple(m.a for m in members if m.a is not None),
                b=None if first.b is None else tuple(m.b for m in members if m.b is not None),
                owners=tuple(m.owner for m in members),
                kept=tuple(m.kept for m in members),
                places=tuple(m.place for m in members),
                carriers=tuple(zip(*(m.carriers for m in members))),
                joints=tuple(m.joint for m in members if m.joint is not None),
            )
        )
    return tuple(sorted(stacks, key=lambda stack: stack.ends.velocity))


def position_values(stacks: Sequence[Stack[Any]], q: Pose, t) -> list[Float[Array, "e rows"]]:
    """Φ of the elements of each stack, those that are not kept too."""
    return [stack.map(value_of, ends, (t,)) for stack, ends in zip(stacks, at_ends(stacks, q))]


def value_of(element: AbstractConstraint, *args) -> Float[Array, " rows"]:
    """Φ of one element."""
    return of_length(element, "value", element.value(*args), element.num_rows, "its `num_rows` equations")


def rate_of(element: AbstractVelocityConstraint, *args) -> Float[Array, " rows"]:
    """A v + b of one element."""
    return of_length(element, "rate", element.rate(*args), element.num_rows, "its `num_rows` equations")


# Elements with closed-form tangents use them; for the others autodiff perturbs by R (I + θ̃).


def constraint_jacobian(element: AbstractRows, a: Frame, b: Frame, t, *others: Frame):
    """B of one element, or A, shape (rows, 12), 6 more for each other body."""
    if isinstance(element, AbstractClosedFormConstraint):
        return element.jacobian(a, b, t, *others)
    zero = jnp.zeros(BODY_DIM * (2 + len(others)), a.position.dtype)
    if isinstance(element, AbstractConstraint):

        def value(x):
            a_, b_, *others_ = tilted((a, b, *others), x)
            return value_of(element, a_, b_, t, *others_)

        return jax.jacfwd(value)(zero)
    assert isinstance(element, AbstractVelocityConstraint)
    return jax.jacfwd(lambda v: rate_of(element, a, b, v[BODY_A], v[BODY_B], t))(zero)


def constraint_force(element: AbstractRows, a: Frame, b: Frame, lam, t, *others: Frame):
    """Bᵀλ of one element, or Aᵀλ, shape (12,) or more."""
    if isinstance(element, AbstractClosedFormConstraint):
        return element.force(a, b, lam, t, *others)
    return lam @ constraint_jacobian(element, a, b, t, *others)


def constraint_stiffness(element: AbstractRows, a: Frame, b: Frame, lam, t, *others: Frame):
    """D_q(Bᵀλ) of one element, or D_q(Aᵀλ), shape (12, 12) or more."""
    if isinstance(element, AbstractClosedFormConstraint):
        return element.geometric_stiffness(a, b, lam, t, *others)
    zero = jnp.zeros(BODY_DIM * (2 + len(others)), a.position.dtype)

    def force(x):
        a_, b_, *others_ = tilted((a, b, *others), x)
        return constraint_force(element, a_, b_, lam, t, *others_)

    return jax.jacfwd(force)(zero)


def entries_at(arrays: Float[Array, "... n"], places: np.ndarray, axis: int = -1) -> Float[Array, "... p"]:
    """The entries at increasing `places` along an axis, by slices, of which XLA computes no others."""
    if not len(places):
        return lax.slice_in_dim(arrays, 0, 0, axis=axis)
    runs = np.split(places, np.flatnonzero(np.diff(places) > 1) + 1)
    return jnp.concatenate([lax.slice_in_dim(arrays, run[0], run[-1] + 1, axis=axis) for run in runs], axis=axis)


def square_blocks(matrices: Float[Array, "e n n"], places: np.ndarray) -> Float[Array, "e p p"]:
    """The rows and columns at increasing `places`."""
    return entries_at(entries_at(matrices, places), places, axis=1)


def load_tangents(element: AbstractLoad | AbstractDynamicLoad, a: Frame, b: Frame, va, vb, t, *z) -> LoadTangents:
    """∂Q/∂q and ∂Q/∂v of one element; with states z, of Q and g by the coordinates of bodies and carriers."""
    if isinstance(element, AbstractClosedFormLoad):
        return element.tangents(a, b, va, vb, t)
    bodies, count = 2 * BODY_DIM, num_states(element)
    zero = jnp.zeros(bodies, a.position.dtype)

    def force(x, speed, *states):
        changed = [of_z.at[:count].add(states[0]) if states else of_z for of_z in z]
        return generalized_force(element, *tilted((a, b), x), va + speed[BODY_A], vb + speed[BODY_B], t, *changed)

    if not z:  # a gradient of four torsion springs takes 7 % less time than with one Jacobian of both
        return LoadTangents(*(jax.jacfwd(force, argnums=i)(zero, zero) for i in (0, 1)))
    # one Jacobian: three of friction in a hinge and a controller take a quarter more time to compile
    ends = bodies, 2 * bodies
    every = jax.jacfwd(lambda x: force(*jnp.split(x, ends)))(jnp.zeros(2 * bodies + count, zero.dtype))
    *of_bodies, by_states = jnp.split(every, ends, axis=1)
    wide = jnp.zeros((len(every), len(every)), every.dtype)
    position, velocity = (wide.at[:, :bodies].set(part) for part in of_bodies)
    if count:
        velocity = velocity.at[:, np.asarray(places_of_states(count))].set(by_states)
    return LoadTangents(position, velocity)


def load_by_multipliers(element: AbstractDynamicLoad, a: Frame, b: Frame, va, vb, t, z) -> Float[Array, "n r"]:
    """∂Q/∂λ, and ∂g/∂λ, of one element that reads multipliers."""
    states, lam = jnp.split(z, [num_states(element)])
    at = lambda lam: generalized_force(element, a, b, va, vb, t, jnp.concatenate([states, lam]))
    return jax.jacfwd(at)(lam)
