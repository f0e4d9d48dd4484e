"""What is said of values and gradients that are not finite though the motion is."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, PyTree

from lgsens._validate import all_finite, is_concrete, leaf_name
from lgsens.criteria._by_parts import Task
from lgsens.sensitivity import DirectDifferentiation
from lgsens.simulation import Trajectory

_ADVICE = (
    "jnp.linalg.norm, jnp.sqrt, jnp.arccos and powers have no derivative at the ends of their range; of |x| take "
    "jnp.sqrt(x @ x + ε²), or keep such arguments from them by jnp.where before and behind"
)


def require_finite(task: Task, p, names: tuple[str, ...], values: tuple[Any, ...], gradients: tuple[PyTree, ...]):
    """Raise `ValueError` for what is known and not finite, with where it comes from: NaN in a gradient would go on into
    the numbers of a design."""
    if not is_concrete(values, gradients, p, task.t0, task.t1):
        return
    for name, criterion, value, gradient in zip(names, task.criteria, values, gradients):
        if all_finite((value, gradient)):
            continue
        of_value = not all_finite(value)
        leaves = jax.tree_util.tree_leaves_with_path(gradient)
        wrong = [leaf_name(path, "p") for path, leaf in leaves if not all_finite(leaf)]
        what = f"its value is {float(value)}" if of_value else f"its gradient by {', '.join(wrong)} is not finite"
        for part, times in _not_finite(task, p, criterion, derivatives=not of_value).items():
            if times.size:
                which = f"`{part}`" if of_value else f"the derivative of `{part}`"
                advice = "" if of_value else f": {_ADVICE}"
                raise ValueError(f"{name}: {what}, as {which} is not finite at t = {times[0]:.6g} s{advice}.")
        finite = "values" if of_value else "derivatives"
        raise ValueError(
            f"{name}: {what}, though its integrand and terminal term have finite {finite} at the ends of all steps: it "
            f"is from `build`, or from an element of one's own; {_ADVICE}."
        )


def _not_finite(task: Task, p, criterion: Any, derivatives: bool) -> dict[str, np.ndarray]:
    """The times at which the integrand and the terminal term are not finite, or their derivatives."""
    flat, unravel = ravel_pytree(p)
    task = task._replace(unravel=unravel)
    trajectory: Trajectory = task.simulate(flat, DirectDifferentiation())[1][0]

    def finite(of, state, t) -> Bool[Array, ""]:
        numbers, rest = eqx.partition((trajectory.system, state, p), eqx.is_inexact_array)

        def value(numbers):
            system, state, p = eqx.combine(numbers, rest)
            return of(system, state, t, p)

        asked = jax.grad(value)(numbers) if derivatives else value(numbers)
        return jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(asked)]).all()

    t, states = trajectory.t, trajectory.states
    inside = jax.vmap(lambda state, t: finite(criterion.rate, state, t))(states, t)
    at_end = finite(criterion.final, trajectory.state(-1), t[-1])
    return {"integrand": np.asarray(t)[~np.asarray(inside)], "terminal": np.asarray(t)[-1:][~np.asarray(at_end)[None]]}
