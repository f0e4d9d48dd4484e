"""What an import gives: a model, and a report of what became of everything that the file says."""

import dataclasses

from lgsens.model import Model


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
            lines += [f"{title} ({len(of)})" + (":" if of else "")] + kinds(of)
        for title, of in (("Carried over in another form", self.notes), ("Not carried over", self.dropped)):
            lines += [f"{title} ({len(of)})" + (":" if of else "")] + [f"  {line}" for line in of]
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
