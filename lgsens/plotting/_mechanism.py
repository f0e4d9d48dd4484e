"""The mechanism in space."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from lgsens.dynamics import finite
from lgsens.model import Model, MultibodySystem
from lgsens.plotting._shapes import Shapes, corners, placed, shapes, stretched
from lgsens.plotting._stress import ColourBeams, beam_stress, colour_bar
from lgsens.plotting._style import COLOURS, ROLES, figure, legend_below
from lgsens.simulation import AbstractRun, require_one_motion

if TYPE_CHECKING:
    from matplotlib.figure import Figure

VIEW = (18.0, -38.0)  # elevation and azimuth [degree]
ACROSS = ((0.0, 0.0), (0.0, -90.0), (90.0, -90.0))  # those of an eye on an axis of coordinates
TICKS = 6  # along the longest axis


def mechanism(
    models: Mapping[str, Model | AbstractRun] | Model | AbstractRun,
    title: str = "",
    view: tuple[float, float] | None = None,
    axes_names: Sequence[str] = ("x", "y", "z"),
    *,
    colour_beams: ColourBeams = "stress",
) -> "Figure":
    """Mechanisms in space, in their reference configuration or at the end of a motion; the last in colour, those before
    it in grey.

    A body is drawn from the points at which joints hold it: two make a bar, more a solid; one with a tyre is a wheel;
    with fewer points it is a box of its inertia. The axes are equal. Springs are coils, dampers tubes with a rod,
    massless rods lines, elements of beams bent lines.

    Arguments:
        models: scenes by name, drawn over each other: a `Model`, or what `simulate`, `kinematics` and `statics` return;
            or one of these alone.
        title: over the figure.
        view: elevation and azimuth [degree]; None: from the front, or across the plane in which everything lies.
        axes_names: names of the inertial axes: ("x, forward", "y, left", "z, up") of a car.
        colour_beams: "stress": elements of beams have the colour of their `SectionState.stress` [MPa], with its scale,
            where it is known and not 0 everywhere (of a `Model` at rest it is that of preloads); None: all one colour.

    Raises `ValueError` for `models` of another type, motions that failed and another `colour_beams`,
    `ImportError` without matplotlib.
    """
    scenes = models if isinstance(models, Mapping) else {"": models}
    for model in scenes.values():
        if not isinstance(model, Model | AbstractRun):
            raise ValueError(
                "`models` must be a Model, or what `simulate`, `kinematics` or `statics` return, or a dict of such by "
                f"name, got {type(model).__name__}."
            )
    fig = figure(8.0, 7.0, title)
    axes: Any = fig.add_subplot(projection="3d")
    points, held, labels = [], [], {}
    for name, model in scenes.items():
        last = name == list(scenes)[-1]
        system, q, v, lam, t = _last(model)
        position, orientation = (np.asarray(array[0]) for array in q)
        scene = shapes(system)
        stress = beam_stress(scene, system, q, v, lam, t, colour_beams if last else None)
        colours = stress.colours(0) if stress else [None] * len(scene.struts)
        points.append(draw(axes, scene, position, orientation, last, colours))
        held.append(corners(scene, position, orientation))
        if len(scenes) > 1:
            labels[name] = ROLES["link"] if last else COLOURS[0]
        else:
            own = [strut for strut, colour in zip(scene.struts, colours) if colour is None]
            seen = {shape.role for shape in (*scene.outlines, *own)}
            labels = {role: colour for role, colour in ROLES.items() if role in seen}
        if stress:
            colour_bar(fig, axes, stress.top)
    frame(axes, np.concatenate(points), view_of(np.concatenate(held)) if view is None else view, axes_names)
    if labels:
        line = lambda label, colour: axes.plot([], [], [], color=colour, linewidth=3, label=label)[0]
        handles = {label: line(label, colour) for label, colour in labels.items()}
        legend_below(fig, handles, len(handles))
    return fig


def _last(model: Model | AbstractRun) -> tuple[MultibodySystem, Any, Any, Any, Any]:
    """The system of a scene, and q, v, λ and t with an axis of length 1: at rest in the reference configuration, or
    what a motion ends with."""
    if isinstance(model, AbstractRun):
        require_one_motion(model, "models")
        system, states, t = model.of_bodies()
        if not finite(last := jax.tree.map(lambda leaf: leaf[-1:], (states.q, states.v, states.lam, t))):
            raise ValueError("`models`: a motion failed (its `result` is not 0), so it ends without positions to draw.")
        return system, *last
    system = model.system()
    zeros = lambda count: jnp.zeros(count, system.mass.dtype)
    rest = system.pose, jnp.zeros_like(system.velocity), zeros(system.topology.num_constraints), zeros(())
    return system, *jax.tree.map(lambda leaf: leaf[None], rest)


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


def draw(axes: Any, scene: Shapes, position, orientation, coloured: bool, own: Sequence[Any]) -> np.ndarray:
    """Draw a scene at the given poses of its bodies, struts in colours of their own unless they are None; returns the
    points that the axes must hold, shape (n, 3)."""
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
    for strut, shade in zip(scene.struts, own):
        lines, colour = stretched(strut, position, orientation), shade or colours[strut.role]
        drawn += lines
        widths = {"spring": (1.8,), "damper": (1.8, 6.0), "link": (3.0,), "beam": (3.5,)}[strut.role]
        for line, width in zip(lines, widths):
            axes.plot(*line.T, color=colour, linewidth=width, alpha=0.45 if width > 5 else 1.0)
    joints = np.array([placed(mark, position, orientation) for mark in scene.joints]).reshape(-1, 3)
    if len(joints):
        axes.scatter(*joints.T, color="white", edgecolors=colours["link"], s=24, depthshade=False, zorder=5)
    return np.concatenate([joints, *drawn])
