"""Animations of a motion: an interactive page of HTML that needs nothing else, a GIF, or a video."""

import html
import json
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lgsens._validate import as_count
from lgsens.analysis import Kinematics
from lgsens.model import scene_of
from lgsens.plotting._mechanism import draw, frame, view_of
from lgsens.plotting._shapes import Shapes, corners, placed, shapes
from lgsens.plotting._stress import ColourBeams, Stress, beam_stress, colour_bar, in_page
from lgsens.plotting._style import ROAD, ROLES, figure
from lgsens.simulation import Saved, Trajectory, require_one_motion

SWEEP = 4.0  # seconds that a sweep through the positions of a kinematic analysis takes
PER_SECOND = 30  # frames


class Film(NamedTuple):
    """A motion as it is drawn: shapes, and the poses of all bodies at each of n frames.

    Attributes:
        shapes: what is drawn.
        clock: when each frame is shown [s], from 0, shape (n,).
        values: what is written beside it, time or a driven value, shape (n,); `label`, `unit`: its name and unit.
        position: origins of the body frames [m], inertial frame, shape (n, N, 3).
        orientation: body to inertial frame, shape (n, N, 3, 3).
        road: height of the road [m] under each tyre, shape (n, tyres).
        stress: what beams are coloured by, if anything.
    """

    shapes: Shapes
    clock: np.ndarray
    values: np.ndarray
    label: str
    unit: str
    position: np.ndarray
    orientation: np.ndarray
    road: np.ndarray
    stress: Stress | None


def animate(
    motion: Trajectory | Kinematics,
    path: str | Path,
    *,
    title: str = "",
    speed: float = 1.0,
    max_frames: int = 300,
    view: tuple[float, float] | None = None,
    colour_beams: ColourBeams = "stress",
) -> Path:
    """Write a motion as an animation and return its path; what is written follows from the suffix.

      - `.html`: one file that a browser plays offline: play, pause, scrub, speed; the mouse turns, moves and zooms.
      - `.gif`: drawn by matplotlib.
      - `.mp4` and other videos: the same by ffmpeg, which must be on the path.

    Arguments:
        motion: a `Trajectory`, or a `Kinematics`, whose positions are swept through.
        path: the file; its folder must exist.
        title: over the picture.
        speed: seconds of the motion per second of the animation; the page lets its reader change it.
        max_frames: as many frames are drawn at most, and 30 per second; a Python int. Frames are steps of the motion,
            chosen as evenly as they allow; there is no interpolation.
        view: elevation and azimuth of the eye at first [degree]; None: from the front, or across the plane of motion.
        colour_beams: "stress": elements of beams have the colour of their `SectionState.stress` [MPa], where it is
            known, on a scale from 0 to the largest of the motion; None: all have the same.

    Bodies, joints, springs, dampers and tyres are drawn as in `mechanism`, the road as a patch under the wheel
    of a `Trajectory`.

    Raises `ValueError` for another suffix or `colour_beams`, a motion of a system without bodies, a failed motion or a
    speed that is not positive, `ImportError` without matplotlib (but for `.html`), and `OSError` without ffmpeg.
    """
    path = Path(path)
    if not speed > 0:
        raise ValueError(f"`speed` must be positive, got {speed}.")
    found = film(motion, speed, as_count(max_frames, "max_frames"), colour_beams)
    poses = zip(found.position, found.orientation)
    everything = np.concatenate([corners(found.shapes, *pose) for pose in poses])  # of all frames
    view = view_of(everything) if view is None else view
    if path.suffix.lower() == ".html":
        path.write_text(page(found, title, everything, view), encoding="utf-8")
        return path
    writer = _writer(path, found.clock)
    fig = figure(8.0, 7.0)
    fig.set_layout_engine("none")  # it would move the axes from frame to frame, and takes longer than the drawing
    axes: Any = fig.add_subplot(projection="3d")
    if found.stress:
        colour_bar(fig, axes, found.stress.top)
    with writer.saving(fig, path, dpi=100):
        for i, value in enumerate(found.values):
            axes.clear()
            colours = found.stress.colours(i) if found.stress else [None] * len(found.shapes.struts)
            draw(axes, found.shapes, found.position[i], found.orientation[i], True, colours)
            for tyre, height in zip(found.shapes.tyres, found.road[i]):
                centre = placed(tyre.centre, found.position[i], found.orientation[i])
                patch = _patch(centre, height, 0.06 * np.max(np.ptp(everything, axis=0)))
                axes.plot(*np.concatenate([patch, patch[:1]]).T, color=ROAD)
            frame(axes, everything, view)
            axes.set_title(f"{title}\n{found.label} = {value:.{_digits(found)}f} {found.unit}".strip())
            writer.grab_frame()
    return path


def film(motion: Trajectory | Kinematics, speed: float, max_frames: int, colour_beams: ColourBeams) -> Film:
    """The frames of a motion."""
    wanted = "`motion` must be a Trajectory or a Kinematics of a Model, got "
    if not isinstance(motion, Trajectory | Kinematics):
        remedy = "what `simulate(…, save=…)` returns has no positions" if isinstance(motion, Saved) else "simulate it"
        raise ValueError(f"{wanted}{type(motion).__name__}; {remedy}.")
    scene = scene_of(motion.system)
    if scene is None:
        raise ValueError(f"{wanted}that of a {type(motion.system).__name__}, which has no bodies.")
    require_one_motion(motion, "motion")
    if int(motion.result) != 0:
        raise ValueError("`motion` failed (its `result` is not 0), so it has no positions to draw from some frame on.")
    if isinstance(motion, Kinematics) and motion.values:
        (label, values), *_ = motion.values.items()
        values = np.asarray(values)
        clock = np.linspace(0.0, SWEEP, len(values)) / speed
        turns = all(stack.elements.turning for stack in scene.constraints if label in stack.owners)
        unit = "rad" if turns else "m"
    else:
        label, unit, values = "t", "s", np.asarray(motion.t)
        clock = (values - values[0]) / speed
    count = min(len(clock), max_frames, max(2, 1 + round(PER_SECOND * clock[-1])))
    frames = np.unique(np.abs(clock[:, None] - np.linspace(0.0, clock[-1], count)[None]).argmin(axis=0))
    position, orientation = (np.asarray(array)[frames] for array in motion.states.q)
    drawn = shapes(scene)
    if isinstance(motion, Kinematics):  # a rig has no road
        drawn = drawn._replace(tyres=[])
    t = jnp.asarray(motion.t)[frames]
    road = np.array([jax.vmap(tyre.road)(t) for tyre in drawn.tyres]).reshape(-1, len(frames)).T
    _, states, times = motion.of_bodies()
    stress = beam_stress(drawn, scene, states.q, states.v, states.lam, times, colour_beams)
    if stress:  # on the scale of the whole motion
        stress = stress._replace(values=stress.values[frames])
    return Film(drawn, clock[frames], values[frames], label, unit, position, orientation, road, stress)


def _digits(film: Film) -> int:
    """Decimals that tell the frames apart."""
    least = np.min(np.abs(np.diff(film.values)), initial=1.0)
    return int(np.clip(np.ceil(-np.log10(max(float(least), 1e-6))), 0, 6))


def _patch(centre: np.ndarray, height: float, size: float) -> np.ndarray:
    corners = np.array([[-3.0, -1.0], [3.0, -1.0], [3.0, 1.0], [-3.0, 1.0]]) * size + centre[:2]
    return np.column_stack([corners, np.full(4, height)])


def page(film: Film, title: str, points: np.ndarray, view: tuple[float, float]) -> str:
    """The page that plays a film: the template, with its data as JSON, numbers to 1e-6 of the scene.

    `points` are those that must be in sight, shape (n, 3).
    """
    low, high = points.min(axis=0), points.max(axis=0)
    radius = float(np.linalg.norm(high - low) / 2) or 1.0
    digits = max(0, 6 - int(np.floor(np.log10(radius))))
    rounded = lambda array, digits=digits: np.round(np.asarray(array, float), digits).tolist()
    plain = lambda shape: {k: rounded(v) if isinstance(v, np.ndarray) else v for k, v in shape._asdict().items()}
    scale, stresses = in_page(film.stress) if film.stress else (None, [{}] * len(film.shapes.struts))
    data = {
        "label": film.label,
        "unit": film.unit,
        "digits": _digits(film),
        "clock": rounded(film.clock, 6),
        "values": rounded(film.values, 9),
        "view": rounded(view),
        "centre": rounded((low + high) / 2),
        "radius": radius,
        "colours": ROLES | {"road": ROAD},
        "position": rounded(film.position),
        "orientation": rounded(film.orientation.reshape(*film.orientation.shape[:2], 9), 6),
        "outlines": [plain(outline) for outline in film.shapes.outlines],
        "struts": [plain(strut) | stress for strut, stress in zip(film.shapes.struts, stresses)],
        "stress": scale,
        "joints": [plain(mark) for mark in film.shapes.joints],
        "tyres": [plain(tyre.centre) | {"road": rounded(film.road[:, i])} for i, tyre in enumerate(film.shapes.tyres)],
    }
    # "</" would end the script element that holds the data.
    text = json.dumps(data, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    template = (resources.files("lgsens.plotting") / "player.html").read_text(encoding="utf-8")
    return template.replace("__TITLE__", html.escape(title or "lgsens")).replace("__DATA__", text)


def _writer(path: Path, clock: np.ndarray) -> Any:
    """matplotlib's writer for this suffix, its frames as far apart as the clock says in the mean."""
    figure()  # asks for matplotlib, and says what to install
    from matplotlib.animation import FFMpegWriter, PillowWriter

    rate: Any = (len(clock) - 1) / clock[-1] if clock[-1] > 0 else 1.0
    if path.suffix.lower() == ".gif":
        return PillowWriter(fps=rate)
    if path.suffix.lower() not in (".mp4", ".webm", ".mkv", ".mov"):
        raise ValueError(f"`path` must end in .html, .gif or .mp4, got {str(path)!r}.")
    if not FFMpegWriter.isAvailable():
        raise OSError(f"Writing {str(path)!r} needs ffmpeg on the path; install it, or write .html or .gif.")
    return FFMpegWriter(fps=rate)
