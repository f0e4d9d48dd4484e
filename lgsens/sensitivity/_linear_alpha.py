"""Generalized-α on a linear space, for the linear equations of the continuous methods (§6.1 and §7).

    M ẍ + D(t) ẋ + K(t) x + B(t)ᵀλ = l(t),     B(t) x = g(t)

The sensitivities of §6.1 satisfy equations of this kind, and so do the adjoint variables of §7 in the time that runs
backwards. With u = a_{n+1}, and x*, ẋ*, ẍ* the values at u = 0 of eqs. (27)–(29) written for a linear space,

    [[c M + γh D + βh² K,  Bᵀ],   [u; λ] = [l − M ẍ* − D ẋ* − K x*;  (g − B x*)/(βh²)]
     [B,                   0 ]]

This matrix is not the iteration matrix of eq. (30): the continuous methods need factors of their own. The columns of
x are right-hand sides (parameters or criteria), and share them.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import kkt_solve, mass_scale
from lgsens.integrate import GeneralizedAlpha
from lgsens.linear import Factors


class LinearNode(NamedTuple):
    """The equations at one time."""

    damping: Float[Array, "k k"]  # D
    stiffness: Float[Array, "k k"]  # K
    constraint_jacobian: Float[Array, "m k"]  # B
    load: Float[Array, "k c"]  # l
    level: Float[Array, "m c"]  # g


class LinearMotion(NamedTuple):
    """The solution at one time: x, ẋ, ẍ, λ, and the algorithmic acceleration a."""

    x: Float[Array, "k c"]
    rate: Float[Array, "k c"]
    acceleration: Float[Array, "k c"]
    lam: Float[Array, "m c"]
    a: Float[Array, "k c"]


def start(
    scheme: GeneralizedAlpha, mass, nodes: tuple[LinearNode, LinearNode, LinearNode, LinearNode], s, x, rate, h
) -> LinearMotion:
    """The starting values that follow from x and ẋ at the first of four nodes, the others at distances s_i h from it.

    The second derivative of the constraint would give ẍ; it asks for B̈ and g̈. Here x is instead a polynomial of degree
    four through x_0 and ẋ_0, with y_d = h^d x^(2+d)_0, d = 0, 1, 2, that solves the equations at the three later nodes,
    i = 1, 2, 3, with s = s_i:

        M ẍ_i + D_i ẋ_i + K_i x_i + B_iᵀλ_i = l_i,      B_i x_i = g_i
        ẍ_i = Σ s^d/d! y_d,   ẋ_i = ẋ_0 + h Σ s^(d+1)/(d+1)! y_d,   x_i = x_0 + s h ẋ_0 + h² Σ s^(d+2)/(d+2)! y_d

    ẍ_0 is then accurate to O(h³) and x⃛_0 to O(h²). (A cubic through two nodes has order 2 as well, but an h³ that hid
    it down to h = 3e-4 s in a terminal criterion of the quarter-car.)
    """
    k, m = nodes[0].load.shape[0], nodes[0].level.shape[0]
    scale = mass_scale(mass)
    none, empty = jnp.zeros((k, m), mass.dtype), jnp.zeros((m, m), mass.dtype)
    dynamic, constraints, loads, levels = [], [], [], []
    for i, node in enumerate(nodes[1:], 1):
        jacobian = scale * node.constraint_jacobian
        weights = [[s[i - 1] ** (d + n) / math.factorial(d + n) for d in range(3)] for n in range(3)]
        columns = [
            weights[0][d] * mass + (h * weights[1][d]) * node.damping + (h**2 * weights[2][d]) * node.stiffness
            for d in range(3)
        ]
        dynamic.append([*columns, *(jacobian.T if n == i else none for n in (1, 2, 3))])
        constraints.append([*(weights[2][d] * jacobian for d in range(3)), empty, empty, empty])
        free = x + (s[i - 1] * h) * rate
        loads.append(node.load - node.damping @ rate - node.stiffness @ free)
        levels.append(scale * (node.level - node.constraint_jacobian @ free) / h**2)
    solution = jnp.linalg.solve(jnp.block([*dynamic, *constraints]), jnp.concatenate([*loads, *levels]))
    acceleration, jerk = solution[:k], solution[k : 2 * k]
    first = nodes[0]
    left = first.load - mass @ acceleration - first.damping @ rate - first.stiffness @ x
    _, lam = kkt_solve(mass, first.constraint_jacobian, left, jnp.zeros_like(first.level))
    a = acceleration + (scheme.alpha_m - scheme.alpha_f) * jerk
    return started(scheme, mass, first.constraint_jacobian, LinearMotion(x, rate, acceleration, lam, a), h)


def started(scheme: GeneralizedAlpha, mass, jacobian, exact: LinearMotion, h) -> LinearMotion:
    """What the scheme starts from, given exact values and a = ẍ_0 + (α_m − α_f) h x⃛_0.

    ẋ_0 receives h² P c, c = (1/6 − β − Δ/2) x⃛_0, Δ = α_m − α_f: as in `simulate` for the nonlinear scheme; here T = I.
    """
    if not scheme.second_order_start:
        return exact._replace(a=exact.acceleration)
    delta = scheme.alpha_m - scheme.alpha_f
    missed = ((1.0 / 6.0 - scheme.beta - delta / 2.0) / delta) * (exact.a - exact.acceleration)
    tangential, _ = kkt_solve(mass, jacobian, mass @ missed, jnp.zeros_like(exact.lam))
    return exact._replace(rate=exact.rate + h * (missed - tangential))


def advance(scheme: GeneralizedAlpha, mass, previous: LinearMotion, node: LinearNode, h, ratio) -> LinearMotion:
    """One step, `ratio` times as long as the one before: one factorization, one solve for all columns."""
    previous = previous._replace(a=scheme.resized_acceleration(previous.acceleration, previous.a, ratio))
    x = previous.x + h * previous.rate + (h**2 * (0.5 - scheme.beta)) * previous.a
    rate = previous.rate + (h * (1.0 - scheme.gamma)) * previous.a
    acceleration = (scheme.alpha_m * previous.a - scheme.alpha_f * previous.acceleration) / (1.0 - scheme.alpha_f)
    jacobian = node.constraint_jacobian
    dynamic = scheme.inertia_factor * mass + (scheme.gamma * h) * node.damping + (scheme.beta * h**2) * node.stiffness
    factors = Factors.of(dynamic, jacobian.T, jacobian, mass_scale(mass))
    u, lam = factors.solve(
        node.load - mass @ acceleration - node.damping @ rate - node.stiffness @ x,
        (node.level - jacobian @ x) / (scheme.beta * h**2),
    )
    return LinearMotion(
        x=x + (scheme.beta * h**2) * u,
        rate=rate + (scheme.gamma * h) * u,
        acceleration=acceleration + scheme.inertia_factor * u,
        lam=lam,
        a=u,
    )
