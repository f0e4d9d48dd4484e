"""What a linear map on the coordinates of a system is on those of each body."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.model._frames import ROTATION


def body_blocks(system: Any, matrix) -> Float[Array, "N 6 6"]:
    """Of a `MultibodySystem`: `AbstractSparseSystem.body_blocks`."""
    here = system.index
    there = (here[:, :, None] >= 0) & (here[:, None, :] >= 0)
    return jnp.where(there, matrix[here[:, :, None], here[:, None, :]], jnp.zeros((), matrix.dtype))


def rotation_operators(system: Any, function) -> Float[Array, "N 3 3"]:
    """Likewise: a unit vector for each of the three rotations, in all bodies at once, gives the columns."""
    axes = system.index.T[ROTATION]
    units = np.zeros((len(axes), system.group.dim + 1))
    np.put_along_axis(units, axes, 1.0, axis=1)  # −1, where a body does not have it, is the last place
    columns = jax.vmap(function)(jnp.asarray(units[:, :-1], system.mass.dtype))
    return jnp.moveaxis(system.twists(columns)[..., ROTATION], 0, 2)
