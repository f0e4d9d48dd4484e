"""The mechanism in space."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from lgsens.model import Model
from lgsens.plotting._shapes import Shapes, placed, shapes, stretched
from lgsens.plotting._style import COLOURS, ROLES, figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VIEW = (18.0, -38.0)  # elevation and azimuth [degree]


def mechanism(models: Mapping[str, Model], title: str = "", view: tuple[float, float] = VIEW) -> "Figure":
    """Mechanisms in their reference configuration, in space; the last in colour, those before it in grey.

    A body is drawn from the points at which joints hold it: two make a bar, more a solid; one with a tyre is a wheel;
    with fewer points it is a box of its inertia. The axes are equal. Springs are coils, dampers tubes with a rod,
    massless rods lines.

    Arguments:
        models: scenes by name, drawn over each other.
        title: over the figure.
        view: elevation and azimuth [degree].

    Raises `ImportError` without matplotlib.
    """
    fig = figure(8.0, 7.0, title)
    axes: Any = fig.add_subplot(projection="3d")
    points, labels = [], {}
    for name, model in models.items():
        last = name == list(models)[-1]
        system = model.system()
        position, orientation = (np.asarray(array) for array in system.pose)
        scene = shapes(system)
        points.append(draw(axes, scene, position, orientation, last))
        if len(models) > 1:
            labels[name] = ROLES["link"] if last else COLOURS[0]
        else:
            seen = {shape.role for shape in (*scene.outlines, *scene.struts)}
            labels = {role: colour for role, colour in ROLES.items() if role in seen}
    frame(axes, np.concatenate(points), view)
    if labels:
        handles = [axes.plot([], [], [], color=labels[label], linewidth=3, label=label)[0] for label in labels]
        axes.legend(handles=handles, frameon=False, loc="upper center", ncols=len(handles), columnspacing=1.2)
    return fig


def frame(axes: Any, points: np.ndarray, view: tuple[float, float]) -> None:
    """Equal axes that hold some points, with their names, seen from somewhere."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.03 * np.max(high - low)
    for setter, a, b in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), low - margin, high + margin):
        setter(a, b)
    axes.set_box_aspect(high - low + 2 * margin, zoom=0.95)
    axes.view_init(*view)
    axes.set(xlabel="x [m], forward", ylabel="y [m], left", zlabel="z [m], up")
    for axis, extent in zip((axes.xaxis, axes.yaxis, axes.zaxis), high - low):
        axis.set_pane_color((0.98, 0.98, 0.98))
        axis.labelpad = 8
        if extent < 1e-6 * np.max(high - low):  # numbers would lie on each other
            axis.set_ticks([])
            axis.set_label_text("")


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
        widths = {"spring": (1.8,), "damper": (1.8, 6.0), "link": (3.0,)}[strut.role]
        for line, width in zip(lines, widths):
            axes.plot(*line.T, color=colours[strut.role], linewidth=width, alpha=0.45 if width > 5 else 1.0)
    joints = np.array([placed(mark, position, orientation) for mark in scene.joints]).reshape(-1, 3)
    if len(joints):
        axes.scatter(*joints.T, color="white", edgecolors=colours["link"], s=24, depthshade=False, zorder=5)
    return np.concatenate([joints, *drawn])
