"""What the degrees of freedom of two bodies leave of the equations of a joint between them."""

from collections.abc import Sequence

from lgsens._validate import require
from lgsens.model._body import RigidBody
from lgsens.model._constraints import AbstractRows
from lgsens.model._free import ROTATIONS, is_along, plane_of, single_rotation
from lgsens.model._joints import AbstractJoint


def in_plane(joint: AbstractJoint, bodies: Sequence[RigidBody]) -> AbstractJoint:
    """The joint as it is between its bodies, one or two: where all of them move in one plane, in that plane."""
    axis = plane_of(name for body in bodies for name in body.free)
    return joint if axis is None else joint.in_plane(axis)


def violable_rows(
    name: str, joint: AbstractJoint, constraints: Sequence[AbstractRows], bodies: Sequence[RigidBody]
) -> Sequence[tuple[bool, ...]]:
    """Which equations of each of a joint's basic constraints its bodies, one or two, could violate.

    The others hold in every configuration as they do in the reference, so their rows of B are zero on the free
    coordinates: with them the constraints would be redundant, and without them nothing is lost. Joints and constraints
    say which, for bodies that turn about one inertial axis at most. All equations are kept where bodies turn otherwise,
    and those of a joint that the reference configuration need not satisfy.

    Raises `ValueError` for a hinge about another axis than the one rotation that its bodies have, and for a joint that
    holds the orientation of a point mass.
    """
    free = {name for body in bodies for name in body.free}
    axis = single_rotation(free)
    if axis is not None and (hinge := joint.hinge) is not None:
        require(
            lambda direction: is_along(direction, axis),
            f"Joint {name!r}: `axis` {hinge} must be that of {ROTATIONS[axis]!r}, the only rotation that "
            f"{joint.a!r} and {joint.b!r} have; turn the axis, or free all rotations of one of them.",
            hinge,
        )
    if axis is not None and (in_plane := joint.violable_about(name, free, axis)) is not None:
        kept = in_plane
    elif not joint.assembled or (axis is None and free & {*ROTATIONS}):
        kept = [(True,) * constraint.num_rows for constraint in constraints]
    else:
        kept = joint.violable(constraints, free)
    holds_orientation = any(constraint.turning and any(own) for constraint, own in zip(constraints, kept))
    if holds_orientation and any(body.inertia is None for body in bodies):
        raise ValueError(
            f"Joint {name!r}: a {type(joint).__name__} between {joint.a!r} and {joint.b!r} holds the orientation of a "
            "point mass, which has none; use a SphericalJoint or a DistanceJoint at the point, or give the body an "
            "`inertia`."
        )
    return kept
