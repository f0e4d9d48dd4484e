"""Direct or adjoint? The choice of §9, from the number of parameters and criteria and from measured cost."""

from typing import NamedTuple

from lgsens._validate import as_count
from lgsens.linear import tuned
from lgsens.sensitivity import AdjointVariable, DirectDifferentiation


class Costs(NamedTuple):
    """What value and gradient cost, in units of one simulation without sensitivities.

    Attributes:
        direct_fixed, direct_per_parameter: the direct differentiation method, on the fly.
        adjoint_fixed, adjoint_per_criterion: the adjoint variable method, forward and backward sweep.
    """

    direct_fixed: float
    direct_per_parameter: float
    adjoint_fixed: float
    adjoint_per_criterion: float


TYPICAL = Costs(**tuned.TYPICAL_COSTS)


class Advice(NamedTuple):
    """Which method to choose, and why.

    Attributes:
        method: `DirectDifferentiation()` or `AdjointVariable()`.
        direct_cost, adjoint_cost: expected cost of value and gradient, in simulations.
        reason: a sentence.
    """

    method: DirectDifferentiation | AdjointVariable
    direct_cost: float
    adjoint_cost: float
    reason: str


def direct_or_adjoint(
    num_parameters: int, num_criteria: int = 1, *, active_constraints: int = 0, costs: Costs = TYPICAL
) -> Advice:
    """Which of the two methods is cheaper (paper, §9).

    The direct method solves one more linear system per step for each parameter, the adjoint variable method one for
    each criterion. After time discretization a path constraint is as many criteria as there are time steps at which it
    is active: with some active, the direct method is the one for few parameters.

    Arguments:
        num_parameters: number of scalar design parameters.
        num_criteria: criteria whose gradients are needed one by one; a weighted sum is one.
        active_constraints: time steps at which a path constraint is active, each a criterion of its own.
        costs: the cost of the parts, those of a small scene by default; `measure_costs` measures them on your scene.

    Raises `ValueError` for counts that are not positive (`active_constraints`: negative).
    """
    num_parameters = as_count(num_parameters, "num_parameters")
    num_criteria = as_count(num_criteria, "num_criteria")
    if active_constraints < 0:
        raise ValueError(f"`active_constraints` must be at least 0, got {active_constraints}.")
    total = num_criteria + active_constraints
    direct = costs.direct_fixed + costs.direct_per_parameter * num_parameters
    adjoint = costs.adjoint_fixed + costs.adjoint_per_criterion * total
    method = DirectDifferentiation() if direct <= adjoint else AdjointVariable()
    counted = f"{num_parameters} parameter{'s' * (num_parameters > 1)} and {total} criteri{'a' if total > 1 else 'on'}"
    reason = (
        f"For {counted} value and gradient cost about {direct:.2g} simulations by the direct differentiation method "
        f"and {adjoint:.2g} by the adjoint variable method."
    )
    return Advice(method, direct, adjoint, reason)
