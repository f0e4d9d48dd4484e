"""What a run that fails leaves of its derivative.

Its states are those of the numerical trajectory up to the step that failed, and NaN from there on. The derivative of
the first ones is theirs whatever follows. But back substitution meets the rows of the others first, and 0 × NaN is NaN:
one lane of a batch that failed, masked or not, would make NaN of a gradient by what all lanes share. So rules linearize
the last state before instead, at each later time, that of the reference where there is none, and what they find is

    forwards:     δ_n → NaN,
    backwards:    c_n = 0 → 0,  else NaN:

who asks for nothing of the states that there are not has a derivative, and who asks for them has none.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from lgsens.dynamics import AbstractSystem, State
from lgsens.linear import LinearEquations, linear_solve


class Sound(NamedTuple):
    """The states of a run, the last one before it failed in place of those after it, or the reference where it did not
    begin; and which those are."""

    states: State
    failed: Bool[Array, " n+1"]

    @classmethod
    def of(cls, states: State, system: AbstractSystem) -> "Sound":
        known = jnp.all(jnp.isfinite(states.v), axis=1) & jnp.all(jnp.isfinite(states.a), axis=1)
        first = jnp.where(jnp.all(known), known.size, jnp.argmin(known))
        failed, last = jnp.arange(known.size) >= first, jnp.maximum(first - 1, 0)

        zero = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0]), states)
        home = eqx.tree_at(lambda state: (state.q, state.v), zero, lax.stop_gradient(system.reference()))

        def filled(leaf, home):
            one = jnp.where(first > 0, lax.dynamic_index_in_dim(leaf, last, keepdims=True), home)
            return jnp.where(_along(failed, leaf), one, leaf)

        return cls(jax.tree.map(filled, states, home), failed)

    def lost(self, rows: Any) -> Any:
        """Rows of floats, NaN where the run has failed: one by one, so that what nobody asks for has no derivative."""
        return jax.tree.map(lambda leaf: linear_solve(_LOST, self.failed, leaf), rows)

    def asked(self, rows: Any) -> Any:
        """The transpose: cotangents, NaN where the run has failed and they are not zero."""
        return jax.tree.map(partial(_asked, self.failed), rows)


def _along(failed, leaf):
    return jnp.expand_dims(failed, range(1, leaf.ndim))


def _lost(failed, leaf):
    return jnp.where(_along(failed, leaf), jnp.nan, leaf)


def _asked(failed, leaf):
    none = jnp.where(leaf == 0.0, 0.0, jnp.nan).astype(leaf.dtype)
    return jnp.where(_along(failed, leaf), none, leaf)


_LOST = LinearEquations(lambda failed, x: x, _lost, _asked)
