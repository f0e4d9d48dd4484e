"""Optimization of designs (paper, §9): bounded and path-constrained, by gradients that are checked."""

from lgsens.optimize._gradient_check import (
    GradientCheck as GradientCheck,
    check_gradient as check_gradient,
)
from lgsens.optimize._minimize import (
    History as History,
    OptimizationResult as OptimizationResult,
    minimize as minimize,
)
