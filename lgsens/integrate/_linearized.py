"""One converged step, linearized: what the sweeps of the sensitivities know of a scheme.

With E(y_n, y_{n+1}; p) = 0 the equations of a step, y the state, δ its variation, and p' that of the parameters,

    E_{y⁺} δ_{n+1} + E_y δ_n + E_p p' = b.

The rows b and the variations have the same parts (`Variation`). A linearized step solves forwards, δ_{n+1} from δ_n,
the loads E_p p' and b, and backwards: with μ the multipliers of the rows and c the cotangent of δ_{n+1},

    E_{y⁺}ᵀ μ = c,     c_n += −E_yᵀ μ,     p̄ += −E_pᵀ μ.

E_p p' is the tangent of a function of the parameters, `AbstractScheme.loads`, at the fixed converged step, and −E_pᵀ μ
the pull-back of `c_loads` through the same function. By hand or not, both directions are checked against each other
and against the rows of E themselves.
"""

import abc
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens.dynamics import State


class Variation(NamedTuple):
    """δ of one state (or, stacked, of a trajectory) in Lie-algebra coordinates; also one row of the equations."""

    w: Float[Array, " k"]
    v: Float[Array, " k"]
    vdot: Float[Array, " k"]
    lam: Float[Array, " m"]
    a: Float[Array, " k"]
    inner: Any = None

    @classmethod
    def of(cls, w, rest: State) -> "Variation":
        """With all but w as in `rest`."""
        return cls(w, rest.v, rest.vdot, rest.lam, rest.a, rest.inner)

    @classmethod
    def none(cls, states: State) -> "Variation":
        """That of a state, or of stacked ones, which does not vary."""
        return jax.tree.map(jnp.zeros_like, cls.of(states.v, states))


class Node(NamedTuple):
    """One step in time, or a tangent or cotangent of it."""

    begin: Float[Array, ""]
    t: Float[Array, ""]  # its end
    h: Float[Array, ""]

    @property
    def behind(self) -> Float[Array, ""]:
        """Just behind the begin: a break that is no later is at it, but for round-off of times."""
        return self.begin + float(jnp.finfo(self.h.dtype).eps) ** 0.5 * lax.stop_gradient(self.h)


class AbstractLinearizedStep(eqx.Module):
    """The linearized equations of one step, with what solves them."""

    @abc.abstractmethod
    def forward(self, shared: Any, node: Node, previous: Variation, loads: Any, row: Variation) -> Variation:
        """δ_{n+1} from δ_n, E_p p' and b; `shared`, what all steps share, is no part of what is stacked for each."""

    def backward(self, shared: Any, node: Node, c: Variation, loads: Any) -> tuple[Variation, Any, Variation]:
        """c_n, `c_loads` and μ from c, here by JAX's transposition of `forward`; `loads`: in shape."""
        return jax.linear_transpose(partial(self.forward, shared, node), c, loads, c)(c)


class DenseLinearizedStep(AbstractLinearizedStep):
    """The matrices of E as arrays: what a scheme without a linearization of its own has."""

    lu: tuple[Array, Array]  # of E_{y⁺}
    by_previous: Float[Array, "n n"]  # E_y

    def forward(self, shared, node, previous, loads, row):
        flat, unravel = ravel_pytree(row)
        rhs = flat - ravel_pytree(loads)[0] - self.by_previous @ ravel_pytree(previous)[0]
        return unravel(jsl.lu_solve(self.lu, rhs))

    def backward(self, shared, node, c, loads):
        flat, unravel = ravel_pytree(c)
        mu = jsl.lu_solve(self.lu, flat, trans=1)
        return unravel(-(mu @ self.by_previous)), unravel(-mu), unravel(mu)
