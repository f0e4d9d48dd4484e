"""Steps of an augmented Lagrangian method with one gradient in reverse mode each, for many variables.

The method is L-BFGS of optax on the face of the box in which z may move (Bertsekas 1982, SIAM J. Control Optim.
20:221), with a backtracking search along the projected path. Each step is one evaluation, accepted or not. Behind a
constraint that z has not touched L rises steeply, of which the memory knows nothing; so a step that was shortened
limits the next ones, which may double.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from lgsens.optimize import _augmented_lagrangian as outer
from lgsens.optimize._box import Box
from lgsens.optimize._course import Course, Found

Memory = Any  # optax.ScaleByLBFGSState; its members are declared as any pytree, here they are arrays
LBFGS: Any = optax.scale_by_lbfgs(memory_size=10)


class Carry(NamedTuple):
    """What one evaluation hands to the next."""

    search: outer.Search
    z: Float[Array, " n"]  # the last point that was accepted
    value: Float[Array, ""]  # L there
    gradient: Float[Array, " n"]  # ∇L there
    memory: Memory  # of points before z
    direction: Float[Array, " n"]  # to the trial
    reach: Float[Array, ""]  # the most that an entry of it may be
    rejected: Int[Array, ""]  # trials from z
    fresh: Bool[Array, ""]  # z is to be evaluated anew: L is another one


class Method:
    """The search for one problem, from any start."""

    def __init__(self, fun: Callable, box: Box, tolerances: tuple[float, float], num_constraints: int):
        self.box, self.start = box, lambda x: start(box.scaled(x), num_constraints)
        self.one_step = make_step(fun, box, tolerances)  # to be traced
        self.step: Callable = jax.jit(self.one_step)
        self.slope_alone: Callable = jax.jit(jax.value_and_grad(lambda z: fun(box.value(z))[0]))

    def compile(self, x: Array) -> None:
        """Compile the step, for any x of its kind."""
        self.step = self.step.lower(self.start(x)).compile()

    def begin(self, x: Array) -> tuple[Carry, outer.Row]:
        """What follows from the evaluation at x₀. Raises `ValueError` for a constraint that is not finite there."""
        carry, row = self.step(self.start(x))
        if int(carry.rejected) and np.isfinite(row.objective) and np.isfinite(row.gradient_norm):
            raise ValueError(
                "A constraint is not finite at `x0`; leave out what can never be active, and start from a design that "
                "can be simulated."
            )
        return carry, row

    def slope(self, x: Array) -> tuple[np.ndarray, np.ndarray]:
        """f at x, and its gradient by z: that of the first L with hardly any penalty; where this is not finite a
        program of its own, as a constraint may be to blame."""
        begun = self.start(x)
        penalty = jnp.full_like(begun.search.penalty, jnp.finfo(x.dtype).tiny)
        carry, row = self.step(begun._replace(search=begun.search._replace(penalty=penalty)))
        if int(carry.rejected):
            f, slope = self.slope_alone(begun.z)
            return np.asarray(f), np.asarray(slope)
        return np.asarray(row.objective), np.asarray(carry.gradient * carry.search.scale)

    def go_on(self, course: Course) -> str:
        """Steps from the last evaluation on; why they ended."""
        while not int(course.carry.search.ended) and not course.full:
            course.add(*self.step(course.carry))
        return outer.REASONS[int(course.carry.search.ended)]

    def found(self, course: Course) -> Found:
        """The best so far."""
        search: outer.Search = course.carry.search
        return Found(int(search.best.step), np.asarray(search.best.constraints), np.asarray(search.multipliers))


def start(z: Float[Array, " n"], num_constraints: int) -> Carry:
    """The carry before the first evaluation, which is at z."""
    return Carry(
        search=outer.Search.start(z, num_constraints),
        z=z,
        value=jnp.full((), jnp.inf, z.dtype),
        gradient=jnp.zeros_like(z),
        memory=LBFGS.init(z),
        direction=jnp.zeros_like(z),
        reach=jnp.full((), outer.LARGEST_MOVE, z.dtype),
        rejected=jnp.zeros((), jnp.int32),
        fresh=jnp.asarray(True),
    )


def make_step(fun: Callable, box: Box, tolerances: tuple[float, float]) -> Callable[[Carry], tuple[Carry, outer.Row]]:
    """carry ↦ (carry, row): one evaluation of f, g and ∇L, and what follows from it."""
    # Without a box a move may be as long as it has to.
    longest = outer.LARGEST_MOVE if np.all(np.isfinite(box.ends)) else np.inf

    def step(carry: Carry) -> tuple[Carry, outer.Row]:
        search = carry.search
        z = jnp.where(carry.fresh, carry.z, box.clip(carry.z + carry.direction))

        def lagrangian(z):
            x = box.value(z)
            f, g = fun(x)
            estimate = search.estimate(g)
            return search.lagrangian(f / search.scale_of(f), estimate), (x, f, g, estimate)

        (value, (x, f, g, estimate)), gradient = jax.value_and_grad(lagrangian, has_aux=True)(z)
        finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(g)) & jnp.all(jnp.isfinite(gradient))

        move = z - carry.z
        promised = jnp.vdot(carry.gradient, move)
        enough = value <= carry.value + outer.DECREASE * promised + outer.round_off(carry.value)
        accepted = finite & (carry.fresh | enough)
        trial = outer.Trial(z, x, f, g, gradient, estimate, finite)
        search, follow, row = outer.advance(search, trial, accepted, tolerances, box)

        zero, one = jnp.zeros_like(carry.rejected), jnp.ones_like(carry.rejected)
        moved = carry._replace(
            z=z,
            value=value,
            gradient=gradient,
            memory=_next_memory(carry, z, gradient),
            reach=jnp.where(
                carry.fresh,
                carry.reach,
                jnp.minimum(2 * jnp.where(carry.rejected > 0, jnp.max(jnp.abs(move)), carry.reach), longest),
            ),
            rejected=zero,
            fresh=follow,
        )
        # The parabola through L, its slope and L at the trial; half where the trial is not finite.
        ratio = -promised / (2 * (value - carry.value - promised))
        given_up = carry.rejected >= outer.REJECTIONS
        stayed = carry._replace(
            memory=outer.select(given_up, LBFGS.init(z), carry.memory),
            direction=carry.direction * jnp.where(finite, jnp.clip(ratio, 0.1, 0.5), 0.5),
            rejected=jnp.where(given_up, zero, carry.rejected + one),
        )
        stalled = ~accepted & given_up & (carry.memory.count == 0)
        after = outer.select(accepted, moved, stayed)
        after = outer.select(accepted | given_up, after._replace(direction=_direction(after, box)), after)
        ended = jnp.where(stalled, outer.STALLED, search.ended)
        return after._replace(search=search._replace(ended=ended)), row

    return step


def _next_memory(carry: Carry, trial, gradient) -> Memory:
    """The memory of the points before the trial, which was accepted.

    The last of them is z, unless the step shows no positive curvature or is across two Lagrangians. Then the point
    before z is shifted so that the difference to it stays: the pair of the last step serves once more.
    """
    move, change = trial - carry.z, gradient - carry.gradient
    shifted = carry.memory._replace(params=carry.memory.params + move, updates=carry.memory.updates + change)
    small = jnp.finfo(move.dtype).eps ** 0.5 * jnp.linalg.norm(move) * jnp.linalg.norm(change)
    with jax.numpy_dtype_promotion("standard"):  # optax mixes its int32 count with floats
        _, usual = LBFGS.update(carry.gradient, carry.memory, carry.z)
    return outer.select(~carry.fresh & (jnp.vdot(move, change) > small), usual, shifted)


def _direction(carry: Carry, box: Box) -> Float[Array, " n"]:
    """−H ∇L on the face in which z may move, with the pairs of the memory projected on it, no farther than reach."""
    z, gradient, memory = carry.z, carry.gradient, carry.memory
    lower, upper = box.ends
    free = jnp.where(((z <= lower) & (gradient > 0)) | ((z >= upper) & (gradient < 0)), 0.0, 1.0)
    moves, changes = (free[None] * pairs for pairs in (memory.diff_params_memory, memory.diff_updates_memory))
    curvature = jnp.sum(moves * changes, axis=1)
    on_face = memory._replace(
        params=free * memory.params,
        updates=free * memory.updates,
        diff_params_memory=moves,
        diff_updates_memory=changes,
        weights_memory=jnp.where(curvature > 0, 1.0 / jnp.where(curvature > 0, curvature, 1.0), 0.0),
    )
    slope = free * gradient
    with jax.numpy_dtype_promotion("standard"):
        scaled, _ = LBFGS.update(slope, on_face, free * z)
    descends = jnp.vdot(scaled, slope) > 1e-8 * jnp.linalg.norm(scaled) * jnp.linalg.norm(slope)
    direction = -free * jnp.where(descends & jnp.all(jnp.isfinite(scaled)), scaled, slope)
    largest = jnp.max(jnp.abs(direction))
    return direction * jnp.minimum(1.0, carry.reach / jnp.where(largest > 0, largest, 1.0))
