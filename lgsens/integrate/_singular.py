"""Singular configurations: where B loses rank during the motion (a parallelogram linkage that lies flat).

There the constraints do not determine the motion: branches meet. A time step jumps over such a point and goes on along
one of them, often the right one, while the derivatives by lengths are those of a branch point: infinite. Nothing
in the step shows it, as its equations are regular on both sides.

Let y be a fixed displacement, and S [x; μ] = [0; B y], that is B A⁻¹ Bᵀ μ = −B y (up to T and O(h)). With the singular
values σ_i of B A^{-1/2} and its singular vectors μ is the sum of the u_i (v_i · A^{1/2} y)/σ_i: where the smallest
falls to zero, so does the margin

    m = |Bᵀ μ|/|μ| ∝ σ_min,

linearly in time on both sides of the singular point, without any part along redundant equations. Two successive steps
with 2 m_n ≤ m_{n−1} ≤ m_{n−2} say that it would be zero before the next one; where Newton's method jumps from one
solution to another (steps too long for the motion), multipliers and so A jump with it, and m goes up and down. A motion
that passes a singular configuration at a distance has a minimum of m instead, which steps that resolve it see as such.
m lies between the smallest and the largest singular value of B, wherever y points and whatever A is: another step size,
or friction that sticks and adds its slope to A, changes 1/|μ| by powers of ten, but both norms alike. Coordinates are
in rad and lengths of the scene.

m costs one product with the inverse that many steps share. Where m falls so fast that it would be zero before two such
inverses are over, every step has its own.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, factorized, mass_scale, softness
from lgsens.linear import Factors, Matrix

_SMALL = 0.1  # margins above this fraction of the largest of a run are no sign: B may turn by radians in a step


def margin_of(factors: Factors, jacobian: Matrix, scale: Float[Array, " k"]) -> Float[Array, ""]:
    """m, by the factors of S; NaN after a failure."""
    if not jacobian.shape[0]:
        return jnp.full((), jnp.inf, scale.dtype)
    y = scale * jnp.asarray(np.random.default_rng(0).normal(size=scale.shape), scale.dtype)
    _, mu = factors.solve(jnp.zeros_like(scale), jacobian @ y)
    return jnp.sqrt(jnp.sum((scale * (mu @ jacobian)) ** 2) / jnp.sum(mu**2))


def margin_by_mass(system: AbstractSystem, mass: Matrix, jacobian: Matrix, scale: Float[Array, " k"]):
    """m with M for A, where no factors of S are: it costs a factorization."""
    factors = factorized(system, mass, jacobian.T, jacobian, mass_scale(mass), softness=softness(system))
    return margin_of(factors, jacobian, scale)


class Watch(NamedTuple):
    """The margin when it was last known, its rate then, and when."""

    margin: Float[Array, ""]
    slope: Float[Array, ""]
    t: Float[Array, ""]

    @classmethod
    def first(cls, t) -> "Watch":
        return cls(jnp.full((), jnp.inf, t.dtype), jnp.zeros((), t.dtype), t)

    def after(self, margin, t) -> "Watch":
        """With a margin known at t; the slope to the first one is −inf, which asks for another at once."""
        return Watch(margin, (margin - self.margin) / (t - self.t), t)

    def ends_by(self, t, ahead):
        """Whether the margin would be zero as late as `ahead` after t."""
        return self.margin + self.slope * ((t - self.t) + ahead) <= 0.0


def singular_steps(margins: Float[Array, " n"]):
    """For each step whether a singular configuration is passed in it or in the next; margins not known are infinite.

    Not NaN: under `jax_debug_nans` that would be an error in every run.
    """
    count, padded = margins.shape[0], jnp.concatenate([jnp.full(2, jnp.inf, margins.dtype), margins])
    earlier, before = padded[:count], padded[1 : count + 1]
    known = jnp.isfinite(margins) & jnp.isfinite(before)
    largest = jnp.max(margins, where=jnp.isfinite(margins), initial=0.0)
    return (2.0 * margins <= before) & (before <= earlier) & (margins <= _SMALL * largest) & known
