"""The beam of `beams.py` in Exudyn: its geometrically exact element `ObjectBeamGeometricallyExact`, on rigid nodes.

Exudyn's element takes no damping of its section (with and without it motions are the same to the last digit), so both
swing without. It has its mass between the nodes, lgsens's on them, and at equal nodes their motions differ by their
errors of discretization, O(1/elements²). `lumped` takes Exudyn's mass from the elements to rigid bodies on the same
nodes: then both solve the same equations, and what is left says whether they do. Time is that of Exudyn as it comes.

Of its linear solvers, Newton iterations and rotations the fastest counts, by one run of each at Exudyn's tolerance of
1e-8 or the next of 1e-7 and 1e-6 that all steps reach; none reaches 1e-10, and rotation vectors on the Lie group do not
converge with this element.
"""

import importlib
import itertools
import time
from typing import Any

import numpy as np
from exudyn_solver import FULL, MODIFIED, PER_STEP, beam_on_nodes, converges, fast, solver_settings

TOLERANCES = (1e-8, 1e-7, 1e-6)  # relative and absolute
SPARSE, DENSE = "EigenSparse", "EXUdense"
LARGEST_DENSE = 32  # elements: dense matrices take several times as long there, and grow with the third power
NODES = {"NodeRigidBodyEP": [1.0, 0.0, 0.0, 0.0], "NodeRigidBodyRxyz": [0.0, 0.0, 0.0]}
STIFFNESS, MASS, INERTIA, LENGTH, GRAVITY = (1e6, 5e5, 5e5, 1e3, 1e3, 1e3), 1.0, (0.02, 0.01, 0.01), 10.0, 9.81


def available() -> bool:
    try:
        fast()
    except ImportError:
        return False
    return True


class Beam:
    """The beam on its hinge."""

    def __init__(self, elements: int, nodes: str, *, lumped: bool = False):
        self.exu, items = fast(), importlib.import_module("exudyn.itemInterface")
        self.container = self.exu.SystemContainer()
        self.mbs = self.container.AddSystem()
        add, length = self.mbs, LENGTH / elements
        kind, rotation = getattr(items, nodes), NODES[nodes]
        places = [[length * i, 0.0, 0.0, *rotation] for i in range(elements + 1)]
        self.nodes = [add.AddNode(kind(referenceCoordinates=place)) for place in places]
        beam_on_nodes(self.exu, add, self.nodes, length, (STIFFNESS, MASS, INERTIA), lumped=lumped)
        for i, node in enumerate(self.nodes):
            carried = length / 2.0 if i in (0, elements) else length
            marker = add.AddMarker(items.MarkerNodePosition(nodeNumber=node))
            add.AddLoad(items.Force(markerNumber=marker, loadVector=[0.0, -GRAVITY * MASS * carried, 0.0]))
        ground = add.AddObject(items.ObjectGround())
        markers = [
            add.AddMarker(items.MarkerBodyRigid(bodyNumber=ground)),
            add.AddMarker(items.MarkerNodeRigid(nodeNumber=self.nodes[0])),
        ]
        add.AddObject(items.GenericJoint(markerNumbers=markers, constrainedAxes=[1, 1, 1, 1, 1, 0]))
        add.Assemble()

    def settings(self, steps: int, h: float, linear: str, newton: str, tolerance: float) -> Any:
        return solver_settings(self.exu, steps * h, steps, linear, newton, tolerance)

    def solve(self, settings: Any) -> bool:
        return converges(self.exu, self.mbs, settings)

    def height(self) -> float:
        """Of the tip [m], at the end of the run before."""
        return float(self.mbs.GetNodeOutput(self.nodes[-1], self.exu.OutputVariableType.Position)[1])


def fastest(elements: int, steps: int, h: float) -> tuple[Beam, tuple[str, str, float], dict]:
    """The fastest of its programs, its settings but for the steps, and what there is to say of it."""
    best, least = None, np.inf
    for nodes, newton in itertools.product(NODES, (FULL, PER_STEP, MODIFIED)):
        for linear in (SPARSE, DENSE) if elements <= LARGEST_DENSE else (SPARSE,):
            beam = Beam(elements, nodes)
            for tolerance in TOLERANCES:
                started = time.process_time()
                if beam.solve(beam.settings(steps, h, linear, newton, tolerance)):
                    taken = time.process_time() - started
                    if taken < least:
                        best, least = (nodes, beam, (linear, newton, tolerance)), taken
                    break
    if best is None:
        raise RuntimeError(f"Exudyn: no program converges with {elements} elements.")
    nodes, beam, choice = best
    same = Beam(elements, nodes, lumped=True)
    solved = same.solve(same.settings(steps, h, *choice))
    tips = {"tip": beam.height(), "tip_lumped": same.height() if solved else None}
    program = ", ".join((*choice[:2], nodes.removeprefix("NodeRigidBody"), f"{choice[2]:.0e}"))
    return beam, choice, {"program": program, **tips}
