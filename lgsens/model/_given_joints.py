"""The joints of a scene as they were given, kept by its equations.

Equations of motion hold what equations need: points and axes in the frames of bodies. How the bodies of a joint move in
each other is told by its frames (`AbstractJoint.frames`), functions of the numbers it was given. So a system keeps
these, joints of one kind in one array: a motion, an instant of one and whatever is differentiated by the system know
their joints, and derivatives by hardpoints and axes come the same way as those by masses.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lgsens._validate import array_of, is_concrete
from lgsens.model._evaluate_by_kind import StackRow
from lgsens.model._joints import AbstractJoint


def numbers_of(joint: AbstractJoint, dtype: Any) -> list[Array]:
    """Its numbers, as what a system is differentiated by."""
    return [jnp.asarray(leaf, jnp.promote_types(dtype, jnp.result_type(leaf))) for leaf in jax.tree.leaves(joint)]


class Structure:
    """What numbers of a joint are numbers of, and static: a `PyTreeDef` that can be copied and pickled.

    One by itself cannot: equinox marks fields that are missing by an object of which a copy is another one. So a copy
    is made of a joint with no numbers.
    """

    __slots__ = ("of",)

    def __init__(self, joint: AbstractJoint):
        self.of = jax.tree.structure(joint)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Structure) and self.of == other.of

    def __hash__(self) -> int:
        return hash(self.of)

    def __reduce__(self):
        return Structure, (jax.tree.unflatten(self.of, range(self.of.num_leaves)),)


class GivenJoints(eqx.Module):
    """Joints of one kind: their numbers with a leading axis, and by each name what they are numbers of."""

    numbers: list[Array]
    structures: tuple[tuple[str, Structure], ...] = eqx.field(static=True)

    def __getitem__(self, name: str) -> AbstractJoint:
        place = [own for own, _ in self.structures].index(name)
        row = lambda leaf: array_of(np.asarray(leaf)[place]) if is_concrete(leaf) else leaf[place]
        return jax.tree.unflatten(self.structures[place][1].of, map(row, self.numbers))


def given_joints(joints: Sequence[tuple[str, AbstractJoint]], rows: Sequence[StackRow]) -> tuple[GivenJoints, ...]:
    """Joints by name, of each of which a row has `numbers_of`."""
    kinds: dict[int, list[int]] = {}
    for i, row in enumerate(rows):
        kinds.setdefault(id(row.of), []).append(i)
    structure = lambda i: (joints[i][0], Structure(joints[i][1]))
    return tuple(GivenJoints(rows[own[0]].of, tuple(map(structure, own))) for own in kinds.values())


class JointsOf(Mapping[str, AbstractJoint]):
    """The joints that a system keeps, by name; one is made when it is asked for."""

    def __init__(self, given: Sequence[GivenJoints]):
        self._of = {name: of for of in given for name, _ in of.structures}

    def __getitem__(self, name: str) -> AbstractJoint:
        return self._of[name][name]

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._of))

    def __len__(self) -> int:
        return len(self._of)
