"""How much each step of a run adds to the errors of criteria and of their gradients.

Let L e = b be the equation of the error of a run, b its defects (`_error_estimate`), and Ψ a criterion. With the
adjoint variables Lᵀ z = Ψ_y the error of Ψ is Ψ_y e = Σ_n z_n·b_n: what a step misses, times what Ψ makes of it. The
trapezoidal rule adds −h/12 Δ²F of its own. So

    Ψ(true) − Ψ ≈ Σ_n η_n,     d/dp of it ≈ Σ_n dη_n/dp,

η_n = O(h³). dη_n/dp has as many columns as there are parameters; of its norm over p, which is what counts, the products
with a few random directions d_k tell enough: for D = √P Q, Q of orthonormal columns, the mean of (g·d_k)² is |g|² on
average, and exactly that if there are as many directions as parameters. A product is one derivative of η in forward
mode, by the rules for second derivatives of a trajectory.

Source: Becker & Rannacher, Acta Numerica 10 (2001), doi:10.1017/S0962492901000010 (dual weighted residuals);
Hutchinson, Communications in Statistics 19 (1990) 433 (norms from random directions).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens.criteria._criterion import Criterion
from lgsens.criteria._error_estimate import corrected, error_by_defects, smooth_defects
from lgsens.criteria._known_motion import known_motion, unpacked
from lgsens.integrate import AbstractScheme
from lgsens.simulation import Trajectory

_DIRECTIONS = 8


class Densities(NamedTuple):
    """Errors that add up over the n steps of a run, and what c criteria would be without them.

    Attributes:
        rows: relative to each criterion; the first is η_n/|Ψ|, the squares of the k others add up to that of dη_n/dp
            over |dΨ/dp|.
        values: Ψ + Σ_n η_n.
        slopes: their products with the directions.
        directions: d_k.
        trajectory: the run.
    """

    rows: Float[Array, "c 1+k n"]
    values: Float[Array, " c"]
    slopes: Float[Array, "c k"]
    directions: Float[Array, "k p"]
    trajectory: Trajectory


@eqx.filter_jit
def defect_densities(
    criteria: tuple[Criterion, ...],
    build: Callable[[Any], Any],
    start: Callable[[Any], Any] | None,
    p: Any,
    t0,
    t1,
    num_steps: int,
    scheme: AbstractScheme,
) -> Densities:
    """Of a run in equal steps."""
    # in this program, so that what is refused is so before anything is compiled
    motion = unpacked(known_motion(build, start, p, t0, t1, num_steps, scheme))
    known = motion.known
    flat, unravel = ravel_pytree(p)

    def terms(states, system, flat):
        p = unravel(flat)
        trajectory = motion.trajectory(scheme, states, system)
        parameters = known.parameters._replace(system=system)
        b = smooth_defects(scheme, system, parameters.grid, trajectory.states)
        if b is None:
            raise ValueError(
                f"What {scheme!r} misses in its steps is not known: GeneralizedAlpha of index 3 says it, if no force "
                "depends on the multipliers (friction in joints) and no driver breaks (a Ramp, a Sampled). "
                "AlignedSteps end at breaks, and AdaptiveSteps has steps for the motion by any scheme."
            )

        def without(error):
            run = corrected(trajectory, error)
            return jnp.stack([criterion(run, p) for criterion in criteria])

        error = lambda b: error_by_defects(scheme, trajectory.states, parameters, b, known.linear)
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(error, b))
        to_defects = jax.linear_transpose(error, b)
        z = jax.vmap(lambda row: to_defects(row)[0])(jax.jacrev(without)(none))
        products = jax.tree.map(lambda z, b: jnp.sum(z * b[None], axis=2), z, b)
        of_motion = jnp.sum(jnp.stack(jax.tree.leaves(products)), axis=0)
        of_motion = of_motion[:, 1:].at[:, 0].add(of_motion[:, 0])  # what the start misses goes with the first step
        of_rule = jnp.stack([_missed_by_rule(criterion, trajectory, p) for criterion in criteria])
        values = jnp.stack([criterion(trajectory, p) for criterion in criteria])
        return (of_motion + of_rule, values), trajectory

    at = known.states, known.parameters.system, flat
    (eta, values), derivative, trajectory = jax.linearize(terms, *at, has_aux=True)
    size = flat.shape[0]
    directions = jax.random.normal(jax.random.key(0), (size, min(size, _DIRECTIONS)), flat.dtype)
    along = jnp.sqrt(size / directions.shape[1]) * jnp.linalg.qr(directions)[0].T
    d_eta, d_values = jax.vmap(lambda direction: derivative(*motion.along(direction)))(along)
    norms = jnp.sqrt(jnp.sum(d_values**2, axis=0))
    relative = lambda rows, to: rows / jnp.where(to == 0.0, 1.0, to)  # NaN where a value or a gradient is
    of_values = relative(eta, jnp.abs(values)[:, None])[:, None]
    of_gradients = relative(jnp.moveaxis(d_eta, 0, 1), norms[:, None, None])
    rows = jnp.concatenate([of_values, of_gradients], axis=1)
    slopes = jnp.moveaxis(d_values + jnp.sum(d_eta, axis=2), 0, 1)
    return Densities(rows, values + jnp.sum(eta, axis=1), slopes, along, trajectory)


def _missed_by_rule(criterion: Criterion, trajectory: Trajectory, p) -> Float[Array, " n"]:
    """−h³/12 F̈ of each step, from second differences at its ends."""
    t, states, system = trajectory.t, trajectory.states, trajectory.system
    rates = jax.vmap(lambda state, t: criterion.rate(system, state, t, p))(states, t)
    bends = jnp.diff(rates, 2)
    bends = jnp.concatenate([bends[:1], (bends[1:] + bends[:-1]) / 2.0, bends[-1:]])
    return -jnp.diff(t) / 12.0 * bends
