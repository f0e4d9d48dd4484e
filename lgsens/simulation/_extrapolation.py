"""Richardson extrapolation of any function of the number of steps.

What a scheme of second order computes with step h is ψ_h = ψ + c₂ h² + c₃ h³ + …, and two runs leave the powers from h³
on (`_richardson`). Where c₃ is small the next power is h⁴, and a third run with h/4 removes it, and so on (Romberg's
scheme):

    T_{j,1} = ψ_{h/2ʲ},     T_{j,k+1} = T_{j,k} + (T_{j,k} − T_{j−1,k})/(4ᵏ − 1).

An integral by the trapezoidal rule has an expansion in even powers itself, so criteria are extrapolated as a whole.

Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.4 and §II.8.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from lgsens._brief import brief
from lgsens._validate import as_count


class Extrapolated(NamedTuple):
    """What `richardson` returns.

    Attributes:
        value: the extrapolated values, a pytree as the function returns.
        error: the last correction, as large or larger than what is left: the estimated errors of the finer of two runs,
            value − fn(2 num_steps), or of the finest values that one run less would have given.
    """

    value: PyTree
    error: PyTree

    __repr__ = brief


def richardson(fn: Callable[[int], Any], num_steps: int, runs: int = 2) -> Extrapolated:
    """The limit of a function of the number of steps, of second order, from two of its values or more.

        ψ ≈ ψ_{2n} + e,   e = (ψ_{2n} − ψ_n)/3

    Arguments:
        fn: number of steps ↦ a pytree of floats; for instance criteria, their gradients, or both:
            `lambda n: differentiate(criteria, build, p, t1=1.0, num_steps=n)[:2]`.
        num_steps: n, a Python int.
        runs: how many: `fn` is called with n, 2n, 4n, …. From three on the powers h⁴, h⁶, … are removed as well, which
            gains digits in smooth motions with little numerical damping (ρ∞ = 0.9), and few where h³ is not small.

    Every JAX transformation goes through as it does through `fn`. Raises `ValueError` for a number of steps that is not
    one, for fewer than two runs, and for values that are not floats.
    """
    num_steps = as_count(num_steps, "num_steps", " (it is static)")
    if isinstance(runs, bool) or not isinstance(runs, int) or runs < 2:
        raise ValueError(f"`runs` must be a Python int of at least 2, got {runs!r}: one run cannot be extrapolated.")
    if not callable(fn):
        raise ValueError(f"`fn` must be a function of the number of steps, got {fn!r}.")
    values = [fn(2**j * num_steps) for j in range(runs)]
    for path, leaf in jax.tree_util.tree_leaves_with_path(values[-1]):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"`fn` must return floats, got {jnp.result_type(leaf)} in its value{jax.tree_util.keystr(path)}; "
                "return only what shall be extrapolated."
            )
    for k in range(1, runs):
        errors = [jax.tree.map(partial(missing, power=k), *pair) for pair in pairwise(values)]
        values = [jax.tree.map(jnp.add, finer, error) for finer, error in zip(values[1:], errors)]
    return Extrapolated(values[0], errors[0])


def missing(coarse, fine, power: int = 1):
    """What values miss whose errors are of order h²ᵏ, k the power."""
    return (fine - coarse) / (4.0**power - 1.0)
