"""Beams with corners."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp

from lgsens._validate import as_count, as_float
from lgsens.model._beam_sections import BeamSection
from lgsens.model._beams import Beam, BeamElement
from lgsens.model._body import RigidBody


class BentBeam(eqx.Module):
    """Straight beams end to end with rigid corners between them, for a `Model`: an anti-roll bar, a frame.

        bar = BentBeam("bar", section, [[0.3, 0.6, 0], [0, 0.5, 0], [0, -0.5, 0], [0.3, -0.6, 0]], elements=4)
        Model(bodies | bar.bodies, joints, forces | bar.forces)

    Nodes and elements have names as those of a `Beam`, "bar.0" … "bar.12" and "bar.0" … "bar.11"; a corner is a node,
    a body with the axes of the piece before it. `bar.corners` are the names of ends and corners.

    Arguments:
        name: what its nodes and elements begin with, static.
        section: a `BeamSection`, or one of each piece.
        corners: its ends and corners in order [m], inertial frame, shape (m, 3), at least 3.
        elements: of each piece, static.
        up: as of a `Beam`, of all pieces; None: z, of pieces that are nearly upright x.

    Raises `ValueError` for wrong shapes, and as `Beam`.
    """

    name: str = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    pieces: tuple[Beam, ...]

    def __init__(self, name: str, section: BeamSection | Sequence[BeamSection], corners, *, elements: int = 4, up=None):
        corners = as_float(corners, None, "BentBeam: `corners`")
        if corners.ndim != 2 or corners.shape[1] != 3 or corners.shape[0] < 3:
            raise ValueError(f"BentBeam: `corners` must have shape (m, 3) with m of at least 3, got {corners.shape}.")
        count = corners.shape[0] - 1
        sections = [section] * count if isinstance(section, BeamSection) else [*section]
        if len(sections) != count:
            raise ValueError(f"BentBeam: `section` must be one or one of each of {count} pieces, got {len(sections)}.")
        self.name, self.elements = name, as_count(elements, "elements", " (it is static)")
        self.pieces = tuple(
            Beam(name, of, corners[i : i + 2], elements=self.elements, up=upward(corners[i], corners[i + 1], up))
            for i, of in enumerate(sections)
        )

    def _called(self, piece: int, node: str) -> str:
        return f"{self.name}.{int(node.rpartition('.')[2]) + piece * self.elements}"

    @property
    def nodes(self) -> tuple[str, ...]:
        """The names of its bodies, in order."""
        return tuple(f"{self.name}.{i}" for i in range(len(self.pieces) * self.elements + 1))

    @property
    def corners(self) -> tuple[str, ...]:
        """Those of its ends and corners."""
        return self.nodes[:: self.elements]

    @property
    def forces(self) -> dict[str, BeamElement]:
        """Its elements by name: that from node i to node i + 1 has the name of node i."""
        return {
            self._called(i, name): dataclasses.replace(of, a=self._called(i, of.a or ""), b=self._called(i, of.b or ""))
            for i, piece in enumerate(self.pieces)
            for name, of in piece.forces.items()
        }

    @property
    def bodies(self) -> dict[str, RigidBody]:
        """Its nodes by name."""
        found: dict[str, RigidBody] = {}
        for i, piece in enumerate(self.pieces):
            for name, body in piece.bodies.items():
                name = self._called(i, name)
                found[name] = _both(found[name], body) if name in found else body
        return found


def upward(start, end, up=None):
    """`up`, or of None z, of a beam that is within 6° of it x."""
    if up is not None:
        return up
    direction = end - start
    x, z = jnp.eye(3, dtype=direction.dtype)[::2]
    return jnp.where(direction[2] ** 2 > 0.99 * jnp.dot(direction, direction), x, z)


def _both(one: RigidBody, other: RigidBody) -> RigidBody:
    """Two bodies with the same centre of mass as one, with the axes of the first."""
    turn = one.orientation.T @ other.orientation
    inertia = one.inertia_matrix + turn @ other.inertia_matrix @ turn.T
    return RigidBody(one.mass + other.mass, inertia, one.position, one.orientation)
