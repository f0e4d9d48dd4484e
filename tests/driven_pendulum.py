"""A system of two coordinates and one constraint, whose programs compile fast."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

import lgsens as lg
from lgsens.dynamics import Tangents
from lgsens.liegroups import Rn

P = (1.3, 0.8, 40.0, 0.5)  # mass, length, stiffness, damping


class Pendulum(lg.AbstractSystem):
    """A mass point on a rod in the plane, Φ = (x² − l²)/2, on a spring to a point that moves."""

    mass: Float[Array, ""]
    length: Float[Array, ""]
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    assembled: bool = eqx.field(static=True, default=True)

    @property
    def group(self):
        return Rn(2)

    @property
    def constraint_names(self):
        return ("rod",)

    def reference(self):
        return jnp.stack([self.length, jnp.zeros_like(self.length)]), jnp.array([0.0, 1.0])

    def coordinate_scale(self):
        return jnp.ones(2)

    def mass_matrix(self):
        return self.mass * jnp.eye(2)

    def residual(self, q, v, vdot, lam, t):
        away = q - jnp.stack([jnp.cos(3.0 * t), jnp.exp(-((5.0 * (t - 0.6)) ** 2))])
        return self.mass * vdot + self.damping * v + self.stiffness * away + lam @ q[None]

    def constraint(self, q, t):
        return (q @ q - self.length**2)[None] / 2.0

    def constraint_jacobian(self, q, t):
        return q[None]

    def tangents(self, q, v, vdot, lam, t):
        eye = jnp.eye(2)
        return Tangents((self.stiffness + lam[0]) * eye, self.damping * eye, q[None])


def make(p):
    return Pendulum(*p)
