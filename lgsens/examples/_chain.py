"""A spatial chain of links on hinges."""

import jax.numpy as jnp

from lgsens._validate import as_count
from lgsens.examples._arrays import vector
from lgsens.model import Gravity, Model, RevoluteJoint, RigidBody


def spatial_chain(num_links: int = 3, length=0.3, mass=0.5, tilt=1.0, spin=3.0, g=9.81) -> Model:
    """Equal links in a row along x, hung at the origin; each hinge is turned about x against the one before.

    Arguments:
        num_links: number of links N ≥ 1, a Python int: 6 N coordinates, 5 N constraints, N degrees of freedom.
        length: of a link, a uniform bar of square section, a tenth of its length wide [m].
        mass: of a link [kg]. tilt: angle between the axes of neighbouring hinges [rad].
        spin: rate of the first hinge at first, the chain straight [rad/s]. g: gravity along −z [m/s²].

    Raises `ValueError` for fewer than 1 link. Source: a standard scene; its reference is `IndexReduced`.
    """
    num_links = as_count(num_links, "num_links", " (it is static)")

    def axis(i):
        return vector(0.0, jnp.cos(tilt * i), jnp.sin(tilt * i))

    section = 0.1 * length
    inertia = mass / 12 * vector(2 * section**2, length**2 + section**2, length**2 + section**2)
    rate = spin * axis(0)
    bodies, joints = {}, {}
    for i in range(num_links):
        centre = vector((i + 0.5) * length, 0.0, 0.0)
        bodies[f"link{i}"] = RigidBody(
            mass=mass,
            inertia=inertia,
            position=centre,
            velocity=jnp.cross(rate, centre),
            angular_velocity=rate,
        )
        previous = f"link{i - 1}" if i else None
        joints[f"hinge{i}"] = RevoluteJoint(previous, f"link{i}", at=vector(i * length, 0.0, 0.0), axis=axis(i))
    return Model(bodies, joints, {"gravity": Gravity(vector(0.0, 0.0, -g))})
