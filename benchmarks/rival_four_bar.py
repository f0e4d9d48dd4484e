"""The misaligned four-bar of `lgsens.examples` in Exudyn: numbers for tests/data/misaligned_four_bar.json.

    python benchmarks/rival_four_bar.py [--out FILE]        # 20 s

Its published results are curves, so an independent program gives the digits: Exudyn's geometrically exact element,
`ObjectBeamGeometricallyExact`, rotations as Tait-Bryan angles, hinges as `GenericJoint`, and the same scheme,
generalized-α with ρ∞ = 0.8 and equal steps of 5 ms. `lumped` has the mass on the nodes, as lgsens has it: the equations
then are the same. `fine` has four times the elements and Exudyn's distribution of mass: what discretization leaves.
"""

import argparse
import importlib
import json
import warnings
from pathlib import Path

import numpy as np
from exudyn_solver import FULL, beam_on_nodes, fast, solver_settings

from lgsens.examples._misaligned_four_bar import BARS

DATA = Path(__file__).parent.parent / "tests" / "data" / "misaligned_four_bar.json"
MISALIGNMENT, RATE, T1, STEPS, RHO = np.deg2rad(5.0), -0.6, 12.0, 2400, 0.8
EVERY = 50  # steps, of what is stored
COMMENT = (
    "Four-bar with a hinge out of line (Bauchau et al., Multibody Syst. Dyn. 37, 2016), scene of "
    "lgsens.examples.misaligned_four_bar. Position of C [m], forces [N] and moments [N m] of the section in the middle "
    "of the coupler's element 4 of 8 (`lumped`) or 16 of 32 (`fine`), in its frame, by Exudyn's "
    "ObjectBeamGeometricallyExact; written by benchmarks/rival_four_bar.py."
)


def turn(angle: float, axis: int) -> np.ndarray:
    """Rotation about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    found = np.eye(3)
    found[i, i], found[j, j], found[i, j], found[j, i] = c, c, -s, s
    return found


def run(elements: tuple[int, ...], lumped: bool, tolerance: float) -> dict[str, list]:
    exu, items = fast(), importlib.import_module("exudyn.itemInterface")
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    nodes, beams, heading = {}, {}, {}
    for (name, ((EA, GA, GJ, EI, mass, inertia), start, end)), count in zip(BARS.items(), elements):
        start, end = np.array(start), np.array(end)
        length = np.linalg.norm(end - start) / count
        heading[name] = np.arctan2(*(end - start)[1::-1])
        for i in range(count + 1):
            place = start + (end - start) * i / count
            arm = {"crank": place, "coupler": start, "rocker": place - end}[name]
            spin = 0.0 if name == "coupler" else RATE
            nodes[name, i] = mbs.AddNode(
                items.NodeRigidBodyRxyz(
                    referenceCoordinates=[*place, 0.0, 0.0, heading[name]],
                    initialVelocities=[*np.cross([0.0, 0.0, RATE], arm), 0.0, 0.0, spin],
                )
            )
        own, moments = [nodes[name, i] for i in range(count + 1)], (2 * inertia, inertia, inertia)
        section = ((EA, GA, GA, GJ, EI, EI), mass, moments)
        beams[name] = beam_on_nodes(exu, mbs, own, length, section, lumped=lumped)
    ground = mbs.AddObject(items.ObjectGround())
    still = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=mbs.AddNode(items.NodePointGround()), coordinate=0))
    for coordinate in range(6):  # the crank's node at A: all held, but for its angle about e_z
        moving = mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=nodes["crank", 0], coordinate=coordinate))
        driven = {"offsetUserFunction": lambda mbs, t, *_: RATE * t, "offsetUserFunction_t": lambda *_: RATE}
        mbs.AddObject(items.CoordinateConstraint(markerNumbers=[still, moving], **(driven if coordinate == 5 else {})))

    def hinge(a, b, angle):
        """Between the end of a bar (None: the ground at D) and a node, about e_z turned by `angle` towards e_x."""
        at_a = (
            mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=ground, localPosition=list(BARS["rocker"][2])))
            if a is None
            else mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=nodes[a]))
        )
        at_b = mbs.AddMarker(items.MarkerNodeRigid(nodeNumber=nodes[b]))
        frames = [turn(0.0 if of is None else -heading[of[0]], 2) @ turn(angle, 1) for of in (a, b)]
        mbs.AddObject(
            items.GenericJoint(
                markerNumbers=[at_a, at_b],
                constrainedAxes=[1, 1, 1, 1, 1, 0],
                rotationMarker0=frames[0],
                rotationMarker1=frames[1],
            )
        )

    hinge(("crank", elements[0]), ("coupler", 0), 0.0)
    hinge(("coupler", elements[1]), ("rocker", 0), MISALIGNMENT)
    hinge(None, ("rocker", elements[2]), 0.0)
    kinds, middle = exu.OutputVariableType, beams["coupler"][elements[1] // 2]
    sensors = {"C": items.SensorNode(nodeNumber=nodes["coupler", elements[1]], outputVariableType=kinds.Position)}
    for name, kind in (("force", kinds.ForceLocal), ("moment", kinds.TorqueLocal)):
        sensors[name] = items.SensorBody(bodyNumber=middle, localPosition=[0.0, 0.0, 0.0], outputVariableType=kind)
    for sensor in sensors.values():
        sensor.storeInternal = True
    numbers = {name: mbs.AddSensor(sensor) for name, sensor in sensors.items()}
    mbs.Assemble()
    settings = solver_settings(exu, T1, STEPS, "EigenSparse", FULL, tolerance)
    settings.timeIntegration.generalizedAlpha.spectralRadius = RHO
    settings.solution.sensors.writePeriod = T1 / STEPS
    exu.SolveDynamic(mbs, settings, storeSolver=False, autoAssemble=False)
    found = {name: np.asarray(mbs.GetSensorStoredData(number))[::EVERY] for name, number in numbers.items()}
    digits = {"C": 12, "force": 6, "moment": 9}
    return {"t": np.round(found["C"][:, 0], 9).tolist()} | {
        name: np.round(found[name][:, 1:], digits[name]).tolist() for name in found
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=DATA)
    options = parser.parse_args()
    warnings.simplefilter("ignore", DeprecationWarning)  # of names that Exudyn 1.12 and 1.13 both take
    version = importlib.import_module("importlib.metadata").version("exudyn")
    document = {
        "name": "misaligned_four_bar",
        "comment": COMMENT,
        "exudyn": version,
        "rho_inf": RHO,
        "t1": T1,
        "num_steps": STEPS,
        "lumped": run((4, 8, 4), lumped=True, tolerance=1e-8),
        "fine": run((16, 32, 16), lumped=False, tolerance=1e-7),  # 1e-8 is out of its reach
    }
    options.out.write_text(json.dumps(document) + "\n", encoding="utf-8")
    print(f"{options.out.name}: C at {T1} s", document["lumped"]["C"][-1], document["fine"]["C"][-1])


if __name__ == "__main__":
    main()
