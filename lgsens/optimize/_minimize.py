"""Bounded minimization under path constraints, evaluation by evaluation."""

import os
import time
import warnings
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from lgsens._brief import brief
from lgsens._progress import compiling, progress_bar
from lgsens._validate import as_count
from lgsens.linear import tuned
from lgsens.optimize import _reverse_steps, _slsqp
from lgsens.optimize._augmented_lagrangian import Row
from lgsens.optimize._box import Box, checked_box
from lgsens.optimize._checkpoint import Checkpoint
from lgsens.optimize._course import Course
from lgsens.optimize._problem import Problem, flattened


class History(NamedTuple):
    """The course of a minimization; NumPy arrays with a leading axis over the evaluations, the first of them at x₀.

    Attributes:
        objective: f, shape (n,).
        worst_constraint: max g, shape (n,); −∞ without constraints.
        gradient_norm: |clip(z − ∇L) − z|, a projected gradient step in the scaled variables z, shape (n,).
        complementarity: σ = max |max(g, −μ/ρ)|, 0 where g and μ are those of an optimum, shape (n,); in forward mode ρ
            is 1 and μ what makes ∇L least.
        design: x, its leaves with a leading axis n.
    """

    objective: np.ndarray
    worst_constraint: np.ndarray
    gradient_norm: np.ndarray
    complementarity: np.ndarray
    design: PyTree

    __repr__ = brief


class OptimizationResult(NamedTuple):
    """The outcome of `minimize`.

    Attributes:
        x: the design where the search converged; if it did not, the lowest objective among those that satisfy the
            constraints to tolerance or, where none does, the one that violates them least.
        objective: f(x).
        constraints: g(x), in the shape `fun` gave them.
        feasible: whether max g(x) ≤ constraint_tolerance.
        reason: why the search ended: "converged"; "steps", all of them were taken; "stalled", no step along −∇L
            lowers L any more: round-off, a gradient that is wrong, an objective without a least value (of x beyond all
            measure: give bounds), or designs ahead that cannot be simulated (`history.objective` is not finite there:
            keep away from them by a constraint, of a linkage that it can be closed); "infeasible", the violation has a
            minimum here; "interrupted" from the keyboard (Ctrl-C) after the first evaluation: nothing that was found is
            lost.
        step: the evaluation at which x was found.
        history: the course of the minimization.
        multipliers: μ at the end, shaped as the constraints: the gain in f/|f(x₀)| per unit by which a constraint is
            relaxed.
        compile_seconds, run_seconds: wall time of the compilation and of the steps [s].
    """

    x: PyTree
    objective: float
    constraints: np.ndarray
    feasible: bool
    reason: str
    step: int
    history: History
    multipliers: np.ndarray
    compile_seconds: float
    run_seconds: float

    __repr__ = brief


def minimize(
    fun: Problem,
    x0: PyTree,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    num_steps: int,
    log_scale: PyTree = False,
    tolerance: float = 1e-5,
    constraint_tolerance: float = 1e-3,
    forward: bool | None = None,
    progress: bool = True,
    callback: Callable[[int, float, float], None] | None = None,
    checkpoint: str | os.PathLike | None = None,
) -> OptimizationResult:
    """min f(x) subject to g(x) ≤ 0 and lower ≤ x ≤ upper.

    Of few variables by SciPy's SLSQP with the Jacobian of all constraints, in forward mode; of many by an augmented
    Lagrangian and L-BFGS in the box with one gradient for each evaluation, in reverse mode, whatever the number of
    constraints.

    Arguments:
        fun: x ↦ (f, g): the objective, shape (), and the constraints, an array of any shape, each scaled so
            that 1 is a large violation; or x ↦ f without constraints. Traced once.
        x0: where to start, a pytree of arrays within the bounds. It need not satisfy g ≤ 0.
        lower, upper: the bounds, pytrees as x0; a leaf of shape () bounds every entry, an infinite one and None do not.
        num_steps: the most evaluations of f, g and derivatives; the first is at x0.
        log_scale: whether to search by the logarithm, a bool or a pytree of bools as x0; for positive rates
            whose bounds are a decade apart.
        tolerance: the search ends where the projected gradient of the Lagrangian, in variables scaled to [0, 1] and
            for f/|f(x₀)|, and σ of `History` are not above it; 0: never. The scale of a variable that lacks a bound is
            the largest entry of its array in x0, or the factor e.
        constraint_tolerance: the g up to which a design satisfies its constraints.
        forward: whether to differentiate in forward mode, static; None: where there are constraints and at most 40
            variables.
        progress: say what is compiled, and show a bar, if tqdm is installed (`pip install "lgsens[plot]"`).
        callback: called after each evaluation with (step, f, max g).
        checkpoint: a file (.npz) that keeps the search, written after every evaluation. If it is there already, of
            the same problem, the search goes on from it to the same numbers, bit by bit, as if it had never been
            interrupted; with more `num_steps` a finished one goes on. To recognize another `fun`, x0 is evaluated
            again.

    A step into a region where f, g or the gradient is not finite is halved until they are. Warns of a gradient that is
    zero at x0. Raises `ValueError` for bounds of another shape than x0, lower ≥ upper, x0 outside them, a logarithmic
    scale over 0, `num_steps` < 1, a tolerance that is out of range, an f or g that is not finite at x0 or has no
    derivative in the mode, and a checkpoint of another problem. Derivations and sources:
    `lgsens/optimize/_slsqp.py` and `_augmented_lagrangian.py`.
    """
    as_count(num_steps, "num_steps")  # before anything is compiled
    search = Minimization(
        fun,
        x0,
        lower=lower,
        upper=upper,
        log_scale=log_scale,
        tolerance=tolerance,
        constraint_tolerance=constraint_tolerance,
        forward=forward,
        progress=progress,
    )
    return search(num_steps, progress=progress, callback=callback, checkpoint=checkpoint)


class Minimization:
    """The program of `minimize`, compiled once: gradients wherever they are wanted, and the search.

        program = Minimization(fun, x0, lower=…, upper=…)
        f, gradient = program.value_and_grad(x0)
        found, another = program(num_steps=100), program(num_steps=100, x0=x1)

    Arguments are those of `minimize`, and so are errors.

    Attributes:
        compile_seconds: wall time of the compilation [s].
    """

    def __init__(
        self,
        fun: Problem,
        x0: PyTree,
        *,
        lower: PyTree = None,
        upper: PyTree = None,
        log_scale: PyTree = False,
        tolerance: float = 1e-5,
        constraint_tolerance: float = 1e-3,
        forward: bool | None = None,
        progress: bool = True,
    ):
        self._bounds = lower, upper, log_scale
        self._x, self._unravel, self._box = checked_box(x0, *self._bounds)
        self._tolerances = checked_tolerances(tolerance, constraint_tolerance)
        started = time.perf_counter()
        self._method, self._shape = prepared(fun, self._x, self._unravel, self._box, self._tolerances, forward)
        with compiling("objective, constraints and their derivatives", progress):
            try:
                self._method.compile(self._x)
            except TypeError as error:
                if "custom_vjp" not in str(error):
                    raise
                raise ValueError(
                    "`fun` has a function in it that forward mode does not pass through, as `AdjointVariable()` is; "
                    "leave `sensitivity` out of `simulate`, or give `forward=False`."
                ) from error
        self.compile_seconds = time.perf_counter() - started

    def _flat(self, x: PyTree, name: str) -> Array:
        """A design as a vector. Raises `ValueError` where it is none like x0."""
        like, kind = self._unravel(self._x), lambda x: (jax.tree.structure(x), [*map(np.shape, jax.tree.leaves(x))])
        if kind(x) != kind(like):
            raise ValueError(f"`{name}` must be like that of the program, {like!r}, got {x!r}.")
        return ravel_pytree(x)[0].astype(self._x.dtype)

    def value_and_grad(self, x: PyTree) -> tuple[float, PyTree]:
        """f and ∇f at a design like x0. Raises `ValueError` for another structure."""
        flat = self._flat(x, "x")
        f, slope = self._method.slope(flat)
        return float(f), self._unravel(slope / self._box.rate(self._box.scaled(flat)))

    def __call__(
        self,
        num_steps: int,
        *,
        x0: PyTree = None,
        progress: bool = True,
        callback: Callable[[int, float, float], None] | None = None,
        checkpoint: str | os.PathLike | None = None,
    ) -> OptimizationResult:
        """The search, from x0 or another start within the bounds, on the same scale."""
        num_steps = as_count(num_steps, "num_steps")
        method, began = self._method, time.perf_counter()
        x = self._x
        if x0 is not None:
            x = self._flat(x0, "x0")
            checked_box(x0, *self._bounds)
        start = method.begin(x)
        first = start[1]
        if not (np.isfinite(first.objective) and np.isfinite(first.gradient_norm) and not np.isnan(first.worst)):
            raise ValueError(
                "The objective, a constraint or the gradient is not finite at `x0` (objective "
                f"{float(first.objective)}); start from a design that can be simulated."
            )
        if float(first.gradient_norm) == 0.0 and not np.any(method.slope(x)[1]):
            warnings.warn(
                "The gradient of the objective is zero at `x0`, by every variable, and the search ends there. It does "
                "not depend on them (a number that `float` or NumPy made of one, `stop_gradient`), or x0 is a "
                "stationary point, a symmetric design say: start elsewhere.",
                stacklevel=3,
            )
        store = None if checkpoint is None else Checkpoint(checkpoint, self._box, x, self._tolerances)
        course, reason = Course(start, num_steps, store), "interrupted"
        with progress_bar(num_steps, "step", progress, initial=len(course.rows)) as bar:

            def shown(step: int, f: float, worst: float) -> None:
                bar.set_postfix({"objective": f"{f:.4g}", "worst constraint": f"{worst:+.1e}"}, refresh=False)
                bar.update()
                if callback is not None:
                    callback(step, f, worst)

            course.shown = shown
            try:
                if not course.rows:
                    course.add(*start)
                reason = method.go_on(course)
            except KeyboardInterrupt:
                if not course.rows:
                    raise
                course.keep()
        run_seconds = time.perf_counter() - began

        found = method.found(course)
        x, *numbers = (np.stack([getattr(row, name) for row in course.rows]) for name in Row._fields)
        history = History(*numbers, design=jax.tree.map(np.asarray, jax.vmap(self._unravel)(jnp.asarray(x))))
        return OptimizationResult(
            x=self._unravel(jnp.asarray(x[found.step])),
            objective=float(history.objective[found.step]),
            constraints=found.constraints.reshape(self._shape),
            feasible=bool(history.worst_constraint[found.step] <= self._tolerances[1]),
            reason=reason,
            step=found.step,
            history=history,
            multipliers=found.multipliers.reshape(self._shape),
            compile_seconds=self.compile_seconds,
            run_seconds=run_seconds,
        )


def checked_tolerances(tolerance: float, constraint_tolerance: float) -> tuple[float, float]:
    """Both, in a pair. Raises `ValueError`."""
    if not tolerance >= 0:
        raise ValueError(f"`tolerance` must not be negative, got {tolerance}.")
    if not constraint_tolerance > 0:
        raise ValueError(f"`constraint_tolerance` must be positive, got {constraint_tolerance}.")
    return tolerance, constraint_tolerance


def prepared(
    fun: Problem, x: Array, unravel: Callable, box: Box, tolerances: tuple[float, float], forward: bool | None
) -> tuple[_slsqp.Method | _reverse_steps.Method, tuple[int, ...]]:
    """The method for a problem, and the shape of its constraints."""
    flat_fun, constraints = flattened(fun, unravel, x)
    few = constraints.size > 0 and x.size <= tuned.FORWARD_VARIABLES
    method = _slsqp.Method if (few if forward is None else forward) else _reverse_steps.Method
    return method(flat_fun, box, tolerances, constraints.size), constraints.shape
