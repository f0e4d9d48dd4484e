"""Eigenvalues over a parameter: root locus and Campbell diagram."""

from typing import TYPE_CHECKING, Any

import numpy as np

from lgsens.plotting._style import CURVES, figure, plain

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def root_locus(values: Any, eigenvalues: Any, parameter: str = "p", *, title: str = "") -> "Figure":
    """Eigenvalues in the complex plane over a parameter, and beside that their damped frequencies (Campbell).

    Arguments:
        values: of the parameter, shape (n,), such as the spin of a rotor.
        eigenvalues: λ for each of them [1/s], shape (n, N), `jax.vmap(lambda p: lg.linearize(…).eigenvalues)(values)`.
        parameter: its name, with its unit: "damping [N s/m]".
        title: over the figure.

    Of conjugates one is shown. Raises `ValueError` for shapes that do not fit, `ImportError` without matplotlib.
    """
    values, eigenvalues = np.asarray(values, float), np.asarray(eigenvalues)
    if values.ndim != 1 or eigenvalues.ndim != 2 or len(values) != len(eigenvalues):
        raise ValueError(
            f"`values` and `eigenvalues` must have shapes (n,) and (n, N), got {values.shape} and {eigenvalues.shape}."
        )
    fig = figure(10.0, 4.2, title)
    axes: Any = fig.subplots(1, 2)
    shown = eigenvalues.imag >= 0.0
    at = np.broadcast_to(values[:, None], eigenvalues.shape)[shown]
    points = axes[0].scatter(eigenvalues.real[shown], eigenvalues.imag[shown], c=at, cmap="viridis", s=12)
    axes[0].axvline(0.0, color="#3c3c3c", linewidth=0.8)
    axes[0].set(xlabel="Re λ [1/s]", ylabel="Im λ [rad/s]")
    axes[1].plot(at, eigenvalues.imag[shown] / (2.0 * np.pi), ".", color=CURVES[0]["color"], markersize=4)
    axes[1].set(xlabel=parameter, ylabel="damped frequency [Hz]")
    for each in axes:
        plain(each)
    fig.colorbar(points, ax=axes[0], label=parameter)
    return fig
