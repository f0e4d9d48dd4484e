"""The pieces of an interval between the times at which equations of motion break.

Steps that end at breaks move with them. Let breaks at times s_j − t0 have been where the sizes h_n of steps were found,
and be at e_j now, 0 and t1 − t0 among both, at the ends of steps m_j. Then the steps between two of them are

    h_n (e_{j+1} − e_j)/(s_{j+1} − s_j),        m_j ≤ n < m_{j+1},

which is h_n where nothing has moved, but has the derivative by times of breaks, t0 and t1. Without it a criterion whose
integrand jumps at a break, as accelerations and forces of drivers do, would lack the share [F] ė_j of its derivative in
any number of steps, and others be right to first order only. Ratios of sizes change in the first step of a piece
alone. Several breaks at one end of a step move it by half of the first and half of the last.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens.dynamics import breaks_of

MANY = 256  # pieces: more are the samples of a table, which are many for steps to end at each
SHORTEST = 1e-6  # of the interval: a break that is no farther from another one is that
_MET = 0.1  # of a step: so near to its end a break is there
_SEEN = 3.0  # steps in a piece, at whose ends something of what happens there is seen


def piece_ends(scene: Any, t0, t1) -> Float[Array, " k+1"]:
    """The ends of the pieces into which the breaks of a scene divide the time from t0 to t1, as times from t0 on."""
    breaks, total = breaks_of(scene).astype(t0.dtype) - t0, t1 - t0
    before, behind = breaks <= 0.0, breaks >= total
    return jnp.append(jnp.sort(jnp.where(before, 0.0, jnp.where(behind, total, breaks))), total)


def piece_lengths(scene: Any, t0, t1) -> Float[Array, " k+1"]:
    """The lengths of these pieces; some are 0."""
    lengths = jnp.diff(piece_ends(scene, t0, t1), prepend=0.0)
    return jnp.where(lengths > SHORTEST * (t1 - t0), lengths, 0.0)


def nearest_ends(
    t: Float[Array, " n+1"], times: Float[Array, " k"], within: float
) -> tuple[Int[Array, " k"], Bool[Array, " k"]]:
    """Which of the ends of steps is nearest to each of some times, and whether it is within such a part of a step."""
    after = jnp.clip(jnp.searchsorted(t, times), 1, t.size - 1)
    to_after, to_before = t[after] - times, times - t[after - 1]
    nearest = jnp.where(to_after <= to_before, after, after - 1)
    return nearest, jnp.minimum(jnp.abs(to_after), jnp.abs(to_before)) <= within * (to_after + to_before)


def moved(
    sizes: Float[Array, " n"], known: Float[Array, " k"], ends: Float[Array, " k"]
) -> tuple[Float[Array, " n"], Float[Array, " n"] | None]:
    """Steps that were laid where pieces ended at `known`, for pieces that end at `ends`; and 1 for each step that is
    the first of a piece, else 0, None: all are of one piece."""
    if known.size == 1:
        return sizes * (ends[0] / known[0]), None
    nodes = jnp.concatenate([jnp.zeros_like(sizes[:1]), jnp.cumsum(sizes)])
    at, met = nearest_ends(nodes, known, _MET)
    # A break at which no step ends is none: like the last one before it.
    last = lax.cummax(jnp.where(met.at[-1].set(True), jnp.arange(at.size), -1))
    at = jnp.where(last < 0, 0, at[last])
    first, final = jnp.searchsorted(at, at), jnp.searchsorted(at, at, side="right") - 1

    def anchors(ends):
        """With the begin; several at one end of a step are one."""
        own = jnp.where(last < 0, 0.0, ends[last])
        own = jnp.where(at == at[-1], ends[-1], jnp.where(at == 0, 0.0, 0.5 * (own[first] + own[final])))
        return jnp.concatenate([jnp.zeros_like(own[:1]), own])

    n = jnp.arange(sizes.size, dtype=at.dtype)
    through = jnp.minimum(jnp.searchsorted(at, n, side="right"), at.size - 1)  # the piece of each step
    now, then = (of[through + 1] - of[through] for of in map(anchors, (ends, known)))
    begins = (n > 0) & (n < at[-1]) & (jnp.searchsorted(at, n) != jnp.searchsorted(at, n, side="right"))
    return sizes * jnp.where(then > 0.0, now / jnp.where(then > 0.0, then, 1.0), 1.0), begins.astype(sizes.dtype)


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
