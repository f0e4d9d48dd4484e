"""Bounded minimization under path constraints, on optax.

With many constraints g_i(x) ≤ 0 (every time step of a trajectory is one, paper eqs. 48–50) and few active,
the augmented Lagrangian needs one gradient per step, whatever their number:

    L(x; μ, ρ) = f(x)/|f(x₀)| + Σ_i [max(0, μ_i + ρ g_i)² − μ_i²] / (2ρ),      μ_i ← max(0, μ_i + ρ g_i)

Adam with a decaying rate descends on L in variables scaled to [0, 1] between the bounds, clipped to them; the
multipliers follow every few steps, and ρ grows while the violation does not fall (Nocedal & Wright 2006,
§17.4).
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, PyTree

from lgsens._progress import progress_bar
from lgsens._validate import as_count
from lgsens.optimize._box import Box, checked_box

PENALTY = 30.0  # ρ at first: f and g are both scaled to about 1
PENALTY_GROWTH = 2.0
LARGEST_PENALTY = 100.0  # a larger one makes L so stiff that Adam only zigzags; μ does the rest
PERIOD = 5  # steps of Adam between two updates of the multipliers
LARGEST_GRADIENT = 1.0  # f is scaled to 1: longer gradients are those of a violation, which Adam would remember
DECAY = 0.02  # the last learning rate over the first
# Shorter memories than Adam's own: these gradients carry no noise, and L changes with μ.
ADAM_DECAYS = (0.5, 0.99)


class History(NamedTuple):
    """The course of a minimization; NumPy arrays with a leading axis over the steps, the first of them at x₀.

    Attributes:
        objective: f, shape (n,).
        worst_constraint: max g, shape (n,); −∞ without constraints.
        gradient_norm: length of the projected gradient step clip(z − ∇L) − z in the scaled variables z, shape
            (n,).
        design: x, its leaves with a leading axis n.
    """

    objective: np.ndarray
    worst_constraint: np.ndarray
    gradient_norm: np.ndarray
    design: PyTree


class OptimizationResult(NamedTuple):
    """The outcome of `minimize`.

    Attributes:
        x: the best design: the lowest objective among those that satisfy the constraints to tolerance, or,
            where none does, the one that violates them least.
        objective: f(x).
        constraints: g(x), in the shape `fun` gave them.
        feasible: whether max g(x) ≤ constraint_tolerance.
        step: the step at which x was found.
        history: the course of the minimization.
        multipliers: μ after the last step, shaped as the constraints: the gain in f/|f(x₀)| per unit by
            which a constraint is relaxed.
        compile_seconds, run_seconds: wall time of the compilation and of the steps [s].
    """

    x: PyTree
    objective: float
    constraints: np.ndarray
    feasible: bool
    step: int
    history: History
    multipliers: np.ndarray
    compile_seconds: float
    run_seconds: float


class _Carry(NamedTuple):
    """What one step hands to the next; all of it traced, so the step is compiled once."""

    z: Float[Array, " n"]
    last_finite: Float[Array, " n"]
    optimizer: optax.OptState
    multipliers: Array  # μ
    penalty: Float[Array, ""]  # ρ
    violation: Float[Array, ""]  # at the last update of μ
    scale: Float[Array, ""]  # |f(x₀)|; 0 until it is known


def minimize(
    fun: Callable[[PyTree], tuple[Float[Array, ""], Array]],
    x0: PyTree,
    *,
    lower: PyTree,
    upper: PyTree,
    num_steps: int,
    learning_rate: float = 0.05,
    log_scale: PyTree = False,
    constraint_tolerance: float = 1e-3,
    progress: bool = True,
    callback: Callable[[int, float, float], None] | None = None,
) -> OptimizationResult:
    """min f(x) subject to g(x) ≤ 0 and lower ≤ x ≤ upper.

    Arguments:
        fun: x ↦ (f, g): the objective, shape (), and the constraints, an array of any shape, each scaled so
            that 1 is a large violation; an empty array for none. Traced once, differentiated in reverse mode.
        x0: where to start, a pytree of arrays within the bounds. It need not satisfy g ≤ 0.
        lower, upper: the bounds, pytrees as x0; a leaf of shape () bounds every entry.
        num_steps: number of evaluations of f, g and one gradient; the first is at x0.
        learning_rate: first step of Adam as a fraction of the distance between the bounds.
        log_scale: whether to search by the logarithm, a bool or a pytree of bools as x0; for positive rates
            whose bounds are a decade apart.
        constraint_tolerance: the g up to which a design satisfies its constraints.
        progress: show a bar, if tqdm is installed (`pip install "lgsens[plot]"`).
        callback: called after each step with (step, f, max g).

    A step into a region where f, g or the gradient is not finite is halved until they are. Raises
    `ValueError` for bounds of another shape than x0, lower ≥ upper, x0 outside them, a logarithmic scale over
    0, `num_steps` < 1, a rate or tolerance that is not positive, and an f or g that is not finite at x0.
    """
    num_steps = as_count(num_steps, "num_steps")
    for name, value in (("learning_rate", learning_rate), ("constraint_tolerance", constraint_tolerance)):
        if not value > 0:
            raise ValueError(f"`{name}` must be positive, got {value}.")
    x, unravel, box = checked_box(x0, lower, upper, log_scale)
    schedule = optax.cosine_decay_schedule(learning_rate, num_steps, DECAY)
    optimizer = optax.chain(optax.clip_by_global_norm(LARGEST_GRADIENT), optax.adam(schedule, *ADAM_DECAYS))
    started = time.perf_counter()
    flat_fun = jax.jit(lambda x: fun(unravel(x)))  # jit keeps its trace: shapes and gradient come from one
    shape = jax.eval_shape(flat_fun, x)
    if not (isinstance(shape, tuple) and len(shape) == 2 and shape[0].shape == ()):
        raise ValueError(f"`fun` must return (objective of shape (), array of constraints), got {shape}.")
    z, dtype = box.scaled(x), x.dtype
    carry = _Carry(
        z=z,
        last_finite=z,
        optimizer=optimizer.init(z),
        multipliers=jnp.zeros(shape[1].shape, dtype),
        penalty=jnp.asarray(PENALTY, dtype),
        violation=jnp.asarray(jnp.inf, dtype),
        scale=jnp.zeros((), dtype),
    )
    step = _make_step(flat_fun, box, optimizer, constraint_tolerance)
    step = jax.jit(step).lower(carry, jnp.asarray(False)).compile()
    compiled = time.perf_counter()

    records: list[tuple] = []
    best: Any = None  # rank, step, x, f, g
    with progress_bar(num_steps, "step", progress) as bar:
        for i in range(num_steps):
            carry, (x, f, g, worst, norm) = step(carry, jnp.asarray(i % PERIOD == PERIOD - 1))
            f, worst = float(f), float(worst)
            if i == 0 and not (np.isfinite(f) and np.all(np.isfinite(g)) and np.isfinite(norm)):
                raise ValueError(
                    f"The objective, a constraint or the gradient is not finite at `x0` (objective {f}); "
                    "start from a design that can be simulated."
                )
            records.append((f, worst, float(norm), np.asarray(x)))
            # Feasible before infeasible, then by objective; among infeasible ones by violation.
            feasible = worst <= constraint_tolerance
            rank = (not feasible, f if feasible else worst)
            if np.isfinite(f) and np.isfinite(norm) and (best is None or rank < best[0]):
                best = (rank, i, x, f, np.asarray(g))
            bar.set_postfix({"objective": f"{f:.4g}", "worst constraint": f"{worst:+.1e}"}, refresh=False)
            bar.update()
            if callback is not None:
                callback(i, f, worst)
    finished = time.perf_counter()

    (infeasible, _), i, x, f, g = best
    columns = [np.asarray(column) for column in zip(*records)]
    return OptimizationResult(
        x=unravel(x),
        objective=f,
        constraints=g,
        feasible=not infeasible,
        step=i,
        history=History(
            objective=columns[0],
            worst_constraint=columns[1],
            gradient_norm=columns[2],
            design=jax.tree.map(np.asarray, jax.vmap(unravel)(jnp.asarray(columns[3]))),
        ),
        multipliers=np.asarray(carry.multipliers),
        compile_seconds=compiled - started,
        run_seconds=finished - compiled,
    )


def _make_step(fun, box: Box, optimizer: optax.GradientTransformation, tolerance: float):
    """One step: f, g and ∇L at z, then Adam on z and, where asked, the update of μ and ρ."""

    def step(carry: _Carry, update_multipliers):
        def lagrangian(z):
            x = box.value(z)
            f, g = fun(x)
            magnitude = jnp.abs(jax.lax.stop_gradient(f))
            first = jnp.where(magnitude > 0, magnitude, 1.0)
            scale = jnp.where(carry.scale > 0, carry.scale, first)
            pushed = jnp.maximum(0.0, carry.multipliers + carry.penalty * g)
            penalty = jnp.sum(pushed**2 - carry.multipliers**2) / (2 * carry.penalty)
            return f / scale + penalty, (x, f, g, scale, pushed)

        (_, (x, f, g, scale, pushed)), gradient = jax.value_and_grad(lagrangian, has_aux=True)(carry.z)
        finite = jnp.isfinite(f) & jnp.all(jnp.isfinite(g)) & jnp.all(jnp.isfinite(gradient))
        worst = jnp.max(g, initial=-jnp.inf)
        norm = jnp.linalg.norm(jnp.clip(carry.z - gradient, 0.0, 1.0) - carry.z)

        with jax.numpy_dtype_promotion("standard"):  # optax takes powers of a float to its int32 count
            updates, state = optimizer.update(gradient, carry.optimizer)
        z = optax.apply_updates(carry.z, updates)
        update = update_multipliers & finite
        stalled = (worst > tolerance) & (worst > carry.violation / 2)
        moved = _Carry(
            z=optax.projections.projection_box(z, 0.0, 1.0),
            last_finite=carry.z,
            optimizer=state,
            multipliers=jnp.where(update, pushed, carry.multipliers),
            penalty=jnp.where(
                update & stalled, jnp.minimum(PENALTY_GROWTH * carry.penalty, LARGEST_PENALTY), carry.penalty
            ),
            violation=jnp.where(update, worst, carry.violation),
            scale=scale,
        )
        halved = carry._replace(z=(carry.z + carry.last_finite) / 2)
        chosen = jax.tree.map(lambda new, old: jnp.where(finite, new, old), moved, halved)
        return chosen, (x, f, g, worst, norm)

    return step
