"""Sensitivities along a trajectory: how each body and each joint force answers to a parameter."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from lgsens._validate import suggestion
from lgsens.dynamics import State
from lgsens.model import scene_of
from lgsens.plotting._style import CURVES, figure, plain
from lgsens.simulation import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 4
# What is drawn of a body, its part of the six coordinates, and its unit.
BODY = (
    ("w, translation", slice(0, 3), "m"),
    ("w, rotation", slice(3, 6), "rad"),
    ("v′, translation", slice(0, 3), "m/s"),
    ("v′, rotation", slice(3, 6), "rad/s"),
)


def sensitivities(
    trajectory: Trajectory,
    derivative: Trajectory | State,
    parameter: str = "p",
    *,
    bodies: Sequence[str] | None = None,
    joints: Sequence[str] | None = None,
    title: str = "",
) -> "Figure":
    """The sensitivities w, v′ of bodies and λ′ of joints over time, for one parameter (paper, §6).

    w are the Lie-algebra coordinates of the derivative of the configuration, dq/dp = q w̃: a translation in the inertial
    and a rotation in the body frame; v′ = dv/dp and λ′ = dλ/dp.

    Arguments:
        trajectory: the motion.
        derivative: its derivative by the parameter, as from
            `trajectory, derivative = jax.jvp(lambda p: lg.simulate(build(p), …), (p,), (1.0,))`, or the `states` of it.
        parameter: name of the parameter, with its unit: "l [m]".
        bodies: names of the bodies, a row of four panels each; None: all.
        joints: names of the joints, a panel each; None: all.
        title: over the figure.

    Raises `ValueError` for unknown names, a motion without bodies, or nothing to draw, `ImportError` without
    matplotlib.
    """
    system = scene_of(trajectory.system)
    if system is None:
        raise ValueError(
            f"`trajectory` is one of a {type(trajectory.system).__name__}, which has no named bodies and joints."
        )
    known = list(dict.fromkeys(system.constraint_names))
    bodies = list(system.body_names) if bodies is None else list(bodies)
    joints = known if joints is None else list(joints)
    for what, names, all_names in (("bodies", bodies, system.body_names), ("joints", joints, known)):
        for name in names:
            if name not in all_names:
                raise ValueError(f"`{what}`: {suggestion(name, all_names)}.")
    rows = len(bodies) + -(-len(joints) // COLUMNS)
    if rows == 0:
        raise ValueError("`bodies` and `joints` are empty; name something to draw.")
    change = derivative.states if isinstance(derivative, Trajectory) else derivative
    in_bodies = lambda states: dataclasses.replace(trajectory, states=states).of_bodies()[1]
    states, change = jax.jvp(in_bodies, (trajectory.states,), (change,))
    w = jax.vmap(system.group.from_ambient)(states.q, change.q)
    by_body = {"w": np.asarray(system.twists(w)), "v": np.asarray(system.twists(change.v))}
    t = np.asarray(trajectory.t)

    per = parameter.partition(" [")
    fig = figure(13.0, 0.8 + 2.3 * rows, title or f"Sensitivities with respect to {per[0]}")
    grid: Any = fig.subplots(rows, COLUMNS, sharex=True, squeeze=False)
    unit = f" per {per[2].rstrip(']')}" if per[2] else ""

    def panel(axes, name: str, label: str, values, names) -> None:
        for i, (column, component) in enumerate(zip(values.T, names)):
            axes.plot(t, column, color=CURVES[i % len(CURVES)]["color"], linewidth=1.5, label=component)
        plain(axes)
        axes.margins(x=0)
        axes.set_title(name, fontsize=10, pad=18)  # points; the legend is between
        axes.set_ylabel(label, fontsize=9)
        # over the panel: the search of a place within it takes seconds where trajectories are long
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "borderaxespad": 0.0}
        axes.legend(frameon=False, fontsize=8, ncols=3, handlelength=1.0, **place)

    for row, body in zip(grid, bodies):
        number = system.body_names.index(body)
        for axes, (what, part, of) in zip(row, BODY):
            panel(axes, f"{body}: {what}", f"{of}{unit}", by_body[what[0]][:, number, part], "xyz")
    rest = list(grid[len(bodies) :].flat)
    for axes, joint in zip(rest, joints):
        values = np.asarray(change.lam)[:, system.multiplier_rows(joint)]
        panel(axes, f"{joint}: λ′", f"N, N m{unit}", values, [str(i + 1) for i in range(values.shape[1])])
    for axes in rest[len(joints) :]:
        axes.remove()
    for column in grid.T:
        for axes in [axes for axes in column if axes.figure is not None][-1:]:  # the lowest, if there is one
            axes.set_xlabel("time [s]")
            axes.tick_params(labelbottom=True)
    return fig
