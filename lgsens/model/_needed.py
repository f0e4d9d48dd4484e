"""What the degrees of freedom of two bodies leave of the equations of a joint between them."""

from collections.abc import Sequence

from lgsens._validate import require
from lgsens.model._constraints import AbstractRows, Coincidence, Orthogonality
from lgsens.model._free import ROTATIONS, TRANSLATIONS, Free, is_along, single_rotation
from lgsens.model._joints import AbstractJoint, FixedJoint, RevoluteJoint
from lgsens.model._rolling import Rolling


def needed(
    name: str, joint: AbstractJoint, constraints: Sequence[AbstractRows], free_a: Free, free_b: Free
) -> list[tuple[bool, ...]]:
    """Which equations of each of a joint's basic constraints its bodies could violate; the ground has `free` = ().

    The others hold in every configuration as they do in the reference, so their rows of B are zero on the free
    coordinates: with them the constraints would be redundant, and without them nothing is lost. Let the rotations
    of the two bodies be about one inertial axis e at most.

      - A component of x_b + R_b X_b − x_a − R_a X_a along e changes by translation along e only; another
        one by any rotation too.
      - R_a e_a · R_b e_b is constant without rotations. With the one about e it is constant in a hinge about e; of
        the three orthogonalities of a triad x·y, y·z, z·x only that of the two axes other than e changes.

      - A wheel that only turns about its axle slips sideways by translation along it only. It lifts by translation
        along one line not at all, if the plane is along that line.

    A joint that the reference configuration need not satisfy keeps all its equations of position level.

    Raises `ValueError` for a hinge or an axle about another axis than the one rotation that its bodies have, and for a
    wheel that can only move along a line that leaves the plane.
    """
    free = {*free_a, *free_b}
    rotations = free & set(ROTATIONS)
    axis = single_rotation(free)
    if axis is not None and isinstance(joint, Rolling):
        return _of_rolling(name, joint, free, axis)
    keep_all = [(True,) * constraint.num_rows for constraint in constraints]
    if not joint.assembled or (rotations and axis is None):
        return keep_all
    if axis is not None and isinstance(joint, RevoluteJoint):
        require(
            lambda direction: is_along(direction, axis),
            f"Joint {name!r}: `axis` {joint.axis} must be that of {ROTATIONS[axis]!r}, the only rotation that "
            f"{joint.a!r} and {joint.b!r} have; turn the axis, or free all rotations of one of them.",
            joint.axis,
        )
    kept = []
    for constraint, default in zip(constraints, keep_all):
        if isinstance(constraint, Coincidence):
            kept.append(tuple(TRANSLATIONS[i] in free or bool(rotations - {ROTATIONS[i]}) for i in range(3)))
        elif isinstance(constraint, Orthogonality) and (not rotations or isinstance(joint, RevoluteJoint)):
            kept.append((False,))
        elif isinstance(constraint, Orthogonality) and isinstance(joint, FixedJoint):
            # the i-th of the triad is between axes i and i + 1
            orthogonality = sum(isinstance(before, Orthogonality) for before in constraints[: len(kept)])
            kept.append((axis == (orthogonality + 2) % 3,))
        else:
            kept.append(default)
    return kept


def _of_rolling(name: str, joint: Rolling, free: set[str], axis: int) -> list[tuple[bool, ...]]:
    """Of a wheel that turns about one inertial axis: its height; forward and sideways."""
    require(
        lambda axle: is_along(axle, axis),
        f"Joint {name!r}: `axis` {joint.axis} must be that of {ROTATIONS[axis]!r}, the only rotation that {joint.b!r} "
        "has; turn the axle, or free all rotations.",
        joint.axis,
    )
    line = [i for i, translation in enumerate(TRANSLATIONS) if i != axis and translation in free]
    lifts = len(line) > 1 or not joint.assembled
    if not lifts and line:
        require(
            lambda normal: is_along(normal, 3 - axis - line[0]),
            f"Joint {name!r}: {joint.b!r} moves along {TRANSLATIONS[line[0]]!r} only, out of the plane with the "
            f"`normal` {joint.normal}; free another translation.",
            joint.normal,
        )
    return [(lifts,), (True, TRANSLATIONS[axis] in free)]
