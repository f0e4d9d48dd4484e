"""The two-node element of a geometrically exact beam, as stacked numbers.

Between the frames H_a, H_b ∈ SE(3) of its end sections the beam is a helix, of constant strain: with d = log(H_a⁻¹H_b),
d₀ in the reference configuration and L its length,

    ε = (d − d₀)/L,     U = ½ L εᵀK ε,     σ = K (ε + η ε̇)

ε = [stretch and shears, twist and bendings] in the frame of the sections, and σ the six forces and moments conjugate.
A rigid motion of both sections leaves H_a⁻¹H_b, and so U; bending to an arc has no shear, so nothing locks. With
V_a, V_b the twists of the sections, each in its own frame, and T the tangent operator of SE(3),
exp(d)⁻¹ δ(exp d) = δh_b − Ad(exp −d) δh_a and T(d)⁻¹ Ad(exp −d) = T(−d)⁻¹ give

    δd = T(d)⁻¹ δh_b − T(−d)⁻¹ δh_a,     ḋ = T(d)⁻¹ V_b − T(−d)⁻¹ V_a,
    wrenches on the sections:  T(−d)⁻ᵀσ on a,  −T(d)⁻ᵀσ on b.

A section is fixed to a body: H = (x + R X, R A). Its wrench [f, m] is on the body the force R A f and the moment A m +
X × A f. Source: Sonneville, Cardona & Brüls (2014), CMAME 268, 451, §4.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.liegroups import SE3, Pose, cross, turn, turn_back
from lgsens.model._frames import ROTATION, Frame
from lgsens.model._loads import AbstractLoad

_GROUP = SE3()


class SectionState(NamedTuple):
    """Strains and stress resultants of an element, in the frame of its sections.

    Attributes:
        strain: ε₁ stretch, γ₂ and γ₃ shears [–], shape (3,).
        curvature: κ₁ twist, κ₂ and κ₃ bendings, beyond those of the reference [1/m], shape (3,).
        force: N, Q₂, Q₃ [N], shape (3,).
        moment: M₁, M₂, M₃ [N m], shape (3,).

    Of a trajectory each has a leading axis over the times.
    """

    strain: Float[Array, "3"]
    curvature: Float[Array, "3"]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]

    def fibre_strain(self, second, third) -> Float[Array, ""]:
        """ε₁ + x₃ κ₂ − x₂ κ₃, the strain along the beam where the section's axes 2 and 3 have x₂, x₃ [m]; E times it is
        the stress of the fibre [N/m²]."""
        along = self.strain[..., 0]
        return along + third * self.curvature[..., 1] - second * self.curvature[..., 2]


class BeamLoad(AbstractLoad):
    """An element between a section of a, at `point_a` with axes the columns of `triad_a` in its frame, and one of b."""

    point_a: Float[Array, "3"]
    point_b: Float[Array, "3"]
    triad_a: Float[Array, "3 3"]
    triad_b: Float[Array, "3 3"]
    reference: Float[Array, "6"]  # d₀
    length: Float[Array, ""]
    stiffness: Float[Array, "6 6"]
    damping: Float[Array, ""]

    balanced = True
    drawn = "link"

    def fixed(self, kind, bodies="ab"):
        return [getattr(self, f"point_{body}") for body in bodies] if kind == "point" else []

    def _screw(self, a: Frame, b: Frame):
        """d."""
        of, to = (
            Pose(frame.point(point), frame.orientation @ triad)
            for frame, point, triad in ((a, self.point_a, self.triad_a), (b, self.point_b, self.triad_b))
        )
        return _GROUP.log(_GROUP.compose(_GROUP.inverse(of), to))

    def _strains(self, a, b, va, vb):
        """d, ε and σ."""

        def twist(frame, point, triad, v):
            velocity = frame.local_axis(v[: ROTATION.start]) + cross(v[ROTATION], point)
            return jnp.concatenate([turn_back(triad, velocity), turn_back(triad, v[ROTATION])])

        d = self._screw(a, b)
        of, to = twist(a, self.point_a, self.triad_a, va), twist(b, self.point_b, self.triad_b, vb)
        rate = _GROUP.tangent_inv_mv(d, to) - _GROUP.tangent_inv_mv(-d, of)
        strain = (d - self.reference) / self.length
        return d, strain, self.stiffness @ (strain + self.damping / self.length * rate)

    def measure(self, a, b, va, vb, t) -> SectionState:
        _, strain, stress = self._strains(a, b, va, vb)
        return SectionState(strain[:3], strain[3:], stress[:3], stress[3:])

    def force(self, a, b, va, vb, t):
        d, _, stress = self._strains(a, b, va, vb)

        def on_body(frame, point, triad, wrench):
            force = turn(triad, wrench[:3])
            return frame.axis(force), turn(triad, wrench[3:]) + cross(point, force)

        return jnp.concatenate(
            [
                *on_body(a, self.point_a, self.triad_a, _GROUP.tangent_inv_rmv(-d, stress)),
                *on_body(b, self.point_b, self.triad_b, -_GROUP.tangent_inv_rmv(d, stress)),
            ]
        )


def element(a: Frame, b: Frame, points, triads, stiffness, damping) -> BeamLoad:
    """The load between sections at these points, with these axes as columns, all of the reference configuration."""
    load = BeamLoad(
        point_a=a.local_point(points[0]),
        point_b=b.local_point(points[1]),
        triad_a=a.orientation.T @ triads[0],
        triad_b=b.orientation.T @ triads[1],
        reference=jnp.zeros(6, stiffness.dtype),
        length=jnp.ones((), stiffness.dtype),
        stiffness=stiffness,
        damping=damping,
    )
    reference = load._screw(a, b)
    length = jnp.sqrt(jnp.sum(reference[:3] ** 2))  # of the helix
    return BeamLoad(load.point_a, load.point_b, load.triad_a, load.triad_b, reference, length, stiffness, damping)
