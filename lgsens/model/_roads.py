"""Road profiles, signals of time."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import number_field, require
from lgsens.model._signals import AbstractSignal, samples


class FlatRoad(AbstractSignal):
    """A constant: z(t) = height.

    Arguments:
        height: height of the road above z = 0 [m] (or the value of a load factor [–]), shape ().
    """

    height: Float[Array, ""] = number_field("height", default=0.0)

    def __call__(self, t):
        return self.height


class BumpRoad(AbstractSignal):
    """A sin² bump: z(t) = h sin²(π (t − t_s)/T) for t_s ≤ t ≤ t_s + T, else 0; that is ½ h (1 − cos 2π(t − t_s)/T).

    Arguments:
        height: height h of the bump [m], shape ().
        duration: time T that the wheel takes to cross it [s], shape (), positive.
        start: time t_s at which it begins [s], shape ().

    Continuous with its first derivative; the second jumps at both ends. Raises `ValueError` for a
    duration ≤ 0.
    """

    height: Float[Array, ""] = number_field("height")
    duration: Float[Array, ""] = number_field("duration")
    start: Float[Array, ""] = number_field("start", default=0.0)

    def __check_init__(self):
        require(
            lambda duration: duration > 0,
            f"BumpRoad: `duration` must be positive, got {self.duration} s.",
            self.duration,
        )

    def __call__(self, t):
        phase = (t - self.start) / self.duration
        on_bump = (phase >= 0) & (phase <= 1)
        return jnp.where(on_bump, self.height * jnp.sin(jnp.pi * phase) ** 2, 0.0)


class SampledRoad(AbstractSignal):
    """Linear interpolation between samples, constant outside them.

    Arguments:
        times: sample times [s], shape (n,), increasing.
        heights: heights at these times [m], shape (n,).

    The slope jumps at the samples: put them on time steps to keep second order. Raises `ValueError` for
    shapes that differ or times that do not increase.
    """

    times: Float[Array, " n"]
    heights: Float[Array, " n"]

    def __init__(self, times, heights):
        self.times, self.heights = samples(times, heights, "SampledRoad", "heights")

    def __call__(self, t):
        return jnp.interp(t, self.times, self.heights)
