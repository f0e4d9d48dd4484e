"""What bounds a cross-section of a beam: its area and its moments, and the largest stress in it.

Of the forces [N, Q₂, Q₃] and moments [M₁, M₂, M₃] of a section, whose axes 2 and 3 are principal and of symmetry,

    σ = N/A + x₃ M₂/I₂ − x₂ M₃/I₃,     τ = M₁/J |∇φ|,   ∂²φ/∂x₂² + ∂²φ/∂x₃² = −2,   φ = 0 on the boundary,

and the equivalent stress of von Mises is √(σ² + 3τ²). σ is linear and both parts of ∇φ are harmonic over the section,
so σ² + 3τ² is subharmonic: it is largest on the boundary. Nothing of the material is in it. Shear stresses of Q₂ and Q₃
are left out: over the σ of what bends they are of the order of its height over its length, and elementary theory has
none of them in the outermost fibres. So are what a notch, a load or a clamp adds.

Sources: σ, and torsion of circles: Young & Budynas (2002), Roark's Formulas for Stress and Strain, chapters 8 and 10.
J and τ of rectangles: Timoshenko & Goodier (1970), Theory of Elasticity, §109. Shear coefficients k: Cowper (1966),
J. Appl. Mech. 33, 335, table 1.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_ODD = np.arange(1.0, 11.0, 2.0)  # 2/(exp(nπ) + 1) is 5e-14 of the first at n = 9
_SUM = 1.0045237627951382  # Σ n⁻⁵ of odd n, 31 ζ(5)/32
# Of τ, to 1e-4 of its largest in the middle of a side; series of 1/n², alternating there. At a corner, where it is 0,
# 4e-3 is left of it.
_MANY = np.arange(1.0, 101.0, 2.0)
_PLACES = np.linspace(0.0, 1.0, 33)  # from the middle of a side to its corner; a maximum in between is missed by 1e-3


class AbstractOutline(eqx.Module):
    """What bounds a section of one material."""

    @property
    @abc.abstractmethod
    def area(self) -> Float[Array, ""]:
        """A [m²]."""

    @property
    @abc.abstractmethod
    def second(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """I₂ and I₃, the integrals of x₃² and x₂² [m⁴]."""

    @property
    @abc.abstractmethod
    def torsion(self) -> Float[Array, ""]:
        """J [m⁴]."""

    @abc.abstractmethod
    def shear(self, poisson) -> Float[Array, ""]:
        """The shear coefficient k, of both directions."""

    @abc.abstractmethod
    def stress(self, force: Float[Array, "3"], moment: Float[Array, "3"]) -> Float[Array, ""]:
        """The largest stress of von Mises [N/m²], of N, Q₂, Q₃ [N] and M₁, M₂, M₃ [N m]."""


class Ring(AbstractOutline):
    """Two circles about one centre, of these diameters [m], the outer one first; of a bar the inner one is 0."""

    diameters: Float[Array, "2"]

    @property
    def area(self):
        outer, inner = self.diameters
        return jnp.pi / 4.0 * (outer**2 - inner**2)

    @property
    def second(self):
        outer, inner = self.diameters
        second = jnp.pi / 64.0 * (outer**4 - inner**4)
        return second, second

    @property
    def torsion(self):
        return 2.0 * self.second[0]

    def shear(self, poisson):
        outer, inner = self.diameters
        ratio = (inner / outer) ** 2
        shear = 6.0 * (1.0 + poisson) * (1.0 + ratio) ** 2
        return shear / ((7.0 + 6.0 * poisson) * (1.0 + ratio) ** 2 + (20.0 + 12.0 * poisson) * ratio)

    @jax.jit
    def stress(self, force, moment):
        """On the outer circle, of radius R, τ = |M₁| R/J everywhere, and σ is largest where M₂ and M₃ bend towards."""
        radius, bending = self.diameters[0] / 2.0, _root(moment[1] ** 2 + moment[2] ** 2)
        normal = jnp.abs(force[0]) / self.area + bending * radius / self.second[0]
        return _root(normal**2 + 3.0 * (moment[0] * radius / self.torsion) ** 2)


class Rectangle(AbstractOutline):
    """A rectangle with these sides along the axes 2 and 3 [m]."""

    sides: Float[Array, "2"]

    @property
    def area(self):
        width, height = self.sides
        return width * height

    @property
    def second(self):
        width, height = self.sides
        return width * height**3 / 12.0, height * width**3 / 12.0

    @property
    def torsion(self):
        """a b³/3 (1 − 192/π⁵ (b/a) Σ tanh(nπa/2b)/n⁵), n odd, b ≤ a; tanh = 1 − 2/(exp(nπa/b) + 1)."""
        short, long = jnp.min(self.sides), jnp.max(self.sides)
        odd = jnp.asarray(_ODD, short.dtype)
        series = _SUM - jnp.sum(2.0 / (jnp.exp(odd * jnp.pi * long / short) + 1.0) / odd**5)
        return long * short**3 / 3.0 * (1.0 - 192.0 / jnp.pi**5 * short / long * series)

    def shear(self, poisson):
        return 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson)

    @jax.jit
    def stress(self, force, moment):
        """Along a quarter of the boundary: with |N|, |M₂|, |M₃| it has the largest σ, and τ is symmetric.

        At a share s of the way from the middle to the corner of a long side, a, and of a short one, b, τ is |M₁| b/J of

            1 − 8/π² Σ n⁻² cosh(nπas/2b)/cosh(nπa/2b),     8/π² Σ n⁻² (−1)^((n−1)/2) tanh(nπa/2b) cos(nπs/2),   n odd.
        """
        width, height = self.sides
        short, long, (second, third) = jnp.min(self.sides), jnp.max(self.sides), self.second
        axial = jnp.abs(force[0]) / self.area
        high, wide = jnp.abs(moment[1]) * height / (2.0 * second), jnp.abs(moment[2]) * width / (2.0 * third)
        s, odd = jnp.asarray(_PLACES, width.dtype), jnp.asarray(_MANY, width.dtype)[:, None]
        at_side, at_top = axial + wide + high * s, axial + high + wide * s  # where |x₂|, |x₃| is largest

        u, weight = odd * jnp.pi / 2.0 * (long / short), 8.0 / (jnp.pi * odd) ** 2
        falling = jnp.exp(u * (s[None] - 1.0)) * (1.0 + jnp.exp(-2.0 * u * s[None])) / (1.0 + jnp.exp(-2.0 * u))
        along_long = 1.0 - jnp.sum(weight * falling, axis=0)
        waves = jnp.asarray(np.sin(_MANY * np.pi / 2.0)[:, None] * np.cos(_MANY[:, None] * np.pi / 2.0 * _PLACES))
        along_short = jnp.sum(weight * jnp.tanh(u) * waves.astype(width.dtype), axis=0)
        unit, tall = moment[0] * short / self.torsion, height >= width
        shears = jnp.where(tall, along_long, along_short), jnp.where(tall, along_short, along_long)
        squares = [normal**2 + 3.0 * (unit * shear) ** 2 for normal, shear in zip((at_side, at_top), shears)]
        return _root(jnp.max(jnp.concatenate(squares)))


def _root(square: Float[Array, ""]) -> Float[Array, ""]:
    """√, with the derivative 0 at 0, where that of a size has none."""
    some = square > 0.0
    return jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)


class Stack(AbstractOutline):
    """So many outlines [–], shape (), side by side, which slide on each other: each has its share of all."""

    one: AbstractOutline
    count: Float[Array, ""]

    @property
    def area(self):
        return self.count * self.one.area

    @property
    def second(self):
        of_2, of_3 = self.one.second
        return self.count * of_2, self.count * of_3

    @property
    def torsion(self):
        return self.count * self.one.torsion

    def shear(self, poisson):
        return self.one.shear(poisson)

    def stress(self, force, moment):
        return self.one.stress(force / self.count, moment / self.count)
