"""The pieces of an interval between the times at which equations of motion break."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import breaks_of

MANY = 256  # pieces: more are the samples of a table, which are many for steps to end at each
_SHORTEST = 1e-6  # of the interval: a break that is no farther from another one is that
_SEEN = 3.0  # steps in a piece, at whose ends something of what happens there is seen


def piece_lengths(scene: Any, t0, t1) -> Float[Array, " k+1"]:
    """The lengths of the pieces into which the breaks of a scene divide the time from t0 to t1; some are 0."""
    ends = jnp.concatenate([jnp.sort(jnp.clip(breaks_of(scene).astype(t0.dtype), t0, t1)), t1[None]])
    lengths = jnp.diff(ends, prepend=t0[None])
    return jnp.where(lengths > _SHORTEST * (t1 - t0), lengths, 0.0)


def pieces_within(lengths: Float[Array, " k"]) -> Float[Array, " k"]:
    """How many of the first pieces are not empty."""
    return jnp.cumsum(jnp.where(lengths > 0.0, jnp.ones_like(lengths), 0.0))


class PieceEnds(NamedTuple):
    """Where steps under error control are to end, from t0 on: at breaks, unless there are too many of them."""

    ends: Float[Array, " k"]

    @classmethod
    def of(cls, scene: Any, t0, total, most: int = MANY) -> "PieceEnds":
        lengths = piece_lengths(scene, t0, t0 + total)
        ends, taken = jnp.cumsum(lengths), pieces_within(lengths)[-1] <= most
        return cls(jnp.where((ends < ends[-1]) & taken, ends, total))

    def after(self, elapsed) -> tuple[Any, Any]:
        """The end of the piece in which a step begins, and the longest step that it may have; None: any."""
        if self.ends.size == 1:
            return self.ends[0], None
        i = jnp.minimum(jnp.searchsorted(self.ends, elapsed, side="right"), self.ends.size - 1)
        begin = jnp.where(i > 0, self.ends[i - 1], 0.0)
        return self.ends[i], (self.ends[i] - begin) / _SEEN

    def inside(self, t0) -> Array | None:
        """The times of breaks, as `jump_ts` of diffrax: others are behind the end; None: there are none."""
        if self.ends.size == 1:
            return None
        between = (self.ends > 0.0) & (self.ends < self.ends[-1])
        return lax.stop_gradient(t0 + jnp.where(between, self.ends, 2.0 * self.ends[-1]))
