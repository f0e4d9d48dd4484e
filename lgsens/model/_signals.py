"""Signals: numbers that are functions of time, as modules whose numbers are leaves.

Drivers differentiate them twice by t, so each branch here is finite where it is not taken, and the derivatives by t
and by every leaf are those of the formula at its breaks as well.
"""

import abc
import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._brief import as_called
from lgsens._validate import as_float, number_field, require, shaped
from lgsens.dynamics import AbstractTimeFunction, told_breaks


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

    def prepared(self) -> "AbstractSignal":
        """The same with what can be computed before the time steps."""
        return self

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
            lambda duration: duration > 0,
            lambda: f"Ramp: `duration` must be positive, got {self.duration} s.",
            self.duration,
        )

    @property
    def breaks(self):
        return jnp.stack([self.t_start, self.t_start + self.duration], axis=-1)

    def __call__(self, t):
        # the polynomial has zero slope and curvature at 0 and 1, whatever JAX says of those of `clip` there
        x = jnp.clip((t - self.t_start) / self.duration, 0.0, 1.0)
        return self.start + (self.end - self.start) * (x * x * x * (10.0 + x * (6.0 * x - 15.0)))


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

    def prepared(self):
        return dataclasses.replace(self, signal=self.signal.prepared())

    def __call__(self, t):
        return self.signal(t - self.delay)


Prescribed = Float[Array, ""] | AbstractSignal


def prepared(value: Any) -> Any:
    """A number or signal with what can be computed before the time steps."""
    return value.prepared() if isinstance(value, AbstractSignal) else value


def at_time(value: Prescribed, t) -> Float[Array, ""]:
    """A number, or the value of a signal."""
    return value(t) if isinstance(value, AbstractSignal) else value


def number_of(value: Prescribed | None) -> Float[Array, ""] | None:
    """A number; None: a signal, or nothing."""
    return None if isinstance(value, AbstractSignal) else value


def constant_of(signal: AbstractSignal) -> Float[Array, ""] | None:
    """The number of a signal that is one; None: of another."""
    return signal.value if isinstance(signal, Constant) else None
