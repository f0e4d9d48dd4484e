"""Linear solvers as values, and the choice between them by estimated cost."""

import math

import equinox as eqx

from lgsens.linear import tuned
from lgsens.linear._elimination import Elimination
from lgsens.linear._ordering import Graph, levels, of_one_shape


class AbstractLinearSolver(eqx.Module):
    """How the equations of a step are solved.

    Attributes:
        mixed: whether factors are in single precision and solutions refined in double (`_mixed`).
    """

    mixed: eqx.AbstractVar[bool]

    def __check_init__(self):
        if not isinstance(self.mixed, bool):
            raise ValueError(f"{type(self).__name__}: `mixed` must be True or False, got {self.mixed!r}.")


class DenseLU(AbstractLinearSolver):
    """LU factors of the whole matrix with row exchanges (LAPACK): time grows with the third power of its size.

    Arguments:
        mixed: factors in single precision, solutions refined in double: motion and sensitivities are those of double
            precision to 1e-9. No gain on a CPU so far, which is why it is not the default: of 94 unknowns, factors with
            one solution take 1.2 times as long, every further solution 3 times; iterations of modified Newton 0.6 times
            (`benchmarks/precision.py`). A matrix that cannot be refined (a condition above 1e6) fails the step.
            Without effect in `RadauIIA`, in stabilized steps, and where everything is in single precision.

    Raises `ValueError` where `mixed` is not True or False.
    """

    mixed: bool = eqx.field(static=True, default=False, kw_only=True)


class BlockSparse(AbstractLinearSolver):
    """Block elimination on the graph of bodies and joints: time grows with the size of trees and chains.

    Bodies and joints are eliminated in levels, all of a level at once, without exchanges between blocks; what remains
    where it is too dense to go on is solved by a dense LU.

    Arguments:
        mixed: as in `DenseLU`.

    Raises `ValueError` where `mixed` is not True or False.
    """

    mixed: bool = eqx.field(static=True, default=False, kw_only=True)


def elimination(
    solver: AbstractLinearSolver | None, graph: Graph, by_joints: Graph, otherwise: float | None = None
) -> Elimination | None:
    """The plan of `BlockSparse`, or None for a dense LU; `solver` None: the cheaper one.

    graph: of the matrices of steps. by_joints: of those that are factorized once in a run, which have no forces.
    otherwise: the time [µs] of what solves the equations without a plan; None: that of a dense LU.
    """
    size = sum(map(len, graph.nodes))
    if isinstance(solver, DenseLU) or (solver is None and size < tuned.SMALLEST_SPARSE):
        return None
    dense, best = Elimination([], size), _cheapest(graph)
    if solver is None and (_cost(dense) if otherwise is None else otherwise) <= _cost(best):
        return None
    at_once = best if by_joints.neighbours == graph.neighbours else _cheapest(by_joints)
    steps, once = _with_loop(best, tuned.LOOP_COST), _with_loop(at_once, math.inf)
    return best if once is best else Elimination(steps.levels, size, steps.looped, once)


def _cheapest(graph: Graph) -> Elimination:
    """As many levels as take the least time, joints early or not; none where no node may go."""
    size = sum(map(len, graph.nodes))
    found = [levels(graph, early=early) for early in (False, True)]
    sparse = [Elimination(some[: 1 + count], size) for some in found for count in range(len(some))]
    return min(sparse, key=_cost, default=Elimination([], size))


def _with_loop(plan: Elimination, limit: float) -> Elimination:
    """The plan with as many of its last levels in a loop as cost at most `limit` times what they did; or as it was.

    A level of many clusters is several in the loop, one of few is filled up.
    """
    for first in range(len(plan.levels) - tuned.LOOP_LEVELS + 1):
        head, tail = plan.levels[:first], plan.levels[first:]
        equal = [of_one_shape(tail, count, plan.size) for count in sorted({len(own) for own, _ in tail})]
        found = min((Elimination([*head, *some], plan.size, len(some)) for some in equal), key=_cost)
        if _cost(found) <= limit * _cost(plan):
            return found
    return plan


def _cost(plan: Elimination) -> float:
    """The estimated time [µs] of one factorization and one solve."""
    total = tuned.dense(len(plan.rest))
    for own, boundary in plan.levels:
        count, p, q = len(own), own.shape[1], boundary.shape[1]
        flops = 4 * p**3 + 4 * p**2 * q + 2 * p * q**2
        total += tuned.LEVEL + count * (tuned.CLUSTER + flops / tuned.FLOPS + tuned.ENTRY * (p + q) ** 2)
    return total
