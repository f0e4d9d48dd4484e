"""The spinning top of the paper, §8."""

import jax.numpy as jnp

from lgsens.model import Gravity, Model, RigidBody, SphericalJoint


def spinning_top(alpha0, mass=15.0, inertia=(0.2, 0.4, 0.2), length=1.0, spin=10.0, gravity=9.81) -> Model:
    """A top on a fixed point, its axis in the yz-plane at first and spinning about it.

    Arguments:
        alpha0: angle α₀ of the axis over the horizontal [rad].
        mass: [kg]. inertia: principal moments about the centre of mass [kg m²], shape (3,), body frame.
        length: distance of the centre of mass from the pivot [m].
        spin: angular velocity ω₀ about the axis [rad/s]. gravity: [m/s²].

    With l = 1 m, t in [0, 1] s and Ψ = ∫ x² dt, dΨ/dα₀ = −0.0021318254254500 at α₀ = π/4 (the paper prints l = 0.5 m).
    Source: Sonneville & Brüls (2014), §8.
    """
    axis = jnp.stack([jnp.zeros_like(alpha0), jnp.cos(alpha0), jnp.sin(alpha0)])
    return Model(
        bodies={"top": RigidBody(mass=mass, inertia=inertia, position=length * axis, angular_velocity=spin * axis)},
        joints={"pivot": SphericalJoint(None, "top", at=jnp.zeros_like(axis))},
        forces={"gravity": Gravity(jnp.stack([jnp.zeros_like(gravity), jnp.zeros_like(gravity), -gravity]))},
    )
