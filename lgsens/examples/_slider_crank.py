"""The slider-crank of SUNDIALS' sensitivity example."""

import jax.numpy as jnp

from lgsens.examples._arrays import number, vector
from lgsens.model import (
    AppliedForce,
    Model,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SphericalJoint,
    SpringDamper,
    UniversalJoint,
)

_CRANK_MASS = 1.0  # kg, at rest on the pivot


def slider_crank(a=0.5, J1=1.0, m2=1.0, J2=2.0, k=1.0, c=1.0, l0=1.0, F=1.0) -> Model:
    """Crank, connecting rod of length 1 m and slider, at rest with the crank upright, moved by a spring and a force.

    Arguments:
        a: length of the crank from its pivot, the origin [m].
        J1: moment of inertia of the crank about its pivot [kg m²].
        m2, J2: mass [kg] and moment of inertia [kg m²] of rod and slider, both about the slider's pin.
        k, c, l0: stiffness [N/m], damping [N s/m] and free length [m] of the spring between the middle of the crank and
            the middle of the rod.
        F: constant force along x [N] on the point of the rod 1 m beyond the slider's pin.

    The slider moves along x, the mechanism in the xy-plane without gravity. The source lumps the mass of the rod at
    the slider's pin; here rod and slider have their centres of mass there and half of m2 each. The joints are revolute
    at the pivot, spherical at the crank's pin, universal at the slider's pin and prismatic to the ground: 17 equations
    for 18 coordinates. Other moments of inertia than those about z do not matter.

    Source: IDAS example `idasSlCrank_FSA_dns.c` of SUNDIALS (LLNL); reference numbers by index-1 integration in
    `slider_crank_sundials.json`.
    """
    reach = jnp.sqrt(1.0 - a**2)  # of the rod along x, when its other end is at (0, a)
    pivot, crank_pin, slider_pin = vector(0.0, 0.0, 0.0), vector(0.0, a, 0.0), vector(reach, 0.0, 0.0)
    e_x, e_y, e_z = vector(1.0, 0.0, 0.0), vector(0.0, 1.0, 0.0), vector(0.0, 0.0, 1.0)
    return Model(
        bodies={
            "crank": RigidBody(mass=_CRANK_MASS, inertia=(J1, J1, J1)),
            "conrod": RigidBody(mass=m2 / 2, inertia=(J2, J2, J2), position=slider_pin),
            "slider": RigidBody(mass=m2 / 2, inertia=(J2, J2, J2), position=slider_pin),
        },
        joints={
            "pivot": RevoluteJoint(None, "crank", at=pivot, axis=e_z),
            "crank_pin": SphericalJoint("crank", "conrod", at=crank_pin),
            "slider_pin": UniversalJoint("conrod", "slider", at=slider_pin, axis_a=e_z, axis_b=e_y),
            "guide": PrismaticJoint(None, "slider", at=slider_pin, axis=e_x),
        },
        forces={
            "spring": SpringDamper(
                "crank",
                "conrod",
                at_a=crank_pin / 2,
                at_b=(crank_pin + slider_pin) / 2,
                stiffness=number(k),
                damping=number(c),
                free_length=number(l0),
            ),
            "push": AppliedForce("conrod", at=2 * slider_pin - crank_pin, force=vector(F, 0.0, 0.0)),
        },
    )
