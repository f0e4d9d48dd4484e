"""The constraints of a scene that follow signals which break."""

from typing import Any

from lgsens.dynamics import Breaking, breaks_of
from lgsens.linear import added
from lgsens.model._stack import position_values


def breaking_of(system: Any) -> Breaking | None:
    """Those of position level of a `MultibodySystem`; None: there are none."""
    every = zip(system.constraints[: system.topology.num_positions], system.topology.rows)
    own = [(stack, rows) for stack, rows in every if breaks_of(stack).shape[0]]
    if not own:
        return None
    stacks, rows = [stack for stack, _ in own], [rows for _, rows in own]

    def constraint(q, t):
        values = list(zip(position_values(stacks, system._placed(q), t), rows))
        return added(values, system.topology.num_constraints - system.num_velocity_rows, system.mass.dtype)

    return Breaking(breaks_of(stacks), constraint)
