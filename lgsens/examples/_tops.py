"""Tops on a fixed point, and the rigid body that turns freely."""

import jax.numpy as jnp

from lgsens.model import Gravity, Model, RigidBody, SphericalJoint

_LEVER = 0.1  # l'/l of the body that stands for the top of Lagrange


def free_rigid_body(J1=0.4, J2=0.7, J3=0.9, w1=1.2, w2=-0.5, w3=2.0) -> Model:
    """A body that turns freely about its centre of mass, which rests at the origin.

    Arguments:
        J1, J2, J3: principal moments of inertia [kg m²].
        w1, w2, w3: angular velocity at first [rad/s], body frame, which is the inertial frame at first.

    Rotation about the axis of the middle moment is unstable: started near it, the body turns over again and again
    (Dzhanibekov). Source: Landau & Lifshitz, Mechanics, §37; reference numbers from elliptic functions in
    `free_rigid_body.json`.
    """
    return Model(bodies={"body": RigidBody(mass=1.0, inertia=(J1, J2, J3), angular_velocity=(w1, w2, w3))})


def _on_a_point(body: RigidBody, gravity) -> Model:
    """A body on a ball joint at the origin, gravity along −z."""
    pivot = SphericalJoint(None, "top", at=jnp.zeros_like(body.position))
    return Model({"top": body}, {"pivot": pivot}, {"gravity": Gravity((0.0, 0.0, -gravity))})


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
    return _on_a_point(RigidBody(mass, inertia, position=length * axis, angular_velocity=spin * axis), gravity)


def heavy_top(m=15.0, J11=0.234375, J22=0.46875, J33=0.234375, l=1.0, Om2=150.0, Om3=-4.61538, g=9.81) -> Model:
    """A top that spins at 150 rad/s about its axis, horizontal at first.

    Arguments:
        m: mass [kg]. J11, J22, J33: principal moments about the centre of mass [kg m²], body frame; the axis of the
            top is the second.
        l: distance of the centre of mass from the fixed point, the origin [m].
        Om2, Om3: angular velocity about the second and third body axis [rad/s] at first; the first is at rest.
        g: gravity along −z [m/s²].

    The body frame is the inertial frame at first. Source: Brüls, Cardona & Arnold, Lie group generalized-α time
    integration of constrained flexible multibody systems, Mechanism and Machine Theory 48 (2012); reference numbers
    in `heavy_top_bruls2012.json`.
    """
    body = RigidBody(
        mass=m,
        inertia=(J11, J22, J33),
        position=(0.0, l, 0.0),
        velocity=(-l * Om3, 0.0, 0.0),
        angular_velocity=(0.0, Om2, Om3),
    )
    return _on_a_point(body, g)


def lagrange_top(m=2.0, l=0.25, J1=0.05, J3=0.02, w3=80.0, theta0=0.6, g=9.81) -> Model:
    """A symmetric top on a fixed point, released with its spin only: it nutates between two cones.

    Arguments:
        m: mass [kg]. l: distance of the centre of mass from the fixed point, the origin [m].
        J1, J3: moments about the centre of mass [kg m²], transverse and about the axis of symmetry, which is the third
            body axis.
        w3: spin about the axis [rad/s]. theta0: angle of the axis to the vertical z at first [rad], about x.
        g: gravity along −z [m/s²].

    Only m l, J3 and the moment A = J1 + m l² about the fixed point determine the rotation R(t). Tables give A, and an m
    and l with which J1 need not be the moment of any body: Simo & Wong's A = 5, J3 = 1, m = 20, l = 1 mean J1 = −15.
    The scene has the body m' = 10 m, l' = l/10, J1' = J1 + 0.9 m l² instead, with the same m l and A, which can exist
    there too. The top's centre of mass is at l R e₃, ten times as far as that of the body, and the force in the joint
    is that of the body, not that of the top.

    Source: Goldstein, Classical Mechanics, §5.7; Simo & Wong, Int. J. Numer. Meth. Eng. 31 (1991), 19–52; reference
    numbers from elliptic functions in `lagrange_top_analytic.json`.
    """
    cos, sin = jnp.cos(theta0), jnp.sin(theta0)
    lever = _LEVER * l
    transverse = J1 + (1.0 - _LEVER) * m * l**2  # J1' + m' l'² = J1 + m l²
    body = RigidBody(
        mass=m / _LEVER,
        inertia=(transverse, transverse, J3),
        position=(0.0, -lever * sin, lever * cos),
        orientation=((1.0, 0.0, 0.0), (0.0, cos, -sin), (0.0, sin, cos)),
        angular_velocity=(0.0, 0.0, w3),
    )
    return _on_a_point(body, g)
