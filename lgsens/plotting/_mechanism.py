"""The mechanism in space."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lgsens.model import Model
from lgsens.plotting._shapes import Shapes, corners, placed, shapes, stretched
from lgsens.plotting._style import COLOURS, ROLES, figure, legend_below

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VIEW = (18.0, -38.0)  # elevation and azimuth [degree]
ACROSS = ((0.0, 0.0), (0.0, -90.0), (90.0, -90.0))  # those of an eye on an axis of coordinates
TICKS = 6  # along the longest axis


def mechanism(
    models: Mapping[str, Model],
    title: str = "",
    view: tuple[float, float] | None = None,
    axes_names: Sequence[str] = ("x", "y", "z"),
) -> "Figure":
    """Mechanisms in their reference configuration, in space; the last in colour, those before it in grey.

    A body is drawn from the points at which joints hold it: two make a bar, more a solid; one with a tyre is a wheel;
    with fewer points it is a box of its inertia. The axes are equal. Springs are coils, dampers tubes with a rod,
    massless rods lines, elements of beams bent lines.

    Arguments:
        models: scenes by name, drawn over each other.
        title: over the figure.
        view: elevation and azimuth [degree]; None: from the front, or across the plane in which everything lies.
        axes_names: names of the inertial axes: ("x, forward", "y, left", "z, up") of a car.

    Raises `ImportError` without matplotlib.
    """
    fig = figure(8.0, 7.0, title)
    axes: Any = fig.add_subplot(projection="3d")
    points, held, labels = [], [], {}
    for name, model in models.items():
        last = name == list(models)[-1]
        system = model.system()
        position, orientation = (np.asarray(array) for array in system.pose)
        scene = shapes(system)
        points.append(draw(axes, scene, position, orientation, last))
        held.append(corners(scene, position, orientation))
        if len(models) > 1:
            labels[name] = ROLES["link"] if last else COLOURS[0]
        else:
            seen = {shape.role for shape in (*scene.outlines, *scene.struts)}
            labels = {role: colour for role, colour in ROLES.items() if role in seen}
    frame(axes, np.concatenate(points), view_of(np.concatenate(held)) if view is None else view, axes_names)
    if labels:
        line = lambda label, colour: axes.plot([], [], [], color=colour, linewidth=3, label=label)[0]
        handles = {label: line(label, colour) for label, colour in labels.items()}
        legend_below(fig, handles, len(handles))
    return fig


def view_of(points: np.ndarray) -> tuple[float, float]:
    """Across the plane of points in one of the coordinate planes; else as a mechanism is seen."""
    extent = np.ptp(points, axis=0)
    flat = int(np.argmin(extent))
    return ACROSS[flat] if extent[flat] < 1e-6 * extent.max() else VIEW


def frame(axes: Any, points: np.ndarray, view: tuple[float, float], names: Sequence[str] = ("x", "y", "z")) -> None:
    """Equal axes that hold some points, with their names, seen from somewhere."""
    from matplotlib.ticker import MaxNLocator

    low, high = points.min(axis=0), points.max(axis=0)
    span = np.max(high - low)
    margin, shares = 0.03 * span, (high - low) / span
    for setter, a, b in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), low - margin, high + margin):
        setter(a, b)
    across = ACROSS.index(tuple(view)) if tuple(view) in ACROSS else None  # the axis that points at the eye
    tall = max(0.0, shares[2] - max(shares[:2]))  # what stands upright leaves little room below
    axes.set_box_aspect(high - low + 2 * margin, zoom=0.9 - 0.15 * tall if across is None else 1.05)
    axes.set_proj_type("persp" if across is None else "ortho")
    axes.view_init(*view)
    for i, (axis, share) in enumerate(zip((axes.xaxis, axes.yaxis, axes.zaxis), shares)):
        axis.set_pane_color((0.98, 0.98, 0.98))
        ends = 0.1 * share if across is None and i < 2 else 0.0  # where two axes meet before the eye
        ticks = MaxNLocator(max(1, int(TICKS * share)), min_n_ticks=1).tick_values(low[i], high[i])
        inside = (ticks >= low[i] + ends * span - margin) & (ticks <= high[i] - ends * span + margin)
        shown = share >= 0.15  # else numbers would lie on each other
        axis.set_ticks(ticks[inside] if shown and i != across else [])
        axis.set_label_text("" if i == across or share < 1e-6 else f"{names[i]} [m]")
        # matplotlib measures it by the other axes; without numbers the name takes their place
        axis.labelpad = 10 / max(np.max(np.delete(shares, i)), 0.05) if shown else -8


def draw(axes: Any, scene: Shapes, position, orientation, coloured: bool = True) -> np.ndarray:
    """Draw a scene at the given poses of its bodies; returns the points that the axes must hold, shape (n, 3)."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    colours = ROLES if coloured else dict.fromkeys(ROLES, COLOURS[0])
    drawn = []
    many = sum(outline.role == "body" for outline in scene.outlines) > 1
    for outline in scene.outlines:
        points, colour = placed(outline, position, orientation), colours[outline.role]
        drawn.append(points)
        if outline.role == "wheel":
            axes.add_collection3d(Poly3DCollection([points], facecolor=colour, alpha=0.08))
            axes.plot(*points.T, color=colour, linewidth=2.5, alpha=0.8)
        elif outline.filled:
            axes.add_collection3d(Poly3DCollection([points], facecolor=colour, alpha=0.16, linewidth=0))
            if many:
                axes.plot(*np.concatenate([points, points[:1]]).T, color=colour, linewidth=0.4, alpha=0.5)
        else:
            axes.plot(*points.T, color=colour, linewidth=4.5, solid_capstyle="round")
    for strut in scene.struts:
        lines = stretched(strut, position, orientation)
        drawn += lines
        widths = {"spring": (1.8,), "damper": (1.8, 6.0), "link": (3.0,), "beam": (3.5,)}[strut.role]
        for line, width in zip(lines, widths):
            axes.plot(*line.T, color=colours[strut.role], linewidth=width, alpha=0.45 if width > 5 else 1.0)
    joints = np.array([placed(mark, position, orientation) for mark in scene.joints]).reshape(-1, 3)
    if len(joints):
        axes.scatter(*joints.T, color="white", edgecolors=colours["link"], s=24, depthshade=False, zorder=5)
    return np.concatenate([joints, *drawn])
