"""Mass, centre of mass and inertia of a body with point masses fixed to it."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float


def with_point_masses(
    mass, moments, centre, points: Sequence[tuple[Array, Array]]
) -> tuple[Float[Array, ""], Float[Array, "3 3"], Float[Array, "3"]]:
    """m [kg], J about the centre of mass [kg m²] and the centre of mass c [m] of the whole.

        m c = Σ m_i c_i,     J = Σ J_i + m_i (|d_i|² I − d_i d_iᵀ),     d_i = c_i − c  (Steiner)

    Arguments:
        mass, moments, centre: those of the body alone, shapes (), (3,) and (3,).
        points: pairs of a mass [kg], shape (), and its place [m], shape (3,), in the axes of the body.
    """
    masses = jnp.stack([mass, *(point for point, _ in points)])
    places = jnp.stack([centre, *(place for _, place in points)])
    total = jnp.sum(masses)
    middle = masses @ places / total
    arms = places - middle[None]
    squares = jnp.sum(masses * jnp.sum(arms**2, axis=1)) * jnp.eye(3, dtype=masses.dtype)
    return total, jnp.diag(moments) + squares - jnp.einsum("n,ni,nj->ij", masses, arms, arms), middle
