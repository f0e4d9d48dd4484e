"""Difference quotients and round-off, both with an estimate of their error.

Round-off. Values of f at points so close that f is straight there scatter by round-off alone. Of n values with an
independent scatter of deviation σ, the k-th differences have the variance σ² (2k)!/(k!)², and the smooth part of f
leaves only its k-th power of the spacing (Moré & Wild, Estimating computational noise, SIAM J. Sci. Comput. 33, 2011).

Differences. With f_k = f(k h), of sixth and of fourth order,

    D₆ = (45 (f₁ − f₋₁) − 9 (f₂ − f₋₂) + (f₃ − f₋₃)) / (60 h),     D₄ = (8 (f₁ − f₋₁) − (f₂ − f₋₂)) / (12 h)

The error of D₆ is below |D₆ − D₄|, which is that of D₄, but for round-off: at most 110 σ/(60 h), by the sum of the
weights.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Array

from lgsens.liegroups import SO3

NODES = (-3, -2, -1, 1, 2, 3)
_SIXTH = np.array([-1.0, 9.0, -45.0, 45.0, -9.0, 1.0]) / 60.0
_FOURTH = np.array([0.0, 1.0, -8.0, 8.0, -1.0, 0.0]) / 12.0
NOISE_POINTS = 16
# Round-off from sixteen values is known to a fifth, and the largest error of many entries is some deviations. (Of eight
# a right joint comes to 1.02 of its tolerance in one of 12 seeds, of sixteen to 0.36.)
SAFETY = 10.0


def default_step(dtype) -> float:
    """h where the truncation of D₄, h⁴, and its round-off, ε/h, are of one size."""
    return float(np.finfo(dtype).eps) ** 0.2


def noise_spacing(dtype) -> float:
    """The distance of the points for `noise`, whose third power is far below round-off."""
    return float(np.finfo(dtype).eps) ** 0.5


def noise(samples: np.ndarray) -> np.ndarray:
    """The deviation by round-off of each entry of f, from values at equally spaced points along the first axis.

    No less than half a unit in the last place.
    """
    estimates = [np.finfo(samples.dtype).eps / 2 * np.abs(samples[0])]
    for k in (3, 4, 5):
        estimates.append(np.sqrt(np.mean(np.diff(samples, k, axis=0) ** 2, axis=0) / math.comb(2 * k, k)))
    return np.max(estimates, axis=0)


class Difference(NamedTuple):
    """A derivative by differences, and the largest error that truncation and round-off explain, entry by entry."""

    value: np.ndarray
    tolerance: np.ndarray


def difference(samples: np.ndarray, step: float, sigma: np.ndarray) -> Difference:
    """The derivative of f at 0 from its values at `NODES` times `step` along the first axis; `sigma`: its round-off."""
    sixth, fourth = (np.tensordot(weights, samples, 1) / step for weights in (_SIXTH, _FOURTH))
    round_off = SAFETY * sigma * np.abs(_SIXTH).sum() / step
    return Difference(sixth, np.abs(sixth - fourth) + round_off)


class Direction(NamedTuple):
    """A way to move one leaf: along `along` by s, or, a rotation matrix, R exp(s ẽ) with e = `along` of shape (3,)."""

    name: str
    leaf: Array
    along: Array
    is_rotation: bool

    def moved(self, s: float):
        """The leaf at a distance."""
        if self.is_rotation:
            return SO3().retract(self.leaf, self.along * s)
        return self.leaf + s * self.along

    def tangent(self, s: float = 0.0):
        """The derivative of `moved` there."""
        return SO3().to_ambient(self.moved(s), self.along) if self.is_rotation else self.along


def is_rotation(name: str, leaf: Array) -> bool:
    """Whether a leaf is a rotation matrix, which differences may not leave: an `orientation`."""
    return name.rpartition(".")[2] == "orientation" and leaf.shape == (3, 3)
