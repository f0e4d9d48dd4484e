"""The curves of a suspension over wheel travel."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lgsens.examples import SuspensionCurves
from lgsens.plotting._style import COLOURS, LIMIT_LINE, figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Title, factor to the unit drawn, label of the axis, member of SuspensionCurves.
PANELS = (
    ("camber", np.degrees(1.0), "camber [°], top outward +", "camber"),
    ("toe", np.degrees(1.0), "toe [°], toe-in +", "toe"),
    ("track", 1e3, "track change [mm]", "track_change"),
    ("wheelbase", 1e3, "wheelbase change [mm]", "wheelbase_change"),
    ("motion ratio", 1.0, "motion ratio of the spring [–]", "spring_motion_ratio"),
    ("roll centre", 1e3, "roll centre height [mm]", "roll_centre_height"),
)


def suspension_curves(
    curves: Mapping[str, SuspensionCurves],
    bounds: Mapping[str, tuple[Any, Any, Any]] | None = None,
    title: str = "",
) -> "Figure":
    """Camber, toe, track, wheelbase, motion ratio and roll centre over wheel travel, of several suspensions.

    Arguments:
        curves: `QuarterCar.curves` by name; the first is drawn in grey if there are several.
        bounds: travel [m], lower and upper bound, each of shape (m,), by member of `SuspensionCurves` and in its unit
            ("camber": [rad]); dashed lines.
        title: over the figure.

    Raises `ValueError` for bounds of a member that is not drawn, `ImportError` without matplotlib.
    """
    members = [member for *_, member in PANELS]
    for name in bounds or ():
        if name not in members:
            raise ValueError(f"`bounds`: {name!r} is not one of {members}.")
    fig = figure(11.0, 6.6, title)
    all_axes = fig.subplots(2, 3, sharex=True)
    colours = COLOURS if len(curves) > 1 else COLOURS[1:]
    for axes, (panel, factor, label, member) in zip(all_axes.ravel(), PANELS):
        for i, (name, curve) in enumerate(curves.items()):
            travel, values = 1e3 * np.asarray(curve.travel), factor * np.asarray(getattr(curve, member))
            axes.plot(travel, values, label=name, color=colours[i % len(colours)], linewidth=1.8)
        if bounds and member in bounds:
            travel, *ends = (np.asarray(array) for array in bounds[member])
            for end in ends:
                axes.plot(1e3 * travel, factor * end, **LIMIT_LINE)
        plain(axes)
        axes.axvline(0.0, color="#bcbcbc", linewidth=0.8)
        axes.set(title=panel, ylabel=label)
        axes.margins(x=0)
    for axes in all_axes[-1]:
        axes.set_xlabel("wheel travel [mm], bump +")
    if len(curves) > 1:
        all_axes[0, 0].legend(frameon=False, loc="lower left")
    return fig
