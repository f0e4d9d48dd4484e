"""Nonlinear least squares by Gauss–Newton, of optimistix, and what noise leaves of its answer.

With residuals r(x) = (model(x) − data)/σ in units of the standard deviation of independent Gaussian noise, the
likelihood of the data is ∼ exp(−½ |r|²): the least squares are the most likely parameters. The Fisher information is
JᵀJ with J = ∂r/∂x, so that no unbiased estimate has less covariance than (JᵀJ)⁻¹ (Cramér & Rao), which this one reaches
as noise falls: x − x_true ≈ −(JᵀJ)⁻¹ Jᵀ r(x_true), where r(x_true) has covariance 1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import optimistix
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from lgsens._brief import brief
from lgsens._validate import as_count
from lgsens.optimize._parametrization import variables


class LeastSquaresResult(NamedTuple):
    """The outcome of `least_squares`; all of it arrays, so it comes out of `jit` and `vmap`.

    Attributes:
        x: the parameters.
        residual: r(x), shape (m,).
        jacobian: ∂r/∂x by forward mode, the parameters in the order of `ravel_pytree`, shape (m, n).
        covariance: (JᵀJ)⁻¹ [products of units of x], shape (n, n): for r in units of the noise, the bound of Cramér and
            Rao. Not finite where the data leave a combination of the parameters undetermined.
        deviation: the roots of its diagonal, a pytree as x.
        converged: whether the last step was below the tolerances; where not, x is no optimum, and covariance and
            deviation say nothing of how far it is from one.
        steps: number of Jacobians.
    """

    x: PyTree
    residual: Float[Array, " m"]
    jacobian: Float[Array, "m n"]
    covariance: Float[Array, "n n"]
    deviation: PyTree
    converged: Bool[Array, ""]
    steps: Int[Array, ""]

    __repr__ = brief


class LineSearchGaussNewton(optimistix.AbstractGaussNewton):
    """Gauss–Newton with backtracking, of optimistix's parts: like the parameters themselves it has no scale.

    The damping of Levenberg–Marquardt has one, which slows it down where the data determine some combinations of
    parameters a hundred times better than others: 234 steps beside 161 for five data sets of `AccelerationTest`, on
    which Gauss–Newton alone diverges (`benchmarks/results/optimizers.json`). `optimistix.Dogleg`, with 135, did not
    converge on all of the hundred oscillators of `tests/optimize/test_least_squares.py`. Ends where a step is below
    `rtol` of the parameters and lowers |r|² by less.
    """

    rtol: float = 1e-5
    atol: float = 1e-5
    norm: Callable = optimistix.max_norm
    # the shortest step where J has less rank than columns, which by QR has none
    descent: optimistix.NewtonDescent = optimistix.NewtonDescent(linear_solver=lineax.SVD())
    search: optimistix.BacktrackingArmijo = optimistix.BacktrackingArmijo()
    verbose: Callable = lambda **_: None


def least_squares(
    residual: Callable[[PyTree], PyTree],
    x0: PyTree,
    *,
    parametrization: PyTree = None,
    solver: Any = None,
    max_steps: int = 100,
) -> LeastSquaresResult:
    """min ½ |r(x)|², by Gauss–Newton with Jacobians in forward mode, one simulation with n tangents each.

    Arguments:
        residual: x ↦ r, a pytree of arrays; divided by the standard deviation of the noise, if `covariance` shall be
            that of x.
        x0: where to start, a pytree of arrays.
        parametrization: what is searched by, as of `variables`: `Log()` for masses and rates, `Interval(a, b)` for
            points that must not leave it on the way; None: x over its size. Where the optimum lies on the end of an
            interval Gauss–Newton creeps towards it, in steps that soon say nothing of the other parameters: hold that
            parameter there, or use `minimize`, which has bounds.
        solver: of optimistix, in the variables of the parametrization; None: `LineSearchGaussNewton()`;
            `optimistix.LevenbergMarquardt(rtol, atol)` where data determine the parameters badly.
        max_steps: the most steps, of which rejected ones are some: close to the optimum they drown in the round-off of
            |r|², and how many are rejected before the last one is chance.

    Compiled once for one `residual` and shapes; a function that is written anew is another one. It can be traced:
    `jax.jit` it for many data sets, `jax.vmap` or `lgsens.sweep` it over them. Not converging is data,
    `LeastSquaresResult.converged`. Raises `ValueError` as `variables`, and for fewer residuals than parameters.
    Sources: Nocedal & Wright 2006, §10.3; Kay, Fundamentals of Statistical Signal Processing I (1993), §3.
    """
    z0, design = variables(parametrization, x0)
    plain = _Residual(residual, design)
    flat_residual = _ByMatrix(plain)
    count = jax.eval_shape(flat_residual, z0).shape[0]
    if count < z0.size:
        raise ValueError(
            f"`residual` has {count} entries, fewer than the {z0.size} parameters: measure more, or free less."
        )
    solver = LineSearchGaussNewton() if solver is None else solver
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # optimistix is less strict
        found = optimistix.least_squares(
            flat_residual,
            solver,
            z0,
            max_steps=as_count(max_steps, "max_steps"),
            throw=False,
        )
    converged = found.result == optimistix.RESULTS.successful
    return LeastSquaresResult(**_at(plain, found.value), converged=converged, steps=found.stats["num_steps"])


class _Residual(eqx.Module):
    """z ↦ r, flat: of the same function the same, so that programs of it are found again."""

    residual: Callable[[PyTree], PyTree]
    design: Callable[[Array], PyTree]

    def __call__(self, z, _=None):
        return ravel_pytree(self.residual(self.design(z)))[0]


class _ByMatrix(eqx.Module):
    """The same, whose linearization at z is the matrix J, made once.

    Of a function optimistix keeps what its tangents need, the motion and more, and takes products with it in several
    places, of which each is compiled as a sweep of its own, transposed ones too: 13 s in place of 9 for a pendulum.
    """

    of: _Residual

    def __call__(self, z, _=None):
        return _by_matrix(eqx.filter_closure_convert(self.of, z), z)  # what it closes over has derivatives, too


@eqx.filter_custom_jvp
def _by_matrix(of: Callable[[Array], Array], z: Array) -> Array:
    return of(z)


@_by_matrix.def_jvp
def _by_matrix_rule(primals, tangents):
    (of, z), (d_of, dz) = primals, tangents
    jacobian, left = jax.jacfwd(lambda z: (of(z),) * 2, has_aux=True)(z)
    tangent = jnp.zeros_like(left) if dz is None else jacobian @ dz
    if jax.tree.leaves(d_of):
        tangent = tangent + eqx.filter_jvp(lambda of: of(z), (of,), (d_of,))[1]
    return left, tangent


@eqx.filter_jit
def _at(of: _Residual, z: Array) -> dict[str, Any]:
    """What is said of a point."""
    x = of.design(z)
    flat, unravel = ravel_pytree(x)
    twice = lambda x: (ravel_pytree(of.residual(unravel(x)))[0],) * 2
    jacobian, left = jax.jacfwd(twice, has_aux=True)(flat)
    bound = covariance(jacobian)
    deviation = unravel(jnp.sqrt(jnp.diagonal(bound)))
    return {"x": x, "residual": left, "jacobian": jacobian, "covariance": bound, "deviation": deviation}


def covariance(jacobian: Float[Array, "m n"]) -> Float[Array, "n n"]:
    """(JᵀJ)⁻¹, from J = Q R: R⁻¹ R⁻ᵀ with half the digits lost that JᵀJ would lose; columns scaled to 1 before.

    Infinite where J has less rank than columns, up to the round-off of its numbers.
    """
    size = jnp.linalg.norm(jacobian, axis=0)
    size = jnp.where(size > 0, size, 1.0)
    triangle = jnp.linalg.qr(jacobian / size[None], mode="r")
    inverse = jax.scipy.linalg.solve_triangular(triangle, jnp.eye(size.size, dtype=size.dtype)) / size[:, None]
    singular = jnp.linalg.svd(triangle, compute_uv=False)
    determined = singular[-1] > max(jacobian.shape) * jnp.finfo(size.dtype).eps * singular[0]
    return jnp.where(determined, inverse @ inverse.T, jnp.inf)
