"""The symmetric top of Lagrange, whose motion has a closed form."""

import jax.numpy as jnp

from lgsens.examples._arrays import vector
from lgsens.model import Gravity, Model, RigidBody, SphericalJoint

_LEVER = 0.1  # l'/l of the body that stands for the top


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
    return Model(
        bodies={"top": body},
        joints={"pivot": SphericalJoint(None, "top", at=vector(0.0, 0.0, 0.0))},
        forces={"gravity": Gravity((0.0, 0.0, -g))},
    )
