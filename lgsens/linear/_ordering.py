"""In which order unknowns are eliminated: levels of clusters that do not touch each other.

The unknowns come as nodes: the coordinates of a body, the multipliers of a joint. Two nodes are neighbours where the
matrix couples them. A cluster is a node and what is eliminated with it; its boundary, the neighbours that remain, is
coupled by the elimination. The clusters of a level are independent: one batched operation eliminates all of them, and a
chain of N bodies takes log₂ N levels.

A joint has no pivot of its own. Its multipliers follow the bodies that it connects: with A the block of some bodies,
whose symmetric part is positive definite like the mass matrix, −B A⁻¹ Bᵀ is negative definite like it where the rows of
B are independent, in any order of the joints (a quasi-definite matrix: Vanderbei 1995, doi:10.1137/0805005). So no
pivoting across clusters is needed.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np


class Level(NamedTuple):
    """Clusters of equal shape: their own unknowns, shape (clusters, p), and those of their boundaries, (clusters, q).

    Unknown n, one after the last, fills up.
    """

    own: np.ndarray
    boundary: np.ndarray


class Cluster(NamedTuple):
    nodes: tuple[int, ...]
    boundary: frozenset[int]


def levels(
    nodes: Sequence[Sequence[int]], neighbours: Sequence[set[int]], after: Mapping[int, set[int]]
) -> list[Level]:
    """The levels, until nothing remains.

    Arguments:
        nodes: the unknowns of each node. neighbours: of each node, symmetric.
        after: the nodes that must be eliminated before or with a node.
    """
    total = sum(map(len, nodes))
    size = [len(node) for node in nodes]
    around = [set(near) for near in neighbours]
    gone: set[int] = set()
    remaining = {i for i, count in enumerate(size) if count}
    found = []
    while remaining:
        chosen = _independent(remaining, gone, size, around, after)
        if not chosen:
            break
        found.append(_level(chosen, nodes, total))
        for cluster in chosen:
            for i in cluster.boundary:
                around[i] |= cluster.boundary
                around[i] -= {i, *cluster.nodes}
            gone.update(cluster.nodes)
            remaining.difference_update(cluster.nodes)
    return found


def _independent(remaining, gone, size, around, after) -> list[Cluster]:
    """Clusters that do not touch each other, those with the smallest boundaries first.

    A boundary larger than most waits: it shrinks when its neighbours are gone (the chassis after the links).
    """
    candidates = [i for i in sorted(remaining) if after.get(i, set()) <= gone]
    weight = lambda cluster: sum(size[i] for i in cluster.boundary)
    grown = [_grown(i, gone, size, around, after, None) for i in candidates]
    if not grown:
        return []
    limit = float(np.median([weight(cluster) for cluster in grown]))
    own = Counter(sum(size[i] for i in cluster.nodes) for cluster in grown if weight(cluster) <= limit)
    largest = max(own, key=lambda p: (own[p] * p, p))
    taken, chosen = set(), []
    for cluster in sorted(grown, key=lambda cluster: (weight(cluster) > limit, cluster.nodes[0])):
        cluster = _grown(cluster.nodes[0], gone, size, around, after, largest)
        if weight(cluster) > limit or sum(size[i] for i in cluster.nodes) > largest:
            continue
        if taken.isdisjoint(cluster.nodes) and all(taken.isdisjoint(around[i]) for i in cluster.nodes):
            chosen.append(cluster)
            taken.update(cluster.nodes)
    return chosen


def _grown(node: int, gone, size, around, after, largest: int | None) -> Cluster:
    """A node with the nodes that may follow it at once and couple nothing more than it does."""
    nodes, near, count = [node], set(around[node]), size[node]
    for other in sorted(around[node]):
        allowed = after.get(other) is not None and after[other] <= gone | set(nodes)
        fits = largest is None or count + size[other] <= largest
        if allowed and fits and around[other] - {node} <= near:
            nodes.append(other)
            count += size[other]
    return Cluster(tuple(nodes), frozenset(near - set(nodes)))


def _level(chosen: Sequence[Cluster], nodes, fill: int) -> Level:
    own = [[unknown for i in cluster.nodes for unknown in nodes[i]] for cluster in chosen]
    boundary = [[unknown for i in sorted(cluster.boundary) for unknown in nodes[i]] for cluster in chosen]
    return Level(_filled(own, fill), _filled(boundary, fill))


def _filled(rows: Sequence[Sequence[int]], fill: int) -> np.ndarray:
    full = np.full((len(rows), max(map(len, rows))), fill, np.int32)
    for row, values in zip(full, rows):
        row[: len(values)] = values
    return full
