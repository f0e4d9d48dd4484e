"""Road profiles, signals of time.

Random roads. The height z of an ISO 8608 road has the power spectral density G_d(n) = G_d(n_0) (n/n_0)⁻² over wave
numbers n. Passed at the speed V, f = V n, its rate has (2πf)² G_d(f/V)/V, the same at every frequency f: white noise,
one-sided in Hz and as E[ż(t) ż(t + τ)] = S δ(τ)

    G_ż = (2π n_0)² G_d(n_0) V = 2 S.

z itself has no variance: over time steps Δt it grows by independent normal numbers of variance S Δt. Samples made so
are exact, and what lies between them has a rate with the spectral density S sinc²(f Δt).

Source: ISO 8608:2016; of the classes of its annex C, the geometric means of their roughness.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from lgsens._validate import as_float, number_field, require, suggestion
from lgsens.model._sampled import samples
from lgsens.model._signals import AbstractSignal

# G_d(n_0) [m³] at n_0 = 0.1 cycles/m of each class of roads.
ISO_8608 = {name: 16e-6 * 4.0**i for i, name in enumerate("ABCDEFGH")}


def road_roughness(roughness) -> Float[Array, ""]:
    """G_d(n_0) [m³], given as a number or as the class of the road.

    Raises `ValueError` for a class that is not one of ISO 8608, and a number of another shape or not positive.
    """
    if isinstance(roughness, str):
        if roughness not in ISO_8608:
            raise ValueError(f"`roughness`: {suggestion(roughness, ISO_8608)}, the classes of ISO 8608.")
        roughness = ISO_8608[roughness]
    return _positive("roughness", roughness)


def _positive(name: str, value) -> Float[Array, ""]:
    value = as_float(value, (), f"`{name}`")
    require(lambda value: 0.0 < value < jnp.inf, lambda: f"`{name}` must be positive, got {value}.", value)
    return value


def rate_intensity(roughness, speed, wave_number) -> Float[Array, ""]:
    """S = (2π n_0)² G_d(n_0) V/2 [m²/s] of the rate of a random road.

    Raises `ValueError` for a class that is not one of ISO 8608, and numbers of another shape or not positive.
    """
    roughness, speed = road_roughness(roughness), _positive("speed", speed)
    wave_number = _positive("wave_number", wave_number)
    return (2.0 * jnp.pi * wave_number) ** 2 * roughness * speed / 2.0


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
            lambda: f"BumpRoad: `duration` must be positive, got {self.duration} s.",
            self.duration,
        )

    @property
    def breaks(self):
        return jnp.stack([self.start, self.start + self.duration], axis=-1)

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

    @property
    def straight(self):
        return True

    @property
    def breaks(self):
        return self.times

    @staticmethod
    def random(key: Key[Array, ""], times, *, roughness, speed, wave_number=0.1) -> "SampledRoad":
        """A random road of ISO 8608, passed at constant speed: z = 0 at the first of the times.

            z(t_{i+1}) = z(t_i) + √(S (t_{i+1} − t_i)) ξ_i,     S = (2π n_0)² G_d(n_0) V/2,     ξ_i normal

        Arguments:
            key: of the random numbers, `jax.random.key(0)`; another key, another road.
            times: sample times [s], shape (n,), increasing: those of the time steps, as what is between is straight.
            roughness: G_d(n_0) [m³], shape (), positive, or the class of the road, "A" to "H".
            speed: V [m/s], shape (), positive.
            wave_number: n_0 [cycles/m], shape (), positive.

        `lgsens.random_road` has the deviations of a linear car on it. A road without bounds of its wave numbers: it
        wanders off by √(S t), with all of what stands on it. Raises `ValueError` for times that do not increase, other
        classes, and numbers that are not positive. Source: ISO 8608:2016; `lgsens/model/_roads.py`.
        """
        times = as_float(times, None, "SampledRoad: `times`")
        start = SampledRoad(times, jnp.zeros_like(times))
        intensity = rate_intensity(roughness, speed, wave_number)
        growth = jnp.sqrt(intensity * jnp.diff(times)) * jax.random.normal(key, (times.size - 1,), times.dtype)
        return SampledRoad(times, start.heights.at[1:].set(jnp.cumsum(growth)))

    def __call__(self, t):
        return jnp.interp(t, self.times, self.heights)
