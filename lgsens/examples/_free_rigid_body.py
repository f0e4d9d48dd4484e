"""A rigid body without joints and forces: Euler's equations."""

from lgsens.model import Model, RigidBody


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
