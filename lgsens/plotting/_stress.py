"""Beams in the colour of the stress in them, on one scale for all frames, in figures, GIFs and pages alike."""

from typing import Any, Literal, NamedTuple

import numpy as np

from lgsens.model import MultibodySystem, stresses
from lgsens.plotting._shapes import Shapes

ColourBeams = Literal["stress"] | None  # what beams are coloured by
LABEL = "stress in beams (von Mises) [MPa]"
# The first 80 % of matplotlib's plasma, whose steps look alike; its end is too pale for lines on white.
SCALE = ("#0d0887", "#41049d", "#6a00a8", "#8f0da4", "#b12a90", "#cc4778", "#e16462", "#f2844b", "#fca636")


_LEAST = 1e-6  # what no load has: strains are zero to round-off, 1e-14 or so, and E times it is 1e-9 [MPa]


class Stress(NamedTuple):
    """The largest stress in each strut of a scene, over the frames.

    Attributes:
        values: [MPa], shape (n, struts); NaN of what does not know its own.
        top: the end of the scale, which begins at 0 [MPa].
    """

    values: np.ndarray
    top: float

    def colours(self, frame: int) -> list[Any]:
        """Of each strut; None of those whose stress is not known."""
        shades, own = _map(), self.values[frame]
        return [None if np.isnan(value) else shades(value / self.top) for value in own]


def beam_stress(scene: Shapes, system: MultibodySystem, q, v, lam, t, by: ColourBeams) -> Stress | None:
    """What beams are coloured by along a motion, whose arrays have a leading axis; None where no beam has a stress but
    round-off, and of `by` None. Raises `ValueError` for another `by`."""
    if by not in ("stress", None):
        raise ValueError(f'`colour_beams` must be "stress" or None, got {by!r}.')
    beams = [strut.owner for strut in scene.struts if strut.role == "beam" and by]
    found = stresses(system, beams, q, v, lam, t)
    unknown = np.full(np.shape(t), np.nan)
    values = [1e-6 * np.asarray(found[strut.owner]) if strut.owner in found else unknown for strut in scene.struts]
    top = max((float(of.max()) for of in values if not np.isnan(of).any()), default=0.0)
    return Stress(np.stack(values, axis=1), top) if top > _LEAST else None


def colour_bar(fig: Any, axes: Any, top: float) -> None:
    """The scale, from 0 to `top` [MPa], beside axes."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    fig.colorbar(
        ScalarMappable(Normalize(0.0, top), _map()),
        ax=axes,
        label=LABEL,
        shrink=0.6,
        aspect=30,
        fraction=0.06,
        pad=0.08,
    )


def in_page(stress: Stress) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What a page has of them: the scale, and of each strut its stress at all frames, to 1e-4 of the scale."""
    digits = 4 - int(np.floor(np.log10(stress.top)))
    scale = {"label": LABEL, "top": round(stress.top, digits), "colours": SCALE}
    known = [not np.isnan(own).any() for own in stress.values.T]
    struts = [{"stress": np.round(own, digits).tolist()} if of else {} for own, of in zip(stress.values.T, known)]
    return scale, struts


def _map() -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("stress", SCALE)
