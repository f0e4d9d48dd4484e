"""What a system's arrays look like whatever its numbers: who is coupled to whom, and where the entries go."""

from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from lgsens.liegroups import Poses
from lgsens.linear import AbstractLinearSolver, Elimination, Graph, Joint, Pattern, elimination
from lgsens.model._frames import ALL, BODY_DIM, ROTATION


class Ends(NamedTuple):
    """What is static of a stack of elements; hashable."""

    a: tuple[int, ...] | None
    b: tuple[int, ...] | None
    owners: tuple[str, ...]
    kept: tuple[tuple[bool, ...], ...]
    relative: bool = False  # of constraints, as in `AbstractConstraint`
    coupled: tuple[tuple[int, ...], ...] = ()  # likewise
    acts_on: tuple[int, ...] = ALL  # likewise, and of loads
    velocity: bool = False  # of constraints, whether their rows have velocity level only
    carriers: tuple[tuple[int, ...], ...] = ()  # of loads with states: the bodies that carry them
    nth: tuple[int, ...] = ()  # of constraints: which of its joint's each is
    read: tuple[tuple[str, tuple[int, ...]], ...] = ()  # of loads: the joint whose multipliers each reads

    @property
    def _sides(self) -> list[tuple[int, tuple[int, ...]]]:
        """The place of each side that is not the ground, and its bodies."""
        return [(i, side) for i, side in enumerate((self.a, self.b, *self.carriers)) if side is not None]

    @property
    def slots(self) -> np.ndarray:
        """The bodies of each element, carriers of states too, shape (elements, 1 or more)."""
        return np.stack([np.asarray(side, int) for _, side in self._sides], axis=1)

    @property
    def own(self) -> np.ndarray:
        """The coordinates of an element that belong to bodies, 0 … 11 or more; the ground has none."""
        return np.concatenate([BODY_DIM * i + np.arange(BODY_DIM) for i, _ in self._sides])

    def places(self, coordinates: tuple[int, ...]) -> np.ndarray:
        """Where these increasing coordinates are among `own`."""
        return np.flatnonzero(np.isin(self.own, coordinates))


class Topology:
    """Where the entries of a system are; static, and equal only to itself."""

    def __init__(self, index: np.ndarray, constraints: tuple[Ends, ...], loads: tuple[Ends, ...]):
        self.index, self._constraints, self._loads = index, constraints, loads
        self._plans: dict[Any, Elimination | None] = {}
        self.rows: list[np.ndarray] = []
        start = 0
        for ends in constraints:
            kept = np.asarray(ends.kept)
            self.rows.append(np.where(kept, start + np.cumsum(kept).reshape(kept.shape) - 1, -1).astype(np.int32))
            start += int(kept.sum())
        self.num_constraints = start
        self.num_velocity_rows = sum(int(np.sum(ends.kept)) for ends in constraints if ends.velocity)
        self.num_positions = sum(not ends.velocity for ends in constraints)  # stacks; they come first
        self.mass = Pattern(index, index, np.arange(len(index))[:, None])
        self.gyroscopic = Pattern(index[:, ROTATION], index[:, ROTATION])
        self.loads = [self._square(ends) for ends in loads]
        self.stiffness = [self._stiffness(ends) for ends in constraints]
        self.jacobian = [
            Pattern(rows, self.coordinates(ends)[:, ends.places(ends.acts_on)], ends.slots)
            for rows, ends in zip(self.rows, constraints)
        ]
        self.forces = [self.coordinates(ends)[:, ends.places(ends.acts_on)] for ends in loads]
        self.read = [Pattern(self._read(ends), own) for ends, own in zip(loads, self.forces)]

    def coordinates(self, ends: Ends) -> np.ndarray:
        """The coordinates of each element's bodies, shape (elements, 6 or 12); −1 where a body has none."""
        return self.index[ends.slots].reshape(len(ends.owners), -1)

    def _read(self, ends: Ends) -> np.ndarray:
        """Where the multipliers are that each load reads, shape (elements, rows of its joint); −1 for those that the
        joint does not have between its bodies."""
        own = {
            (owner, place): rows
            for of, rows_of in zip(self._constraints, self.rows)
            for owner, place, rows in zip(of.owners, of.nth, rows_of)
        }
        found = [
            [row for i, count in enumerate(counts) for row in own.get((joint, i), (-1,) * count)]
            for joint, counts in ends.read
        ]
        return np.asarray(found, np.int32)

    def _square(self, ends: Ends) -> Pattern:
        coordinates = self.coordinates(ends)
        return Pattern(coordinates, coordinates, ends.slots)

    def _stiffness(self, ends: Ends) -> list[tuple[np.ndarray, Pattern]]:
        """Of each set of coupled coordinates those of bodies, by their places among these, and where they are."""
        coordinates, found = self.coordinates(ends), []
        for group in ends.coupled:
            places = ends.places(group)
            if len(places):
                own = coordinates[:, places]
                found.append((places, Pattern(own, own, ends.slots[:, np.unique(places // BODY_DIM)])))
        return found

    @cached_property
    def _graphs(self) -> tuple[Graph, Graph]:
        """Bodies, and after them joints, for the elimination: of all elements, and of joints alone (of M and B)."""
        k = int((self.index >= 0).sum())
        count = len(self.index)
        names = sorted({owner for ends in self._constraints for owner in ends.owners})
        number = {name: count + i for i, name in enumerate(names)}
        nodes = [list(own[own >= 0]) for own in self.index] + [[] for _ in names]
        near: list[set[int]] = [set() for _ in nodes]
        joints = {node: Joint(frozenset(), grounded=False, relative=True) for node in number.values()}
        for ends, rows in zip(self._constraints, self.rows):
            for owner, bodies, own in zip(ends.owners, ends.slots.tolist(), rows):
                node = number[owner]
                nodes[node].extend(k + own[own >= 0])
                known = joints[node]
                joints[node] = Joint(
                    known.bodies | set(bodies), known.grounded or len(bodies) == 1, known.relative and ends.relative
                )
                _join(near, {node, *bodies})
        by_joints = [set(some) for some in near]
        for ends in self._loads:
            for bodies in ends.slots.tolist():
                _join(near, set(bodies))
        for node, joint in joints.items():  # of two bodies or of one and the ground, no more
            if len(joint.bodies) + joint.grounded > 2:
                joints[node] = joint._replace(relative=False)
        whole = frozenset(body for body, own in enumerate(self.index) if (own >= 0).all())
        return Graph(nodes, near, joints, whole), Graph(nodes, by_joints, joints, whole)

    def elimination(self, solver: AbstractLinearSolver | None, arrangement: Any = None) -> Elimination | None:
        """The plan of the linear solver, made once; None: a dense one. `solver` None: the cheaper one.

        `arrangement`: of other unknowns (`AbstractSparseSystem.arranged`); None: coordinates and multipliers."""
        if self.num_velocity_rows:  # they are not those of B T in S, as plans take them to be
            return None
        key = solver, arrangement
        if key not in self._plans:
            graph, by_joints = self._graphs
            if arrangement is None:
                self._plans[key] = elimination(solver, graph, by_joints)
            else:
                every, dense = arrangement(graph)
                self._plans[key] = elimination(solver, every, every, dense)
        return self._plans[key]


def _join(near: list[set[int]], group: set[int]) -> None:
    for one in group:
        near[one] |= group - {one}


@lru_cache(maxsize=64)
def topology(free: tuple[tuple[int, ...], ...], constraints: tuple[Ends, ...], loads: tuple[Ends, ...]) -> Topology:
    return Topology(Poses(free).index.astype(np.int32), constraints, loads)
