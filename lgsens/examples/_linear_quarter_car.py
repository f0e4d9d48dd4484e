"""The linear quarter-car: two masses, two springs, one damper."""

from lgsens.examples._arrays import number, vector
from lgsens.model import BumpRoad, Model, PrismaticJoint, RigidBody, SpringDamper, TyreSpring


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
    origin, e_z = vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 1.0)
    bump = BumpRoad(height=number(hb), duration=number(Tb))
    return Model(
        bodies={"sprung": RigidBody(mass=ms, inertia=None), "unsprung": RigidBody(mass=mu, inertia=None)},
        joints={
            "heave": PrismaticJoint(None, "sprung", at=origin, axis=e_z),
            "hop": PrismaticJoint(None, "unsprung", at=origin, axis=e_z),
        },
        forces={
            "suspension": SpringDamper(
                "unsprung", "sprung", at_a=origin, at_b=e_z, stiffness=number(ks), damping=number(cs)
            ),
            "tyre": TyreSpring("unsprung", at=origin, stiffness=number(kt), road=bump),
        },
    )
