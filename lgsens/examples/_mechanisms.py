"""Mechanisms of a few parts: simple pendulum, slider-crank, four-bar linkage, chain of hinges, linear quarter-car."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import as_count, as_float
from lgsens.model import (
    AppliedForce,
    BumpRoad,
    DistanceJoint,
    Gravity,
    Model,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SphericalJoint,
    SpringDamper,
    TyreSpring,
    UniversalJoint,
)

_CRANK_MASS = 1.0  # kg, of the slider-crank, at rest on the pivot
_AXIAL = 1e-2  # axial over transverse moment of inertia of a rod; planar motion does not excite it
_ORIGIN: Any = (0.0, 0.0, 0.0)  # tuples, which become arrays in the joints; an array made at import is float32
_E_X: Any = (1.0, 0.0, 0.0)
_E_Y: Any = (0.0, 1.0, 0.0)
_E_Z: Any = (0.0, 0.0, 1.0)


def _vector(x, y, z: Any = 0.0) -> Float[Array, "3"]:
    """An array of Python floats, arrays or traced numbers."""
    return as_float((x, y, z), (3,), "parameters")


def simple_pendulum(m=1.0, l=1.0, g=9.81) -> Model:
    """A point mass on a massless rod, released from the horizontal; it swings in the xy-plane.

    Arguments:
        m: mass [kg]. l: length of the rod from the origin [m]. g: gravity along −y [m/s²].

    Source: Library of Computational Benchmark Problems, IFToMM Technical Committee for Multibody Dynamics, A01;
    reference numbers from elliptic functions in `simple_pendulum_A01.json`.
    """
    start = _vector(-l, 0.0)
    return Model(
        bodies={"mass": RigidBody(mass=m, inertia=None, position=start)},
        joints={"rod": DistanceJoint(None, "mass", at_a=_ORIGIN, at_b=start)},
        forces={"gravity": Gravity((0.0, -g, 0.0))},
    )


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
    crank_pin, slider_pin = _vector(0.0, a), _vector(reach, 0.0)
    spring: Any = {"stiffness": k, "damping": c, "free_length": l0}
    return Model(
        bodies={
            "crank": RigidBody(mass=_CRANK_MASS, inertia=(J1, J1, J1)),
            "conrod": RigidBody(mass=m2 / 2, inertia=(J2, J2, J2), position=slider_pin),
            "slider": RigidBody(mass=m2 / 2, inertia=(J2, J2, J2), position=slider_pin),
        },
        joints={
            "pivot": RevoluteJoint(None, "crank", at=_ORIGIN, axis=_E_Z),
            "crank_pin": SphericalJoint("crank", "conrod", at=crank_pin),
            "slider_pin": UniversalJoint("conrod", "slider", at=slider_pin, axis_a=_E_Z, axis_b=_E_Y),
            "guide": PrismaticJoint(None, "slider", at=slider_pin, axis=_E_X),
        },
        forces={
            "spring": SpringDamper("crank", "conrod", at_a=crank_pin / 2, at_b=(crank_pin + slider_pin) / 2, **spring),
            "push": AppliedForce("conrod", at=2 * slider_pin - crank_pin, force=_vector(F, 0.0)),
        },
    )


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
    pin_d = _vector(d, 0.0)
    pin_b = _vector(a * jnp.cos(th0), a * jnp.sin(th0))
    span = pin_d - pin_b
    distance = jnp.linalg.norm(span)
    along = (b**2 - c**2 + distance**2) / (2 * distance)
    height = jnp.sqrt(b**2 - along**2)
    unit = span / distance
    turned = lambda vector: _vector(-vector[1], vector[0])  # e_z × vector
    pin_c = pin_b + along * unit + height * turned(unit)
    # w3, w4 from ẋ_B + w3 e_z × (C − B) = w4 e_z × (C − D)
    vel_b = w0 * turned(pin_b)
    matrix = jnp.stack([turned(pin_c - pin_b)[:2], -turned(pin_c - pin_d)[:2]], axis=1)
    w3, w4 = jnp.linalg.solve(matrix, -vel_b[:2])

    def rod(mass, start, end, velocity, rate):
        x = (end - start) / jnp.linalg.norm(end - start)
        transverse = mass * jnp.sum((end - start) ** 2) / 12
        along = jnp.outer(x, x)
        inertia = transverse * (_AXIAL * along + jnp.eye(3, dtype=x.dtype) - along)
        middle = velocity + rate * turned(end - start) / 2
        return RigidBody(mass, inertia, (start + end) / 2, velocity=middle, angular_velocity=(0.0, 0.0, rate))

    spring: Any = {"stiffness": k, "damping": cd, "free_length": l0}
    return Model(
        bodies={
            "crank": rod(m2, _vector(0.0, 0.0), pin_b, 0.0, w0),
            "coupler": rod(m3, pin_b, pin_c, vel_b, w3),
            "rocker": rod(m4, pin_d, pin_c, 0.0, w4),
        },
        joints={
            "A": RevoluteJoint(None, "crank", at=_ORIGIN, axis=_E_Z),
            "B": SphericalJoint("crank", "coupler", at=pin_b),
            "C": UniversalJoint("coupler", "rocker", at=pin_c, axis_a=_E_Z, axis_b=pin_c - pin_d),
            "D": RevoluteJoint(None, "rocker", at=pin_d, axis=_E_Z),
        },
        forces={
            "gravity": Gravity((0.0, -g, 0.0)),
            "spring": SpringDamper(None, "coupler", at_a=_vector(px, py), at_b=(pin_b + pin_c) / 2, **spring),
        },
    )


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

    axis = lambda i: _vector(0.0, jnp.cos(tilt * i), jnp.sin(tilt * i))
    section = 0.1 * length
    inertia = mass / 12 * _vector(2 * section**2, length**2 + section**2, length**2 + section**2)
    rate = spin * axis(0)
    bodies, joints = {}, {}
    for i in range(num_links):
        centre = _vector((i + 0.5) * length, 0.0)
        velocity = jnp.cross(rate, centre)
        bodies[f"link{i}"] = RigidBody(mass, inertia, centre, velocity=velocity, angular_velocity=rate)
        previous = f"link{i - 1}" if i else None
        joints[f"hinge{i}"] = RevoluteJoint(previous, f"link{i}", at=_vector(i * length, 0.0), axis=axis(i))
    return Model(bodies, joints, {"gravity": Gravity((0.0, 0.0, -g))})


def linear_quarter_car(ms=400.0, mu=40.0, ks=20000.0, cs=1500.0, kt=200000.0, hb=0.1, Tb=0.2) -> Model:
    """A wheel and the car above it that crosses a bump, in deviations from the equilibrium.

    Arguments:
        ms, mu: sprung and unsprung mass [kg].
        ks, cs: stiffness [N/m] and damping [N s/m] of the suspension. kt: stiffness of the tyre [N/m].
        hb, Tb: height [m] and duration [s] of the bump, which starts at t = 0.

    The heights z of "sprung" and "unsprung" are their deviations: gravity would only shift the equilibrium.
    The suspension acts between points 1 m apart, so that its line keeps its direction and the equations are linear.

    Source: a standard model; reference numbers by the matrix exponential in `quarter_car_linear.json`.
    """
    suspension: Any = {"stiffness": ks, "damping": cs}
    bump: Any = {"height": hb, "duration": Tb}
    tyre: Any = {"stiffness": kt, "road": BumpRoad(**bump)}
    return Model(
        bodies={"sprung": RigidBody(mass=ms, inertia=None), "unsprung": RigidBody(mass=mu, inertia=None)},
        joints={
            "heave": PrismaticJoint(None, "sprung", at=_ORIGIN, axis=_E_Z),
            "hop": PrismaticJoint(None, "unsprung", at=_ORIGIN, axis=_E_Z),
        },
        forces={
            "suspension": SpringDamper("unsprung", "sprung", at_a=_ORIGIN, at_b=_E_Z, **suspension),
            "tyre": TyreSpring("unsprung", at=_ORIGIN, **tyre),
        },
    )
