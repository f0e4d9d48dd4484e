"""Steps that end where the equations of motion break.

A force that has a kink inside of a step costs the scheme its order there: what it adds to the error depends on where in
the step the kink is, so errors do not fall evenly, and neither extrapolation nor a scheme of high order has anything to
gain. Where a signal says when it breaks (`breaks`: the ends of a bump, of a ramp, the samples of a table), steps can
end there, and are of one size from one break to the next.

Numbers of steps. The K pieces of lengths L_j have two steps each, which Gregory's rule takes (`time_integral`), and the
N − 2 K others are theirs in proportion to length, by rounding what adds up: with S_j = L_1 + … + L_j

    m_1 + … + m_j = 2 j + round((N − 2 K) S_j/S_K).

So that 2n steps are the halves of n, this is done for N = n/2^r, as small as it may be and still 48 or more and 2 K or
more; each of these is divided into 2^r. With fewer than 2 K steps, all are equal.

Numbers of steps are constant for derivatives; where steps end moves with the breaks (`_pieces.moved`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.integrate._generalized_alpha import GeneralizedAlpha
from lgsens.integrate._given import AbstractUnevenSteps, GivenSteps
from lgsens.integrate._grid import Steps
from lgsens.integrate._integrator import Laid
from lgsens.integrate._pieces import moved, piece_ends, piece_lengths, pieces_within
from lgsens.integrate._scheme import AbstractScheme, scheme_of
from lgsens.integrate._uneven_grid import UnevenGrid

_FEWEST = 48  # so that pieces are in proportion to within a few per cent
_LEAST = 2  # steps in each piece
_HALVINGS = 24


class AlignedSteps(AbstractUnevenSteps):
    """Steps that end at the breaks of a scene, and are equal between them: an integrator of `simulate`.

    Breaks are the times at which a signal, or a derivative of it, jumps, as far as the signals of the scene say so
    (`AbstractSignal.breaks`): both ends of a `BumpRoad` and of a `Ramp`, the samples of a `SampledRoad` and of
    `Sampled`. Where derivatives jump, what is computed in so many steps has the order of the scheme, and can be
    extrapolated: `Richardson(AlignedSteps())`. Where the signal itself jumps, it is of first order, as in any steps,
    and so is an integral of accelerations or forces over a time at which these jump, with its derivatives. Breaks at
    times that depend on the motion (a contact that opens) are not known.

    Arguments:
        integrator: the scheme, `GeneralizedAlpha` or another one.

    `num_steps` steps are shared among the pieces between breaks in proportion to their lengths, and each piece has two
    at least. Where there are not so many, all steps are equal, and so they are where nothing breaks. Twice as many
    steps are the halves of these, from 48 steps on. Under `vmap` each design has its own. The derivative is that of the
    numerical solution at these numbers of steps, exactly: the ends of pieces move with the times of breaks, t0 and t1,
    and steps with them, the times of a `Trajectory` too. But numbers of steps change by whole ones from piece to piece,
    and what is computed jumps there by as much as it is wrong, so a search over times of breaks goes better in numbers
    that stay: `GivenSteps.of(trajectory)`.

    Raises `ValueError` for what is no scheme in steps. Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential
    Equations I (2008), §II.6 (discontinuities).
    """

    integrator: AbstractScheme = eqx.field(static=True, default=GeneralizedAlpha())

    def __check_init__(self):
        scheme_of("AlignedSteps", self.integrator)

    def lay(self, system, start, t0, t1, num_steps):
        counted = isinstance(num_steps, Steps)
        steps, room = (num_steps.count, num_steps.room) if counted else (jnp.asarray(num_steps, t0.dtype), num_steps)
        steps, lengths, ends, total = jax.lax.stop_gradient(
            (steps, piece_lengths(system, t0, t1), piece_ends(system, t0, t1), t1 - t0)
        )
        sizes = total * aligned_sizes(lengths / jnp.sum(lengths), steps, room)
        fit = _LEAST * pieces_within(lengths)[-1] <= steps  # else no step ends at a break, but by chance
        known, now = (jnp.where(fit, ends, ends[-1]) for ends in (ends, piece_ends(system, t0, t1)))
        sizes, begins = moved(sizes, known, now)
        how = {"room": counted, "count": steps if counted else None, "fixed": True, "moving": begins}
        return Laid(UnevenGrid.first(t0, sizes, restarts=self.integrator.restarts(system), **how))

    @property
    def equal_pieces(self):
        return True

    def frozen(self, trajectory):
        return GivenSteps.of(trajectory, self.integrator)


def undivided(pieces):
    """The least number of steps through so many pieces that is not halved any further."""
    return jnp.maximum(_LEAST * pieces, _FEWEST)


def aligned_sizes(lengths: Float[Array, " k"], count: Float[Array, ""], room: int) -> Float[Array, " room"]:
    """The sizes of `count` steps through pieces of these lengths, whose sum is 1, then zeros; equal ones, where there
    are not two for each piece."""
    share, pieces = jnp.cumsum(lengths), pieces_within(lengths)
    least = _LEAST * pieces
    divided = count / 2.0 ** jnp.arange(_HALVINGS, dtype=count.dtype)
    halvings = jnp.sum((divided == jnp.floor(divided)) & (divided >= undivided(pieces[-1]))) - 1
    each = 2.0 ** jnp.maximum(halvings, 0).astype(count.dtype)
    last = each * (least + jnp.round((count / each - least[-1]) * share))  # the number of steps up to each end
    n = jnp.arange(room, dtype=count.dtype)
    piece = jnp.minimum(jnp.searchsorted(last, n, side="right"), last.size - 1)
    taken = jnp.diff(last, prepend=0.0)[piece]
    sizes = jnp.where(least[-1] <= count, lengths[piece] / jnp.where(taken > 0.0, taken, 1.0), 1.0 / count)
    return jnp.where(n < count, sizes, 0.0)
