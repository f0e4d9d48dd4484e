"""Frequency weightings of vibration: how much of an acceleration a person feels.

    H = H_h H_l H_t H_s,     s = iω,  ω_j = 2π f_j
    H_h = (s/ω₁)²/(1 + s/(Q₁ω₁) + (s/ω₁)²),          H_l = 1/(1 + s/(Q₂ω₂) + (s/ω₂)²)          (band limits)
    H_t = (1 + s/ω₃)/(1 + s/(Q₄ω₄) + (s/ω₄)²),                                                  (a–v transition)
    H_s = (1 + s/(Q₅ω₅) + (s/ω₅)²)/(1 + s/(Q₆ω₆) + (s/ω₆)²) (ω₅/ω₆)²                            (upward step)

Each factor is a section x₁' = ω x₂, x₂' = ω (u − x₁ − x₂/Q), whose x₁, x₂ and x₂'/ω are u times 1, s/ω and (s/ω)² over
its denominator: states of one size, where one companion matrix of eighth order would span 10¹⁵.

Sources: ISO 2631-1:1997, annex A; ISO 8041-1:2017, table 3 (parameters).
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jax import lax
from jaxtyping import Array, Complex, Float

from lgsens._validate import as_float
from lgsens._xla import scan

_Q = 1.0 / math.sqrt(2.0)
_NONE = (math.inf, 1.0, math.inf, 1.0)
# f₁, f₂, f₃, f₄, Q₄, (f₅, Q₅, f₆, Q₆), K
_PARAMETERS = {
    "Wb": (0.4, 100.0, 16.0, 16.0, 0.55, (2.5, 0.9, 4.0, 0.95), 1.024),
    "Wc": (0.4, 100.0, 8.0, 8.0, 0.63, _NONE, 1.0),
    "Wd": (0.4, 100.0, 2.0, 2.0, 0.63, _NONE, 1.0),
    "We": (0.4, 100.0, 1.0, 1.0, 0.63, _NONE, 1.0),
    "Wf": (0.08, 0.63, math.inf, 0.25, 0.86, (0.0625, 0.80, 0.10, 0.80), 1.0),
    "Wj": (0.4, 100.0, math.inf, math.inf, 1.0, (3.75, 0.91, 5.32, 0.91), 1.0),
    "Wk": (0.4, 100.0, 12.5, 12.5, 0.63, (2.37, 0.91, 3.35, 0.91), 1.0),
}


class _Linear(NamedTuple):
    """x' = A x + B u, y = C x + D u."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: float

    @classmethod
    def section(cls, f: float, q: float, numerator: tuple[float, float, float]) -> "_Linear":
        """(n₀ + n₁ s/ω + n₂ (s/ω)²)/(1 + s/(Qω) + (s/ω)²)."""
        w, (n0, n1, n2) = 2.0 * math.pi * f, numerator
        a = w * np.array([[0.0, 1.0], [-1.0, -1.0 / q]])
        return cls(a, np.array([0.0, w]), np.array([n0 - n2, n1 - n2 / q]), n2)

    def then(self, other: "_Linear") -> "_Linear":
        zero = np.zeros((len(self.B), len(other.B)))
        a = np.block([[self.A, zero], [np.outer(other.B, self.C), other.A]])
        b, c = np.append(self.B, other.B * self.D), np.append(other.D * self.C, other.C)
        return _Linear(a, b, c, other.D * self.D)


def _sections(name: str) -> _Linear:
    f1, f2, f3, f4, q4, (f5, q5, f6, q6), gain = _PARAMETERS[name]
    found = _Linear.section(f1, _Q, (0.0, 0.0, 1.0)).then(_Linear.section(f2, _Q, (gain, 0.0, 0.0)))
    if f4 < math.inf:
        found = found.then(_Linear.section(f4, q4, (1.0, f4 / f3, 0.0)))
    if f6 < math.inf:
        ratio = f6 / f5
        found = found.then(_Linear.section(f6, q6, (1.0 / ratio**2, 1.0 / (q5 * ratio), 1.0)))
    return found


class FrequencyWeighting(eqx.Module):
    """A frequency weighting of ISO 2631 and ISO 8041, as linear equations of an acceleration f [m/s² or rad/s²].

        x' = A x + B f,     weighted f = C x

    Arguments:
        name: "Wk" (vertical, seat), "Wd" (horizontal, seat), "Wb" (vertical, trains), "Wc" (back), "We" (rotation),
            "Wf" (motion sickness), "Wj" (head).

    For `random_road(…, weighting={"acceleration": FrequencyWeighting("Wk")})`, and for samples, `apply`. Static. Raises
    `ValueError` for another name. Source: ISO 2631-1:1997, annex A; ISO 8041-1:2017, table 3.
    """

    name: str = eqx.field(static=True)

    def __check_init__(self):
        if self.name not in _PARAMETERS:
            raise ValueError(f"FrequencyWeighting: `name` must be one of {', '.join(_PARAMETERS)}, got {self.name!r}.")

    def matrices(self, dtype: Any = float) -> tuple[Float[Array, "n n"], Float[Array, " n"], Float[Array, " n"]]:
        """A [1/s], B [1/s] and C."""
        found = _sections(self.name)
        a, b, c = (jnp.asarray(of, dtype) for of in (found.A, found.B, found.C))
        return a, b, c

    def frequency_response(self, frequency) -> Complex[Array, "*n"]:
        """H(iω) [–] at ω = 2π `frequency` [Hz], shape (…) → (…)."""
        frequency = as_float(frequency, None, "`frequency`")
        whole = lax.complex(jnp.zeros_like(frequency), 2.0 * jnp.pi * frequency)  # s
        a, b, c = (of.astype(whole.dtype) for of in self.matrices(frequency.dtype))
        response = lambda s: c @ jnp.linalg.solve(s * jnp.eye(len(b), dtype=s.dtype) - a, b)
        return jax.vmap(response)(whole.reshape(-1)).reshape(frequency.shape)

    def apply(self, t: Float[Array, " n"], f: Float[Array, " n"]) -> Float[Array, " n"]:
        """f weighted, from rest, exact for an f that is linear between equidistant times.

        Arguments:
            t: times [s], shape (n,), `Trajectory.t`.
            f: an acceleration there, shape (n,).

        Returns it in its unit, shape (n,); √(mean of its square) is the weighted RMS. Raises `ValueError` for shapes
        that differ.
        """
        t, f = as_float(t, None, "`t`"), as_float(f, None, "`f`")
        if t.ndim != 1 or f.shape != t.shape or t.shape[0] < 2:
            raise ValueError(f"`apply`: `t` and `f` must have one shape (n,), n ≥ 2, got {t.shape} and {f.shape}.")
        a, b, c = self.matrices(t.dtype)
        n, h = len(b), (t[-1] - t[0]) / (t.shape[0] - 1)
        # [x; f; f' h] over one step: f goes on along its slope.
        whole = jnp.zeros((n + 2, n + 2), t.dtype).at[:n, :n].set(a * h).at[:n, n].set(b * h).at[n, n + 1].set(1.0)
        step = jsl.expm(whole)[:n]

        def advance(x, ends):
            x = step @ jnp.concatenate([x, jnp.stack([ends[0], ends[1] - ends[0]])])
            return x, c @ x

        _, later = scan(advance, jnp.zeros(n, t.dtype), (f[:-1], f[1:]))
        return jnp.concatenate([jnp.zeros_like(later[:1]), later])
