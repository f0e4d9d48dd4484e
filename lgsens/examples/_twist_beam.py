"""The cross member of a twist-beam axle."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.examples._axle_parts import Between
from lgsens.examples._link_beam import LinkBeam
from lgsens.examples._suspension_parts import ALONG_Y, LEVEL, reflected, stiffened
from lgsens.model import Beam, BeamSection, CylindricalJoint, FixedJoint, PlanarJoint, TorsionSpringDamper, upward

Car = TypeVar("Car", bound=Any)


class TwistBeam(eqx.Module):
    """A beam from one trailing arm to the other, fixed to both: it guides them, and twists when the car rolls.

    Each arm is on one ball joint of the chassis, or on one bushing. The member bends little, and is soft in torsion as
    open sections are: its shear centre in the plane y = 0 stays where it is in roll, so that either arm turns about the
    line from there to its joint, like a semi-trailing one, and where both wheels travel alike, about the line through
    both joints (Reimpell, Stoll & Betzler 2001, §1.6). With joints at y = ±b, wheels l behind them at ±t, the shear
    centre c behind them and h above, the wheel that goes up by z and the other one, which goes down, have

        toe-in ±h z/s,     camber ∓c z/s,     s = b l + c (t − b),     K = G J/L (2 b t/s)²

    to first order, and the car so much more roll stiffness K [N m/rad]; the member has the length L.
    Rigid, it has halves that are fixed to the arms and turn on each other about the shear centre, against G J/L.

    Attributes:
        ends: by the body of the left corner that is the arm, the point of the member's axis at which it is fixed [m],
            shape (3,); at its mirror image it is fixed to the other arm.
        beam: its section, of axes along it to the right, forward and up (`up` for z), and how many elements a half has.
        shear_centre: of the section, forward and up from the member's axis, which goes through its centroid [m], shape
            (2,); None: there, as of tubes.

    Sections warp as they like: G J of one whose ends are welded to stiff arms is more than that of its shape, and is
    the number to give. The member is straight; what is said of its stiffness holds all along it.
    """

    ends: dict[str, Float[Array, "3"]]
    beam: LinkBeam
    shear_centre: Float[Array, "2"] | None = None

    @property
    def link(self) -> str:
        """The body that is the arm."""
        return next(iter(self.ends))

    @property
    def end(self) -> Array:
        """Of the axis of the member, on the left [m], shape (3,)."""
        return self.ends[self.link]

    @property
    def middle(self) -> Array:
        """Of the axis of the member [m], shape (3,)."""
        return self.end * jnp.asarray([1.0, 0.0, 1.0], self.end.dtype)

    @property
    def section(self) -> BeamSection:
        """With its shear centre."""
        section = self.beam.section
        return section if self.shear_centre is None else section.sheared_at(self.shear_centre)

    @property
    def own_mass(self) -> Array:
        """Of the whole member [kg], shape ()."""
        return self.section.mass * 2.0 * jnp.abs(self.end[1])

    @property
    def rate(self) -> Array:
        """G J/L of the whole member, about its shear centre [N m/rad], shape ()."""
        return 1.0 / (jnp.linalg.inv(self.section.matrix)[3, 3] * 2.0 * jnp.abs(self.end[1]))

    def bent(self, *, half: bool = False) -> Beam:
        """The beam, "twist_beam.0" at the left, to the right or, half of it, to the middle."""
        other, parts = (self.middle, 1) if half else (reflected(self).end, 2)
        up = upward(self.end, other, self.beam.up)
        points, elements = jnp.stack([self.end, other]), parts * self.beam.elements
        return Beam("twist_beam", self.section, points, elements=elements, up=up)

    def instead(self, car: Car) -> Car:
        """A corner that the member guides in place of the hinge of its arm, of which a ball joint is left."""
        joints = {
            name: dataclasses.replace(joint, kind="spherical") if joint.kind == LEVEL else joint
            for name, joint in car.joints.items()
        }
        return dataclasses.replace(car, joints=joints)

    def scene(self, cars: Mapping[str, Any], compliant: bool) -> Between:
        """It between corners: a beam, or rigid halves; of one side alone half of it, moved as both sides move alike."""
        arms = {side: car.scene_name(self.link, "twist_beam", f"{side}_") for side, car in cars.items()}
        ends = {"left": self.end, "right": reflected(self).end}
        fixed = lambda side, to: {f"{side}_twist_beam_{self.link}": FixedJoint(arms[side], to, at=ends[side])}
        if compliant:
            beam = self.bent(half=len(cars) < 2)
            joints: dict[str, Any] = fixed("left", beam.nodes[0])
            if len(cars) < 2:
                joints |= {"twist_beam": PlanarJoint(None, beam.nodes[-1], at=self.middle, axis=ALONG_Y)}
            else:
                joints |= fixed("right", beam.nodes[-1])
            return Between(beam.bodies, joints, dict(beam.forces), (*beam.forces,))
        half = self.bent(half=True)
        part, bodies, joints = stiffened(half), {}, {}
        for side in cars:
            bodies[f"{side}_twist_beam"] = (part if side == "left" else reflected(part)).body()
            joints |= fixed(side, f"{side}_twist_beam")
        if len(cars) < 2:
            return Between(bodies, joints, {}, ())
        across = half.axes[0][:, 1:]
        centre = self.middle if self.shear_centre is None else self.middle + across @ self.shear_centre
        joints |= {"twist_beam": CylindricalJoint(*bodies, at=centre, axis=ALONG_Y)}
        damping = self.section.damping * self.rate
        twisted = TorsionSpringDamper(*bodies, axis=ALONG_Y, stiffness=self.rate, damping=damping)
        return Between(bodies, joints, {"twist_beam": twisted}, ())
