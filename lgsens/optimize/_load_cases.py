"""Several load cases as one problem."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lgsens._validate import as_float
from lgsens.criteria import soft_maximum
from lgsens.optimize._problem import as_pair


def load_cases(
    fun: Callable[[PyTree, Any], Float[Array, ""] | tuple[Float[Array, ""], Array]],
    cases: Any,
    *,
    weights: Any = None,
    sharpness: float | None = None,
) -> Callable[[PyTree], tuple[Float[Array, ""], Float[Array, " m"]]]:
    """One problem for `minimize` of several load cases: x ↦ (f, g).

        f = Σ w_c f_c,     or with `sharpness` ρ the worst case,  f = KS_ρ(w_c f_c) ≥ max w_c f_c
        g = the constraints of all cases in a row

    Arguments:
        fun: (x, case) ↦ (f_c, g_c) or f_c, as `minimize` wants them for one case.
        cases: a pytree (a dict, a tuple) whose arrays have a leading axis over C cases, evaluated at once under
            `jax.vmap`; or a list of C cases that are anything (scenes of other bodies, say), evaluated one after
            another.
        weights: w [1/unit of f_c], shape (C,); None: 1/C each for the sum, 1 each for the worst case.
        sharpness: ρ of `soft_maximum` [–]; it exceeds the worst w_c f_c, which should be about 1, by ln C/ρ at most.

    The result is a new function: make it once, outside of `jit`. Raises `ValueError` for no cases, weights of another
    shape, and a sharpness that is not positive.
    """
    listed = isinstance(cases, list)
    leaves = jax.tree.leaves(cases)
    if not listed and not all(isinstance(leaf, jax.Array | np.ndarray | float | int) for leaf in leaves):
        raise ValueError(f"`cases` must be arrays with an axis over the cases, or a list of cases, got {cases!r}.")
    shapes = {(len(cases),)} if listed else {jnp.shape(leaf)[:1] for leaf in leaves}
    if len(shapes) != 1 or shapes & {(), (0,)}:
        raise ValueError(
            f"`cases` must be a list, or arrays of one leading axis over the cases, got {shapes or 'none'}."
        )
    ((count,),) = shapes
    if sharpness is not None and not sharpness > 0:
        raise ValueError(f"`sharpness` must be positive, got {sharpness}.")
    if weights is None:
        weights = jnp.full(count, 1.0 if sharpness is not None else 1.0 / count, jnp.result_type(float))
    weights = as_float(weights, (count,), "`weights`")

    def combined(x):
        if listed:
            found = [as_pair(fun(x, case)) for case in cases]
            f, g = jnp.stack([f for f, _ in found]), jnp.concatenate([g.ravel() for _, g in found])
        else:
            f, g = jax.vmap(lambda x, case: as_pair(fun(x, case)), in_axes=(None, 0))(x, cases)
        weighted = weights * f
        return (jnp.sum(weighted) if sharpness is None else soft_maximum(weighted, sharpness)), g.ravel()

    return combined
