"""A four-bar linkage of beams with a hinge out of line: rigid bars would lock, bending ones carry large forces."""

import dataclasses
from typing import Any

import jax.numpy as jnp

from lgsens.model import Beam, BeamSection, Model, Polynomial, RevoluteJoint, RotationDriver

# Square bars of steel, E = 207 GPa, ν = 0.3, 16 and 8 mm wide, by the problem's own numbers: E A, k G A [N], G J, E I
# [N m²], mass [kg/m] and ϱ I [kg m].
THICK = (52.99e6, 16.88e6, 733.5, 1131.0, 1.997, 42.60e-6)
THIN = (13.25e6, 4.220e6, 45.84, 70.66, 0.4992, 2.662e-6)
POWERS = (2, 2, 4, 4, 2, 4)  # of the width
A: Any = (0.0, 0.0, 0.0)  # [m]
B: Any = (0.0, 0.12, 0.0)
C: Any = (0.24, 0.12, 0.0)
D: Any = (0.24, 0.0, 0.0)
BARS = {"crank": (THICK, A, B), "coupler": (THICK, B, C), "rocker": (THIN, C, D)}
_E_Z: Any = (0.0, 0.0, 1.0)


def misaligned_four_bar(misalignment=0.08726646259971647, rate=-0.6, width=8e-3, elements=(4, 8, 4)) -> Model:
    """Bars AB, BC and CD of 0.12, 0.24 and 0.12 m, a rectangle at first, in the xy-plane; the crank AB is driven.

    Arguments:
        misalignment: angle from e_z to the axis of the hinge at C, towards e_x [rad], shape (); 5°. The others are e_z.
        rate: of the crank about e_z [rad/s], shape (), constant. width: of the rocker [m], shape ().
        elements: of crank, coupler and rocker, Python ints.

    Bodies are the nodes, "crank.0" at A to "rocker.4" at D, elements the forces of the same names. The bars start
    without stress, with the velocities of a parallelogram.

    Four hinges about e_z leave rigid bars one freedom; with the one at C out of line they would lock. Where the bars
    lie flat, 2.6 and 7.9 s after the start, the linkage snaps from parallelogram to antiparallelogram and back. Its
    elastic forces decide, not rounding, and steps have to resolve it (5 ms).

    Source: O. Bauchau et al., Validation of flexible multibody dynamics beam formulations using benchmark problems,
    Multibody Syst. Dyn. 37 (2016), 29–48, doi:10.1007/s11044-016-9514-y, whose results are curves; numbers of an
    independent program are in tests/data/misaligned_four_bar.json.

    Raises `ValueError` for other than three numbers of elements, and as `BeamSection` and `Beam`.
    """
    if len(elements) != len(BARS):
        raise ValueError(f"`elements` must be three, those of crank, coupler and rocker, got {elements!r}.")
    turning = jnp.asarray(rate) * jnp.asarray(_E_Z)
    bodies, forces, end = {}, {}, {}
    for (name, (numbers, *points)), count in zip(BARS.items(), elements):
        ratio = width / 8e-3 if name == "rocker" else 1.0
        EA, GA, GJ, EI, mass, inertia = (jnp.asarray(x * ratio**power) for x, power in zip(numbers, POWERS))
        section = BeamSection(jnp.stack([EA, GA, GA, GJ, EI, EI]), mass, jnp.stack([2 * inertia, inertia, inertia]))
        beam = Beam(name, section, points, elements=count)
        for node, body in beam.bodies.items():  # crank and rocker turn about A and D, the coupler goes with B
            place, pivot = {"crank": (body.position, A), "coupler": (B, A), "rocker": (body.position, D)}[name]
            velocity = jnp.cross(turning, jnp.asarray(place) - jnp.asarray(pivot))
            spin = jnp.zeros_like(turning) if name == "coupler" else turning  # about the beam's axis 3, which is e_z
            bodies[node] = dataclasses.replace(body, velocity=velocity, angular_velocity=spin)
        forces |= beam.forces
        end[name] = beam.nodes[-1]
    angle = jnp.asarray(misalignment)
    skew = jnp.stack([jnp.sin(angle), jnp.zeros_like(angle), jnp.cos(angle)])
    joints = {
        "A": RevoluteJoint(None, "crank.0", at=A, axis=_E_Z),
        "B": RevoluteJoint(end["crank"], "coupler.0", at=B, axis=_E_Z),
        "C": RevoluteJoint(end["coupler"], "rocker.0", at=C, axis=skew),
        "D": RevoluteJoint(None, end["rocker"], at=D, axis=_E_Z),
        "motor": RotationDriver(None, "crank.0", axis=_E_Z, value=Polynomial(turning[1:])),  # 0 + rate t
    }
    return Model(bodies, joints, forces)
