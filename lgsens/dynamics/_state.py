"""The state of a constrained system at one instant, as the integrator carries it."""

from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from lgsens.linear import Matrix


class State(eqx.Module):
    """Position, velocity, acceleration, multipliers and auxiliary acceleration at one instant.

    Arrays carry a leading time axis when the state is that of a whole trajectory.

    Attributes:
        q: element of the Lie group (its own pytree of arrays).
        v: velocity v = (q⁻¹ q̇)^∨ of eq. (10), shape (k,).
        vdot: its time derivative v̇, shape (k,).
        lam: Lagrange multipliers λ of the constraints, shape (m,).
        a: the algorithmic acceleration of the generalized-α scheme, eq. (29), shape (k,).
        inner: what a scheme has found within the step that ends here (stages), a pytree of arrays; None: nothing.

    Source: Sonneville & Brüls (2014), §3–4.
    """

    q: Any
    v: Float[Array, " k"]
    vdot: Float[Array, " k"]
    lam: Float[Array, " m"]
    a: Float[Array, " k"]
    inner: Any = None


class Tangents(NamedTuple):
    """The matrices of the linearized equations of motion, §3.1.

    δr = K_t δq + C_t δv + M δv̇ + Bᵀ δλ  and  δΦ = B δq, at one state.
    """

    stiffness: Matrix  # K_t, (k, k)
    damping: Matrix  # C_t, (k, k)
    constraint_jacobian: Matrix  # B, (m, k); with rows of velocity level [B; A]
