"""What a scene consists of, and what it solves for."""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence

from lgsens._brief import brief
from lgsens._validate import is_concrete
from lgsens.model._body import RigidBody
from lgsens.model._forces import AbstractForce
from lgsens.model._joints import AbstractJoint
from lgsens.model._merge import Group
from lgsens.model._system import MultibodySystem


@dataclasses.dataclass(frozen=True)
class Summary:
    """A scene in numbers; `print` shows it as a table.

    Attributes:
        bodies: for each body its degrees of freedom, names as in `RigidBody.free`; for a part of a merged body those
            of that body.
        equations: for each joint the number of its equations; those that its bodies cannot violate do not count.
        coordinates: number of unknown coordinates k, without states of force elements.
        constraints: number of constraint equations m, and of multipliers.
        table: what `print` shows.
    """

    bodies: dict[str, tuple[str, ...]]
    equations: dict[str, int]
    coordinates: int
    constraints: int
    table: str = dataclasses.field(repr=False)

    @property
    def degrees_of_freedom(self) -> int:
        """k − m: those of the mechanism, if no equation repeats another; of its velocities, where wheels roll."""
        return self.coordinates - self.constraints

    def __str__(self) -> str:
        return self.table

    __repr__ = brief


def summarize(
    bodies: Mapping[str, RigidBody],
    joints: Mapping[str, AbstractJoint],
    forces: Mapping[str, AbstractForce],
    system: MultibodySystem,
    groups: Sequence[Group],
) -> Summary:
    """The summary of a scene with the given equations of motion, of whose bodies `groups` are merged."""
    constraint_names = system.constraint_names
    count = Counter(constraint_names)
    equations = {name: count[name] for name in joints}
    coordinates = system.group.dim - system.num_states
    part_of = {part: group for group in groups if group.name not in bodies for part in group.parts}
    lines = [f"Bodies ({len(bodies)}): mass [kg], free coordinates"]
    lines += _columns([(name, _mass(body), _free(body, part_of.get(name))) for name, body in bodies.items()])
    lines += [f"Joints ({len(joints)}): type, bodies, equations"]
    lines += _columns(
        [
            (name, type(joint).__name__, _ends((joint.a, joint.b, *joint.others)), equations[name])
            for name, joint in joints.items()
        ]
    )
    lines += [f"Force elements ({len(forces)}): type, bodies"]
    lines += _columns([(name, type(force).__name__, _ends(force.on(joints).bodies)) for name, force in forces.items()])
    totals = [
        ("Unknown coordinates", coordinates),
        ("Constraint equations", len(constraint_names)),
        ("Degrees of freedom", coordinates - len(constraint_names)),
    ]
    if system.num_velocity_rows:
        totals.insert(2, ("of velocities alone", system.num_velocity_rows))
    if system.num_states:
        totals.append(("States of forces", system.num_states))
    lines += [f"{what:<24}{number:>5}" for what, number in totals]
    free = {name: part_of[name].free if name in part_of else body.free for name, body in bodies.items()}
    return Summary(free, equations, coordinates, len(constraint_names), "\n".join(lines))


def _mass(body: RigidBody) -> str:
    return f"{float(body.mass):.6g}" if is_concrete(body.mass) else "traced"


def _free(body: RigidBody, group: Group | None) -> str:
    if group is not None and group.name is None:
        return "fixed to the ground"
    if group is not None:
        return " ".join(group.free) + f", one body: {group.name}"
    return " ".join(body.free) + (" about its pivot" if body.pivot is not None else "") if body.free else "held"


def _ends(names: Sequence[str | None]) -> str:
    """The bodies of an element; an element that names none acts on all."""
    return " – ".join("ground" if name is None else name for name in names) if names else "all bodies"


def _columns(rows: Sequence[Sequence[object]]) -> list[str]:
    """Rows of a table, indented, columns aligned."""
    texts = [[str(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*texts)]
    return ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in texts]
