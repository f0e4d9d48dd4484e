"""The interface of a matrix Lie group."""

import abc
from typing import Any, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# An element of a group: an array or a pytree of arrays. A tangent to it has the same structure.
Element = Any


class AbstractLieGroup(eqx.Module):
    """A `k`-dimensional matrix Lie group `G`: all that the integrator knows of the configuration space.

    Variations are left-invariant, `δq = q (δq)~` (eq. 3): coordinates `x, w` in `R^k` are those of the Lie
    algebra, and rotational ones refer to the body frame. All methods act on one element, follow the dtype of
    their arguments and can be differentiated twice wherever they are smooth. A group is static data: it is
    hashable and has no leaf.

    Source: paper, §2 and §6.2; Brüls & Cardona 2010, §2.
    """

    @property
    @abc.abstractmethod
    def dim(self) -> int:
        """The dimension `k` of the group."""

    @abc.abstractmethod
    def identity(self, dtype=None) -> Element:
        """The neutral element `e`, its arrays of `dtype` (default: JAX's default float)."""

    @abc.abstractmethod
    def compose(self, p: Element, q: Element) -> Element:
        """The product `p q` (eq. 1)."""

    @abc.abstractmethod
    def inverse(self, q: Element) -> Element:
        """The inverse `q^{-1}`."""

    @abc.abstractmethod
    def exp(self, x: Float[Array, " k"]) -> Element:
        """The exponential map `q = exp(x~)` (§2, before eq. 7). `x`: coordinates, shape (k,)."""

    @abc.abstractmethod
    def log(self, q: Element) -> Float[Array, " k"]:
        """The coordinates `x`, shape (k,), of smallest norm with `exp(x~) = q`."""

    @abc.abstractmethod
    def wedge(self, x: Float[Array, " k"]) -> Float[Array, "m m"]:
        """The matrix `x~` of the Lie algebra (eq. 3, the paper's tilde). `x`: coordinates, shape (k,)."""

    @abc.abstractmethod
    def vee(self, X: Float[Array, "m m"]) -> Float[Array, " k"]:
        """The coordinates, shape (k,), of a matrix of the Lie algebra: the inverse of `wedge`."""

    @abc.abstractmethod
    def matrix(self, q: Element) -> Float[Array, "m m"]:
        """The matrix that represents `q` faithfully (eq. 20): `matrix(p∘q) = matrix(p) matrix(q)`."""

    @abc.abstractmethod
    def ad_mv(self, x: Float[Array, " k"], y: Float[Array, " k"]) -> Float[Array, " k"]:
        """The Lie bracket, `(ad(x) y)~ = [x~, y~] = x~ y~ - y~ x~` (eqs. 5-6). `x, y`: shape (k,)."""

    @abc.abstractmethod
    def Ad_inv_mv(self, q: Element, w: Float[Array, " k"]) -> Float[Array, " k"]:
        """`D(q) w` with `(D(q) w)~ = q^{-1} w~ q` (§6.2). `w`: coordinates, shape (k,)."""

    @abc.abstractmethod
    def Ad_inv_rmv(self, q: Element, w: Float[Array, " k"]) -> Float[Array, " k"]:
        """`D(q)^T w`, the transpose of `Ad_inv_mv`. `w`: a covector (generalized force), shape (k,)."""

    @abc.abstractmethod
    def tangent_mv(self, x: Float[Array, " k"], y: Float[Array, " k"]) -> Float[Array, " k"]:
        """`T(x) y`, where `q^{-1} dq = (T(x) dx)~` for `q = exp(x~)` (eq. 9). `x, y`: shape (k,)."""

    @abc.abstractmethod
    def tangent_rmv(self, x: Float[Array, " k"], y: Float[Array, " k"]) -> Float[Array, " k"]:
        """`T(x)^T y`, the transpose of `tangent_mv`. `y`: a covector (generalized force), shape (k,)."""

    @abc.abstractmethod
    def tangent_inv_mv(self, x: Float[Array, " k"], y: Float[Array, " k"]) -> Float[Array, " k"]:
        """`T(x)^{-1} y`, the inverse of `tangent_mv`, where `T(x)` is regular. `x, y`: shape (k,)."""

    @abc.abstractmethod
    def to_ambient(self, q: Element, w: Float[Array, " k"]) -> Element:
        """The tangent `δq = q w~` (eq. 3) of the arrays of `q`, in the pytree structure of `q`."""

    @abc.abstractmethod
    def from_ambient(self, q: Element, dq: Element) -> Float[Array, " k"]:
        """The coordinates `w`, shape (k,), with `δq = q w~` (eq. 3).

        `dq` has the structure of `q`. What it holds outside the tangent space at `q` is projected away.
        """

    @final
    def retract(self, q: Element, x: Float[Array, " k"]) -> Element:
        """The element `q exp(x~)` (eqs. 7 and 24). `x`: coordinates of the increment, shape (k,)."""
        return self.compose(q, self.exp(x))

    @final
    def ad(self, x: Float[Array, " k"]) -> Float[Array, "k k"]:
        """The matrix of `ad_mv` (eqs. 5-6), shape (k, k)."""
        return _dense(lambda y: self.ad_mv(x, y), self.dim, x.dtype)

    @final
    def Ad_inv(self, q: Element) -> Float[Array, "k k"]:
        """The matrix `D(q)` of `Ad_inv_mv` (§6.2), shape (k, k)."""
        dtype = jnp.result_type(*jax.tree.leaves(q))
        return _dense(lambda w: self.Ad_inv_mv(q, w), self.dim, dtype)

    @final
    def tangent(self, x: Float[Array, " k"]) -> Float[Array, "k k"]:
        """The matrix `T(x)` of `tangent_mv` (eq. 9), shape (k, k)."""
        return _dense(lambda y: self.tangent_mv(x, y), self.dim, x.dtype)

    @final
    def tangent_inv(self, x: Float[Array, " k"]) -> Float[Array, "k k"]:
        """The matrix `T(x)^{-1}` of `tangent_inv_mv`, shape (k, k)."""
        return _dense(lambda y: self.tangent_inv_mv(x, y), self.dim, x.dtype)


def _dense(mv, dim, dtype):
    return jax.vmap(mv, out_axes=1)(jnp.eye(dim, dtype=dtype))
