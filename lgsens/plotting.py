"""Figures: time histories, convergence, errors, the mechanism in space; matplotlib comes late.

Figures are made without pyplot, so they need no display and leave no global state; in a notebook they show
themselves, and `save` writes them.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lgsens.model import DistanceJoint, Model, RevoluteJoint, SpringDamper, TyreSpring

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#8c8c8c", "#1b62a5", "#d9822b", "#3a8a4d")  # before in grey, after in blue, then others
LIMIT = "#b3262e"
# For curves that may lie on each other and be printed without colours: each has a marker of its own.
CURVES: tuple[dict[str, Any], ...] = (
    {"color": "#1b62a5", "marker": "o", "markersize": 11, "fillstyle": "none", "linestyle": "-", "linewidth": 2.4},
    {"color": "#d9822b", "marker": "s", "markersize": 4.5, "fillstyle": "full", "linestyle": "--", "linewidth": 1.2},
    {"color": "#3a8a4d", "marker": "D", "markersize": 8, "fillstyle": "none", "linestyle": "-.", "linewidth": 1.4},
    {"color": "#7a4b9a", "marker": "^", "markersize": 5.5, "fillstyle": "full", "linestyle": "--", "linewidth": 1.2},
    {"color": "#3c3c3c", "marker": "v", "markersize": 5, "fillstyle": "none", "linestyle": ":", "linewidth": 0.8},
    {"color": "#b3262e", "marker": "x", "markersize": 5, "fillstyle": "full", "linestyle": ":", "linewidth": 0.8},
)
ROLES = {"link": "#1b62a5", "body": "#3a8a4d", "wheel": "#3c3c3c", "spring": "#d9822b", "damper": "#7a4b9a"}


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


def figure(width: float = 7.0, height: float = 4.5) -> "Figure":
    """An empty figure of this size [inch]. Raises `ImportError` that says what to install, if need be."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Figures need matplotlib: pip install "lgsens[plot]"') from error
    return Figure(figsize=(width, height), layout="constrained")


def save(fig: "Figure", path: str | Path, dpi: int = 150) -> Path:
    """Write a figure as a PNG (or what the suffix says) and return its path; the folder must exist."""
    path = Path(path)
    fig.savefig(path, dpi=dpi)
    return path


def _plain(axes: "Axes") -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e4e4e4", linewidth=0.6)
    axes.set_axisbelow(True)


def time_histories(t, panels: Sequence[Panel], title: str = "") -> "Figure":
    """Quantities over time, one above the other, several runs in each, with their limits as dashed lines.

    Arguments:
        t: times [s], shape (n,).
        panels: what to draw, from top to bottom.
        title: over the figure.

    Raises `ImportError` without matplotlib.
    """
    fig = figure(8.0, 1.2 + 2.3 * len(panels))
    all_axes = fig.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    t = np.asarray(t)
    for axes, panel in zip(all_axes, panels):
        for i, (name, values) in enumerate(panel.series.items()):
            axes.plot(t, np.asarray(values), label=name, color=COLOURS[i % len(COLOURS)], linewidth=1.8)
        for name, value in panel.limits.items():
            axes.axhline(value, color=LIMIT, linestyle=(0, (5, 3)), linewidth=1.2)
            # The name stands at the right end of its line, where motions have died out.
            axes.annotate(
                name,
                (1.0, value),
                xycoords=("axes fraction", "data"),
                xytext=(-4, 3),
                textcoords="offset points",
                ha="right",
                color=LIMIT,
                fontsize=9,
            )
        _plain(axes)
        axes.margins(x=0, y=0.12)
        axes.set_ylabel(panel.label)
    fig.align_ylabels()
    all_axes[-1].set_xlabel("time [s]")
    handles, labels = all_axes[0].get_legend_handles_labels()
    all_axes[0].legend(handles, labels, frameon=False, ncols=len(labels), loc="upper right")
    if title:
        fig.suptitle(title)
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
    top, middle, bottom = fig.subplots(3, 1, sharex=True)
    steps = np.arange(len(history.objective))
    style = {"color": COLOURS[1], "linewidth": 1.6, "marker": "o", "markersize": 3}
    top.plot(steps, history.objective, **style)
    middle.plot(steps, history.worst_constraint, **style)
    bottom.semilogy(steps, history.gradient_norm, **style)
    # Far from the limit a linear axis hides the end, where the constraint is met to 1e-3.
    if np.all(np.isfinite(history.worst_constraint)):
        middle.set_yscale("symlog", linthresh=tolerance)
        low = 2 * min(np.min(history.worst_constraint), -tolerance)  # some room on an axis without margins
        high = 2 * max(np.max(history.worst_constraint), 5 * tolerance)
        middle.axhspan(tolerance, high, color=LIMIT, alpha=0.10, linewidth=0)
        middle.set_ylim(low, high)
        middle.text(0.99, 0.97, "violated", transform=middle.transAxes, ha="right", va="top", color=LIMIT)
    if best is not None:
        values = (history.objective, history.worst_constraint, history.gradient_norm)
        for axes, value in zip((top, middle, bottom), values):
            axes.plot(best, value[best], "o", color=COLOURS[2], markersize=8, label="design kept", zorder=3)
        top.legend(frameon=False)
    labels = (objective, "worst constraint\nover its scale [–]", "projected gradient\nof the Lagrangian [–]")
    for axes, label in zip((top, middle, bottom), labels):
        _plain(axes)
        axes.set_ylabel(label)
        axes.margins(x=0.02)
    bottom.set_xlabel("step")
    fig.align_ylabels()
    return fig


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
    fig = figure(1.6 + 4.6 * columns, 1.0 + 4.2 * rows)
    all_axes = fig.subplots(rows, columns, squeeze=False).ravel()
    for axes in all_axes[len(panels) :]:
        axes.remove()
    names = list(dict.fromkeys(name for panel in panels for name in panel.series))
    handles: dict[str, Any] = {}
    for axes, panel in zip(all_axes, panels):
        for name, (x, error) in panel.series.items():
            style = CURVES[names.index(name) % len(CURVES)]
            (handles[name],) = axes.plot(np.asarray(x), np.asarray(error), label=name, **style)
        axes.set_yscale("log")
        _plain(axes)
        axes.set(title=panel.title, xlabel=panel.horizontal, ylabel=panel.label)
        if panel.order is not None:
            _slope(axes, panel, panel.order)
    style = {"ncols": -(-len(names) // 2) if len(names) > 3 else len(names), "frameon": False, "handlelength": 3.5}
    fig.legend(handles=list(handles.values()), loc="outside lower center", **style)
    if title:
        fig.suptitle(title)
    return fig


def _slope(axes: "Axes", panel: ErrorPanel, order: int) -> None:
    """A line of this slope, below all curves where h is least, and the step sizes themselves along the axis."""
    x = np.unique(np.concatenate([np.asarray(h) for h, _ in panel.series.values()]))
    least = min(np.asarray(error)[np.argmin(h)] for h, error in panel.series.values())
    ends, middle = x[[0, -1]], np.sqrt(x[0] * x[-1])
    axes.plot(ends, 0.5 * least * (ends / x[0]) ** order, color=COLOURS[0], linewidth=1.2)
    axes.text(middle, 0.4 * least * (middle / x[0]) ** order, f"slope {order}", va="top", color=COLOURS[0])
    axes.set_xscale("log")
    axes.set_xticks(x, [f"{h:.3g}" for h in x])
    axes.minorticks_off()


def mechanism(models: Mapping[str, Model], title: str = "", view: tuple[float, float] = (18.0, -38.0)) -> "Figure":
    """Mechanisms in their reference configuration, in space; the last in colour, those before it in grey.

    A body is drawn from the points at which joints hold it: two make a bar, more a solid; one with a tyre
    is a wheel. The axes are equal. Springs are coils, dampers tubes with a rod, massless rods lines.

    Arguments:
        models: scenes by name, drawn over each other.
        title: over the figure.
        view: elevation and azimuth [degree].

    Raises `ImportError` without matplotlib.
    """
    fig = figure(8.0, 7.0)
    axes: Any = fig.add_subplot(projection="3d")
    points, handles = [], []
    for name, model in models.items():
        last = name == list(models)[-1]
        points += _draw(axes, model, ROLES if last else dict.fromkeys(ROLES, COLOURS[0]))
        if not last:
            handles += axes.plot([], [], [], color=COLOURS[0], linewidth=3, label=name)
        elif len(models) > 1:
            handles += axes.plot([], [], [], color=ROLES["link"], linewidth=3, label=name)
        else:
            handles += [axes.plot([], [], [], color=c, linewidth=3, label=role)[0] for role, c in ROLES.items()]
    points = np.asarray(points)
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * np.max(high - low)
    for setter, a, b in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), low - margin, high + margin):
        setter(a, b)
    axes.set_box_aspect(high - low + 2 * margin, zoom=0.95)
    axes.view_init(*view)
    axes.set(xlabel="x [m], forward", ylabel="y [m], left", zlabel="z [m], up")
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((0.98, 0.98, 0.98))
        axis.labelpad = 8
    if handles:
        axes.legend(handles=handles, frameon=False, loc="upper center", ncols=len(handles), columnspacing=1.2)
    if title:
        fig.suptitle(title)
    return fig


def _draw(axes: Any, model: Model, colours: Mapping[str, str]) -> list[np.ndarray]:
    """Draw one scene; returns the points that the axes must hold."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    held, drawn = _joint_points(model), []
    wheels = {force.body: np.asarray(force.at) for force in model.forces.values() if isinstance(force, TyreSpring)}
    for name, points in held.items():
        drawn += points
        if name in wheels:
            circle = _circle(wheels[name], _spin_axis(model, name))
            axes.add_collection3d(Poly3DCollection([circle], facecolor=colours["wheel"], alpha=0.08))
            axes.plot(*circle.T, color=colours["wheel"], linewidth=2.5, alpha=0.8)
            drawn += list(circle)
        elif len(points) == 2:
            axes.plot(*np.transpose(points), color=colours["link"], linewidth=4.5, solid_capstyle="round")
        elif len(points) > 2:
            faces = _hull(np.asarray(points))
            axes.add_collection3d(Poly3DCollection(faces, facecolor=colours["body"], alpha=0.16, linewidth=0))
            for face in faces if len(faces) > 1 else ():
                axes.plot(*np.concatenate([face, face[:1]]).T, color=colours["body"], linewidth=0.4, alpha=0.5)
    for joint in model.joints.values():
        if isinstance(joint, DistanceJoint):
            axes.plot(*np.transpose([joint.at_a, joint.at_b]), color=colours["link"], linewidth=3)
    for force in model.forces.values():
        if isinstance(force, SpringDamper):
            a, b = np.asarray(force.at_a), np.asarray(force.at_b)
            if float(force.stiffness) > 0:
                axes.plot(*_coil(a, b).T, color=colours["spring"], linewidth=1.8)
            else:
                axes.plot(*np.transpose([a, b]), color=colours["damper"], linewidth=1.8)
                axes.plot(*np.transpose([a, a + 0.6 * (b - a)]), color=colours["damper"], linewidth=6, alpha=0.45)
            drawn += [a, b]
    joints = np.asarray([point for points in held.values() for point in points])
    if joints.size:
        axes.scatter(*joints.T, color="white", edgecolors=colours["link"], s=24, depthshade=False, zorder=5)
    return drawn


def _joint_points(model: Model) -> dict[str, list[np.ndarray]]:
    """The points of each body at which a joint connects it to another one.

    Not those to the ground (a guide of the chassis says nothing of its shape), nor those of springs (which
    would make a solid of a bar).
    """
    held: dict[str, list[np.ndarray]] = {name: [] for name in model.bodies}
    for joint in model.joints.values():
        if joint.a is not None and joint.b is not None:
            for name, end in ((joint.a, "at_a"), (joint.b, "at_b")):
                held[name].append(np.asarray(getattr(joint, end if hasattr(joint, end) else "at")))
    return held


def _spin_axis(model: Model, wheel: str) -> np.ndarray:
    for joint in model.joints.values():
        if isinstance(joint, RevoluteJoint) and wheel in (joint.a, joint.b):
            return np.asarray(joint.axis) / np.linalg.norm(joint.axis)
    return np.array([0.0, 1.0, 0.0])


def _circle(centre: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The rim of a wheel that stands on z = 0."""
    first = np.cross(axis, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    angle = np.linspace(0, 2 * np.pi, 73)[:, None]
    return centre + centre[2] * (np.cos(angle) * first + np.sin(angle) * second)


def _coil(a: np.ndarray, b: np.ndarray, turns: int = 6, radius: float = 0.12) -> np.ndarray:
    """A coil between two points, its radius as a fraction of its length, straight at both ends."""
    length = np.linalg.norm(b - a)
    axis = (b - a) / length
    first = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    s = np.linspace(0, 1, 40 * turns)[:, None]
    wave = 2 * np.pi * turns * s
    coil = a + (0.1 + 0.8 * s) * (b - a) + radius * length * (np.cos(wave) * first + np.sin(wave) * second)
    return np.concatenate([[a, a + 0.1 * (b - a)], coil, [b - 0.1 * (b - a), b]])


def _hull(points: np.ndarray) -> np.ndarray:
    """The triangles of the convex hull, shape (m, 3, 3); of points in a plane, the polygon through them."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return points[ConvexHull(points).simplices]
    except QhullError:
        return points[None]
