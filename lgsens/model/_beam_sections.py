"""Cross-sections of beams: stiffness and mass per length, from shape and material or given.

A section has axis 1 along the beam, 2 and 3 across it, principal of area here. With strains ε = [ε₁, γ₂, γ₃], stretch
and shears, and κ = [κ₁, κ₂, κ₃], twist and bendings per length [1/m], forces and moments are linear in them,

    [N, Q₂, Q₃, M₁, M₂, M₃] = K [ε, κ],     K = diag(E A, k₂ G A, k₃ G A, G J, E I₂, E I₃),     G = E / 2(1 + ν).

What follows from a shape, and the stress in it: `_beam_outlines`.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._brief import as_called
from lgsens._validate import as_float, require
from lgsens.model._beam_outlines import AbstractOutline, Rectangle, Ring, Stack


class BeamSection(eqx.Module):
    """A cross-section of a beam.

    Arguments:
        stiffness: K of strains [ε₁, γ₂, γ₃, κ₁, κ₂, κ₃], its diagonal E A, k₂ G A, k₃ G A [N], G J, E I₂, E I₃ [N m²],
            shape (6,), or all of it, shape (6, 6), symmetric and positive definite: of a composite, or about a point
            that is not the centre.
        mass: per length [kg/m], shape (), positive.
        inertia: moments of inertia per length about the axes 1, 2, 3 [kg m], shape (3,), positive.
        damping: η [s], shape (): forces and moments are K (ε + η ε̇), damping proportional to stiffness.
        outline: what bounds it, by which it has a `stress`; `round`, `tube` and `rectangle` bring theirs.

    Raises `ValueError` for wrong shapes, numbers that are not positive or, of the damping, negative, and a K that is
    not symmetric to 1e-6 of √(KᵢᵢKⱼⱼ).
    """

    stiffness: Float[Array, "6"] | Float[Array, "6 6"]
    mass: Float[Array, ""]
    inertia: Float[Array, "3"]
    damping: Float[Array, ""]
    outline: AbstractOutline | None

    __repr__ = as_called

    def __init__(self, stiffness, mass, inertia, damping=0.0, outline: AbstractOutline | None = None):
        if outline is not None and not isinstance(outline, AbstractOutline):
            raise ValueError(
                "BeamSection: `outline` must be None or that of another section, which `round`, `tube` and `rectangle` "
                f"have, got {outline!r}."
            )
        self.outline = outline
        with jax.ensure_compile_time_eval():  # of numbers that are known, inside of `jit` too
            self.stiffness = as_float(stiffness, None, "BeamSection: `stiffness`")
            self.mass = as_float(mass, (), "BeamSection: `mass`")
            self.inertia = as_float(inertia, (3,), "BeamSection: `inertia`")
            self.damping = as_float(damping, (), "BeamSection: `damping`")
        if self.stiffness.shape not in ((6,), (6, 6)):
            raise ValueError(f"BeamSection: `stiffness` must have shape (6,) or (6, 6), got {self.stiffness.shape}.")
        for name, value in (("mass", self.mass), ("inertia", self.inertia)):
            require(lambda value: np.all(value > 0), f"BeamSection: `{name}` must be positive, got {value}.", value)
        require(
            lambda value: value >= 0, f"BeamSection: `damping` must not be negative, got {self.damping}.", self.damping
        )
        require(
            lambda K: np.all(np.linalg.eigvalsh(np.diag(K) if K.ndim == 1 else K) > 0),
            f"BeamSection: `stiffness` {self.stiffness} must be positive; what does not bend is a RigidBody.",
            self.stiffness,
        )
        require(
            lambda K: K.ndim == 1 or np.all(np.abs(K - K.T) <= 1e-6 * np.sqrt(np.outer(np.diag(K), np.diag(K)))),
            f"BeamSection: `stiffness` {self.stiffness} must be symmetric: it is the second derivative of an energy.",
            self.stiffness,
        )

    @property
    def matrix(self) -> Float[Array, "6 6"]:
        """K."""
        return jnp.diag(self.stiffness) if self.stiffness.ndim == 1 else self.stiffness

    def stress(self, force, moment) -> Float[Array, "..."]:
        """The largest equivalent stress (von Mises) in the section, of tension, bending and torsion.

        It is √(σ² + 3τ²) where on the boundary that is largest, with σ = N/A + x₃ M₂/I₂ − x₂ M₃/I₃ and τ of torsion:
        M c/I of a cantilever, √3 T r/J of a shaft. Shear stresses of Q₂ and Q₃, and what notches and clamps add, are
        not in it. It is differentiable; where there is no load its derivative is 0.

        Arguments:
            force: N, Q₂, Q₃ [N], frame of the section, shape (…, 3).
            moment: M₁, M₂, M₃ [N m], frame of the section, shape (…, 3), as of a `SectionState`.

        Returns [N/m²], shape (…,); of a rectangle to 1e-3. Raises `ValueError` for a section without outline, and for
        wrong shapes. Sources: Young & Budynas (2002), Roark's Formulas for Stress and Strain, chapters 8 and 10;
        Timoshenko & Goodier (1970), Theory of Elasticity, §109.
        """
        if self.outline is None:
            raise ValueError(
                "BeamSection: `outline` is None, so `stress` is not known: stiffnesses do not say how far fibres are "
                "from the axes. Make the section by `round`, `tube` or `rectangle`, or take `fibre_strain` times E."
            )
        force, moment = as_float(force, None, "`force`"), as_float(moment, None, "`moment`")
        for name, value in (("force", force), ("moment", moment)):
            if value.ndim == 0 or value.shape[-1] != 3 or value.shape != force.shape:
                raise ValueError(f"`{name}` must have shape (…, 3), as `force` has, got {value.shape}.")
        return jnp.vectorize(self.outline.stress, signature="(3),(3)->()")(force, moment)

    def stacked(self, count) -> "BeamSection":
        """So many of it side by side, which slide on each other without friction: leaves of a spring, wires of a rope.

        Arguments:
            count: n [–], shape (), positive; of a pack that is graduated any number.

        Stiffness, mass and inertia are n times those of one; the `stress` is that of one under the n-th part of forces
        and moments. Raises `ValueError` for a number that is not positive.
        """
        n = as_float(count, (), "BeamSection: `count`")
        require(lambda n: n > 0, f"BeamSection: `count` must be positive, got {n}.", n)
        outline = None if self.outline is None else Stack(self.outline, n)
        damping: Any = self.damping
        return BeamSection(n * self.stiffness, n * self.mass, n * self.inertia, damping, outline)

    def sheared_at(self, centre) -> "BeamSection":
        """The section with another shear centre: an open one, whose axis goes through its centroid.

        Arguments:
            centre: s₂, s₃ of it from the axis [m], shape (2,).

        Forces there do not twist: this K is of the shears there, γ₂ − s₃ κ₁ and γ₃ + s₂ κ₁, in place of γ₂ and γ₃. G J
        is about the shear centre, with sections that warp as they like: there is no moment of warping. Raises
        `ValueError` for a wrong shape.
        """
        s = as_float(centre, (2,), "BeamSection: `centre`")
        there = jnp.eye(6, dtype=s.dtype).at[1, 3].set(-s[1]).at[2, 3].set(s[0])
        return eqx.tree_at(lambda section: section.stiffness, self, there.T @ self.matrix @ there)

    @staticmethod
    def round(diameter, *, young, poisson, density, damping=0.0) -> "BeamSection":
        """A round bar.

        Arguments:
            diameter: [m], shape ().
            young, poisson, density: E [N/m²], ν [–], ρ [kg/m³] of the material, shape ().
            damping: η [s], shape ().

        Raises `ValueError` for numbers that are not positive, and ν outside of −1 to ½.
        """
        return BeamSection.tube(diameter, None, young=young, poisson=poisson, density=density, damping=damping)

    @staticmethod
    def tube(diameter, thickness, *, young, poisson, density, damping=0.0) -> "BeamSection":
        """A round tube.

        Arguments:
            diameter: outer diameter [m], shape ().
            thickness: of the wall [m], shape (), up to half the diameter; None: a bar.
            young, poisson, density, damping: as of `round`.

        Raises `ValueError` as `round`, and for a wall that is thicker than the radius.
        """
        (outer,) = _positive("BeamSection", diameter=diameter)
        inner = 0.0 * outer
        if thickness is not None:
            (wall,) = _positive("BeamSection", thickness=thickness)
            inner = outer - 2.0 * wall
            require(lambda inner: inner >= 0, "BeamSection: `thickness` is more than the radius; take `round`.", inner)
        return _of_outline(Ring(_known(outer, inner)), young, poisson, density, damping)

    @staticmethod
    def rectangle(width, height, *, young, poisson, density, damping=0.0) -> "BeamSection":
        """A rectangle.

        Arguments:
            width, height: along the axes 2 and 3 [m], shape ().
            young, poisson, density, damping: as of `round`.

        Raises `ValueError` as `round`.
        """
        w, h = _positive("BeamSection", width=width, height=height)
        return _of_outline(Rectangle(_known(w, h)), young, poisson, density, damping)


def _positive(what: str, **numbers) -> list[Float[Array, ""]]:
    found = []
    for name, number in numbers.items():
        value = as_float(number, (), f"{what}: `{name}`")
        require(lambda value: value > 0, f"{what}: `{name}` must be positive, got {value}.", value)
        found.append(value)
    return found


def _known(*numbers) -> Float[Array, " n"]:
    with jax.ensure_compile_time_eval():
        return jnp.stack(numbers)


def _of_outline(outline: AbstractOutline, young, poisson, density, damping) -> BeamSection:
    E, rho = _positive("BeamSection", young=young, density=density)
    nu = as_float(poisson, (), "BeamSection: `poisson`")
    require(lambda nu: -1 < nu <= 0.5, f"BeamSection: `poisson` must be above -1 and at most 0.5, got {poisson}.", nu)
    G, area, (second, third) = E / (2.0 * (1.0 + nu)), outline.area, outline.second
    across = outline.shear(nu) * G * area
    stiffness = jnp.stack([E * area, across, across, G * outline.torsion, E * second, E * third])
    return BeamSection(stiffness, rho * area, rho * jnp.stack([second + third, second, third]), damping, outline)
