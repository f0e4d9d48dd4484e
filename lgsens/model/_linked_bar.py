"""An anti-roll bar with levers and drop links, made of bodies, joints and forces."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, number_field, require, require_positive
from lgsens.model._body import RigidBody
from lgsens.model._forces import AbstractForce
from lgsens.model._joints import AbstractJoint, DistanceJoint, RevoluteJoint
from lgsens.model._vehicle_forces import AntiRollBar


def _pair(name: str):
    return eqx.field(converter=lambda value: as_float(value, (2, 3), f"`{name}`"), kw_only=True)


class LinkedAntiRollBar(eqx.Module):
    """An anti-roll bar in two halves, each with a lever that a drop link ties to one side; bodies, joints and forces.

        lg.Model({**car.bodies, **bar.bodies}, {**car.joints, **bar.joints}, {**car.forces, **bar.forces})

    The halves turn in the chassis about the bar, against each other by twisting it: `AntiRollBar` between them. Where
    levers of length r are at right angles to vertical links, k 2/r² is added to the rate of each side in opposite
    travel, nothing in parallel travel, with k of the bar.

    Arguments:
        name: of the bar; halves are "NAME left" and "NAME right", joints "NAME left hinge", "NAME left link", ….
        chassis: name of the body that carries it; None is the ground.
        sides: names of the left and right body at the links.
        bearings: where the twisted part ends, on the axis of the bar, left and right, in the reference configuration
            [m], inertial frame, shape (2, 3).
        arms: ends of the levers there, shape (2, 3).
        links: where the links end on the sides there, shape (2, 3).
        mass: of each half [kg], shape (), > 0: a rod of the bar's diameter from its bearing to the end of its lever.
        diameter, bore, shear_modulus, damping: as in `AntiRollBar`.

    Raises `ValueError` for wrong shapes, a lever without length, bearings that coincide, or a mass ≤ 0.
    """

    name: str = eqx.field(static=True)
    chassis: str | None = eqx.field(static=True)
    sides: tuple[str, str] = eqx.field(static=True)
    bearings: Float[Array, "2 3"] = _pair("bearings")
    arms: Float[Array, "2 3"] = _pair("arms")
    links: Float[Array, "2 3"] = _pair("links")
    mass: Float[Array, ""] = number_field("mass")
    diameter: Float[Array, ""] = number_field("diameter")
    bore: Float[Array, ""] = number_field("bore", default=0.0)
    shear_modulus: Float[Array, ""] = number_field("shear_modulus", default=79.3e9)
    damping: Float[Array, ""] = number_field("damping", default=0.0)

    def __check_init__(self):
        require_positive(self, "mass")
        for what, first, second in (
            ("`bearings` coincide", self.bearings[:1], self.bearings[1:]),
            ("an end in `arms` is at its bearing", self.bearings, self.arms),
            ("an end in `links` is at the end of its lever", self.arms, self.links),
        ):
            require(
                lambda a, b: np.all(np.any(a != b, axis=1)),
                f"LinkedAntiRollBar: {what}, {second}; move it.",
                first,
                second,
            )

    @property
    def _halves(self) -> tuple[str, str]:
        return f"{self.name} left", f"{self.name} right"

    @property
    def bodies(self) -> dict[str, RigidBody]:
        """The two halves."""
        found = {}
        for half, bearing, end in zip(self._halves, self.bearings, self.arms):
            lever = end - bearing
            square = jnp.sum(lever * lever)
            along = jnp.outer(lever, lever) / square
            across = square / 12.0 + self.diameter**2 / 16.0
            inertia = across * (jnp.eye(3, dtype=lever.dtype) - along) + self.diameter**2 / 8.0 * along
            found[half] = RigidBody(self.mass, self.mass * inertia, position=(bearing + end) / 2.0)
        return found

    @property
    def joints(self) -> dict[str, AbstractJoint]:
        """Hinges of the halves in the chassis, and the links."""
        found: dict[str, AbstractJoint] = {}
        axis = self.bearings[1] - self.bearings[0]
        for i, half in enumerate(self._halves):
            found[f"{half} hinge"] = RevoluteJoint(self.chassis, half, at=self.bearings[i], axis=axis)
            found[f"{half} link"] = DistanceJoint(half, self.sides[i], at_a=self.arms[i], at_b=self.links[i])
        return found

    @property
    def forces(self) -> dict[str, AbstractForce]:
        """The bar."""
        axis = self.bearings[1] - self.bearings[0]
        section = {"diameter": self.diameter, "bore": self.bore, "shear_modulus": self.shear_modulus}
        bar = AntiRollBar(*self._halves, axis=axis, length=jnp.linalg.norm(axis), damping=self.damping, **section)
        return {self.name: bar}
