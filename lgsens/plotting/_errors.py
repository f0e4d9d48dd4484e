"""Errors against the step size or over time, and what a small error costs."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lgsens.plotting._style import COLOURS, CURVES, IN_AXES, LIMIT, LIMIT_LINE, READABLE, figure, legend_below, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class ErrorPanel(NamedTuple):
    """Errors of several methods.

    Attributes:
        title: what the errors are of.
        label: what the vertical axis shows, with its unit: "relative error [–]".
        series: step sizes [s] and errors by the name of the method, each of shape (n,).
        order: slope of the reference line; None: no line, and the horizontal axis is linear.
        horizontal: label of the horizontal axis.
    """

    title: str
    label: str
    series: Mapping[str, tuple[Any, Any]]
    order: int | None = 2
    horizontal: str = "step size h [s]"


def errors(panels: Sequence[ErrorPanel], title: str = "") -> "Figure":
    """Errors on a logarithmic axis, panels side by side, four or more in two rows, with a line of the order's slope.

    A name looks the same in every panel, and is in one legend below them.

    Arguments:
        panels: what to draw, at least one.
        title: over the figure.

    Raises `ImportError` without matplotlib.
    """
    rows = 1 if len(panels) < 4 else 2
    columns = -(-len(panels) // rows)
    fig = figure(1.6 + 4.6 * columns, 1.0 + 4.2 * rows, title)
    all_axes = fig.subplots(rows, columns, squeeze=False).ravel()
    for axes in all_axes[len(panels) :]:
        axes.remove()
    styles = _styles(panel.series for panel in panels)
    handles: dict[str, Any] = {}
    for axes, panel in zip(all_axes, panels):
        for name, (x, error) in panel.series.items():
            (handles[name],) = axes.plot(np.asarray(x), np.asarray(error), label=name, **styles[name])
        axes.set_yscale("log")
        plain(axes)
        axes.set(title=panel.title, xlabel=panel.horizontal, ylabel=panel.label)
        if panel.order is not None:
            _slope(axes, panel, panel.order)
    legend_below(fig, handles, -(-len(styles) // 2) if len(styles) > 3 else len(styles))
    return fig


def _styles(panels: Iterable[Iterable[str]]) -> dict[str, dict[str, Any]]:
    """How the curves of all panels look, by their names."""
    names = dict.fromkeys(name for panel in panels for name in panel)
    return {name: CURVES[i % len(CURVES)] for i, name in enumerate(names)}


def _slope(axes: "Axes", panel: ErrorPanel, order: int) -> None:
    """A line of this slope, below all curves where h is least, and step sizes themselves along the axis."""
    x = np.unique(np.concatenate([np.asarray(h) for h, _ in panel.series.values()]))
    least = min(np.asarray(error)[np.argmin(h)] for h, error in panel.series.values())
    ends, middle = x[[0, -1]], np.sqrt(x[0] * x[-1])
    axes.plot(ends, 0.5 * least * (ends / x[0]) ** order, color=COLOURS[0], linewidth=1.2)
    axes.text(middle, 0.4 * least * (middle / x[0]) ** order, f"slope {order}", va="top", color=COLOURS[0])
    axes.set_xscale("log")
    shown = x[:: -(-len(x) // 6)]  # more labels would overlap
    axes.set_xticks(shown, [f"{h:.3g}" for h in shown])
    axes.minorticks_off()


class WorkPrecision(NamedTuple):
    """What a method costs at several settings, and how far off it is there.

    Attributes:
        cost: of a run, shape (n,); the axis names its unit.
        error: of its result, shape (n,).
    """

    cost: Any
    error: Any

    def _by_cost(self) -> tuple[np.ndarray, np.ndarray]:
        order = np.argsort(self.cost)
        return np.asarray(self.cost, float)[order], np.asarray(self.error, float)[order]

    def cost_of(self, target: float) -> float | None:
        """What an error of `target` costs: between the two settings around it, along a line in the logarithms.

        The first setting may be better already; None where no setting is as good.
        """
        cost, error = self._by_cost()
        met = np.flatnonzero(error <= target)
        if not len(met):
            return None
        if met[0] == 0:
            return float(cost[0])
        a, b = met[0] - 1, met[0]
        if error[b] == 0:
            return float(cost[b])
        share = np.log(error[a] / target) / np.log(error[a] / error[b])
        return float(cost[a] * (cost[b] / cost[a]) ** share)


def work_precision(
    methods: Mapping[str, WorkPrecision],
    target: float | None = None,
    *,
    cost: str = "time [ms]",
    error: str = "relative error [–]",
    title: str = "",
) -> "Figure":
    """Error against cost, both logarithmic, one curve per method; a line at the error that is wanted.

    Arguments:
        methods: costs and errors by name.
        target: the error that is wanted; the legend then says what each method pays for it. None: no line.
        cost, error: labels of the axes, with their units.
        title: over the figure.

    Raises `ValueError` for a target or costs that are not positive, `ImportError` without matplotlib.
    """
    if target is not None and not target > 0:
        raise ValueError(f"`target` must be positive, got {target}.")
    fig = figure(8.0, 5.4)
    axes = fig.add_subplot()
    unit = cost.partition("[")[2].partition("]")[0]
    for i, (name, method) in enumerate(methods.items()):
        x, y = _drawn(name, method)
        label = name
        if target is not None:
            price = method.cost_of(target)
            label += ": not reached" if price is None else f": {price:.3g} {unit}".rstrip()
        axes.loglog(x, y, label=label, **CURVES[i % len(CURVES)])
    if target is not None:
        _target_line(axes, target)
    plain(axes)
    axes.set(xlabel=cost, ylabel=error, title=title)
    axes.legend(**IN_AXES, loc="upper right", title=None if target is None else "cost at the target")
    return fig


def work_precision_panels(
    panels: Mapping[str, Mapping[str, WorkPrecision]],
    chosen: Mapping[float, Mapping[str, tuple[float, float]]] | None = None,
    *,
    cost: str = "time [ms]",
    title: str = "",
) -> "Figure":
    """Errors of several quantities against cost, side by side, one curve per method, in one legend below.

    Arguments:
        panels: costs and errors of the methods, by the name of the quantity and that of the method.
        chosen: cost and error of the setting that is recommended for each target, by the name of the quantity; it is
            starred, and a line leads there from the target.
        cost: label of the horizontal axis, with its unit.
        title: over the figure.

    A curve connects the settings of a method of which no other is both cheaper and better; the others are pale. Raises
    `ValueError` for costs that are not positive, `ImportError` without matplotlib.
    """
    fig = figure(1.6 + 4.8 * len(panels), 5.6, title)
    all_axes = fig.subplots(1, len(panels), squeeze=False, sharey=True).ravel()
    styles = _styles(panels.values())
    handles: dict[str, Any] = {}
    for axes, (quantity, methods) in zip(all_axes, panels.items()):
        axes.set(xscale="log", yscale="log", xlabel=cost, ylabel=f"relative error of {quantity} [–]")
        for name, method in methods.items():
            x, y = _drawn(name, method)
            best = y < np.minimum.accumulate(np.concatenate([[np.inf], y[:-1]]))
            (handles[name],) = axes.plot(x[best], y[best], label=name, **styles[name])
            axes.plot(x[~best], y[~best], **styles[name] | {"linestyle": "", "alpha": 0.3})
        for target, points in (chosen or {}).items():
            price, reached = points[quantity]
            _target_line(axes, target, linewidth=0.6, side="right")
            axes.plot([price, price], [target, reached], color=LIMIT, linewidth=0.9, zorder=3)
            axes.plot(price, reached, marker="*", markersize=11, color=LIMIT, linestyle="", zorder=3)
        plain(axes)
    legend_below(fig, handles, 2 if len(styles) > 3 else max(len(styles), 1))
    return fig


def _drawn(name: str, method: WorkPrecision) -> tuple[np.ndarray, np.ndarray]:
    """Costs, which a logarithmic axis can show, and errors, from the cheapest on."""
    if not np.all(np.asarray(method.cost) > 0):
        raise ValueError(f"`methods[{name!r}]`: costs must be positive, got {method.cost}.")
    return method._by_cost()


def _target_line(axes: "Axes", target: float, linewidth: float = 1.2, side: str = "left") -> None:
    axes.axhline(target, **LIMIT_LINE | {"linewidth": linewidth})
    style = {"color": LIMIT, "ha": side, "va": "bottom", "transform": axes.get_yaxis_transform(), "bbox": READABLE}
    axes.text({"left": 0.01, "right": 0.99}[side], target, f"target {target:g}", **style)
