"""The numbers of an axle by the keys that they have in its file, and those of them that a design may change."""

from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from lgsens._validate import as_float
from lgsens.examples._axle import Axle
from lgsens.examples._file_axes import FileAxes, rewritten

POINTS, RATES, ANGLES = "hardpoints", "rates", "angles"
# What is offered of a file, and where: tables of the corner, and numbers that are points or positive rates.
_TABLES = {"mounts": "bushings", "stops": "", "bar": "anti_roll_bar", "tyre_stiffness": "tyre"}
_AT = {"at", "bearing", "lever"}
_POSITIVE = {"rate", "stiffness", "damping", "rotational_stiffness", "rotational_damping", "diameter"}
_POSITIVE |= {"tyre_stiffness", "rounding", "gap", "length", "bore", "shear_modulus", "progression"}
_POSITIVE |= {"thickness", "width", "height"}
_UNNAMED = ("ends", "section", "of", "shape", "material")  # that are no keys of the file


class Place(NamedTuple):
    """A number of an axle: its name, which leaf it is in, and where in that; `factor` times it and `offset` is that of
    the file, of whose side and above whose origin a point is, and in degrees an angle."""

    name: str
    leaf: int
    index: int
    factor: float = 1.0
    offset: float = 0.0


def places(axle: Axle) -> dict[str, list[Place]]:
    """The coordinates of hardpoints, the positive rates, and camber and toe of an axle, in the order of its leaves."""
    found: dict[str, list[Place]] = {POINTS: [], RATES: [], ANGLES: []}
    carriers = dict(axle.left.carriers) | ({} if axle.solid_axle is None else dict(axle.solid_axle.carriers))
    for i, (path, leaf) in enumerate(jax.tree_util.tree_leaves_with_path(axle)):
        names = [str(getattr(entry, "name", getattr(entry, "key", ""))) for entry in path]
        names = names[1:] if names[0] == "left" else names
        if names[0] == "wheel" and names[-1] in ("camber", "toe"):
            found[ANGLES].append(Place(f"wheel.{names[-1]}_deg", i, 0, float(np.degrees(1.0))))
        if names[0] not in ("links", "joints", "spring", "damper", "twist_beam", "solid_axle", "leaf_spring", *_TABLES):
            continue
        is_point = "ends" in names or names[-1] in _AT
        if is_point or (names[-1] in _POSITIVE and np.all(np.asarray(leaf) > 0)):
            key = _key(names, carriers)
            kind = POINTS if is_point else RATES
            axes = axle.left.axes if is_point else FileAxes()
            if names[0] == "solid_axle":
                axes = axes._replace(mirrored=False)
            signs, offset = (np.broadcast_to(of, (3,)) for of in (axes.signs, axes.offset))
            found[kind] += [
                Place(key + end, i, j, float(signs[j % 3]), float(offset[j % 3]))
                for j, end in enumerate(_components(leaf.shape, is_point))
            ]
    return found


def _key(names: list[str], carriers: Mapping[str, str]) -> str:
    """That of the file: "links.tie_rod.subframe", "bushings.pivot.stiffness", "subframe.mounts.front.at"."""
    if names[0] == "solid_axle":  # its links are in its table, their bushings with all others
        own = _key(names[1:], carriers)
        return own if names[1] == "mounts" else f"solid_axle.{own}"
    owner = ".".join(names[: 2 if names[0] in ("links", "joints") else 1]) if names[0] != "stops" else names[1]
    if names[-3:] == ["beam", "of", "stiffness"]:
        names = [*names[:-3], "beam.section", "stiffness"]
    names = [_TABLES.get(names[0], names[0]), *(name for name in names[1:] if name not in _UNNAMED)]
    if names[-1] == "chassis":
        names[-1] = carriers.get(owner, "chassis")
    if names[:2] == ["anti_roll_bar", "mount"]:
        names[1] = "bushing"
    if names[-1] == "rate":
        names[-1] = "stiffness" if names[0] == "spring" else "damping"
    if names[0] == "tyre":
        names.append("stiffness")
    if names[0] == "bushings" and names[1].startswith("subframe_"):
        names[:2] = ["subframe", "mounts", names[1].removeprefix("subframe_")]
    return ".".join(filter(None, names))


def _components(shape: tuple[int, ...], is_point: bool) -> Iterator[str]:
    """Of a point x, y, z; of rates along axes 1, 2, 3; of two of them with 1 or 2 before."""
    for index in np.ndindex(shape):
        *before, last = ("", *(str(i + 1) for i in index))
        yield ".".join([*before, "xyz"[index[-1]] if is_point else last]) if index else ""


class AxleNumbers(eqx.Module):
    """Numbers of an axle that a design changes, those of the left side with their mirror image.

    Attributes:
        places: of `hardpoints` [m], `rates` (SI units, positive) and `angles` [degree], static.
        lower, upper: bounds, by "hardpoints", "rates" and "angles" as far as there are any, shape (n,).
    """

    places: tuple[tuple[str, tuple[Place, ...]], ...] = eqx.field(static=True)
    lower: dict[str, Float[Array, " n"]]
    upper: dict[str, Float[Array, " n"]]

    @staticmethod
    def select(axle: Axle, vary: Mapping[str, Any]) -> "AxleNumbers":
        """The numbers whose names match patterns.

        Arguments:
            axle: the axle at the start.
            vary: by pattern how far numbers may go: of coordinates either way [m], of angles either way [degree], of
                rates the share of their value (0.3: from 0.7 to 1.3 times), or for any a pair (lower, upper). Later
                patterns overrule earlier ones.
                Names are keys of the file, then x, y or z of a point, 1, 2 or 3 for the axes of a bushing, before that
                1 or 2 for the two points of a hinge: "links.upper_arm.subframe.1.z", "bushings.pivot.stiffness.2.1",
                "spring.stiffness", "wheel.toe_deg". Points are in metres and the axes of the file, of its side and from
                its origin. A pattern has * and ? as for files, and stands for all names that it begins.

        Raises `ValueError` for a pattern that matches nothing, and bounds that do not contain the start.
        """
        leaves, chosen = jax.tree.leaves(axle), {}
        every = {place.name: (kind, place) for kind, of in places(axle).items() for place in of}
        for pattern, bound in vary.items():
            matched = [name for name in every if fnmatchcase(name, pattern) or fnmatchcase(name, f"{pattern}.*")]
            if not matched:
                known = sorted({name.rpartition(".")[0] if name[-1] in "xyz123" else name for name in every})
                close = [repr(name) for name in get_close_matches(pattern, known)]
                meant = f"did you mean {' or '.join(close)}? There" if close else "there"
                raise ValueError(f"`vary`: {pattern!r} matches no number of the axle; {meant} are {known}.")
            chosen |= {name: (pattern, bound) for name in matched}
        kept = {kind: tuple(place for place in of if place.name in chosen) for kind, of in places(axle).items()}
        kept = {kind: of for kind, of in kept.items() if of}
        ends = {kind: np.empty((2, len(of))) for kind, of in kept.items()}
        for kind, of in kept.items():
            for i, place in enumerate(of):
                value = place.factor * float(np.ravel(leaves[place.leaf])[place.index]) + place.offset
                pattern, bound = chosen[place.name]
                ends[kind][:, i] = _bounds(pattern, bound, value, kind)
                low, high = ends[kind][:, i]
                if not low <= value <= high or (kind == RATES and not low > 0) or not low < high:
                    more = ", and rates stay positive" if kind == RATES else ""
                    raise ValueError(
                        f"`vary`, {pattern!r}: {place.name} is {value:.6g}, the bounds {low:.6g} and "
                        f"{high:.6g}; they must have it between them{more}."
                    )
        lower, upper = ({kind: as_float(end[i], None, "bounds") for kind, end in ends.items()} for i in (0, 1))
        return AxleNumbers(tuple(kept.items()), lower, upper)

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """By kind those of the numbers."""
        return {kind: tuple(place.name for place in of) for kind, of in self.places}

    def of(self, axle: Axle) -> dict[str, Float[Array, " n"]]:
        """The numbers of an axle."""
        leaves = jax.tree.leaves(axle)
        pick = lambda place: place.factor * leaves[place.leaf].ravel()[place.index] + place.offset
        return {kind: as_float([pick(place) for place in of], None, kind) for kind, of in self.places}

    def replaced(self, axle: Axle, x: Mapping[str, Float[Array, " n"]]) -> Axle:
        """The axle with other numbers."""
        leaves, structure = jax.tree.flatten(axle)
        for kind, of in self.places:
            for leaf in dict.fromkeys(place.leaf for place in of):
                rows = [i for i, place in enumerate(of) if place.leaf == leaf]
                at, old = np.array([of[i].index for i in rows]), leaves[leaf]
                factor, offset = (
                    np.array([getattr(of[i], name) for i in rows], old.dtype) for name in ("factor", "offset")
                )
                new = (x[kind][np.array(rows)] - offset) / factor
                leaves[leaf] = old.ravel().at[at].set(new).reshape(old.shape)
        return jax.tree.unflatten(structure, leaves)

    def document(self, file: Mapping[str, Any], axle: Axle, x: Mapping[str, Float[Array, " n"]]) -> dict[str, Any]:
        """The document of the axle's file with other numbers."""
        before, values = self.of(axle), {kind: np.asarray(x[kind]).tolist() for kind, _ in self.places}
        named = {kind: dict(zip(names, values[kind])) for kind, names in self.names.items()}
        rates = zip(self.names.get(RATES, ()), zip(np.asarray(before.get(RATES, ())).tolist(), values.get(RATES, ())))
        return rewritten(file, named.get(POINTS, {}), dict(rates), named.get(ANGLES, {}))


def _bounds(pattern: str, bound: Any, value: float, kind: str) -> tuple[float, float]:
    if np.shape(bound) == (2,):
        return float(bound[0]), float(bound[1])
    if np.shape(bound) != () or not float(bound) > 0:
        raise ValueError(f"`vary`, {pattern!r}: must be a positive number or a pair (lower, upper), got {bound!r}.")
    if kind == POINTS and float(bound) > 1.0:
        raise ValueError(
            f"`vary`, {pattern!r}: is in metres, whatever the unit of the file, and no point moves {bound:g} m "
            f"either way; did you mean {float(bound) / 1e3:g}?"
        )
    width = float(bound) * (value if kind == RATES else 1.0)
    return value - width, value + width
