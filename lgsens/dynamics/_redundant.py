"""Redundant constraints: rows of B that are linearly dependent in every configuration.

A door on two hinges, a planar linkage of revolute joints, the Bricard mechanism: some n ≠ 0 have Bᵀn = 0. The motion is
unique, λ is not: λ + n gives the same forces Bᵀλ on every coordinate. Which n there are changes with q, how many does
not: the rank of B is constant.

Motion. A step solves, with small compliances c in place of zero,

    r(q, v, v̇, λ, t) = 0,     Φ(q)/(βh²) − c λ = 0,          S = [[A, Bᵀ], [B T, −diag(c)]].

S is regular: the Schur complement −B T A⁻¹ Bᵀ − diag(c) is negative definite for any B (so block elimination without
exchanges stays possible too). For n above, n·Φ(q) = O(Φ²), therefore n·(c λ) = 0 to the round-off of Φ: among all λ of
the same Bᵀλ the step takes the one of least Σ c_i λ_i². Joints give way by Φ = βh² c λ, which moves the solution by
O(ε h²), ε the size of c relative to B M⁻¹ Bᵀ: ε times what the scheme itself leaves. This system is differentiated, and
not its limit: row (26) of the sensitivities has −c λ' in addition, and −2Φ h'/(βh³), as Φ is not zero at the solution.
λ enters the motion through Bᵀλ only, so c is a constant for all derivatives. The start moves the joints by what they
give way; else ε would be excited in accelerations (5e-6 of the four-bar's at ε = 1e-7, for tens of steps).

Multipliers. The round-off of Φ leaves eps/(βh²)/ε of n in λ. Nobody asks for λ along n before it is read, so it
is made there what it is said to be, the multipliers that minimize Σ d_i λ_i² for given Bᵀλ. With λ̂ = √d λ and
B̂ = B/√d that is the orthogonal projection of λ̂ on the range of B̂,

    λ̂⁺ = λ̂ − lim_{δ → 0} [δ (B̂B̂ᵀ + δI)⁻¹]^k λ̂,

where k factors leave (δ/(δ + σ²))^k of what belongs to a singular value σ of B̂, and round-off is multiplied by the
part along n over δ, which is small. This is smooth where the rank of B is constant; derivatives pass through it, those
of d included. Before it any λ will do that has the right Bᵀλ, and any λ' with the right derivative of Bᵀλ.

Physics. d_i are compliances: by the principle of least work these are the forces in joints that all give way alike,
by d metres per newton, in the limit of d → 0.

Initial state. K = [[M, Bᵀ], [B, 0]] is singular and its equations are consistent: y ← y + K_c⁻¹ (b − K y) with −diag(c)
in the corner of K_c leaves ε^k of the error after k iterations (proximal point method).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax import lax
from jaxtyping import Array, Float, Int

from lgsens._xla import one_program, while_loop
from lgsens.dynamics._constraints import full_jacobian
from lgsens.dynamics._system import AbstractSystem

SOFTNESS = 1e-7  # ε
_REGULARIZATION = 1e-7  # δ, relative to the mean square of a row of B̂: three iterations leave 1e-21/σ⁶
_ITERATIONS = 3
_MOST_ITERATIONS = 300
_FALLS = 0.99  # what round-off leaves along n does not
_ENOUGH = 1e-12  # of the first correction


def softness(system: AbstractSystem) -> Float[Array, " m"] | None:
    """c; None: no constraint may be redundant."""
    return None if system.compliance is None else SOFTNESS * lax.stop_gradient(system.compliance)


def require_independent(system: AbstractSystem, method: str) -> None:
    """Raise `ValueError` where constraints may be redundant, for a method that cannot treat that."""
    if softness(system) is not None:
        raise ValueError(
            f"{method} needs independent constraints, and the model has redundant='minimum_norm'. "
            "Model(…, redundant='remove') leaves out what repeats; so do free='x y rz' of the bodies of a planar "
            "mechanism, and joints with fewer equations (`constraint_rank` names them). `equilibrium`, `kinematics`, "
            "and steps of GeneralizedAlpha with DirectDifferentiation() or AdjointVariable() take the model as it is."
        )


class _Refined(NamedTuple):
    solution: Any
    first: Any  # the largest entry of each part of the first correction
    change: Float[Array, ""]  # by the last one, in such
    before: Float[Array, ""]  # by the one before
    count: Int[Array, ""]


def refined(product: Callable, solve: Callable, rhs):
    """The solution of K y = b by solves with K_c, as long as each changes it by less than the one before.

    What ε^k is where all is alike is (ε/(ε + σ²))^k beside a body that is lighter than others by 1/σ².
    """
    largest = lambda tree: jax.tree.map(lambda part: jnp.max(jnp.abs(part), initial=0.0), tree)

    def corrected(solution):
        correction = solve(jax.tree.map(jnp.subtract, rhs, product(solution)))
        return jax.tree.map(jnp.add, solution, correction), largest(correction)

    def iterate(now: _Refined) -> _Refined:
        solution, sizes = corrected(now.solution)
        parts = zip(jax.tree.leaves(sizes), jax.tree.leaves(now.first))
        change = jnp.max(jnp.stack([own / jnp.where(of == 0.0, 1.0, of) for own, of in parts]))
        return _Refined(solution, now.first, change, now.change, now.count + 1)

    def improves(now: _Refined):
        return (now.change < _FALLS * now.before) & (now.change > _ENOUGH) & (now.count < _MOST_ITERATIONS)

    solution, first = corrected(solve(rhs))
    one = jnp.ones((), jax.tree.leaves(first)[0].dtype)
    return while_loop(improves, iterate, _Refined(solution, first, one, 2.0 * one, jnp.zeros((), jnp.int32))).solution


@one_program
def least_norm(system: AbstractSystem, q, lam: Float[Array, " m"], t) -> Float[Array, " m"]:
    """The multipliers of least Σ d_i λ_i² with the same Bᵀλ, at one instant; λ itself if none may be redundant."""
    if system.compliance is None:
        return lam
    root = jnp.sqrt(system.compliance)
    # Any metric of the coordinates gives the same projection; this one makes them comparable.
    rows = full_jacobian(system, q, t) * lax.stop_gradient(system.coordinate_scale())[None, :] / root[:, None]
    normal = rows @ rows.T
    shift = _REGULARIZATION * lax.stop_gradient(jnp.trace(normal) / len(root))
    factor = jnp.linalg.cholesky(normal + shift * jnp.eye(len(root), dtype=lam.dtype), symmetrize_input=False)
    along = root * lam
    for _ in range(_ITERATIONS):
        along = shift * jsl.cho_solve((factor, True), along)
    return lam - along / root
