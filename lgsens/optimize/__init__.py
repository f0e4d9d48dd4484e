"""Optimization of designs (paper, §9) and identification: bounded, path-constrained, by gradients that are checked."""

from lgsens.optimize._gradient_check import (
    GradientCheck as GradientCheck,
    check_gradient as check_gradient,
)
from lgsens.optimize._least_squares import (
    LeastSquaresResult as LeastSquaresResult,
    covariance as covariance,
    least_squares as least_squares,
)
from lgsens.optimize._load_cases import load_cases as load_cases
from lgsens.optimize._minimize import (
    History as History,
    Minimization as Minimization,
    OptimizationResult as OptimizationResult,
    minimize as minimize,
)
from lgsens.optimize._multi_start import MultiStartResult as MultiStartResult, multi_start as multi_start
from lgsens.optimize._parametrization import (
    AbstractParametrization as AbstractParametrization,
    Affine as Affine,
    Interval as Interval,
    Log as Log,
    variables as variables,
)
from lgsens.optimize._scipy import (
    ScipyLeastSquares as ScipyLeastSquares,
    ScipyProblem as ScipyProblem,
    scipy_least_squares as scipy_least_squares,
    scipy_problem as scipy_problem,
)
from lgsens.optimize._tolerances import (
    ToleranceStack as ToleranceStack,
    allocate_tolerances as allocate_tolerances,
    monte_carlo as monte_carlo,
    tolerance_stack as tolerance_stack,
)
