"""The index-reduced equations with the step sizes of diffrax: `IndexReducedODE` with `rtol`.

From one output time to the next the equations of `lgsens.integrate._explicit` are integrated under error control, with
diffrax's derivative, and the drift is taken out at the output time. An interval is recomputed in reverse mode: only the
states at the output times are kept.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._xla import scan
from lgsens.dynamics import AbstractSystem, Inertia, State, factorized_accelerations, shared_inertia
from lgsens.integrate import EqualGrid, IndexReducedODE, PieceEnds, Stats, ended, with_first


class _Local(NamedTuple):
    """The state in coordinates at q_n, or its rate."""

    x: Float[Array, " k"]
    v: Float[Array, " k"]


class _Problem(eqx.Module):
    """What all steps share."""

    inertia: Inertia | None
    system: AbstractSystem

    def rate(self, q, local: _Local, t) -> _Local:
        group = self.system.group
        vdot, _ = factorized_accelerations(self.inertia, self.system, group.retract(q, local.x), local.v, t)
        return _Local(group.tangent_inv_mv(local.x, local.v), vdot)


def _adaptive(settings: IndexReducedODE, problem: _Problem, q, v, t, h, running):
    """From one output time to the next under error control; nowhere unless `running`."""
    import diffrax  # takes its time to import

    jumps = PieceEnds.of(problem.system, t, h, settings.max_steps // 4).inside(t)  # each takes a step at least
    rtol = 0.0 if settings.rtol is None else settings.rtol
    atol = rtol if settings.atol is None else settings.atol
    reverse = diffrax.RecursiveCheckpointAdjoint(checkpoints=settings.max_steps)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, local, args: args[0].rate(args[1], local, t)),
        diffrax.Tsit5() if settings.solver is None else settings.solver,
        *(t, jnp.where(running, t + h, t), h, _Local(jnp.zeros_like(v), v), (problem, q)),
        # the largest entry, so that more bodies do not loosen the control
        stepsize_controller=diffrax.ClipStepSizeController(
            diffrax.PIDController(rtol, atol, norm=_largest), jump_ts=jumps
        ),
        adjoint=reverse if settings.mode == "reverse" else diffrax.ForwardMode(),
        max_steps=settings.max_steps,
        throw=False,
    )
    assert solution.ys is not None
    local = jax.tree.map(lambda leaf: leaf[0], solution.ys)
    return local, solution.result == diffrax.RESULTS.successful, solution.stats["num_steps"]


def _largest(tree) -> Float[Array, ""]:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]))


def integrate_ode(settings: IndexReducedODE, system: AbstractSystem, grid: EqualGrid, first: State):
    """The states at the times of the grid, stacked along a leading axis, and what happened in between.

    An interval that fails ends the simulation: its end and all after it are NaN, and `Stats` says so.
    """
    problem, t0, h = _Problem(shared_inertia(system), system), grid.t0, grid.h

    def interval(problem: _Problem, begin: State, n, running):
        local, finished, steps = _adaptive(settings, problem, begin.q, begin.v, t0 + n * h, h, running)
        q = problem.system.group.retract(begin.q, local.x)
        end, _, left = ended(problem.inertia, problem.system, q, local.v, t0 + (n + 1) * h)
        return end, left, finished, steps

    # In reverse mode nothing is kept of an interval but how it begins.
    interval = jax.checkpoint(interval, prevent_cse=False)

    def step(carry, n):
        begin, running = carry
        end, left, finished, steps = interval(problem, begin, n, running)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(end)]))
        converged = running & finished & finite
        end = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), end)
        steps = jnp.where(running, steps, 0).astype(jnp.int32)
        return (end, converged), (end, Stats(steps, 0.0 * h, left, converged, jnp.full_like(h, jnp.inf)))

    count = jnp.arange(grid.num_steps, dtype=h.dtype)
    later, stats = scan(step, (first, jnp.ones((), bool)), count)[1]
    return with_first(first, later), stats
