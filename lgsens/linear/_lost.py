"""Rows of numbers that are lost, of steps or positions that failed: their values are NaN, and so are their derivatives,

    forwards:     δ → NaN,
    backwards:    c = 0 → 0,  else NaN:

who asks for nothing of a row that there is not has a derivative, and who asks for it has none. A selection would have
derivatives of zero in both modes, and a product with NaN would have NaN of rows that nobody asked for.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from lgsens._xla import one_program
from lgsens.linear._linear_solve import LinearEquations, linear_solve


@one_program
def lost(failed: Bool[Array, "*n"], rows: Any) -> Any:
    """Rows of floats, or a single one, NaN where they have failed: one by one, so that what nobody asks for has no
    derivative."""
    return jax.tree.map(lambda leaf: linear_solve(_LOST, failed, leaf), rows)


@one_program
def sound(failed: Bool[Array, " n"], rows: Any, home: Any) -> Any:
    """Rows to compute with: in place of those that have failed the last one before the first of them, or `home`."""
    first = jnp.where(jnp.any(failed), jnp.argmax(failed), failed.size)

    def of(leaf, home):
        one = jnp.where(first > 0, lax.dynamic_index_in_dim(leaf, jnp.maximum(first - 1, 0), keepdims=True), home)
        return jnp.where(_along(failed, leaf), one, 0.0) + linear_solve(_SET_ASIDE, failed, leaf)

    return jax.tree.map(of, rows, home)


def asked(failed: Bool[Array, " n"], rows: Any) -> Any:
    """The transpose: cotangents, NaN where rows have failed and they are not zero."""
    return jax.tree.map(partial(_asked, failed), rows)


def _along(failed, leaf):
    return failed.reshape(failed.shape + (1,) * (leaf.ndim - failed.ndim))


def _lost(failed, leaf):
    return jnp.where(_along(failed, leaf), jnp.nan, leaf)


def _set_aside(failed, leaf):
    return jnp.where(_along(failed, leaf), 0.0, leaf)


def _asked(failed, leaf):
    return jnp.where(_along(failed, leaf), jnp.where(leaf == 0.0, 0.0, jnp.nan).astype(leaf.dtype), leaf)


_LOST, _SET_ASIDE = (LinearEquations(lambda failed, x: x, solve, _asked) for solve in (_lost, _set_aside))
