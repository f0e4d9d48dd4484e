"""Signals through samples: straight lines, cubic splines and monotone cubics.

Cubic spline. With the second derivatives m_i at the samples (t_i, y_i), h_i = t_{i+1} − t_i, and on an interval the
weights β = (t − t_i)/h_i and α = 1 − β of its ends,

    y = α y_i + β y_{i+1} + h_i²/6 ((α³ − α) m_i + (β³ − β) m_{i+1})

is twice continuously differentiable if the first derivatives of neighbours agree,

    h_{i−1} m_{i−1} + 2 (h_{i−1} + h_i) m_i + h_i m_{i+1} = 6 ((y_{i+1} − y_i)/h_i − (y_i − y_{i−1})/h_{i−1}).

The natural one has m = 0 at both ends, and with α₊³ = max(α, 0)³ for α³ it goes on straight outside of the samples: C²
everywhere. m is solved for where a scene is assembled (`prepared`), not in its time steps.

Monotone cubic (Fritsch & Butland, SIAM J. Sci. Stat. Comput. 5, 1984; ends as SciPy's `PchipInterpolator`). With the
slopes Δ_i of the intervals, the slope d_i at an inner sample is 0 where Δ_{i−1} and Δ_i differ in sign, else their
weighted harmonic mean; at an end it is that of the parabola through three samples, kept in [0, 3Δ]. On an interval

    y = y_i + β h_i d_i + β² (3Δ_i − 2d_i − d_{i+1}) h_i + β³ (d_i + d_{i+1} − 2Δ_i) h_i

is C¹ and rises where the samples rise, so no force curve has a slope of the wrong sign between its points.

Periodic ones. Samples of one period T = t_n − t_0, the last of which is the first again, have n intervals in a ring,
t_{i+n} = t_i + T. All of their slopes are those of inner samples; and m solves a cyclic system, A, with two entries
more in its corners, h_{n−1} each, and the first diagonal entry b_0. A − u wᵀ is tridiagonal and diagonally dominant
with u = (−b_0, 0, …, 0, h_{n−1}), w = (1, 0, …, 0, −h_{n−1}/b_0), so that with x and z its solutions of the right-hand
side and of u (Sherman & Morrison, Ann. Math. Stat. 21, 1950)

    m = x − z (w·x)/(1 + w·z).

Times are taken to within the period, t − T ⌊(t − t_0)/T⌋, with its derivative by t_0 and T.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._validate import as_float, require, require_setting
from lgsens.model._signals import AbstractSignal

_KINDS = ("linear", "cubic", "monotone")


class Sampled(AbstractSignal):
    """Interpolation between samples, by straight lines, the natural cubic spline or a monotone cubic.

    Arguments:
        times: sample times [s], shape (n,), n ≥ 2, increasing.
        values: values at these times, in the unit of what they prescribe, shape (n,).
        kind: "linear", constant outside of the samples; its rate jumps at them, so no driver takes it. "cubic", twice
            continuously differentiable, straight outside of them. "monotone", once continuously differentiable,
            without overshoot, straight on outside of them with the slope at the end.
        periodic: whether the samples are one period, n ≥ 3, which comes again and again before and after them, as
            smooth where it closes as at the samples: a cycle, or a profile over an angle from 0 to 2π. The last value
            is the first one again, by which it is replaced where its number is not known yet (in `jit`). No `breaks`
            are told, as nobody knows of how many periods.

    Raises `ValueError` for shapes that differ, times that do not increase, another kind, and a period that does not end
    as it begins.
    """

    times: Float[Array, " n"]
    values: Float[Array, " n"]
    kind: str = eqx.field(static=True)
    periodic: bool = eqx.field(static=True)

    def __init__(self, times, values, kind: str = "linear", *, periodic: bool = False):
        self.times, self.values = samples(times, values, "Sampled", "values")
        self.kind, self.periodic = kind, periodic
        require_setting(self, "kind", kind in _KINDS, f"one of {_KINDS}")
        require_setting(self, "periodic", isinstance(periodic, bool), "True or False")
        if periodic:
            _check_period(self.values)

    @property
    def straight(self):
        return self.kind == "linear"

    @property
    def breaks(self):
        return self.times[..., :0] if self.periodic else self.times

    def prepared(self):
        times, values = self.times, self.values.at[-1].set(self.values[0]) if self.periodic else self.values
        through = {"linear": _Lines.through, "cubic": _Spline.through, "monotone": _Monotone.through}[self.kind]
        curve = through(times, values, self.periodic)
        return _Repeated(curve, times[0], times[-1]) if self.periodic else curve

    def __call__(self, t):
        return self.prepared()(t)


def _check_period(values: Float[Array, " n"]) -> None:
    if values.size < 3:
        raise ValueError(f"Sampled: a period has three samples or more, the first once more at its end, got {values}.")
    require(
        # of single precision; what is not finite is said where a scene is looked at
        lambda values: not abs(values[-1] - values[0]) > 1e-6 * np.ptp(values),
        lambda: (
            "Sampled: `values` of one period end as they begin, so that it closes; got "
            f"{values[0]} and {values[-1]}. Add a sample at the end of the period, with the first value."
        ),
        values,
    )


class _Repeated(AbstractSignal):
    """A signal between two times, again and again."""

    signal: AbstractSignal
    begin: Float[Array, ""]
    end: Float[Array, ""]

    @property
    def breaks(self):
        return self.begin[..., None][..., :0]

    def __call__(self, t):
        period = self.end - self.begin
        return self.signal(t - period * lax.stop_gradient(jnp.floor((t - self.begin) / period)))


class _Lines(AbstractSignal):
    """Straight lines between samples."""

    times: Float[Array, " n"]
    values: Float[Array, " n"]

    @property
    def breaks(self):
        return self.times

    @classmethod
    def through(cls, times, values, periodic: bool) -> "_Lines":
        return cls(times, values)

    def __call__(self, t):
        return jnp.interp(t, self.times, self.values)


class _Spline(_Lines):
    """The spline of the formulas above."""

    curvatures: Float[Array, " n"]  # m

    @classmethod
    def through(cls, times, values, periodic: bool) -> "_Spline":
        h = jnp.diff(times)
        slope, none, one = jnp.diff(values) / h, jnp.zeros(1, h.dtype), jnp.ones(1, h.dtype)
        if periodic:
            return cls(times, values, _cyclic(h, slope))
        lower = jnp.concatenate([none, h[:-1], none])
        diagonal = jnp.concatenate([one, 2.0 * (h[:-1] + h[1:]), one])
        upper = jnp.concatenate([none, h[1:], none])
        rhs = jnp.concatenate([none, 6.0 * jnp.diff(slope), none])
        return cls(times, values, lax.linalg.tridiagonal_solve(lower, diagonal, upper, rhs[:, None])[:, 0])

    def __call__(self, t):
        i = _interval(self.times, t)
        (t_0, t_1), (y_0, y_1), (m_0, m_1) = ((x[i], x[i + 1]) for x in (self.times, self.values, self.curvatures))
        h = t_1 - t_0
        beta = (t - t_0) / h
        alpha = 1.0 - beta
        bend = lambda weight: jnp.maximum(weight, 0.0) ** 3 - weight
        return alpha * y_0 + beta * y_1 + h * h / 6.0 * (bend(alpha) * m_0 + bend(beta) * m_1)


def _cyclic(h: Float[Array, " n"], slope: Float[Array, " n"]) -> Float[Array, " n+1"]:
    """m of a periodic spline, by Sherman & Morrison."""
    none, before, corner = jnp.zeros_like(h), jnp.roll(h, 1), h[-1]
    diagonal = 2.0 * (before + h)
    first = diagonal[0]
    u = none.at[0].set(-first).at[-1].set(corner)
    of_w = lambda x: x[0] - corner / first * x[-1]
    diagonal = diagonal.at[0].add(first).at[-1].add(corner * corner / first)
    rhs = jnp.stack([6.0 * (slope - jnp.roll(slope, 1)), u], axis=1)
    x, z = lax.linalg.tridiagonal_solve(before.at[0].set(0.0), diagonal, h.at[-1].set(0.0), rhs).T
    m = x - z * (of_w(x) / (1.0 + of_w(z)))
    return jnp.append(m, m[0])


def _interval(times: Float[Array, " n"], t):
    """Of two samples around t the first; outside of them those at the end."""
    return jnp.clip(jnp.searchsorted(lax.stop_gradient(times), t, side="right") - 1, 0, times.shape[0] - 2)


class _Monotone(_Lines):
    """The monotone cubic of the formulas above."""

    slopes: Float[Array, " n"]  # d

    @classmethod
    def through(cls, times, values, periodic: bool) -> "_Monotone":
        h = jnp.diff(times)
        slope = jnp.diff(values) / h
        if slope.shape[0] == 1:
            return cls(times, values, jnp.broadcast_to(slope, (2,)))
        if periodic:
            inner = _inner_slopes(jnp.roll(slope, 1), slope, jnp.roll(h, 1), h)
            return cls(times, values, jnp.append(inner, inner[0]))

        def end(h_0, h_1, slope_0, slope_1):
            parabola = ((2.0 * h_0 + h_1) * slope_0 - h_0 * slope_1) / (h_0 + h_1)
            within = jnp.clip(parabola, jnp.minimum(0.0, 3.0 * slope_0), jnp.maximum(0.0, 3.0 * slope_0))
            return jnp.where(slope_0 * slope_1 > 0.0, jnp.where(parabola * slope_0 > 0.0, parabola, 0.0), within)[None]

        first, last = end(h[0], h[1], slope[0], slope[1]), end(h[-1], h[-2], slope[-1], slope[-2])
        inner = _inner_slopes(slope[:-1], slope[1:], h[:-1], h[1:])
        return cls(times, values, jnp.concatenate([first, inner, last]))

    def __call__(self, t):
        i = _interval(self.times, t)
        (t_0, t_1), (y_0, y_1), (d_0, d_1) = ((x[i], x[i + 1]) for x in (self.times, self.values, self.slopes))
        h = t_1 - t_0
        slope = (y_1 - y_0) / h
        inside = jnp.where(t < t_0, t_0, jnp.where(t > t_1, t_1, t))  # `clip` halves the slope at a sample
        beta = (inside - t_0) / h
        bend = beta * (3.0 * slope - 2.0 * d_0 - d_1 + beta * (d_0 + d_1 - 2.0 * slope))
        straight = (t - inside) * jnp.where(t < t_0, d_0, d_1)
        return y_0 + h * beta * (d_0 + bend) + straight


def _inner_slopes(before, after, h_before, h_after):
    """d at samples between two intervals, of slopes Δ and lengths h."""
    short, long = h_after + 2.0 * h_before, 2.0 * h_after + h_before
    alike, one = before * after > 0.0, jnp.ones_like(before)
    harmonic = (short + long) / (long / jnp.where(alike, before, one) + short / jnp.where(alike, after, one))
    return jnp.where(alike, harmonic, 0.0)


def samples(times, values, what: str, name: str) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Two vectors of one length ≥ 2, the first increasing, as float leaves of `what`."""
    times, values = as_float(times, None, f"{what}: `times`"), as_float(values, None, f"{what}: `{name}`")
    if times.ndim != 1 or times.shape != values.shape or times.size < 2:
        raise ValueError(
            f"{what}: `times` and `{name}` must be two vectors of the same length ≥ 2, got shapes "
            f"{times.shape} and {values.shape}."
        )
    require(
        lambda times: np.all(np.diff(times) > 0),
        f"{what}: `times` must increase from sample to sample; sort them and drop duplicates.",
        times,
    )
    return times, values
