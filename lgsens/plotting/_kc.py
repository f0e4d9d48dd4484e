"""The curves of one sweep of an axle on the rig."""

from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from lgsens.plotting._style import COLOURS, figure, legend_below, plain
from lgsens.rigs import AxleCurves

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DEG = float(np.degrees(1.0))


class KCPanel(NamedTuple):
    """What a panel shows: title, member of `AxleCurves`, factor to the unit drawn, label of the axis."""

    title: str
    member: str
    factor: float
    label: str


PANELS = (
    KCPanel("toe", "wheels.toe", _DEG, "toe [°], toe-in +"),
    KCPanel("steer", "wheels.steer", _DEG, "steer angle [°], left +"),
    KCPanel("camber", "wheels.camber", _DEG, "camber [°], top outward +"),
    KCPanel("lateral way", "wheels.contact_y", 1e3, "contact left + [mm]"),
    KCPanel("longitudinal way", "wheels.contact_x", 1e3, "contact forward + [mm]"),
    KCPanel("wheel load", "wheels.force", 1e-3, "vertical force [kN]"),
    KCPanel("track", "track_change", 1e3, "track change [mm]"),
    KCPanel("motion ratio", "spring_motion_ratio", 1.0, "motion ratio of the spring [–]"),
    KCPanel("wheel rate", "wheel_rate", 1e-3, "wheel rate [N/mm]"),
    KCPanel("roll rate", "roll_rate", 1.0 / _DEG, "roll rate [N m/°]"),
    KCPanel("roll centre", "roll_centre_height", 1e3, "height, kinematic [mm]"),
    KCPanel("roll centre by forces", "force_roll_centre_height", 1e3, "height [mm]"),
    KCPanel("anti-dive", "anti_dive", 100.0, "anti-dive [%]"),
    KCPanel("anti-lift", "anti_lift", 100.0, "anti-lift [%]"),
    KCPanel("anti-squat", "anti_squat", 100.0, "anti-squat [%]"),
    KCPanel("caster", "caster", _DEG, "caster [°], top rearward +"),
    KCPanel("kingpin inclination", "kingpin_inclination", _DEG, "inclination [°], top inward +"),
    KCPanel("scrub radius", "scrub_radius", 1e3, "scrub radius [mm]"),
    KCPanel("trail", "trail", 1e3, "trail [mm]"),
    KCPanel("steering ratio", "steering_ratio", 1.0, "steering ratio [–]"),
    KCPanel("Ackermann", "ackermann", 100.0, "Ackermann [%]"),
)
_COLUMNS = 4


def kc_curves(curves: AxleCurves, *, title: str = "", along: str = "", factor: float = 1.0) -> "Figure":
    """All outputs of one sweep of an axle, left and right wheel in each panel.

    Arguments:
        curves: those of the sweep, one of `KC.sweeps`.
        title: over the figure.
        along: label of the sweep's number, with its unit.
        factor: from its SI unit to that.

    Raises `ImportError` without matplotlib.
    """
    shown = [panel for panel in PANELS if attrgetter(panel.member)(curves) is not None]
    rows = -(-len(shown) // _COLUMNS)
    fig = figure(3.1 * _COLUMNS, 2.4 * rows + 0.6, title)
    every = fig.subplots(rows, _COLUMNS, sharex=True, squeeze=False).ravel()
    x, lines = factor * np.asarray(curves.value), {}
    for axes, panel in zip(every, shown):
        values = panel.factor * np.asarray(attrgetter(panel.member)(curves))
        values = np.where(np.isfinite(values), values, np.nan)  # a steering ratio where the wheels do not steer
        if values.ndim == 1:
            axes.plot(x, values, color=COLOURS[3], linewidth=1.6)
        else:
            for i, (side, style) in enumerate((("left", "-"), ("right", (0, (4, 2))))):
                (lines[side],) = axes.plot(
                    x, values[:, i], color=COLOURS[1 + i], linewidth=1.6, linestyle=style, label=side
                )
        plain(axes)
        axes.axvline(0.0, color="#bcbcbc", linewidth=0.8)
        axes.ticklabel_format(useOffset=False)
        # What does not change but for round-off is drawn as a level line.
        finite = values[np.isfinite(values)] if np.isfinite(values).any() else np.zeros(1)
        middle, span = np.mean(finite), np.ptp(finite)
        if not span > 1e-6 * max(abs(middle), 1.0):
            axes.set_ylim(middle - 0.5, middle + 0.5)
        axes.set_title(panel.title, fontsize=10)
        axes.set_ylabel(panel.label, fontsize=8)
        axes.margins(x=0)
    for axes in every[len(shown) :]:
        axes.set_axis_off()
    for axes in every[max(0, len(shown) - _COLUMNS) : len(shown)]:
        axes.set_xlabel(along, fontsize=9)
        axes.tick_params(labelbottom=True)
    legend_below(fig, lines, 2)
    return fig
