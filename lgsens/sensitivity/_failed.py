"""What a run that fails leaves of its derivative.

Its states are those of the numerical trajectory up to the step that failed, and NaN from there on. The derivative of
the first ones is theirs whatever follows. But back substitution meets the rows of the others first, and 0 × NaN is NaN:
one lane of a batch that failed, masked or not, would make NaN of a gradient by what all lanes share. So rules linearize
the last state before instead, at each later time, that of the reference where there is none, and what they find is
`lost`: who asks for nothing of the states that there are not has a derivative, and who asks for them has none.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lgsens._xla import one_program
from lgsens.dynamics import AbstractSystem, State
from lgsens.linear import asked, lost, sound


class Sound(NamedTuple):
    """The states of a run, the last one before it failed in place of those after it, or the reference where it did not
    begin; and which those are."""

    states: State
    failed: Bool[Array, " n+1"]

    @classmethod
    def of(cls, states: State, system: AbstractSystem) -> "Sound":
        return cls(*_sound(states, *lax.stop_gradient(system.reference())))

    def lost(self, rows: Any) -> Any:
        """Rows of floats, NaN where the run has failed: what nobody asks for has no derivative."""
        return lost(self.failed, rows)

    def asked(self, rows: Any) -> Any:
        """The transpose: cotangents, NaN where the run has failed and they are not zero."""
        return asked(self.failed, rows)


@one_program
def _sound(states: State, q: Any, v: Float[Array, " k"]) -> tuple[State, Bool[Array, " n+1"]]:
    known = jnp.all(jnp.isfinite(states.v), axis=1) & jnp.all(jnp.isfinite(states.a), axis=1)
    zero = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0]), states)
    home = eqx.tree_at(lambda state: (state.q, state.v), zero, (q, v))
    return sound(~known, states, home), ~known
