"""Exudyn's solver as the rivals' scripts use it: without output, in one thread, with the Newton iteration asked for."""

import importlib
import sys
from typing import Any

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
