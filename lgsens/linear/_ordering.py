"""In which order unknowns are eliminated: levels of clusters that do not touch each other.

The unknowns come as nodes: the coordinates of a body, the multipliers of a joint. Two nodes are neighbours where the
matrix couples them. A cluster is a node and what is eliminated with it; its boundary, the neighbours that remain, is
coupled by the elimination. The clusters of a level are independent: one batched operation eliminates all of them, and a
chain of N bodies takes log₂ N levels.

A joint has no pivot of its own. Its multipliers follow bodies that it connects: with A the block of some bodies, whose
symmetric part is positive definite like the mass matrix, −B A⁻¹ Bᵀ is negative definite like it where the rows of B are
independent in the columns of those bodies, in any order of the joints (a quasi-definite matrix: Vanderbei 1995,
doi:10.1137/0805005). So no pivoting across clusters is needed. The rows are independent

- where all bodies of the joints are among those bodies: the rows of all joints of a system are; and
- where the joints, whose other bodies are held, make of these bodies a tree that hangs at one joint: each joint takes
  its directions from the body below it. Two such joints can hold a body that hangs at both of them (a link between
  chassis and wheel carrier), so one is all that a tree has before the held bodies follow.

Early joints shrink what remains: of a chain of hinged links a link leaves 22 unknowns at its boundary, a link with one
of its hinges 17; of the 93 unknowns of the quarter-car, the wheel and five links leave 57, with a joint of each 37.
"""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Level(NamedTuple):
    """Clusters of equal shape: their own unknowns, shape (clusters, p), and those of their boundaries, (clusters, q).

    Unknown n, one after the last, fills up.
    """

    own: np.ndarray
    boundary: np.ndarray


class Joint(NamedTuple):
    """What the multipliers of a node belong to: its bodies (nodes), whether the ground is one more, and whether its
    equations are independent as those of either body alone, with the other held."""

    bodies: frozenset[int]
    grounded: bool
    relative: bool


class Graph(NamedTuple):
    """The unknowns of each node, its neighbours (symmetric), the joints among the nodes, and the bodies that have all
    six coordinates."""

    nodes: Sequence[Sequence[int]]
    neighbours: Sequence[set[int]]
    joints: Mapping[int, Joint]
    whole: frozenset[int]

    @property
    def sizes(self) -> tuple[int, int]:
        """How many coordinates the bodies have, and how many rows the joints."""
        joints = sum(len(self.nodes[node]) for node in self.joints)
        return sum(map(len, self.nodes)) - joints, joints

    def with_unknowns(self, of_bodies: Sequence[int], of_joints: Sequence[int]) -> "Graph":
        """The same graph with several unknowns for each, in each node in this order: where those of the coordinates
        begin, and those of the rows."""
        k, _ = self.sizes

        def unknowns(node: int, own: Sequence[int]) -> list[int]:
            begins, before = (of_joints, k) if node in self.joints else (of_bodies, 0)
            return [begin + i - before for begin in begins for i in own]

        return self._replace(nodes=[unknowns(node, own) for node, own in enumerate(self.nodes)])


class GraphPart(NamedTuple):
    """Bodies that are gone, and what is known of the joints between them that are gone."""

    hanging: int = 0  # how many of them have a body that remains
    grounded: int = 0
    loops: bool = False
    whole: bool = True  # bodies have all coordinates, and joints are relative

    def independent(self, *, early: bool) -> bool:
        """Whether the rows of the joints are, in the columns of the bodies."""
        return not self.hanging or (early and not self.loops and self.whole and self.hanging + self.grounded == 1)


def _together(parts: Sequence[GraphPart], *, closed: bool = False) -> GraphPart:
    """Parts connected to each other; `closed`: some of them twice."""
    return GraphPart(
        sum(part.hanging for part in parts),
        sum(part.grounded for part in parts),
        closed or any(part.loops for part in parts),
        all(part.whole for part in parts),
    )


class Cluster(NamedTuple):
    nodes: tuple[int, ...]
    boundary: frozenset[int]
    part: GraphPart
    absorbed: frozenset[int]  # the parts that it connects


class _Gone:
    """The nodes that are gone, in parts that do not touch each other."""

    def __init__(self, graph: Graph, *, early: bool):
        self.graph, self.early = graph, early
        self.parts: dict[int, GraphPart] = {}
        self._home: dict[int, int] = {}  # of each body its part, and of a part the one that it became
        self._waiting: dict[int, list[int]] = defaultdict(list)  # the parts that hang on a body

    def _part_of(self, node: int) -> int | None:
        while node in self._home:
            node = self._home[node]
        return node if node in self.parts else None

    def start(self, node: int, near: set[int]) -> Cluster | None:
        """A node on its own, if it may go."""
        empty = Cluster((), frozenset(near), GraphPart(), frozenset())
        if node in self.graph.joints:
            return self.with_joint(empty._replace(boundary=frozenset(near | {node})), node, near)
        hanging = [part for part in map(self._part_of, self._waiting[node]) if part is not None]
        own = GraphPart(-len(hanging), whole=node in self.graph.whole)
        parts = [own, *(self.parts[part] for part in set(hanging))]
        found = _together(parts, closed=len(set(hanging)) < len(hanging))
        return Cluster((node,), frozenset(near), found, frozenset(hanging))

    def with_joint(self, cluster: Cluster, node: int, near: set[int]) -> Cluster | None:
        """The cluster with the joint, if that may go."""
        joint = self.graph.joints[node]
        places = []
        for body in joint.bodies:
            part = self._part_of(body)
            places.append(-1 if body in cluster.nodes or part in cluster.absorbed else part)
        inside = [place for place in places if place is not None]
        others = {place for place in inside if place >= 0}
        own = GraphPart(len(places) - len(inside), int(joint.grounded), whole=joint.relative)
        parts = [cluster.part, own, *(self.parts[place] for place in others)]
        found = _together(parts, closed=len(set(inside)) < len(inside))
        nodes = (*cluster.nodes, node)
        if not found.independent(early=self.early):
            return None
        return Cluster(nodes, (cluster.boundary | near) - set(nodes), found, cluster.absorbed | others)

    def add(self, cluster: Cluster) -> None:
        name = len(self.graph.nodes) + len(self._home)  # of the part; of no node, nor of another part
        self.parts[name] = cluster.part
        for node in (*cluster.nodes, *cluster.absorbed):
            self._home[node] = name
        for node in cluster.nodes:
            for body in self.graph.joints[node].bodies if node in self.graph.joints else ():
                if self._part_of(body) is None:
                    self._waiting[body].append(name)


def levels(graph: Graph, *, early: bool) -> list[Level]:
    """The levels, until nothing remains; `early`: joints may go before one of their bodies."""
    total = sum(map(len, graph.nodes))
    size = [len(node) for node in graph.nodes]
    around = [set(near) for near in graph.neighbours]
    gone = _Gone(graph, early=early)
    remaining = {i for i, count in enumerate(size) if count}
    found = []
    while remaining:
        chosen = _independent(remaining, gone, size, around)
        if not chosen:
            break
        found.append(_level(chosen, graph.nodes, total))
        for cluster in chosen:
            for i in cluster.boundary:
                around[i] |= cluster.boundary
                around[i] -= {i, *cluster.nodes}
            gone.add(cluster)
            remaining.difference_update(cluster.nodes)
    return found


def _independent(remaining, gone: _Gone, size, around) -> list[Cluster]:
    """Clusters that do not touch each other, those with the smallest boundaries first.

    A boundary larger than most waits: it shrinks when its neighbours are gone (the chassis after the links).
    """
    weight = lambda cluster: sum(size[i] for i in cluster.boundary)
    grown = [cluster for i in sorted(remaining) if (cluster := _grown(i, gone, size, around, None))]
    if not grown:
        return []
    limit = float(np.median([weight(cluster) for cluster in grown]))
    own = Counter(sum(size[i] for i in cluster.nodes) for cluster in grown if weight(cluster) <= limit)
    largest = max(own, key=lambda p: (own[p] * p, p))
    taken, chosen = set(), []
    for whole in sorted(grown, key=lambda cluster: (weight(cluster) > limit, cluster.nodes[0])):
        cluster = _grown(whole.nodes[0], gone, size, around, largest)
        if cluster is None or weight(cluster) > limit or sum(size[i] for i in cluster.nodes) > largest:
            continue
        if taken.isdisjoint(cluster.nodes) and all(taken.isdisjoint(around[i]) for i in cluster.nodes):
            chosen.append(cluster)
            taken.update(cluster.nodes)
    return chosen


def _grown(node: int, gone: _Gone, size, around, largest: int | None) -> Cluster | None:
    """A node with the joints that may follow it at once: those that couple nothing more than it does or, where they may
    go early, that take more unknowns away than they couple."""
    cluster = gone.start(node, around[node])
    weight = lambda nodes: sum(size[i] for i in nodes)
    while cluster is not None:
        followers = []
        for other in sorted(cluster.boundary & gone.graph.joints.keys()):
            more = weight(around[other] - cluster.boundary - {*cluster.nodes, other})
            fits = largest is None or weight(cluster.nodes) + size[other] <= largest
            if fits and (more < size[other] if gone.early else not more):
                followers.append((more - size[other], other))
        for _, other in sorted(followers):
            if longer := gone.with_joint(cluster, other, around[other]):
                cluster = longer
                break
        else:
            return cluster
    return None


def _level(chosen: Sequence[Cluster], nodes, fill: int) -> Level:
    own = [[unknown for i in cluster.nodes for unknown in nodes[i]] for cluster in chosen]
    boundary = [[unknown for i in sorted(cluster.boundary) for unknown in nodes[i]] for cluster in chosen]
    return Level(_filled(own, fill), _filled(boundary, fill))


def of_one_shape(some: Sequence[Level], count: int, fill: int) -> list[Level]:
    """Levels with the same clusters, `count` in each, filled up."""
    p, q = (max(level[i].shape[1] for level in some) for i in range(2))

    def parts(unknowns, width):
        rows, columns = -len(unknowns) % count, width - unknowns.shape[1]
        full = np.pad(unknowns, ((0, rows), (0, columns)), constant_values=fill)
        return full.reshape(-1, count, width)

    return [Level(*both) for own, boundary in some for both in zip(parts(own, p), parts(boundary, q))]


def _filled(rows: Sequence[Sequence[int]], fill: int) -> np.ndarray:
    full = np.full((len(rows), max(map(len, rows))), fill, np.int32)
    for row, values in zip(full, rows):
        row[: len(values)] = values
    return full
