"""`constraint_rank`: how many of the constraints are independent, and the joints that say the same."""

import dataclasses
from typing import Any

import numpy as np

from lgsens._validate import as_float, is_concrete
from lgsens.dynamics import RESULTS, AbstractSystem, Rank, rank_near_reference, redundant_names, softness
from lgsens.model import Model, driven_equations, scene_of
from lgsens.simulation import as_system


@dataclasses.dataclass(frozen=True)
class ConstraintRank:
    """Rank and freedom of a mechanism; `print` shows them.

    Attributes:
        coordinates: number of unknown coordinates k.
        equations: number of constraint equations m.
        rank: the rank of the constraint gradient B, in configurations near the reference.
        reference_rank: that in the reference configuration; below `rank` where the reference is singular (a dead
            centre, a linkage that lies flat).
        joints: the names of the joints involved in redundant equations, sorted.
    """

    coordinates: int
    equations: int
    rank: int
    reference_rank: int
    joints: tuple[str, ...]

    @property
    def redundant(self) -> int:
        """m − rank: equations that follow from the others."""
        return self.equations - self.rank

    @property
    def degrees_of_freedom(self) -> int:
        """k − rank, those that the mechanism has; Grübler's count, k − m, is less where equations are redundant."""
        return self.coordinates - self.rank

    @property
    def singular(self) -> bool:
        """Whether the reference is a singular configuration."""
        return self.reference_rank < self.rank

    def __str__(self) -> str:
        rows = [
            ("Unknown coordinates", self.coordinates),
            ("Constraint equations", self.equations),
            ("Independent of them", self.rank),
            ("Degrees of freedom", self.degrees_of_freedom),
        ]
        lines = [f"{what:<24}{number:>5}" for what, number in rows]
        if self.joints:
            lines.append(f"Redundant equations in  {', '.join(self.joints)}")
        if self.singular:
            lines.append(f"The reference configuration is singular: rank {self.reference_rank}")
        return "\n".join(lines)


def constraint_rank(model: Model | AbstractSystem, *, t0=0.0) -> ConstraintRank:
    """How many constraint equations of a model are independent, and which joints share the others.

        rank J(q) near the reference configuration,     n ≠ 0 with Jᵀn = 0: redundant, with weight in the joints of n

    J is B, with the rows of velocity level below it where there are any.

    Arguments:
        model: the scene, or an `AbstractSystem`; its numbers known, not traced.
        t0: the time at which drivers are taken [s].

    The rank is the largest found in the reference configuration and in four that the mechanism reaches by moving from
    it by 0.01 rad or lengths of the scene, drivers let go: in a singular reference configuration alone it would be too
    small, and equations would seem redundant that are not.

    Raises `ValueError` for numbers that are traced.
    """
    system, t0 = as_system(model), as_float(t0, (), "`t0`")
    if not is_concrete(system, t0):
        raise ValueError(
            "`constraint_rank` counts singular values, so `model` and `t0` must be known numbers, got traced ones: "
            "call it before `jit`, `grad` or `vmap`, with one of the models."
        )
    found = _rank(system, t0)
    m, k = found.jacobian.shape
    names = tuple(redundant_names(found.jacobian, system.constraint_names))
    return ConstraintRank(k - system.num_states, m, found.near, found.reference, names)


def _rank(system: AbstractSystem, t) -> Rank:
    scene = scene_of(system)
    if scene is not None:
        system = dataclasses.replace(scene, minimum_norm=True)  # which can be assembled whatever its rank
    none = np.zeros(len(system.constraint_names), bool)
    return rank_near_reference(system, t, none if scene is None else driven_equations(scene))


def cause_of_failure(system: AbstractSystem, t, result, details: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    """What failed and the details of its message, of a method that needs independent constraints and does not ask for
    that: redundant ones make its matrices singular, which looks like something else."""
    if is_concrete(system, t) and softness(system) is None:
        found = _rank(system, t)
        if found.near < len(found.jacobian):
            return np.asarray(RESULTS.redundant_constraints), {"jacobian": found.jacobian}
    return result, details
