"""Random poses of two bodies, and quantities as functions of a displacement x = [δx_a, δθ_a, δx_b, δθ_b] of them."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from lgsens.model import Frame, RigidBody, moved
from lgsens.testing._differences import (
    NODES,
    NOISE_POINTS,
    SAFETY,
    default_step,
    difference,
    noise,
    noise_spacing,
)
from lgsens.testing._report import Check

COORDINATES = tuple(f"{axis}_{body}" for body in "ab" for axis in ("x", "y", "z", "rx", "ry", "rz"))
DIM = len(COORDINATES)
SEPARATION = 4.0  # of two bodies, in lengths: far enough that points do not meet
SPREAD = 0.5  # of points, in lengths, and of a displacement, in lengths and radians


def displaced(a: Frame, b: Frame, x) -> tuple[Frame, Frame]:
    """Both frames after the displacement x, shape (12,)."""
    return moved(a, x[:6]), moved(b, x[6:])


class ScenePoses:
    """Random poses of a scene of some length [m]."""

    def __init__(self, seed: int, length: float):
        self.rng = np.random.default_rng(seed)
        self.length = length
        self.sizes = np.tile([length] * 3 + [1.0] * 3, 2)  # a large change of each coordinate: a length, a radian
        self.dtype = jnp.result_type(float)

    def frames(self, count: int = 2) -> list[Frame]:
        """ScenePoses some lengths apart."""
        frames = []
        for i in range(count):
            position = self.length * (SPREAD * self.rng.standard_normal(3) + np.array([SEPARATION * i, 0.0, 0.0]))
            rotation, _ = np.linalg.qr(self.rng.standard_normal((3, 3)))
            rotation = rotation * np.sign(np.linalg.det(rotation))
            frames.append(Frame(jnp.asarray(position, self.dtype), jnp.asarray(rotation, self.dtype)))
        return frames

    def bodies(self, names) -> dict[str, RigidBody]:
        """Bodies of unit mass, by name."""
        frames = zip(names, self.frames(len(names)))
        return {name: RigidBody(1.0, (1.0, 1.0, 1.0), frame.position, frame.orientation) for name, frame in frames}

    def ends(self, a: str | None, b: str | None, bodies: Mapping[str, RigidBody]) -> tuple[list[Frame], np.ndarray]:
        """The frames of two bodies, and which coordinates can move: not those of the ground."""
        ground = Frame(jnp.zeros(3, self.dtype), jnp.eye(3, dtype=self.dtype))
        frames = [ground if name is None else bodies[name].frame for name in (a, b)]
        own = [np.arange(6) + 6 * i for i, name in enumerate((a, b)) if name is not None]
        return frames, np.concatenate(own)

    def displacement(self, free: np.ndarray):
        """A random displacement, or velocity, of the coordinates `free`; shape (12,)."""
        x = np.zeros(DIM)
        x[free] = SPREAD * self.rng.standard_normal(len(free)) * self.sizes[free]
        return jnp.asarray(x, self.dtype)

    def points(self, free: np.ndarray):
        """Displacements for `sampled`: close ones for round-off, and those of differences along every coordinate."""
        near = np.arange(NOISE_POINTS)[:, None] * noise_spacing(self.dtype) * np.asarray(self.displacement(free))
        axes = np.eye(DIM)[free] * self.sizes[free, None]
        around = default_step(self.dtype) * np.asarray(NODES, float)[:, None, None] * axes
        return jnp.asarray(np.concatenate([near, around.reshape(-1, DIM)]), self.dtype)

    def sampled(self, values: Mapping[str, Any], free: np.ndarray) -> dict[str, "SampledQuantity"]:
        """Quantities from their values at `points`."""
        found = {}
        for key, array in values.items():
            array = np.asarray(array)
            sigma = noise(array[:NOISE_POINTS])
            stencil = array[NOISE_POINTS:].reshape(len(NODES), len(free), *array.shape[1:])
            slope = difference(stencil, default_step(self.dtype), sigma)
            derivative, tolerance = (np.moveaxis(part, 0, -1) / self.sizes[free] for part in slope)
            found[key] = SampledQuantity(array[0], float(sigma.max(initial=0.0)), derivative, tolerance, free)
        return found


class SampledQuantity(NamedTuple):
    """A quantity at one point: its value, its round-off, and its derivative along the coordinates `free`."""

    value: np.ndarray
    sigma: float
    slope: np.ndarray
    slope_tolerance: np.ndarray
    free: np.ndarray

    def entry(self, expected: np.ndarray, error: np.ndarray) -> str:
        """Where an error is largest, and what is there; the last axis is that of coordinates."""
        index = np.unravel_index(np.argmax(np.where(np.isnan(error), np.inf, error)), error.shape)
        place = ", ".join([*map(str, index[:-1]), COORDINATES[self.free[index[-1]]]])
        return f"[{place}]: {self.value[index]:.6g}, not {expected[index]:.6g}"


def same(name: str, given: SampledQuantity, expected: SampledQuantity, compared: str = "given, autodiff") -> Check:
    """Two ways to one quantity: their entries differ by the round-off of both."""
    error = np.abs(given.value - expected.value)
    largest = float(np.abs(expected.value).max(initial=0.0))
    tolerance = SAFETY * (given.sigma + expected.sigma + float(np.finfo(error.dtype).eps) * largest)
    return Check(name, compared, float(np.max(error)), tolerance, given.entry(expected.value, error))


def slope(name: str, derivative: SampledQuantity, quantity: SampledQuantity) -> Check:
    """A derivative, and the differences of what it is the derivative of."""
    tolerance = quantity.slope_tolerance + SAFETY * derivative.sigma
    error = np.abs(derivative.value - quantity.slope)
    ratio = np.where(np.isfinite(error), error / np.maximum(tolerance, np.finfo(error.dtype).tiny), np.inf)
    index = np.unravel_index(np.argmax(ratio), ratio.shape)
    note = derivative.entry(quantity.slope, ratio)
    return Check(name, "autodiff, differences", float(error[index]), float(tolerance[index]), note)


def vanishes(name: str, compared: str, quantity: SampledQuantity, size: float) -> Check:
    """A quantity that is zero, but for the round-off of terms of that size."""
    eps = float(np.finfo(quantity.value.dtype).eps)
    return Check(name, compared, float(np.abs(quantity.value).max()), SAFETY * (quantity.sigma + eps * size))
