"""Signals: numbers that are functions of time, as modules whose numbers are leaves.

Drivers differentiate them twice by t, so each branch here is finite where it is not taken, and the derivatives by t
and by every leaf are those of the formula at its breaks as well.

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
"""

import abc
import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens._brief import as_called
from lgsens._validate import as_float, number_field, require, shaped
from lgsens.dynamics import AbstractTimeFunction, told_breaks

_KINDS = ("linear", "cubic", "monotone")


class AbstractSignal(AbstractTimeFunction):
    """A scalar function of time: what drivers, rods, roads and forces follow.

    A signal of one's own has leaves for its numbers and `__call__`, so that it can be differentiated by them and
    compiled once, which a Python function could not. What drives a mechanism needs two derivatives by t; JAX takes
    them.

    ```python
    class Chirp(lg.AbstractSignal):
        amplitude: jax.Array
        rate: jax.Array  # [1/s²]

        def __call__(self, t):
            return self.amplitude * jnp.sin(jnp.pi * self.rate * t**2)
    ```

    One that is not smooth says where in a property `breaks`, so that steps can end there (`AlignedSteps`). Without it
    they are those of the signals that it holds, so one that shifts or scales their time must say its own (`Delayed`
    does). An element of one's own that takes a signal over anything but time says so in its field:
    `eqx.field(metadata={"over": "angle"})`.
    """

    __repr__ = as_called

    @property
    def straight(self) -> bool:
        """Whether it follows straight lines between samples, so that its rate jumps there: no driver takes it."""
        return False

    @abc.abstractmethod
    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The value at time t [s], shape (), in the unit of what it prescribes, shape ()."""


class Constant(AbstractSignal):
    """s(t) = value.

    Arguments:
        value: in the unit of what it prescribes, shape ().
    """

    value: Float[Array, ""] = eqx.field(converter=lambda value: as_float(value, (), "`value`"), metadata=shaped())

    def __call__(self, t):
        return self.value


class Harmonic(AbstractSignal):
    """s(t) = offset + amplitude sin(2π frequency t + phase).

    Arguments:
        amplitude, offset: in the unit of what it prescribes, shape ().
        frequency: [Hz], shape ().
        phase: [rad], shape ().
    """

    amplitude: Float[Array, ""] = number_field("amplitude")
    frequency: Float[Array, ""] = number_field("frequency")
    phase: Float[Array, ""] = number_field("phase", default=0.0)
    offset: Float[Array, ""] = number_field("offset", default=0.0)

    def __call__(self, t):
        return self.offset + self.amplitude * jnp.sin(2.0 * jnp.pi * self.frequency * t + self.phase)


class Polynomial(AbstractSignal):
    """s(t) = c_0 + c_1 t + c_2 t² + …; `Polynomial(coefficients=(0, 5))` is a constant rate of 5.

    Arguments:
        coefficients: c_i, in the unit of what it prescribes per s^i, shape (n,), n ≥ 1.
    """

    coefficients: Float[Array, " n"]

    def __init__(self, coefficients):
        self.coefficients = as_float(coefficients, None, "Polynomial: `coefficients`")
        if self.coefficients.ndim != 1 or not self.coefficients.size:
            raise ValueError(
                "Polynomial: `coefficients` must be a vector of one number or more, c_0 first, got shape "
                f"{self.coefficients.shape}."
            )

    def __call__(self, t):
        value = self.coefficients[-1]
        for i in range(self.coefficients.size - 2, -1, -1):
            value = self.coefficients[i] + t * value
        return value


class Ramp(AbstractSignal):
    """From one value to another with continuous rate and acceleration:

        s(t) = start + (end − start) (10 x³ − 15 x⁴ + 6 x⁵),     x = (t − t_start)/duration, between 0 and 1

    Arguments:
        start, end: values before and after, in the unit of what it prescribes, shape ().
        t_start: when it begins [s], shape ().
        duration: how long it takes [s], shape (), positive.

    The largest rate is 1.875 (end − start)/duration; both ends are `breaks`. Raises `ValueError` for a duration ≤ 0.
    """

    start: Float[Array, ""] = number_field("start", default=0.0)
    end: Float[Array, ""] = number_field("end")
    t_start: Float[Array, ""] = number_field("t_start", default=0.0)
    duration: Float[Array, ""] = number_field("duration")

    def __check_init__(self):
        require(
            lambda duration: duration > 0, f"Ramp: `duration` must be positive, got {self.duration} s.", self.duration
        )

    @property
    def breaks(self):
        return jnp.stack([self.t_start, self.t_start + self.duration], axis=-1)

    def __call__(self, t):
        # the polynomial has zero slope and curvature at 0 and 1, whatever JAX says of those of `clip` there
        x = jnp.clip((t - self.t_start) / self.duration, 0.0, 1.0)
        return self.start + (self.end - self.start) * (x * x * x * (10.0 + x * (6.0 * x - 15.0)))


class Sampled(AbstractSignal):
    """Interpolation between samples, by straight lines, the natural cubic spline or a monotone cubic.

    Arguments:
        times: sample times [s], shape (n,), n ≥ 2, increasing.
        values: values at these times, in the unit of what they prescribe, shape (n,).
        kind: "linear", constant outside of the samples; its rate jumps at them, so no driver takes it. "cubic", twice
            continuously differentiable, straight outside of them. "monotone", once continuously differentiable,
            without overshoot, straight on outside of them with the slope at the end.

    Raises `ValueError` for shapes that differ, times that do not increase and another kind.
    """

    times: Float[Array, " n"]
    values: Float[Array, " n"]
    kind: str = eqx.field(static=True)

    def __init__(self, times, values, kind: str = "linear"):
        self.times, self.values = samples(times, values, "Sampled", "values")
        self.kind = kind
        if kind not in _KINDS:
            raise ValueError(f"Sampled: `kind` must be one of {_KINDS}, got {kind!r}.")

    @property
    def straight(self):
        return self.kind == "linear"

    @property
    def breaks(self):
        return self.times

    def __call__(self, t):
        return jnp.interp(t, self.times, self.values) if self.kind == "linear" else prepared(self)(t)


class Delayed(AbstractSignal):
    """Another signal, later: s(t) = signal(t − delay); the rear wheel on the road of the front one.

    Arguments:
        signal: what it follows.
        delay: [s], shape ().

    Raises `ValueError` for what is no signal.
    """

    signal: AbstractSignal
    delay: Float[Array, ""] = number_field("delay")

    def __check_init__(self):
        if not isinstance(self.signal, AbstractSignal):
            raise ValueError(f"Delayed: `signal` must be a signal (BumpRoad, Sampled, …), got {self.signal!r}.")

    @property
    def straight(self):
        return self.signal.straight

    @property
    def breaks(self):
        return told_breaks(self.signal) + self.delay[..., None]

    def __call__(self, t):
        return self.signal(t - self.delay)


class _Spline(AbstractSignal):
    """The spline of the formulas above."""

    times: Float[Array, " n"]
    values: Float[Array, " n"]
    curvatures: Float[Array, " n"]  # m

    @property
    def breaks(self):
        return self.times

    @classmethod
    def through(cls, sampled: Sampled) -> "_Spline":
        times, values = sampled.times, sampled.values
        h = jnp.diff(times)
        slope, none, one = jnp.diff(values) / h, jnp.zeros(1, h.dtype), jnp.ones(1, h.dtype)
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


def _interval(times: Float[Array, " n"], t):
    """Of two samples around t the first; outside of them those at the end."""
    return jnp.clip(jnp.searchsorted(lax.stop_gradient(times), t, side="right") - 1, 0, times.shape[0] - 2)


class _Monotone(AbstractSignal):
    """The monotone cubic of the formulas above."""

    times: Float[Array, " n"]
    values: Float[Array, " n"]
    slopes: Float[Array, " n"]  # d

    @property
    def breaks(self):
        return self.times

    @classmethod
    def through(cls, sampled: Sampled) -> "_Monotone":
        times, values = sampled.times, sampled.values
        h = jnp.diff(times)
        slope = jnp.diff(values) / h
        if slope.shape[0] == 1:
            return cls(times, values, jnp.broadcast_to(slope, (2,)))
        before, after, short, long = slope[:-1], slope[1:], h[1:] + 2.0 * h[:-1], 2.0 * h[1:] + h[:-1]
        alike = before * after > 0.0
        one = jnp.ones_like(before)
        harmonic = (short + long) / (long / jnp.where(alike, before, one) + short / jnp.where(alike, after, one))

        def end(h_0, h_1, slope_0, slope_1):
            parabola = ((2.0 * h_0 + h_1) * slope_0 - h_0 * slope_1) / (h_0 + h_1)
            within = jnp.clip(parabola, jnp.minimum(0.0, 3.0 * slope_0), jnp.maximum(0.0, 3.0 * slope_0))
            return jnp.where(slope_0 * slope_1 > 0.0, jnp.where(parabola * slope_0 > 0.0, parabola, 0.0), within)[None]

        first, last = end(h[0], h[1], slope[0], slope[1]), end(h[-1], h[-2], slope[-1], slope[-2])
        return cls(times, values, jnp.concatenate([first, jnp.where(alike, harmonic, 0.0), last]))

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


Prescribed = Float[Array, ""] | AbstractSignal


def prepared(value: Any) -> Any:
    """A number or signal with what can be computed before the time steps."""
    if isinstance(value, Delayed):
        return dataclasses.replace(value, signal=prepared(value.signal))
    if not isinstance(value, Sampled) or value.kind == "linear":
        return value
    return (_Spline if value.kind == "cubic" else _Monotone).through(value)


def at_time(value: Prescribed, t) -> Float[Array, ""]:
    """A number, or the value of a signal."""
    return value(t) if isinstance(value, AbstractSignal) else value


def number_of(value: Prescribed | None) -> Float[Array, ""] | None:
    """A number; None: a signal, or nothing."""
    return None if isinstance(value, AbstractSignal) else value


def constant_of(signal: AbstractSignal) -> Float[Array, ""] | None:
    """The number of a signal that is one; None: of another."""
    return signal.value if isinstance(signal, Constant) else None
