"""The equations of joints that a system leaves out because others imply them (`_repeated_rows`)."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.model._stack import position_values


def names_left_out(system: Any) -> tuple[str, ...]:
    """A name for each of a `MultibodySystem`, that of its joint."""
    return tuple(name for of in system.repeated for name, own in zip(of.owners, of.kept) for _ in range(sum(own)))


def values_left_out(system: Any, q, t) -> Float[Array, " r"]:
    """Φ of each."""
    values = zip(system.repeated, position_values(system.repeated, system._placed(q), t))
    none = jnp.zeros(0, system.mass.dtype)
    return jnp.concatenate([none, *(rows[np.asarray(of.kept)] for of, rows in values)])
