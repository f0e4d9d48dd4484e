"""How many constraints of a system are independent near its reference, and which of them repeat others."""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from lgsens.dynamics._constraints import full_jacobian
from lgsens.dynamics._initial import assemble
from lgsens.dynamics._system import AbstractSystem
from lgsens.linear import Matrix, SparseMatrix

_DIRECTIONS = 4  # of motion, in which the neighbourhood of the reference is looked at
_DISTANCE = 0.01  # how far, in rad or lengths of the scene
_WAYS, _STRIDES, _STRIDE = 2, 12, 0.25  # directions, forward and back, and steps of a walk away from it
_ITERATIONS = 20


class Rank(NamedTuple):
    """The rank of J in the reference configuration, the largest found near it, and a q and J that have that."""

    reference: int
    near: int
    q: Any
    jacobian: Float[np.ndarray, "m k"]


def rank_near_reference(system: AbstractSystem, t: Float[Array, ""], driven: Bool[np.ndarray, " m"]) -> Rank:
    """The rank in the reference configuration and in others that the mechanism reaches by moving from it a little: in a
    singular reference alone it would be too small. Numbers are known, and constraints may be redundant.

    driven: equations that need not hold there, as they will not a little later: those of drivers. A crank that is held
    in its dead centre would be in one wherever the rest can move.
    """
    q, _ = _assembled(system, t)
    at = best = _Place(q, _evaluated(system, q, t)[1])
    scale, _ = _sizes(system)
    reference = rank = left_null_space(at.jacobian * scale)[1]
    for direction in np.random.default_rng(0).normal(size=(_DIRECTIONS, at.jacobian.shape[1])):
        there, _ = _moved(system, at, t, direction, _DISTANCE, driven)
        if there is not None and (own := left_null_space(there.jacobian * scale)[1]) > rank:
            best, rank = there, own
    return Rank(reference, rank, *best)


def jacobians_on_the_way(
    system: AbstractSystem, found: Rank, t: Float[Array, ""], driven: Bool[np.ndarray, " m"]
) -> list[Float[np.ndarray, "m k"]]:
    """J in configurations that the mechanism reaches, where it has the rank that was found; `driven` as above."""
    (scale, _), every, k = _sizes(system), [found.jacobian], found.jacobian.shape[1]
    for way in np.random.default_rng(1).normal(size=(_WAYS, k)):
        for direction in (way, -way):
            place: _Place | None = _Place(found.q, found.jacobian)
            for _ in range(_STRIDES):
                place, direction = _moved(system, place, t, direction, _STRIDE, driven)
                if place is None:
                    break
                if left_null_space(place.jacobian * scale)[1] == found.near:
                    every.append(place.jacobian)
    return every


def repeated_rows(jacobians: Float[np.ndarray, "c m k"], weights: Float[np.ndarray, " m"]) -> list[int]:
    """Rows that can be left out of c matrices of one rank, so that what is left has it too; of greater weight first.

    Let the columns of N, m × d, be an orthonormal basis of the left null space. The rows that are left are independent
    where those of N that belong to the others are, and the better the larger the least singular value of these. So rows
    of N are taken by QR with column pivoting, of which most is left beside those before in the matrix where that is
    least.
    """
    rest = np.stack([left_null_space(jacobian)[0] for jacobian in jacobians]) * weights[:, None]
    found: list[int] = []
    for _ in range(rest.shape[2]):
        found.append(int(np.argmax(np.min(np.linalg.norm(rest, axis=2), axis=0))))
        row = rest[:, found[-1]]
        unit = row / np.maximum(np.linalg.norm(row, axis=1, keepdims=True), np.finfo(row.dtype).tiny)
        rest = rest - np.einsum("cmd,cd,ce->cme", rest, unit, unit)
        rest[:, found] = 0.0
    return found


def redundant_names(jacobian: Matrix, names: tuple[str, ...]) -> list[str]:
    """The joints whose rows of B are linearly dependent: those with weight in the left null space of B."""
    if isinstance(jacobian, SparseMatrix):
        jacobian = jacobian.to_numpy()
    null_space, _ = left_null_space(jacobian)
    weight = np.abs(null_space).max(axis=1, initial=0.0)
    return sorted({name for name, w in zip(names, weight) if w > np.sqrt(np.finfo(jacobian.dtype).eps)})


def of_unit_rows(jacobian: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The left singular vectors, all of them, and the singular values of B with unit rows."""
    rows = jacobian / np.maximum(np.linalg.norm(jacobian, axis=1, keepdims=True), np.finfo(jacobian.dtype).tiny)
    return np.linalg.svd(rows)[:2]


def left_null_space(jacobian: np.ndarray) -> tuple[np.ndarray, int]:
    """An orthonormal basis of the left null space of B with unit rows, and the rank of B."""
    left, singular = of_unit_rows(jacobian)
    rank = int(np.sum(singular > np.sqrt(np.finfo(jacobian.dtype).eps)))
    return left[:, rank:], rank


class _Place(NamedTuple):
    """A configuration, and J there."""

    q: Any
    jacobian: Float[np.ndarray, "m k"]


def _moved(system: AbstractSystem, place: _Place, t, direction, distance: float, driven):
    """The place at a distance from another one along a direction, None if there is none; and the direction there.
    `driven`: equations that need not hold."""
    (q, jacobian), (scale, tolerance), held = place, _sizes(system), ~driven
    # the part of the direction that the constraints allow, in comparable coordinates
    rows = jacobian[held] * scale
    x = direction - np.linalg.lstsq(rows, rows @ direction, rcond=None)[0]
    size = np.abs(x).max(initial=0.0)
    if size < 1e-6:  # no freedom
        return None, x
    begun = _retracted(system, q, distance * scale * x / size)
    # Singular values that the distance does not explain belong to redundant equations. Those of a branch that begins in
    # a singular reference, to which a direction between two of them leads, may be as small.
    for least in (1e-2 * distance, 1e-4 * distance):
        q = begun
        for _ in range(_ITERATIONS):
            violation, jacobian = _evaluated(system, q, t)
            own = np.flatnonzero(held[: len(violation)])
            if np.abs(violation[own]).max(initial=0.0) <= tolerance:
                return _Place(q, jacobian), x
            step = np.linalg.lstsq(jacobian[own] * scale, violation[own], rcond=least)[0]
            q = _retracted(system, q, -scale * step)
    return None, x


_assembled = eqx.filter_jit(assemble)


def _sizes(system) -> tuple[np.ndarray, np.ndarray]:
    """Those of coordinates, and what counts as none of Φ."""
    scale, round_off = _scale_and_round_off(system)
    return np.asarray(scale), np.asarray(round_off)


@eqx.filter_jit
def _scale_and_round_off(system):
    return system.coordinate_scale(), system.constraint_round_off()


def _evaluated(system, q, t) -> tuple[np.ndarray, np.ndarray]:
    """Φ and J."""
    violation, jacobian = _value_and_jacobian(system, q, t)
    return np.asarray(violation), np.asarray(jacobian)


@eqx.filter_jit
def _value_and_jacobian(system, q, t):
    return system.constraint(q, t), full_jacobian(system, q, t)


@eqx.filter_jit
def _retracted(system, q, x):
    return system.group.retract(q, x)
