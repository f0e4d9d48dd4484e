"""The suspension by the augmented Lagrangian and by SLSQP of SciPy, which share no more than the simulation."""

import numpy as np
import pytest
import scipy.optimize

from lgsens.examples import SuspensionDesign
from lgsens.optimize import minimize, scipy_problem


@pytest.mark.slow
def test_both_find_the_same_stiffness_and_damping():
    design = SuspensionDesign.load(num_steps=400)
    lower, upper = design.bounds
    bounds = {"lower": lower, "upper": upper, "log_scale": design.log_scale}
    found = minimize(design, design.start, **bounds, num_steps=100, tolerance=1e-6, progress=False)
    assert found.reason == "converged"
    assert np.count_nonzero(found.multipliers) <= 3 and abs(np.max(found.constraints)) <= 1e-6

    problem = scipy_problem(design, design.start, **bounds)
    scale = problem.fun(problem.z0)
    constraints = {"fun": lambda z: -problem.constraints(z), "jac": lambda z: -problem.constraints_jac(z)}
    other = scipy.optimize.minimize(
        lambda z: problem.fun(z) / scale,
        problem.z0,
        jac=lambda z: problem.jac(z) / scale,
        bounds=problem.bounds,
        constraints={"type": "ineq"} | constraints,
        method="SLSQP",
        options={"ftol": 1e-10},
    )
    assert np.max(problem.constraints(other.x)) <= 1e-6
    # Constraints are met to 1e-6 by both, times multipliers of 4 and |f(x₀)|/f of 2.3.
    assert found.objective == pytest.approx(scale * other.fun, rel=2e-5)
    for name, value in problem.x(other.x).items():
        # Along the constraint f/|f(x₀)| is flat, of curvature 2e-3: ∇L of 1e-6 and f of 1e-10 are 5e-4 of the box.
        assert float(found.x[name]) == pytest.approx(float(value), rel=5e-3)
