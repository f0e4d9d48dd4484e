"""What an import gives: a model, and a report of what became of everything that the file says."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from lgsens.model import AbstractForce, AbstractJoint, Model, RigidBody

Element = TypeVar("Element")


def made(kind: Callable[..., Element], *arguments: Any, **numbers: Any) -> Element:
    """An element from Python's and NumPy's numbers, which constructors convert; their fields are declared as arrays."""
    return kind(*arguments, **numbers)


@dataclasses.dataclass(frozen=True)
class Report:
    """What became of a file; `print` shows it.

    Attributes:
        source: the file, or what it calls itself.
        bodies: names of the bodies that were read.
        joints: names of the joints that were read, and the types that they became.
        loops: names of the joints that close loops, likewise.
        forces: names of the force elements, likewise.
        notes: what was carried over in another form.
        dropped: what the model does not have, and the file does; empty: nothing.
    """

    source: str
    bodies: tuple[str, ...]
    joints: dict[str, str]
    loops: dict[str, str]
    forces: dict[str, str]
    notes: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()

    def __str__(self) -> str:
        kinds = lambda of: [f"  {name}: {kind}" for name, kind in of.items()]
        lines = [f"{self.source}", f"Bodies ({len(self.bodies)}): {', '.join(self.bodies)}"]
        for title, of in (("Joints", self.joints), ("Loops", self.loops), ("Forces", self.forces)):
            lines += [f"{title} ({len(of)})" + (":" if of else ""), *kinds(of)]
        for title, of in (("Carried over in another form", self.notes), ("Not carried over", self.dropped)):
            lines += [f"{title} ({len(of)})" + (":" if of else ""), *(f"  {line}" for line in of)]
        return "\n".join(lines)

    __repr__ = __str__


@dataclasses.dataclass(frozen=True)
class Imported:
    """A model from a file.

    Attributes:
        model: the scene, whose numbers are leaves like those of every other.
        report: what was read, and what was not carried over.
    """

    model: Model
    report: Report

    def __repr__(self) -> str:
        return f"{self.report}"


def built(
    bodies: Mapping[str, RigidBody],
    joints: Mapping[str, AbstractJoint],
    forces: Mapping[str, AbstractForce],
    *,
    check: bool,
) -> tuple[Model, list[str]]:
    """The model, if asked with minimum norm where equations repeat others in the reference, and a note of that."""
    model = Model(bodies, joints, forces)
    if not check:
        return model, []
    system = model.system()
    jacobian = np.asarray(system.constraint_jacobian(system.reference()[0], 0.0))
    norms = np.linalg.norm(jacobian, axis=1, keepdims=True)
    missing = jacobian.shape[0] - int(np.linalg.matrix_rank(jacobian / norms, tol=1e-8))
    if not missing:
        return model, []
    note = f"{missing} of the joints' equations repeat others: multipliers of minimum norm (constraint_rank)"
    return Model(bodies, joints, forces, redundant="minimum_norm"), [note]
