"""Panels of curves: over time with limits, over the steps of a minimization, over wheel travel."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lgsens.examples import SuspensionCurves
from lgsens.plotting._style import COLOURS, IN_AXES, LIMIT, LIMIT_LINE, READABLE, figure, legend_below, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Title, factor to the unit drawn, label of the axis, member of SuspensionCurves.
SUSPENSION = (
    ("camber", np.degrees(1.0), "camber [°], top outward +", "camber"),
    ("toe", np.degrees(1.0), "toe [°], toe-in +", "toe"),
    ("track", 1e3, "track change [mm]", "track_change"),
    ("wheelbase", 1e3, "wheelbase change [mm]", "wheelbase_change"),
    ("motion ratio", 1.0, "motion ratio of the spring [–]", "spring_motion_ratio"),
    ("roll centre", 1e3, "roll centre height [mm]", "roll_centre_height"),
)


class Panel(NamedTuple):
    """One quantity over time.

    Attributes:
        label: what the axis shows, with its unit: "tyre force [kN]".
        series: values over time by the name of the run, each of shape (n,).
        limits: values of horizontal limit lines by name.
    """

    label: str
    series: Mapping[str, Any]
    limits: Mapping[str, float] = {}


def time_histories(t, panels: Sequence[Panel], title: str = "") -> "Figure":
    """Quantities over time, one above the other, several runs in each, with their limits as dashed lines.

    Arguments:
        t: times [s], shape (n,).
        panels: what to draw, from top to bottom.
        title: over the figure.

    Raises `ImportError` without matplotlib.
    """
    fig = figure(8.0, 1.2 + 2.3 * len(panels), title)
    all_axes = fig.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    t = np.asarray(t)
    names = dict.fromkeys(name for panel in panels for name in panel.series)
    colours = {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}
    handles: dict[str, Any] = {}
    for axes, panel in zip(all_axes, panels):
        for name, values in panel.series.items():
            (handles[name],) = axes.plot(t, np.asarray(values), label=name, color=colours[name], linewidth=1.8)
        for name, value in panel.limits.items():
            axes.axhline(value, **LIMIT_LINE)
            # The name stands at the right end of its line, where motions have died out.
            place = {"xycoords": ("axes fraction", "data"), "xytext": (-4, 3), "textcoords": "offset points"}
            axes.annotate(name, (1.0, value), **place, ha="right", color=LIMIT, fontsize=9, bbox=READABLE)
        plain(axes)
        axes.margins(x=0, y=0.12)
        axes.set_ylabel(panel.label)
    fig.align_ylabels()
    all_axes[-1].set_xlabel("time [s]")
    legend_below(fig, handles, len(handles))
    return fig


def convergence(
    history: Any, *, tolerance: float = 1e-3, best: int | None = None, objective: str = "objective"
) -> "Figure":
    """The objective, the worst constraint and the projected gradient over the steps of a minimization.

    Arguments:
        history: `OptimizationResult.history`.
        tolerance: up to which the constraints count as satisfied, as of `minimize`; the region beyond is shaded.
        best: the step whose design was kept, to be marked.
        objective: label of the objective, with its unit.

    Raises `ImportError` without matplotlib.
    """
    fig = figure(8.0, 7.4)
    all_axes = fig.subplots(3, 1, sharex=True)
    top, middle, bottom = all_axes
    values = (history.objective, history.worst_constraint, history.gradient_norm)
    labels = (objective, "worst constraint\nover its scale [–]", "projected gradient\nof the Lagrangian [–]")
    for axes, value, label in zip(all_axes, values, labels):
        axes.plot(value, color=COLOURS[1], linewidth=1.6, marker="o", markersize=3)
        if best is not None:
            axes.plot(best, value[best], "o", color=COLOURS[2], markersize=8, label="design kept", zorder=3)
        plain(axes)
        axes.set_ylabel(label)
        axes.margins(x=0.02)
    bottom.set_yscale("log")
    # Far from the limit a linear axis hides the end, where the constraint is met to 1e-3.
    if np.all(np.isfinite(history.worst_constraint)):
        middle.set_yscale("symlog", linthresh=tolerance)
        low = 2 * min(np.min(history.worst_constraint), -tolerance)  # some room on an axis without margins
        high = 2 * max(np.max(history.worst_constraint), 5 * tolerance)
        middle.axhspan(tolerance, high, color=LIMIT, alpha=0.10, linewidth=0)
        middle.set_ylim(low, high)
        middle.text(0.99, 0.97, "violated", transform=middle.transAxes, ha="right", va="top", color=LIMIT)
    if best is not None:
        top.legend(**IN_AXES, loc="upper right")
    bottom.set_xlabel("step")
    fig.align_ylabels()
    return fig


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
    members = [member for *_, member in SUSPENSION]
    for name in bounds or ():
        if name not in members:
            raise ValueError(f"`bounds`: {name!r} is not one of {members}.")
    fig = figure(11.0, 6.6, title)
    all_axes = fig.subplots(2, 3, sharex=True)
    colours = COLOURS if len(curves) > 1 else COLOURS[1:]
    for axes, (panel, factor, label, member) in zip(all_axes.ravel(), SUSPENSION):
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
        legend_below(fig, dict(zip(curves, all_axes[0, 0].lines)), len(curves))
    return fig
