"""Figures without pyplot, and how all of them look."""

import functools
import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#8c8c8c", "#1b62a5", "#d9822b", "#3a8a4d")  # before in grey, after in blue, then others
LIMIT = "#b3262e"
LIMIT_LINE: dict[str, Any] = {"color": LIMIT, "linestyle": (0, (5, 3)), "linewidth": 1.2}
# For curves that may lie on each other and be printed without colours: each has a marker of its own.
CURVES: tuple[dict[str, Any], ...] = (
    {"color": "#1b62a5", "marker": "o", "markersize": 11, "fillstyle": "none", "linestyle": "-", "linewidth": 2.4},
    {"color": "#d9822b", "marker": "s", "markersize": 4.5, "fillstyle": "full", "linestyle": "--", "linewidth": 1.2},
    {"color": "#3a8a4d", "marker": "D", "markersize": 8, "fillstyle": "none", "linestyle": "-.", "linewidth": 1.4},
    {"color": "#7a4b9a", "marker": "^", "markersize": 5.5, "fillstyle": "full", "linestyle": "--", "linewidth": 1.2},
    {"color": "#3c3c3c", "marker": "v", "markersize": 5, "fillstyle": "none", "linestyle": ":", "linewidth": 0.8},
    {"color": "#b3262e", "marker": "x", "markersize": 5, "fillstyle": "full", "linestyle": ":", "linewidth": 0.8},
)
ROAD = "#b8a58c"
# Behind words that may lie on a curve, and behind a legend within axes.
READABLE: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.0}
IN_AXES: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "framealpha": 0.85}
NOTEBOOK_DPI = 80
ROLES = {
    "link": "#1b62a5",
    "beam": "#23858f",
    "body": "#3a8a4d",
    "wheel": "#3c3c3c",
    "spring": "#d9822b",
    "damper": "#7a4b9a",
}


def figure(width: float = 7.0, height: float = 4.5, title: str = "") -> "Figure":
    """An empty figure of this size [inch] with a title. Raises `ImportError` that says what to install, if need be."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError('Figures need matplotlib: pip install "lgsens[plot]"') from error
    fig = Figure(figsize=(width, height), layout="constrained")
    if title:
        fig.suptitle(title)
    # In a notebook matplotlib shows the figures of pyplot only; others show themselves if they have this method.
    vars(fig)["_repr_png_"] = functools.partial(_png, fig)
    return fig


def _png(fig: "Figure") -> bytes:
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", dpi=NOTEBOOK_DPI)
    return buffer.getvalue()


def save(fig: "Figure", path: str | Path, dpi: int = 150) -> Path:
    """Write a figure as a PNG (or what the suffix says) and return its path; the folder must exist."""
    path = Path(path)
    fig.savefig(path, dpi=dpi)
    return path


def plain(axes: "Axes") -> None:
    """A light grid, and no frame above and on the right."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, color="#e4e4e4", linewidth=0.6)
    axes.set_axisbelow(True)


def legend_below(fig: "Figure", handles: Mapping[str, Any], columns: int) -> None:
    """One legend for all panels of a figure, under them, where no curve is."""
    style = {"ncols": columns, "frameon": False, "handlelength": 3.5}
    fig.legend(handles=list(handles.values()), loc="outside lower center", **style)
