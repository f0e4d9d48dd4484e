"""The simple pendulum, benchmark A01 of the IFToMM library."""

from lgsens.examples._arrays import vector
from lgsens.model import DistanceJoint, Gravity, Model, RigidBody


def simple_pendulum(m=1.0, l=1.0, g=9.81) -> Model:
    """A point mass on a massless rod, released from the horizontal; it swings in the xy-plane.

    Arguments:
        m: mass [kg]. l: length of the rod from the origin [m]. g: gravity along −y [m/s²].

    Source: Library of Computational Benchmark Problems, IFToMM Technical Committee for Multibody Dynamics, A01;
    reference numbers from elliptic functions in `simple_pendulum_A01.json`.
    """
    start = vector(-l, 0.0, 0.0)
    return Model(
        bodies={"mass": RigidBody(mass=m, inertia=None, position=start)},
        joints={"rod": DistanceJoint(None, "mass", at_a=vector(0.0, 0.0, 0.0), at_b=start)},
        forces={"gravity": Gravity((0.0, -g, 0.0))},
    )
