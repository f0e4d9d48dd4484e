"""The scalar functions of `s = θ²` in the formulas of SO(3), to round-off with two derivatives.

With Stumpff's functions `c_k(s) = Σ_j (-s)^j / (k + 2j)!`,

    c_1 = sin θ / θ,    c_2 = (1 - cos θ) / θ²,    c_3 = (θ - sin θ) / θ³,

entire in `s`, which is why the argument is `s` and not `θ` (`θ = |x|` has no derivative at 0). Closed forms lose
digits for small `s`: in the second derivative of `c_3`, `2 (1 - c_1)/s³` stands against a result of about `2/7!`.
Hence Taylor below `SWITCH`, a large angle: θ = 3 loses eight times less than θ = 2 (measured in the second derivative
of `c_3`), for two terms more. The first term left out there is `n (n-1) s^(n-2) / (2n+3)!`: 6e-21 for `s = 9` and
`n = 14`, against 4e-4 for the whole. The absolute terms of `c_1` add up to `sinh(3)/3 = 3.3`, so the alternating sum
loses nothing.

For `T^{-1}`, with the partial fractions of the cotangent,

    e = (1 - (θ/2) cot(θ/2)) / θ² = Σ_{n ≥ 1} 2 / (p_n - s),    p_n = (2πn)²,

of which all derivatives are sums of positive terms below the pole at `θ = 2π`: nothing cancels, and there is no switch.
The terms n = 1, 2 as they are, the others as a power series, Σ_j s^j Σ_{n ≥ 3} 2 / p_n^(j+1): at 2π each of its terms
is 9 times smaller than the one before. The first one left out of the second derivative there is 7e-16 of their sum.
"""

import math
from fractions import Fraction

import jax.numpy as jnp

SWITCH = 9.0  # θ = 3
_TERMS = 14


def _stumpff(k):
    return tuple(float(Fraction((-1) ** j, math.factorial(k + 2 * j))) for j in range(_TERMS))


_C1, _C2, _C3 = _stumpff(1), _stumpff(2), _stumpff(3)


def _others(k):
    """Σ_{n ≥ 3} n^-k, from m = 256 on by Euler-Maclaurin; its next term is 1e-18 of the whole for k = 2."""
    m = 256.0
    tail = m ** (1 - k) / (k - 1) + m**-k / 2 + k * m ** (-k - 1) / 12 - k * (k + 1) * (k + 2) * m ** (-k - 3) / 720
    return math.fsum(float(n) ** -k for n in range(3, int(m))) + tail


_POLES = tuple((2.0 * math.pi * n) ** 2 for n in (1, 2))
_REST = tuple(2.0 * _others(2 * j + 2) / _POLES[0] ** (j + 1) for j in range(20))


def horner(coefficients, s):
    """The polynomial `Σ_j coefficients[j] s^j`; Python floats, so in the dtype of `s`."""
    value = jnp.full_like(s, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * s + c
    return value


def _switched(series, closed, s):
    """`closed`: numerator and denominator, from s, θ/2 and its sine and cosine."""
    # Both branches see only arguments where they are finite: derivatives through `where` are then finite too.
    small = s < SWITCH
    s_small, s_large = jnp.where(small, s, 0.0), jnp.where(small, SWITCH, s)
    half = 0.5 * jnp.sqrt(s_large)
    # Half angles: 1 - cos θ = 2 sin²(θ/2) keeps its relative accuracy up to θ = 2π, where 1/c_2 has its pole.
    numerator, denominator = closed(s_large, half, jnp.sin(half), jnp.cos(half))
    # The division comes last: what ends in one XLA computes once, and does not fuse the series into each of the 27
    # products of a rotated frame (four times the time of a retraction, where fusions are not one function).
    return jnp.where(small, horner(series, s_small), numerator) / jnp.where(small, 1.0, denominator)


def c1(s):
    """`sin θ / θ`, `s = θ²`."""
    return _switched(_C1, lambda s, half, sin, cos: (sin * cos, half), s)


def c2(s):
    """`(1 - cos θ) / θ²`, `s = θ²`."""
    return _switched(_C2, lambda s, half, sin, cos: (2.0 * sin * sin, s), s)


def c3(s):
    """`(θ - sin θ) / θ³`, `s = θ²`."""
    return _switched(_C3, lambda s, half, sin, cos: (half - sin * cos, half * s), s)


def inverse_tangent_coefficient(s, order=0):
    """`(1 - (θ/2) cot(θ/2)) / θ²`, `s = θ²`, or its derivative by s of this `order`; a pole at `θ = 2π`."""
    series = horner([math.perm(j, order) * c for j, c in enumerate(_REST)][order:], s)
    poles = [1.0 / (pole - s) for pole in _POLES]
    return 2.0 * math.factorial(order) * sum(p ** (order + 1) for p in poles) + series
