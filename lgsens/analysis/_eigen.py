"""Eigenvalues and eigenvectors of a real matrix, with their derivatives; repeated ones are said.

A X = X Λ. With G = X⁻¹ A' X, from (A X)' = (X Λ)' and X' = X F,

    λ_i' = G_ii,     F_ij = G_ij/(λ_j − λ_i)  (i ≠ j),     F_ii = 0, as the scale of a vector is anybody's choice.

Where eigenvalues coincide, |λ_i − λ_j| ≤ 16 √ε max |λ|, each of them alone has no derivative (a change ε of the matrix
splits a pair of them by ±ε, or by ±√ε where they share one vector). Their mean has, tr G over them divided by their
number: it is what the rule gives each of them, and F is left out between them. All of it is finite, and `repeated` says
where. Two that share one vector leave X with the condition number 1/√ε, and G with as many digits.

Source: Magnus, Econometric Theory 1 (1985) 179; Lancaster, Numer. Math. 6 (1964) 377.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float


@jax.custom_jvp
def eigen(matrix: Float[Array, "n n"]) -> tuple[Complex[Array, " n"], Complex[Array, "n n"]]:
    """λ by size, of a pair of conjugates the one with Im λ > 0 first; and the vectors, unit columns."""
    values, vectors = jnp.linalg.eig(matrix)
    # Conjugates have the same size but for round-off of its computation.
    size = jnp.hypot(jnp.real(values), jnp.abs(jnp.imag(values)))
    order = jnp.lexsort((-jnp.imag(values), size))
    return values[order], vectors[:, order]


def near(values: Complex[Array, " n"]) -> Bool[Array, "n n"]:
    """Which eigenvalues coincide."""
    size = jnp.abs(values)
    distance = jnp.abs(values[:, None] - values[None, :])
    return distance <= 16.0 * jnp.sqrt(jnp.finfo(size.dtype).eps) * jnp.max(size, initial=0.0)


@eigen.defjvp
def _eigen_jvp(primals, tangents):
    values, vectors = eigen(*primals)
    change = jnp.linalg.solve(vectors, tangents[0].astype(vectors.dtype) @ vectors)  # G
    same = near(values)
    count = same.astype(values.dtype)
    mean = (count @ jnp.diagonal(change)) / jnp.sum(count, axis=1)
    gaps = jnp.where(same, 1.0, values[None, :] - values[:, None])
    turned = vectors @ jnp.where(same, 0.0, change / gaps)
    return (values, vectors), (mean, turned)


def scaled(vectors: Complex[Array, "n m"], part: Complex[Array, "f m"]) -> Complex[Array, "n m"]:
    """The vectors with uᴴu = 1 for the part u of each, and the largest entry of u real and positive."""

    def one(vector, u):
        largest = u[jnp.argmax(jnp.abs(u))]
        square = jnp.sum(jnp.real(u) ** 2 + jnp.imag(u) ** 2)
        none = square == 0.0
        size = jnp.abs(jnp.where(none, 1.0, largest)) * jnp.sqrt(jnp.where(none, 1.0, square))
        return jnp.where(none, vector, vector * (jnp.conj(largest) / size.astype(vector.dtype)))

    return jax.vmap(one, in_axes=1, out_axes=1)(vectors, part) if part.shape[0] else vectors
