"""What the modules of the extremes share: a row of the table, and both derivatives of a function in one program."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from lgsens.testing._differences import NODES, difference

EPS = float(np.finfo(np.float64).eps)


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table: `measured` is right if it is at most `bound`; `why` says where the bound comes from."""

    extreme: str
    measures: str
    measured: float
    bound: float
    why: str

    @property
    def holds(self) -> bool:
        return self.measured <= self.bound  # not so for NaN

    @property
    def verdict(self) -> str:
        return "right" if self.holds else "WRONG"


def both_modes(function: Callable[[Any], Any]):
    """The compiled function of several points: values of `function` there, Jacobians in forward and in reverse mode.

    One program, and one point after the other; both modes share the simulation, forwards by its linearization and
    backwards by the transpose of that, which is what `jacfwd` and `jacrev` do in a program of their own each.
    """

    def one(p):
        value, slope = jax.linearize(function, p)
        transpose = jax.linear_transpose(slope, p)
        forward = jax.vmap(slope, out_axes=1)(jnp.eye(p.shape[0], dtype=p.dtype))
        reverse = jax.vmap(lambda row: transpose(row)[0])(jnp.eye(value.shape[0], dtype=p.dtype))
        return value, forward, reverse

    return jax.jit(lambda points: jax.lax.map(one, points))


def derivatives(function: Callable[[Any], Any], points):
    """What `both_modes` gives at some points, as NumPy arrays."""
    return tuple(np.asarray(array) for array in both_modes(function)(jnp.asarray(points, float)))


def by_differences(function, points, step: float):
    """Jacobians by central differences of sixth order, and how far they are from those of fourth order."""
    points = np.asarray(points, float)
    count, size = points.shape
    moves = np.array(NODES)[:, None, None] * step * np.eye(size)[None]
    moved = points[:, None, None, :] + moves[None]
    values = jax.jit(lambda points: jax.lax.map(function, points))(jnp.asarray(moved.reshape(-1, size)))
    values = np.asarray(values).reshape(count, len(NODES), size, -1)
    found = [[difference(values[i, :, j], step, np.zeros(())) for j in range(size)] for i in range(count)]
    slopes, orders = (
        np.array([[getattr(each, name) for each in row] for row in found]) for name in ("value", "tolerance")
    )
    return slopes.swapaxes(1, 2), orders.swapaxes(1, 2)


def largest(error, size=1.0) -> float:
    """The largest entry of |error|/size; NaN stays NaN."""
    return float(np.max(np.abs(error) / size))


def worst(errors, bounds) -> int:
    """Which error is closest to its bound, or beyond it by most."""
    return int(np.argmax(np.where(np.isnan(errors), np.inf, np.asarray(errors) / np.asarray(bounds))))


def worst_row(extreme: str, measures: str, errors, bounds, labels, why: str) -> Row:
    """The row of the case that is closest to its bound."""
    i = worst(errors, bounds)
    return Row(extreme, f"{measures}; closest at {labels[i]}", float(errors[i]), float(bounds[i]), why)


def _coefficients(rho_inf: float):
    """α_m, α_f, β, γ of Chung & Hulbert (1993)."""
    alpha_m, alpha_f = (2 * rho_inf - 1) / (rho_inf + 1), rho_inf / (rho_inf + 1)
    gamma = 0.5 + alpha_f - alpha_m
    return alpha_m, alpha_f, (gamma + 0.5) ** 2 / 4, gamma


def linear_error(rho_inf: float, phase, steps: int):
    """|z^n − exp(iφn)| of the scheme for q̈ = −ω² q, z the principal root of its step at φ = hω.

    With q, hv, h²a as unknowns, one step (eqs. 24-29) is A⁻¹ B; NumPy only, nothing of lgsens.
    """
    alpha_m, alpha_f, beta, gamma = _coefficients(rho_inf)
    errors = []
    for s in np.atleast_1d(phase):
        # v̇ = −ω²q, so (29) reads (1 − α_m) a⁺ + α_m a = −ω² ((1 − α_f) q⁺ + α_f q)
        after = np.array([[1, 0, -beta], [0, 1, -gamma], [(1 - alpha_f) * s**2, 0, 1 - alpha_m]])
        before = np.array([[1, 1, 0.5 - beta], [0, 1, 1 - gamma], [-alpha_f * s**2, 0, -alpha_m]])
        roots = np.linalg.eigvals(np.linalg.solve(after, before))
        exact = np.exp(1j * s)
        principal = roots[np.argmin(np.abs(roots - exact))]
        errors.append(abs(principal**steps - exact**steps))
    return np.array(errors)


def multiplier_noise(rho_inf: float, h, steps: int):
    """The largest λ/m that errors δ_n of a joint's position, |δ_n| ≤ 1, can make in n steps [1/s²].

    Where a constraint sets the position, eqs. (27)-(28) read (z − 1)² δ = βh² (z + ρ∞)² a, and (29) v̇ in terms of a:

        v̇ = (z − 1)² ((1 − α_m) z + α_m) / ((z + ρ∞)² ((1 − α_f) z + α_f)) δ/(βh²) = Σ c_k z⁻ᵏ δ/(βh²)

    The multiple root −ρ∞ makes c_k grow to about 4k at ρ∞ = 1; the bound is Σ |c_k|/(βh²).
    """
    alpha_m, alpha_f, beta, _ = _coefficients(rho_inf)
    above = np.polymul([1.0, -2.0, 1.0], [1 - alpha_m, alpha_m])
    below = np.polymul([1.0, 2 * rho_inf, rho_inf**2], [1 - alpha_f, alpha_f])
    return np.sum(np.abs(lfilter(above, below, np.eye(1, steps)[0]))) / (beta * h**2)
