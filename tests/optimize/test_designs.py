"""The suspension by the augmented Lagrangian and by SLSQP, which share no more than the simulation."""

import numpy as np
import pytest

from lgsens.examples import SuspensionDesign
from lgsens.optimize import minimize


@pytest.mark.slow
def test_both_find_the_same_stiffness_and_damping():
    design = SuspensionDesign.load(num_steps=400)
    lower, upper = design.bounds
    settings = {"lower": lower, "upper": upper, "log_scale": design.log_scale, "num_steps": 200, "tolerance": 1e-6}
    found, other = (minimize(design, design.start, **settings, progress=False, forward=mode) for mode in (True, False))
    assert found.reason == other.reason == "converged"
    assert np.count_nonzero(found.multipliers) <= 3 and abs(np.max(found.constraints)) <= 1e-6
    # Constraints are met to 1e-6 by both, times multipliers of 4 and |f(x₀)|/f of 2.3.
    assert found.objective == pytest.approx(other.objective, rel=2e-5)
    for name, value in other.x.items():
        # Along the constraint f/|f(x₀)| is flat, of curvature 2e-3: ∇L of 1e-6 is 5e-4 of the box.
        assert float(found.x[name]) == pytest.approx(float(value), rel=5e-3)
