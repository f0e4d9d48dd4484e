"""The two-node element of a geometrically exact beam, as stacked numbers, with closed-form tangents.

Between the frames H_a, H_b ∈ SE(3) of its end sections the beam is a helix, of constant strain: with d = log(H_a⁻¹H_b),
d₀ in the reference configuration and L its length,

    ε = (d − d₀)/L,     U = L (σ₀ᵀε + ½ εᵀK ε),     σ = σ₀ + K (ε + η ε̇)

ε = [stretch and shears, twist and bendings] in the frame of the sections, and σ the six forces and moments conjugate.
A rigid motion of both sections leaves H_a⁻¹H_b, and so U; bending to an arc has no shear, so nothing locks.

A section is fixed to a body: H = (p, B) = (x + R X, R A). With V the twist of b's section against a's, in the axes of
b's, and T the tangent operator of SE(3),

    V = E v,   ḋ = T(d)⁻¹ V,   Q = −Eᵀλ,   λ = T(d)⁻ᵀσ = [f, m]
    V = [B_bᵀ(ẋ_b + R_b (Ω_b × X_b) − ẋ_a − R_a (Ω_a × r)),  A_bᵀ(Ω_b − R_bᵀR_a Ω_a)],     r = R_aᵀ(p_b − x_a)

as V = h_b − Ad(exp −d) h_a for the twists h of the sections. With U = ∂r/∂q = [−R_aᵀ, r̃, R_aᵀ, −R_aᵀR_b X̃_b], z = A_b
times the translation of V, c = Ω_b × X_b, w = R_bᵀR_a Ω_a, and what λ is on b in its frame, φ = A_b f and μ = A_b m,
and in that of a, h = R_aᵀR_b φ and n = R_aᵀR_b μ, the tangents are

    A_b ∂V/∂q|_v:  rows  (z̃ − c̃) δθ_b + R_bᵀR_a ((Ω_a × r)~ δθ_a − Ω̃_a U δq),  R_bᵀR_a Ω̃_a δθ_a − w̃ δθ_b
    −∂(Eᵀλ)/∂q|_λ:  rows  −R_b φ̃ δθ_b,  (ñ + r̃ h̃) δθ_a − (r̃ R_aᵀR_b φ̃ + R_aᵀR_b μ̃) δθ_b − h̃ U δq,  R_b φ̃ δθ_b,  0
    ∂λ/∂q = (∂(T⁻ᵀσ)/∂d + T⁻ᵀK/L (1 + η ∂(T⁻¹V)/∂d)) T⁻¹E + η/L T⁻ᵀK T⁻¹ ∂V/∂q,     ∂λ/∂v = η/L T⁻ᵀK T⁻¹E.

from δ(Rᵀx) = (Rᵀx)~ δθ and δ(R x) = −R x̃ δθ. Source: Sonneville, Cardona & Brüls (2014), CMAME 268, 451, §4.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import brief
from lgsens.liegroups import SE3, Pose, cross, skew, turn, turn_back
from lgsens.model._beam_outlines import AbstractOutline
from lgsens.model._beam_sections import BeamSection
from lgsens.model._elements import body_fixed
from lgsens.model._frames import ROTATION, ROTATION_A, ROTATION_B, Frame, embedded
from lgsens.model._loads import AbstractClosedFormLoad, LoadTangents
from lgsens.model._turns import rotation_between

_GROUP = SE3()


class SectionState(NamedTuple):
    """Strains, those of the beam without stress being 0, and stress resultants of an element, in its sections' frame.

    Attributes:
        strain: ε₁ stretch, γ₂ and γ₃ shears [–], shape (3,).
        curvature: κ₁ twist, κ₂ and κ₃ bendings [1/m], shape (3,).
        force: N, Q₂, Q₃ [N], shape (3,).
        moment: M₁, M₂, M₃ [N m], shape (3,).
        stress: the largest equivalent one (von Mises) of the forces and moments [N/m²], shape (), `BeamSection.stress`;
            None of a section that does not know its outline.

    Of a trajectory each has a leading axis over the times.
    """

    strain: Float[Array, "3"]
    curvature: Float[Array, "3"]
    force: Float[Array, "3"]
    moment: Float[Array, "3"]
    stress: Float[Array, ""] | None = None

    __repr__ = brief

    def fibre_strain(self, second, third) -> Float[Array, ""]:
        """ε₁ + x₃ κ₂ − x₂ κ₃, the strain along the beam where the section's axes 2 and 3 have x₂, x₃ [m]; E times it is
        the stress of the fibre [N/m²]."""
        along = self.strain[..., 0]
        return along + third * self.curvature[..., 1] - second * self.curvature[..., 2]


class _Motion(NamedTuple):
    """d, V, ε and σ, with r and R_aᵀR_b."""

    screw: Float[Array, "6"]
    twist: Float[Array, "6"]
    strain: Float[Array, "6"]
    stress: Float[Array, "6"]
    arm: Float[Array, "3"]
    b_in_a: Float[Array, "3 3"]


class BeamLoad(AbstractClosedFormLoad):
    """An element between a section of a, at `point_a` with axes the columns of `triad_a` in its frame, and one of b."""

    point_a: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "a"))
    point_b: Float[Array, "3"] = eqx.field(metadata=body_fixed("point", "b"))
    triad_a: Float[Array, "3 3"] = eqx.field(metadata=body_fixed("axes", "a"))
    triad_b: Float[Array, "3 3"] = eqx.field(metadata=body_fixed("axes", "b"))
    reference: Float[Array, "6"]  # d₀
    length: Float[Array, ""]
    stiffness: Float[Array, "6 6"]
    damping: Float[Array, ""]
    preload: Float[Array, "6"]  # σ₀
    outline: AbstractOutline | None

    balanced = True
    drawn = "beam"

    def screw(self, a: Frame, b: Frame) -> Float[Array, "6"]:
        """d."""
        of, to = (
            Pose(frame.point(point), frame.orientation @ triad)
            for frame, point, triad in ((a, self.point_a, self.triad_a), (b, self.point_b, self.triad_b))
        )
        return _GROUP.log(_GROUP.compose(_GROUP.inverse(of), to))

    def branch(self, a, b):
        """The rotation between the sections."""
        return rotation_between(a, self.triad_a, b, self.triad_b)

    def _motion(self, a, b, va, vb) -> _Motion:
        arm, b_in_a = a.local_point(b.point(self.point_b)), a.orientation.T @ b.orientation
        speed = b.local_axis(vb[: ROTATION.start] - va[: ROTATION.start]) + cross(vb[ROTATION], self.point_b)
        speed -= turn_back(b_in_a, cross(va[ROTATION], arm))
        spin = vb[ROTATION] - turn_back(b_in_a, va[ROTATION])
        twist = jnp.concatenate([turn_back(self.triad_b, speed), turn_back(self.triad_b, spin)])
        d = self.screw(a, b)
        strain = (d - self.reference) / self.length
        rate = _GROUP.tangent_inv_mv(d, twist) / self.length
        stress = self.preload + self.stiffness @ (strain + self.damping * rate)
        return _Motion(d, twist, strain, stress, arm, b_in_a)

    def measure(self, a, b, va, vb, t) -> SectionState:
        motion = self._motion(a, b, va, vb)
        strain = motion.strain + jnp.linalg.solve(self.stiffness, self.preload)
        force, moment = motion.stress[:3], motion.stress[3:]
        stress = None if self.outline is None else self.outline.stress(force, moment)
        return SectionState(strain[:3], strain[3:], force, moment, stress)

    def _on_b(self, motion):
        """φ and μ."""
        wrench = _GROUP.tangent_inv_rmv(motion.screw, motion.stress)
        return turn(self.triad_b, wrench[:3]), turn(self.triad_b, wrench[3:])

    def force(self, a, b, va, vb, t):
        motion = self._motion(a, b, va, vb)
        force, moment = self._on_b(motion)
        on_a = cross(motion.arm, turn(motion.b_in_a, force)) + turn(motion.b_in_a, moment)
        force_b = b.axis(force)
        return jnp.concatenate([force_b, on_a, -force_b, -moment - cross(self.point_b, force)])

    def tangents(self, a, b, va, vb, t):
        motion = self._motion(a, b, va, vb)
        d, arm, b_in_a, spin = motion.screw, motion.arm, motion.b_in_a, va[ROTATION]
        force, moment = self._on_b(motion)
        in_a, back = turn(b_in_a, force), a.orientation.T
        by_arm = jnp.concatenate([-back, skew(arm), back, -b_in_a @ skew(self.point_b)], axis=1)  # U
        to_axes = self.triad_b.T @ b_in_a.T
        at_a, at_b = (lambda part, place=place: embedded(part, None, place) for place in (ROTATION_A, ROTATION_B))
        gradient = jnp.concatenate([to_axes @ by_arm, at_b(self.triad_b.T) - at_a(to_axes)])  # E

        slope = _GROUP.tangent_inv(d)
        by_screw = slope @ gradient
        softness = slope.T @ self.stiffness / self.length
        by_rate = self.damping * softness
        velocity = by_rate @ by_screw

        swing = cross(vb[ROTATION], self.point_b)
        speed = turn(self.triad_b, motion.twist[:3]) - swing
        turned = turn_back(b_in_a, spin)
        by_translation = at_b(self.triad_b.T @ skew(speed)) + to_axes @ (
            at_a(skew(cross(spin, arm))) - skew(spin) @ by_arm
        )
        by_rotation = at_a(to_axes @ skew(spin)) - at_b(self.triad_b.T @ skew(turned))
        turning = _GROUP.tangent_inv_rmv_gradient(d, motion.stress) + softness  # ∂λ/∂d
        turning += by_rate @ _GROUP.tangent_inv_gradient(d, motion.twist)
        position = turning @ by_screw + by_rate @ slope @ jnp.concatenate([by_translation, by_rotation])

        moved = at_b(b.orientation @ skew(force))
        on_a = at_a(skew(turn(b_in_a, moment)) + skew(arm) @ skew(in_a)) - skew(in_a) @ by_arm
        on_a -= at_b(skew(arm) @ b_in_a @ skew(force) + b_in_a @ skew(moment))
        geometric = jnp.concatenate([-moved, on_a, moved, jnp.zeros_like(moved)])
        return LoadTangents(geometric - gradient.T @ position, -gradient.T @ velocity)


def element(a: Frame, b: Frame, points, triads, section: BeamSection, preload) -> BeamLoad:
    """The load between sections at these points, with these axes as columns, all of the reference configuration."""
    stiffness = section.matrix
    load = BeamLoad(
        point_a=a.local_point(points[0]),
        point_b=b.local_point(points[1]),
        triad_a=a.orientation.T @ triads[0],
        triad_b=b.orientation.T @ triads[1],
        reference=jnp.zeros(6, stiffness.dtype),
        length=jnp.ones((), stiffness.dtype),
        stiffness=stiffness,
        damping=section.damping,
        preload=preload,
        outline=section.outline,
    )
    reference = load.screw(a, b)
    length = jnp.sqrt(jnp.sum(reference[:3] ** 2))  # of the helix
    return dataclasses.replace(load, reference=reference, length=length)
