"""A semi-elliptic leaf spring between an eye and a shackle, with an axle in its middle."""

from typing import Any

import jax.numpy as jnp

from lgsens._validate import as_count
from lgsens.model import AppliedForce, Beam, BeamSection, DistanceJoint, FixedJoint, Model, RevoluteJoint, RigidBody

_E_Y: Any = (0.0, 1.0, 0.0)
_UP: Any = (0.0, 0.0, 1.0)  # [N]


def leaf_spring(
    length=1.2,
    camber=0.1,
    width=0.06,
    thickness=0.008,
    shackle=0.1,
    shackle_angle=0.2,
    mass=60.0,
    young=2.07e11,
    poisson=0.29,
    density=7850.0,
    damping=1e-4,
    leaves: int = 5,
    elements: int = 8,
) -> Model:
    """Leaves of one length that slide on each other without friction, as one beam in the xz-plane; the chassis is held.

    Arguments:
        length: L, from eye to shackle, along x [m]. camber: how far the ends are above the middle, on a parabola [m].
        width, thickness: of a leaf, along y and across [m]. leaves: how many, a Python int.
        shackle: its length [m]. shackle_angle: of its line from the leaf up to the chassis, from z to x [rad].
        mass: of the axle [kg], in the middle, clamped. young, poisson, density [N/m², –, kg/m³], damping [s]: of the
            leaves, as of `BeamSection`.
        elements: of the whole leaf, a Python int, even.

    Bodies are "axle" and the nodes "leaf.0", on the eye at −L/2, to "leaf.8", on the shackle. The force "load" acts on
    the axle, 1 N up: `lg.statics(model, loads={"load": [0, 2000]})`. The middle of a flat spring moves by

        F (L³/48 E I + L/4 k G A),     I = n b t³/12,

    less 1/(4 (elements/2)²) of the first term; camber and shackle change it as they turn. The stress of a
    `SectionState` is that in a leaf. All numbers but counts may be traced.

    Raises `ValueError` for an odd number of elements. Source: SAE HS-788, Manual on Design and Application
    of Leaf Springs; the closed form is that of a beam on two supports.
    """
    leaves, elements = (
        as_count(of, name, " (it is static)") for of, name in ((leaves, "leaves"), (elements, "elements"))
    )
    if elements % 2:
        raise ValueError(f"`elements` must be even, got {elements}: the axle is clamped to the node in the middle.")
    material: Any = {"young": young, "poisson": poisson, "density": density, "damping": damping}
    pack = BeamSection.rectangle(width, thickness, **material).stacked(leaves)
    share = jnp.linspace(-1.0, 1.0, elements + 1)
    points = jnp.stack([0.5 * length * share, jnp.zeros_like(share), camber * share**2], axis=1)
    beam = Beam("leaf", pack, points)
    eye, middle, end = points[0], points[elements // 2], points[-1]
    angle = jnp.asarray(shackle_angle)
    up = shackle * jnp.stack([jnp.sin(angle), jnp.zeros_like(angle), jnp.cos(angle)])
    joints = {
        "eye": RevoluteJoint(None, beam.nodes[0], at=eye, axis=_E_Y),
        "shackle": DistanceJoint(None, beam.nodes[-1], at_a=end + up, at_b=end),
        "clamp": FixedJoint(beam.nodes[elements // 2], "axle", at=middle),
    }
    # of a tube of 80 mm across the car, a metre of it: the axle turns with the leaf, and hardly moves otherwise
    axle = RigidBody(mass, (mass / 12.0, mass * 8e-4, mass / 12.0), middle)
    load = AppliedForce("axle", at=middle, force=_UP)
    return Model(beam.bodies | {"axle": axle}, joints, beam.forces | {"load": load}, merge_fixed=True)
