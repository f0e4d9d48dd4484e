"""Several joints in a row between two bodies, without bodies between them; and the angles of three of them."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, point_field
from lgsens.model import AbstractJoint, Coincidence, Coordinate, Frame, InPlane, Orthogonality


def _rows() -> Any:
    """A keyword-only leaf of directions in rows."""
    return eqx.field(converter=lambda value: as_float(value, None, "directions").reshape(-1, 3), kw_only=True)


def _completed(directions: Float[Array, "k 3"]) -> Float[Array, "n 3"]:
    """Unit vectors orthogonal to some directions: of none all axes, of one two, of two their cross product."""
    if directions.shape[0] == 0:
        return jnp.eye(3, dtype=directions.dtype)
    if directions.shape[0] == 3:
        return jnp.zeros((0, 3), directions.dtype)
    first = directions[0]
    if directions.shape[0] == 2:
        normal = jnp.cross(first, directions[1])
        return (normal / jnp.linalg.norm(normal))[None]
    least = jnp.eye(3, dtype=first.dtype)[jnp.argmin(jnp.abs(first))]
    across = jnp.cross(first, least)
    across = across / jnp.linalg.norm(across)
    return jnp.stack([across, jnp.cross(first / jnp.linalg.norm(first), across)])


class SerialJoint(AbstractJoint):
    """Up to three sliders in a row, and then up to three hinges about one point; 6 equations less one for each.

        n·d = 0 for each n across the sliders,     and of the hinges: none holds all axes, one leaves its own,
        e₁·e₂ = 0 of two, of three nothing

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: the point of b that slides, in which the hinges meet, in the reference configuration [m], inertial frame.
        slides: directions of the sliders, fixed to a, inertial frame, shape (k, 3), k ≤ 3.
        hinges: axes of the hinges in the reference configuration, inertial frame, shape (h, 3), h ≤ 3: of two, which
            are orthogonal, the first is fixed to a and the second to b.

    The bodies between the joints, which would have no mass, are no bodies of the model.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    slides: Float[Array, "k 3"] = _rows()
    hinges: Float[Array, "h 3"] = _rows()

    assembled = True

    def constraints(self, a, b):
        point_a, point_b = a.local_point(self.at), b.local_point(self.at)
        if self.slides.shape[0] == 0:
            place = [Coincidence(point_a, point_b)]
        else:
            place = [InPlane(point_a, point_b, a.local_axis(n)) for n in _completed(self.slides)]
        hinges = self.hinges
        pairs = {
            0: lambda: [(axis, jnp.roll(axis, 1)) for axis in jnp.eye(3, dtype=self.at.dtype)],
            1: lambda: [(across, hinges[0]) for across in _completed(hinges)],
            2: lambda: [(hinges[0], hinges[1])],
            3: list,
        }[hinges.shape[0]]()
        return (*place, *(Orthogonality(a.local_axis(x), b.local_axis(y)) for x, y in pairs))


def _cardan(name: str, sine: tuple[int, int], cosine: tuple[int, int], sign: float) -> Coordinate:
    of = lambda seen: jnp.arctan2(sign * seen.orientation[sine], seen.orientation[cosine])
    return Coordinate(name, "rad", of, True)


def _middle(seen: Frame) -> Float[Array, ""]:
    first = seen.orientation[0]
    return jnp.arctan2(first[2], jnp.sqrt(first[0] ** 2 + first[1] ** 2))


# D = R_x(α) R_y(β) R_z(γ), |β| < π/2
ANGLES = (
    _cardan("first", (1, 2), (2, 2), -1.0),
    Coordinate("second", "rad", _middle),
    _cardan("third", (0, 1), (0, 0), -1.0),
)


class Gimbal(AbstractJoint):
    """The angles of two or three hinges in a row with orthogonal axes, as the coordinates of a joint without equations.

    Arguments:
        a, b: names of the two bodies; None is the ground.
        at: where the axes meet [m], inertial frame, shape (3,).
        axes_a, axes_b: the frames on both bodies in the reference configuration as columns, inertial frame,
            shape (3, 3): they coincide where all angles are zero, and their axes then are those of the hinges.
    """

    a: str | None = eqx.field(static=True)
    b: str | None = eqx.field(static=True)
    at: Float[Array, "3"] = point_field("at")
    axes_a: Float[Array, "3 3"] = _rows()
    axes_b: Float[Array, "3 3"] = _rows()

    assembled = True
    coordinates = ANGLES

    @property
    def frames(self):
        return Frame(self.at, self.axes_a), Frame(self.at, self.axes_b)

    def constraints(self, a, b):
        return ()


def rotation(axis, angle: float) -> np.ndarray:
    """The rotation by an angle about a unit axis (Rodrigues)."""
    x, y, z = axis
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * skew + (1.0 - np.cos(angle)) * skew @ skew
