"""A problem as `scipy.optimize` wants it: functions of a flat vector of 64-bit floats."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from lgsens.optimize._box import checked_box
from lgsens.optimize._problem import Problem, flattened


class ScipyProblem(NamedTuple):
    """A problem in variables z, scaled to [0, 1] between the bounds as in `minimize`; NumPy arrays of 64-bit floats.

    Attributes:
        z0: the start, shape (n,).
        bounds: (0, 1) for each variable, infinite where it has none, as `scipy.optimize.minimize` takes them.
        fun, jac, hessp: f(z), its gradient (n,), and its Hessian times a vector, (z, p) ↦ (n,).
        constraints, constraints_jac: g(z), shape (m,), and its Jacobian (m, n); g ≤ 0 is wanted.
        x: z ↦ the design, a pytree.
    """

    z0: np.ndarray
    bounds: list[tuple[float, float]]
    fun: Callable[[np.ndarray], float]
    jac: Callable[[np.ndarray], np.ndarray]
    hessp: Callable[[np.ndarray, np.ndarray], np.ndarray]
    constraints: Callable[[np.ndarray], np.ndarray]
    constraints_jac: Callable[[np.ndarray], np.ndarray]
    x: Callable[[np.ndarray], PyTree]


def scipy_problem(
    fun: Problem,
    x0: PyTree,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    log_scale: PyTree = False,
    forward: bool | None = None,
) -> ScipyProblem:
    """A problem of `minimize` for `scipy.optimize.minimize`, with value, gradient and Hessian-vector product.

    ```python
    p = lg.optimize.scipy_problem(fun, x0, lower=lower, upper=upper)
    found = scipy.optimize.minimize(
        p.fun, p.z0, jac=p.jac, bounds=p.bounds, method="SLSQP",
        constraints={"type": "ineq", "fun": lambda z: -p.constraints(z), "jac": lambda z: -p.constraints_jac(z)},
    )
    p.x(found.x)
    ```

    Arguments:
        fun, x0, lower, upper, log_scale: as of `minimize`.
        forward: whether the gradient of f comes by forward mode together with the Jacobian of g, one simulation with n
            tangents, or by reverse mode; None: forward where there are constraints.

    What one z gives is computed once and kept until another z is asked for. The Jacobian of g costs n tangents, the
    Hessian-vector product a tangent of a gradient. Raises `ValueError` as `minimize` for bounds and shapes.
    """
    x, unravel, box = checked_box(x0, lower, upper, log_scale)
    z0 = box.scaled(x)
    flat_fun, constraints = flattened(fun, unravel, x)
    forward = constraints.size > 0 if forward is None else forward
    both = lambda z: flat_fun(box.value(z))
    slope = jax.grad(lambda z: both(z)[0])
    values, jacobians, gradient = map(_remembered, (both, jax.jacfwd(both), slope))
    product = jax.jit(lambda z, p: jax.jvp(slope, (z,), (p,))[1])
    as_array = lambda z: np.asarray(z, z0.dtype)
    return ScipyProblem(
        z0=np.asarray(z0, np.float64),
        bounds=list(zip(*map(np.ndarray.tolist, box.ends))),
        fun=lambda z: float(values(z)[0]),
        jac=lambda z: jacobians(z)[0] if forward else gradient(z),
        hessp=lambda z, p: np.asarray(product(as_array(z), as_array(p)), np.float64),
        constraints=lambda z: values(z)[1],
        constraints_jac=lambda z: jacobians(z)[1],
        x=lambda z: unravel(box.value(as_array(z))),
    )


class ScipyLeastSquares(NamedTuple):
    """Residuals in variables z scaled to [0, 1] between the bounds, for `scipy.optimize.least_squares`; NumPy arrays.

    Attributes:
        z0: the start, shape (n,).
        bounds: the lower and the upper bounds of z, as `scipy.optimize.least_squares` takes them.
        fun, jac: r(z), shape (m,), and its Jacobian by forward mode (m, n).
        x: z ↦ the parameters, a pytree.
    """

    z0: np.ndarray
    bounds: tuple[np.ndarray, np.ndarray]
    fun: Callable[[np.ndarray], np.ndarray]
    jac: Callable[[np.ndarray], np.ndarray]
    x: Callable[[np.ndarray], PyTree]


def scipy_least_squares(
    residual: Callable[[PyTree], PyTree],
    x0: PyTree,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    log_scale: PyTree = False,
) -> ScipyLeastSquares:
    """Residuals as of `least_squares` for `scipy.optimize.least_squares`, which keeps parameters within bounds.

    `p = scipy_least_squares(…)`, then `scipy.optimize.least_squares(p.fun, p.z0, jac=p.jac, bounds=p.bounds)` and
    `p.x(found.x)`. Arguments and errors as of `scipy_problem`.
    """
    x, unravel, box = checked_box(x0, lower, upper, log_scale)
    scaled = jax.jit(lambda z: ravel_pytree(residual(unravel(box.value(z))))[0])
    z0 = box.scaled(x)
    return ScipyLeastSquares(
        z0=np.asarray(z0, np.float64),
        bounds=box.ends,
        fun=_remembered(scaled),
        jac=_remembered(jax.jacfwd(scaled)),
        x=lambda z: unravel(box.value(np.asarray(z, z0.dtype))),
    )


def _remembered(function: Callable) -> Callable[[np.ndarray], PyTree]:
    """`function`, compiled, of NumPy arrays; what it was for the last argument is not computed again."""
    compiled = jax.jit(function)

    @functools.lru_cache(maxsize=1)
    def of_bytes(z: bytes):
        return jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), compiled(np.frombuffer(z)))

    return lambda z: of_bytes(np.asarray(z, np.float64).tobytes())
