"""The heavy top: a fast top on a fixed point, the test case of the integrator's authors."""

from lgsens.examples._arrays import vector
from lgsens.model import Gravity, Model, RigidBody, SphericalJoint


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
    return Model(
        bodies={"top": body},
        joints={"pivot": SphericalJoint(None, "top", at=vector(0.0, 0.0, 0.0))},
        forces={"gravity": Gravity((0.0, 0.0, -g))},
    )
