"""A planar four-bar linkage with a spring-damper at its coupler."""

import jax.numpy as jnp

from lgsens.examples._arrays import number, vector
from lgsens.model import (
    Gravity,
    Model,
    RevoluteJoint,
    RigidBody,
    SphericalJoint,
    SpringDamper,
    UniversalJoint,
)

_AXIAL = 1e-2  # axial over transverse moment of inertia of a rod; planar motion does not excite it


def four_bar(
    a=0.3,
    b=0.8,
    c=0.7,
    d=0.9,
    m2=1.0,
    m3=2.0,
    m4=1.5,
    k=200.0,
    cd=2.0,
    l0=0.4,
    w0=5.0,
    g=9.81,
    th0=1.2,
    px=0.45,
    py=1.1,
) -> Model:
    """Ground pivots A = (0, 0) and D = (d, 0), crank AB, coupler BC, rocker DC with C above BD, in the xy-plane.

    Arguments:
        a, b, c, d: lengths of crank, coupler, rocker and ground [m].
        m2, m3, m4: masses of crank, coupler and rocker, uniform slender rods [kg].
        k, cd, l0: stiffness [N/m], damping [N s/m], free length [m] of the spring between the middle of the coupler
            and the ground point (px, py) [m].
        w0, th0: crank rate [rad/s] and angle [rad] at first. g: gravity along −y [m/s²].

    The joints are revolute at A and D, spherical at B and universal at C: 17 equations for 18 coordinates. Four
    revolute joints would be redundant. Source: a standard mechanism; reference numbers by index-1 integration in
    natural coordinates, `four_bar_spring.json`.
    """
    point = lambda x, y: vector(x, y, 0.0)
    pin_a, pin_d = point(0.0, 0.0), point(d, 0.0)
    pin_b = point(a * jnp.cos(th0), a * jnp.sin(th0))
    span = pin_d - pin_b
    distance = jnp.linalg.norm(span)
    along = (b**2 - c**2 + distance**2) / (2 * distance)
    height = jnp.sqrt(b**2 - along**2)
    unit = span / distance
    normal = point(-unit[1], unit[0])
    pin_c = pin_b + along * unit + height * normal

    def turned(vector):  # e_z × vector
        return point(-vector[1], vector[0])

    e_z = vector(0.0, 0.0, 1.0)
    # w3, w4 from ẋ_B + w3 e_z × (C − B) = w4 e_z × (C − D)
    vel_b = w0 * turned(pin_b - pin_a)
    matrix = jnp.stack([turned(pin_c - pin_b)[:2], -turned(pin_c - pin_d)[:2]], axis=1)
    w3, w4 = jnp.linalg.solve(matrix, -vel_b[:2])

    def rod(mass, start, end, velocity, rate):
        x = (end - start) / jnp.linalg.norm(end - start)
        transverse = mass * jnp.sum((end - start) ** 2) / 12
        along = jnp.outer(x, x)
        inertia = transverse * (_AXIAL * along + jnp.eye(3, dtype=x.dtype) - along)
        middle = velocity + rate * turned(end - start) / 2
        return RigidBody(mass, inertia, (start + end) / 2, velocity=middle, angular_velocity=rate * e_z)

    return Model(
        bodies={
            "crank": rod(m2, pin_a, pin_b, point(0.0, 0.0), w0),
            "coupler": rod(m3, pin_b, pin_c, vel_b, w3),
            "rocker": rod(m4, pin_d, pin_c, point(0.0, 0.0), w4),
        },
        joints={
            "A": RevoluteJoint(None, "crank", at=pin_a, axis=e_z),
            "B": SphericalJoint("crank", "coupler", at=pin_b),
            "C": UniversalJoint("coupler", "rocker", at=pin_c, axis_a=e_z, axis_b=pin_c - pin_d),
            "D": RevoluteJoint(None, "rocker", at=pin_d, axis=e_z),
        },
        forces={
            "gravity": Gravity(point(0.0, -g)),
            "spring": SpringDamper(
                None,
                "coupler",
                at_a=point(px, py),
                at_b=(pin_b + pin_c) / 2,
                stiffness=number(k),
                damping=number(cd),
                free_length=number(l0),
            ),
        },
    )
