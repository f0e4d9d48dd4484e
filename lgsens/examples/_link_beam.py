"""What bends of a suspension: a section by its shape and material, and the beams of it."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float, is_concrete, suggestion
from lgsens.examples._hardpoint_file import Reader
from lgsens.model import Beam, BeamSection, upward

SHAPES = {"tube": ("diameter", "thickness"), "round": ("diameter",), "rectangle": ("width", "height")}
MATERIAL = ("young", "poisson", "density")
GENERAL = "section"  # one by its stiffness and mass, in place of shape and material
LEAST_YOUNG = 1e6  # N/m²
ELEMENTS = 4  # of a beam that does not say how many


class SectionShape(eqx.Module):
    """A cross-section by numbers that are leaves, which designs change and files have by these names.

        SectionShape({"tube": {"diameter": 0.03, "thickness": 0.003}}, {"young": 2e11, "poisson": 0.3, "density": 7850})

    Arguments:
        shape: a constructor of `BeamSection`, "tube", "round" or "rectangle", and what it takes [m], shape ().
        material: young, poisson, density and, if there is some, damping, as of `BeamSection.round`.

    Raises `ValueError` for another shape, other keys, and as `BeamSection`.
    """

    shape: dict[str, dict[str, Float[Array, ""]]]
    material: dict[str, Float[Array, ""]]

    def __init__(self, shape: dict[str, dict[str, Any]], material: dict[str, Any]):
        numbers = lambda of: {key: as_float(value, (), f"SectionShape: `{key}`") for key, value in of.items()}
        if len(shape) != 1 or next(iter(shape)) not in SHAPES:
            raise ValueError(f"SectionShape: `shape` must be one of {sorted(SHAPES)}, got {sorted(shape)}.")
        (kind,) = shape
        for what, given, known in (
            (kind, shape[kind], {*SHAPES[kind]}),
            ("material", material, {*MATERIAL, *({"damping"} & {*material})}),
        ):
            if {*given} != known:
                raise ValueError(f"SectionShape: `{what}` must have {sorted(known)}, got {sorted(given)}.")
        self.shape, self.material = {kind: numbers(shape[kind])}, numbers(material)
        _ = self.section

    @property
    def section(self) -> BeamSection:
        """With its stiffness, mass and inertia per length."""
        ((kind, dimensions),) = self.shape.items()
        return getattr(BeamSection, kind)(**dimensions, **self.material)


class LinkBeam(eqx.Module):
    """That a link bends, and how.

    Attributes:
        of: a `SectionShape`, or a `BeamSection` whose stiffness has shape (6,): of principal axes, as a mirror image
            has it too.
        elements: of the beam, static.
        up: as of a `Beam`, shape (3,); None: z, of one that is nearly upright x.
        nodes: the numbers of the nodes that carry joints and forces, by the keys of the file, static: they do not
            change as points do, so that numbers may be traced.
    """

    of: SectionShape | BeamSection
    elements: int = eqx.field(static=True, default=ELEMENTS)
    up: Float[Array, "3"] | None = None
    nodes: tuple[tuple[str, int], ...] = eqx.field(static=True, default=())

    @property
    def section(self) -> BeamSection:
        """Its cross-section."""
        return self.of.section if isinstance(self.of, SectionShape) else self.of

    def beam(self, name: str, start: Array, end: Array) -> Beam:
        """The beam of this name between two points."""
        up = upward(start, end, self.up)
        return Beam(name, self.section, jnp.stack([start, end]), elements=self.elements, up=up)

    def node(self, link: str, key: str) -> str:
        """What the body is called on which a joint or a force of this key holds."""
        nodes = dict(self.nodes)
        if key not in nodes:
            raise ValueError(
                f"Link {link!r} bends, and where {key!r} holds on to it is not known, "
                f"{suggestion(key, nodes)}: let it bend (`bending`) once everything that it carries is there."
            )
        return f"{link}.{nodes[key]}"


def nearest(
    link: str, start: Array, end: Array, elements: int, points: dict[str, Array]
) -> tuple[tuple[str, int], ...]:
    """The numbers of the nodes that are nearest to points."""
    if not is_concrete(start, end, points):
        raise ValueError(
            f"The nodes of {link!r} that carry {sorted(points)} follow from points that are not known here; let it "
            "bend (`bending`) before its numbers are traced, the nodes stay what they are."
        )
    along = np.asarray(end) - np.asarray(start)
    share = lambda point: np.dot(np.asarray(point) - np.asarray(start), along) / np.dot(along, along)
    return tuple((key, int(np.clip(np.rint(elements * share(at)), 0, elements))) for key, at in sorted(points.items()))


def read_material(table: Reader) -> dict[str, Array]:
    """Young's modulus, Poisson's ratio and density."""
    material = {name: table.number(name, positive=name != "poisson") for name in MATERIAL}
    if not (young := float(material["young"])) >= LEAST_YOUNG:
        raise table.fail(
            "young",
            f"is in N/m², and {young:g} is less than that of rubber, {LEAST_YOUNG:g}; did you mean {1e6 * young:g}?",
        )
    return material


def read_beam(table: Reader, instead: tuple[str, ...], shapes: tuple[str, ...] = (*SHAPES, GENERAL)) -> LinkBeam:
    """The table `beam`; mass and stiffness follow from it, so that it stands for the keys `instead`."""
    key = "beam"
    for other in instead:
        if other in table:
            raise table.fail(other, f"follows from the section of `{key}`; leave one of the two out.")
    beam = table.table(key)
    own = ("damping", "elements", "up")
    beam.only((*shapes, *MATERIAL, *own))
    kinds = [kind for kind in shapes if kind in beam]
    if len(kinds) != 1:
        raise table.fail(key, f"needs one section of {sorted(shapes)}, got {kinds}.")
    (kind,) = kinds
    dimensions = beam.table(kind)
    damping = {"damping": beam.number("damping")} if "damping" in beam else {}
    elements, up = beam.count("elements") if "elements" in beam else ELEMENTS, beam.direction("up")
    of: Callable[[], BeamSection | SectionShape]
    if kind == GENERAL:
        beam.only((kind, *own))
        dimensions.only(("stiffness", "mass", "inertia"))
        rates = {"stiffness": dimensions.numbers("stiffness", 6), "inertia": dimensions.vector("inertia")}
        of = partial(BeamSection, mass=dimensions.number("mass"), **rates, **damping)
    else:
        dimensions.only(SHAPES[kind])
        shape = {kind: {name: dimensions.metres(name, 0.5) for name in SHAPES[kind]}}
        of = partial(SectionShape, shape, read_material(beam) | damping)
    try:
        return LinkBeam(of(), elements, up)
    except ValueError as error:
        raise table.fail(key, str(error)) from error
