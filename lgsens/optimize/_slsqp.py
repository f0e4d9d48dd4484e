"""Sequential quadratic programming by SciPy's SLSQP (Kraft 1988, DFVLR-FB 88-28), for few variables.

Forward mode gives the Jacobian J of all constraints together with ∇f, f and g for about the price of a gradient in
reverse mode. So one program evaluates all of them, at trials of the line search too: most are accepted, and none is
simulated twice. SLSQP is deterministic: given the evaluations of a search that was interrupted, it asks for the same
points once more, up to where that one was.

When it ends is said by the Karush–Kuhn–Tucker conditions, as in `_augmented_lagrangian`, and not by SLSQP, which looks
at the change of f. With f divided by |f(x₀)|, z in the box is optimal where a μ ≥ 0 exists with

    P(z − ∇L) = z,   ∇L = ∇f + Jᵀ μ,   g ≤ 0,   μ_i = 0 unless g_i = 0,   P the projection on the box

Let A be the constraints with g_i ≥ −tolerance and N the outer normals, ±e_j, of bounds that are as near. The first
condition says that −∇f is in the cone of the rows of J_A and N, so that

    min ‖∇f + J_Aᵀ μ_A + Nᵀ ν‖²,   μ_A, ν ≥ 0

is zero at an optimum. These nonnegative least squares (Lawson & Hanson 1974, §23), of n rows, give μ at any point, and
with it the stationarity ‖P(z − ∇L) − z‖ and σ = max_i |max(g_i, −μ_i)|.

What SLSQP lacks is added around it:

- Trials that cannot be simulated: they get f and g of the point that they come from. Neither better nor worse, the step
  is halved, ten times at most.
- An end where constraints contradict each other: without progress over `STILL` evaluations it is stopped. If g ≤ 0 is
  violated there, the least violation is searched, min t with g ≤ t, also by SLSQP. If that is above 0, the problem is
  infeasible; otherwise the search begins anew from there.
- A scale where f(x₀) = 0: the largest slope at x₀.
"""

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array

from lgsens.optimize._box import Box
from lgsens.optimize._course import Course, Found

STILL, SMALL = 8, 1e-8  # evaluations that lie together, within so much of the box
RESTARTS = 3
LEAST_VIOLATION = 1e-8  # SLSQP's own accuracy in the search for it


class Evaluation(NamedTuple):
    """f, g and their derivatives at z; NumPy arrays. The first five are what a `Row` has."""

    x: np.ndarray
    objective: np.ndarray
    worst: np.ndarray
    gradient_norm: np.ndarray
    complementarity: np.ndarray
    z: np.ndarray
    constraints: np.ndarray
    slope: np.ndarray  # of f/|f(x₀)|
    jacobian: np.ndarray
    multipliers: np.ndarray

    @property
    def finite(self) -> bool:
        return all(bool(np.all(np.isfinite(a))) for a in (self.objective, self.constraints, self.slope, self.jacobian))


class Method:
    """The search for one problem, from any start; no carry, the evaluations are all that it needs."""

    def __init__(self, fun: Callable, box: Box, tolerances: tuple[float, float], _: int):
        def evaluate(z):
            x = box.value(z)
            f, g = fun(x)
            return (f, g), (x, f, g)

        self.program: Callable = jax.jit(jax.jacfwd(evaluate, has_aux=True))
        self.box, self.tolerances = box, tolerances

    def compile(self, x: Array) -> None:
        """Compile the evaluation, for any x of its kind."""
        self.program = self.program.lower(self.box.scaled(x)).compile()

    def begin(self, x: Array) -> tuple[None, Evaluation]:
        """The evaluation at x₀. Raises `ValueError` for a constraint that is −∞ there."""
        row = self.evaluated(np.asarray(self.box.scaled(x), np.float64), None)
        if np.any(np.isneginf(row.constraints)):
            raise ValueError("A constraint is −∞ at `x0`; leave out what can never be active.")
        return None, row

    def slope(self, x: Array) -> tuple[np.ndarray, np.ndarray]:
        """f at x, and its gradient by z."""
        row = self.begin(x)[1]
        return row.objective, row.slope * scale_of(row.objective)

    def evaluated(self, z: np.ndarray, scale: float | None) -> Evaluation:
        """The evaluation at z; `scale`: |f(x₀)|, None at x₀."""
        (slope, jacobian), (x, f, g) = jax.tree.map(np.asarray, self.program(jnp.asarray(z, self.box.lower.dtype)))
        slope = slope / (scale or scale_of(f))
        tolerance = self.tolerances[0]
        multipliers, near = np.zeros_like(g), np.flatnonzero(g >= -tolerance)
        if near.size and np.all(np.isfinite(slope)) and np.all(np.isfinite(jacobian)):
            unit = np.eye(z.size)
            lower, upper = self.box.ends
            cone = np.concatenate([jacobian[near], -unit[z <= lower + tolerance], unit[z >= upper - tolerance]])
            with contextlib.suppress(RuntimeError):  # out of its iterations: this point is no optimum then
                multipliers[near] = scipy.optimize.nnls(cone.T, -slope)[0][: near.size]
        norm = np.linalg.norm(np.asarray(self.box.descent(z, slope + multipliers @ jacobian)))
        sigma = np.max(np.abs(np.maximum(g, -multipliers)), initial=0.0)
        worst, norm, sigma = (np.asarray(number, f.dtype) for number in (np.max(g, initial=-np.inf), norm, sigma))
        return Evaluation(x, f, worst, norm, sigma, z, g, slope, jacobian, multipliers)

    def optimal(self, row: Evaluation) -> bool:
        """Whether the conditions hold there, to tolerance."""
        tolerance, constraint_tolerance = self.tolerances
        errors = max(row.gradient_norm, row.complementarity)
        return bool(row.finite and row.worst <= constraint_tolerance and errors <= tolerance)

    def go_on(self, course: Course) -> str:
        """Search, from x₀ and through evaluations that are known already; why it ended."""
        return _Search(self, course).run()

    def found(self, course: Course) -> Found:
        """Where the conditions hold; before, the lowest f of the feasible designs or else the least violation."""
        order = []
        for row in course.rows:
            feasible = bool(row.worst <= self.tolerances[1])
            value = float(row.objective if feasible else row.worst)
            order.append((not self.optimal(row), not row.finite, not feasible, value))
        step = order.index(min(order))
        return Found(step, course.rows[step].constraints, course.rows[step].multipliers)


def scale_of(objective: np.ndarray) -> float:
    """What f is divided by: |f(x₀)|, or 1 where that is 0."""
    return abs(float(objective)) or 1.0


class _Ended(Exception):
    """Why a search ends: SciPy lets it through."""


class _Still(Exception):
    """SLSQP does not move any more."""


class _Search:
    """One search; what SLSQP asks for."""

    def __init__(self, method: Method, course: Course):
        self.method, self.course = method, course
        self.known = {row.z.tobytes(): row for row in course.rows}
        self.first = self.here = course.rows[0]  # `here`: the last point that SLSQP accepted
        self.scale = scale_of(self.first.objective)
        self.trail: list[np.ndarray] = []

    def run(self) -> str:
        if not self.first.finite:
            return "stalled"
        size = 1.0 if float(self.first.objective) else float(np.max(np.abs(self.first.slope))) or 1.0
        fun = lambda z: float(self.values(z).objective) / (self.scale * size)
        jac = lambda z: self.slopes(z).slope.astype(np.float64) / size
        constraints = (self.constraints, self.normals) if self.first.constraints.size else None
        box = list(zip(*map(np.ndarray.tolist, self.method.box.ends)))
        allowed = self.method.tolerances[1]
        try:
            for _ in range(RESTARTS):
                self.slsqp(fun, jac, self.here.z, box, constraints, np.finfo(np.float64).eps)
                if self.here.worst <= allowed:
                    break
                self.least_violation(box)
                if self.here.worst > allowed:
                    return "infeasible"
        except _Ended as ended:
            return str(ended)
        return "stalled"

    def slsqp(self, fun, jac, start, bounds, constraints, accuracy: float) -> None:
        self.trail.clear()
        given: Any = constraints and {"type": "ineq", "fun": constraints[0], "jac": constraints[1]}
        options = {"ftol": accuracy, "maxiter": 10**6}
        with contextlib.suppress(_Still):
            scipy.optimize.minimize(
                fun, start, jac=jac, bounds=bounds, constraints=given or (), method="SLSQP", options=options
            )

    def least_violation(self, box) -> None:
        """min t, g ≤ t and t ≥ 0, from here."""
        n, m = self.first.z.size, self.first.constraints.size
        along, ones = np.append(np.zeros(n), 1.0), np.ones((m, 1))
        constraints = (
            lambda zt: self.constraints(zt[:n]) + zt[n],
            lambda zt: np.concatenate([self.normals(zt[:n]), ones], axis=1),
        )
        start = np.append(self.here.z, self.here.worst)
        self.slsqp(lambda zt: zt[n], lambda _: along, start, [*box, (0.0, None)], constraints, LEAST_VIOLATION)

    def at(self, z: np.ndarray) -> Evaluation:
        if not self.trail or np.any(self.trail[-1] != z):
            self.trail.append(z.copy())
        if len(self.trail) > STILL and np.max(np.ptp(self.trail[-STILL:], axis=0)) <= SMALL:
            raise _Still
        row = self.known.get(z.tobytes())
        if row is None:
            if self.course.full:
                raise _Ended("steps")
            row = self.known[z.tobytes()] = self.method.evaluated(z.copy(), self.scale)
            self.course.add(None, row)
        if self.method.optimal(row):
            raise _Ended("converged")
        return row

    def values(self, z: np.ndarray) -> Evaluation:
        """The evaluation for f and g."""
        row = self.at(z)
        return row if row.finite else self.here

    def slopes(self, z: np.ndarray) -> Evaluation:
        """The evaluation for derivatives, of a point that was accepted."""
        row = self.at(z)
        if not row.finite:
            raise _Ended("stalled")
        self.here = row
        return row

    def constraints(self, z: np.ndarray) -> np.ndarray:
        return -self.values(z).constraints.astype(np.float64)

    def normals(self, z: np.ndarray) -> np.ndarray:
        return -self.slopes(z).jacobian.astype(np.float64)
