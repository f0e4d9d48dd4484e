"""Where steps serve criteria best: sizes from what each step of a pilot run adds to errors.

Row k of the pilot's n equal steps of size H adds up to an error E_k (`_defect_density`). With other sizes, the defects
of a scheme of order two being h³ times functions of time,

    E_k(h) = ∫ c_k(t) h(t)² dt,     c_k = (what the pilot's step adds)/H³,     in ∫ dt/h steps.

**Regardless of signs** the largest bound, ∫ |c| h² dt with |c|² = Σ_k c_k², is least for a given number of steps where
h ∝ |c|^{−1/3}: every step adds as much. |c| is taken as its largest value nearby, and no step is longer than about
`longest` of the pilot's, which resolves the motion also where no criterion looks.

**With signs.** Defects oscillate with the motion, and most of them cancel, in steps whose sizes follow |c| by chance.
The steps are laid in up to 32 plateaus of equal ones (a change of size costs a factorization), and the logarithms x of
the sizes of the plateaus are moved, by a tenth or so, to where

    |E(x)|² + μ |x|²,     μ = 0.1 (∫ |c| h² dt)²/(number of plateaus)

is least, by the method of Levenberg and Marquardt: what cancels then does so for designs nearby too.

Source: Becker & Rannacher, Acta Numerica 10 (2001), doi:10.1017/S0962492901000010, §3 and §5 (meshes that equilibrate
weighted residuals).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_PLATEAUS = 32
_LEAST = 2  # steps in each
_NEARBY = 1 / 60  # of the run
_HELD = 0.1  # μ
_ITERATIONS = 30


class Placed(NamedTuple):
    """Sizes as fractions of the run, and the errors E_k of each row expected with them, regardless of signs as well."""

    fractions: Float[Array, " m"]
    errors: Float[Array, " r"]
    bounds: Float[Array, " r"]


def placed_steps(rows: Float[Array, "r n"], num_steps: int, longest: int) -> Placed:
    """The sizes of so many steps, none longer than about `longest` of the pilot's; where no row says anything, or one
    is not finite, equal ones."""
    plateaus = min(_PLATEAUS, 2 ** int(np.log2(max(num_steps / _LEAST, 1))))  # few programs
    counts = np.full(plateaus, num_steps // plateaus)
    counts[: num_steps % plateaus] += 1
    steps = jnp.asarray(counts, rows.dtype)
    lengths, errors, bounds = _plateaus(rows, steps, longest)
    return Placed(jnp.repeat(lengths / steps, counts, total_repeat_length=num_steps), errors, bounds)


@eqx.filter_jit
def _plateaus(rows: Float[Array, "r n"], counts: Float[Array, " j"], longest: int):
    """The lengths of plateaus with so many steps each, as fractions of the run, the errors and their bounds."""
    n, num_steps = rows.shape[1], jnp.sum(counts)
    edges = jnp.linspace(0.0, 1.0, n + 1, dtype=rows.dtype)
    until = lambda cells: jnp.concatenate([jnp.zeros_like(cells[..., :1]), jnp.cumsum(cells, axis=-1)], axis=-1)

    width = max(round(n * _NEARBY), 1)
    size = jnp.pad(jnp.linalg.norm(rows, axis=0), width, mode="edge")
    weight = jnp.cbrt(jnp.max(jnp.stack([size[k : k + n] for k in range(2 * width + 1)]), axis=0))
    for _ in range(4):  # what is lifted raises the mean
        weight = jnp.maximum(weight, jnp.minimum(n / (longest * num_steps), 1.0) * jnp.mean(weight))
    weight = jnp.where(jnp.all(weight > 0.0), weight, 1.0)  # NaN is not
    ends = until(weight)
    first = jnp.diff(jnp.interp(until(counts) / num_steps, ends / ends[-1], edges))

    def lengths(x):
        moved = first * jnp.exp(x)
        return moved / jnp.sum(moved)

    def errors(rows, lengths):
        """What the pilot's steps add up to over each plateau, times (h/H)²."""
        of_plateaus = jnp.diff(jax.vmap(lambda row: jnp.interp(until(lengths), edges, until(row)))(rows), axis=1)
        return of_plateaus @ (n * lengths / counts) ** 2

    held = _HELD / counts.shape[0] * jnp.sum(errors(jnp.abs(rows), first) ** 2)
    held = jnp.where(held > 0.0, held, 1.0)

    def residual(x):
        return jnp.concatenate([errors(rows, lengths(x)), jnp.sqrt(held) * x])

    def moved(state, _):
        x, least, damping = state
        r, J = residual(x), jax.jacfwd(residual)(x)
        new = x - jnp.linalg.solve(J.T @ J + damping * held * jnp.eye(x.shape[0], dtype=x.dtype), J.T @ r)
        reached = jnp.sum(residual(new) ** 2)
        better = reached < least
        state = jnp.where(better, new, x), jnp.where(better, reached, least), damping * jnp.where(better, 0.2, 4.0)
        return state, None

    begin = jnp.zeros_like(first), jnp.sum(errors(rows, first) ** 2), jnp.ones((), rows.dtype)
    (x, *_), _ = jax.lax.scan(moved, begin, length=_ITERATIONS)
    found = lengths(x)
    return found, errors(rows, found), errors(jnp.abs(rows), found)
