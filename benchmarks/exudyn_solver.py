"""Exudyn as the rivals' scripts use it: its solver without output, in one thread, with the Newton iteration asked for,
and its geometrically exact beam, with its mass or with that of lgsens."""

import importlib
import itertools
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

MODIFIED, PER_STEP, FULL = "modified Newton", "modified Newton, a matrix per step", "full Newton"


def fast() -> Any:
    """Exudyn without its range checks."""
    sys.exudynFast = True
    exudyn = importlib.import_module("exudyn")
    exudyn.config.printToConsole = False  # what a tolerance out of reach makes it say
    return exudyn


def solver_settings(exu: Any, t1: float, steps: int, linear: str, newton: str, tolerance: float) -> Any:
    """Equal steps of generalized-α with ρ∞ = 0.9; `tolerance`: of Newton, relative and absolute."""
    settings = exu.SimulationSettings()
    time = settings.timeIntegration
    time.endTime, time.numberOfSteps = t1, steps
    time.verboseMode = 0
    time.adaptiveStep = False
    time.generalizedAlpha.spectralRadius = 0.9
    time.newton.relativeTolerance = time.newton.absoluteTolerance = tolerance
    time.newton.useModifiedNewton = newton != FULL
    time.newton.modifiedNewtonJacUpdatePerStep = newton == PER_STEP
    settings.linearSolverType = getattr(exu.LinearSolverType, linear)
    settings.parallel.numberOfThreads = 1
    settings.solution.file.write = False
    settings.displayComputationTime = settings.displayStatistics = False
    return settings


def converges(exu: Any, mbs: Any, settings: Any) -> bool:
    """Whether all steps converged."""
    try:
        return exu.SolveDynamic(mbs, settings, storeSolver=False, autoAssemble=False)
    except exu.SolverError:
        return False


def beam_on_nodes(
    exu: Any, mbs: Any, nodes: Sequence[Any], length: float, section: tuple, *, lumped: bool
) -> list[Any]:
    """Elements of this length between nodes one after the other, `ObjectBeamGeometricallyExact`.

    `section`: stiffnesses, shape (6,), mass and moments of inertia per length, shape (3,). The mass is between the
    nodes or, `lumped`, that of rigid bodies on them, as in lgsens.
    """
    items = importlib.import_module("exudyn.itemInterface")
    stiffness, mass, inertia = section
    data = exu.BeamSection()
    data.stiffnessMatrix = np.diag(stiffness)
    data.massPerLength, data.inertia = (0.0, np.zeros((3, 3))) if lumped else (mass, np.diag(inertia))
    elements = [
        mbs.AddObject(items.ObjectBeamGeometricallyExact(nodeNumbers=list(ends), length=length, sectionData=data))
        for ends in itertools.pairwise(nodes)
    ]
    for i, node in enumerate(nodes if lumped else ()):
        carried = length / 2.0 if i in (0, len(nodes) - 1) else length
        moments = [*(carried * np.array(inertia)), 0.0, 0.0, 0.0]
        mbs.AddObject(items.ObjectRigidBody(nodeNumber=node, physicsMass=carried * mass, physicsInertia=moments))
    return elements
