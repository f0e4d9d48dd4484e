"""Quantities over time, with their limits; the course of a minimization."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lgsens.plotting._style import COLOURS, LIMIT, LIMIT_LINE, figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
    for axes, panel in zip(all_axes, panels):
        for i, (name, values) in enumerate(panel.series.items()):
            axes.plot(t, np.asarray(values), label=name, color=COLOURS[i % len(COLOURS)], linewidth=1.8)
        for name, value in panel.limits.items():
            axes.axhline(value, **LIMIT_LINE)
            # The name stands at the right end of its line, where motions have died out.
            place = {"xycoords": ("axes fraction", "data"), "xytext": (-4, 3), "textcoords": "offset points"}
            axes.annotate(name, (1.0, value), **place, ha="right", color=LIMIT, fontsize=9)
        plain(axes)
        axes.margins(x=0, y=0.12)
        axes.set_ylabel(panel.label)
    fig.align_ylabels()
    all_axes[-1].set_xlabel("time [s]")
    all_axes[0].legend(frameon=False, ncols=len(panels[0].series), loc="upper right")
    return fig


def convergence(history: Any, *, tolerance: float, best: int | None = None, objective: str = "objective") -> "Figure":
    """The objective, the worst constraint and the projected gradient over the steps of a minimization.

    Arguments:
        history: `OptimizationResult.history`.
        tolerance: up to which the constraints count as satisfied; the region beyond is shaded.
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
        top.legend(frameon=False, loc="upper right")
    bottom.set_xlabel("step")
    fig.align_ylabels()
    return fig
