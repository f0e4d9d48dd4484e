"""Criteria of a trajectory (paper, §5)."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import as_float


def time_integral(t: Float[Array, " n"], f: Float[Array, " n ..."]) -> Float[Array, " ..."]:
    """∫ f dt by the trapezoidal rule, second order like the integrator.

        Ψ = Σ_n (t_{n+1} − t_n) (f_n + f_{n+1})/2

    Arguments:
        t: times [s], shape (n,), `Trajectory.t`.
        f: the integrand at these times, shape (n, …).

    Returns the integral [unit of f × s], shape (…). Raises `ValueError` for lengths that differ.
    Source: Sonneville & Brüls (2014), eq. (31).
    """
    t, f = as_float(t, None, "`t`"), as_float(f, None, "`f`")
    if t.ndim != 1 or f.ndim < 1 or t.shape[0] != f.shape[0]:
        raise ValueError(
            f"`time_integral`: `t` must have shape (n,) and `f` shape (n, …), got {t.shape} and {f.shape}."
        )
    weight = jnp.diff(t).reshape((-1,) + (1,) * (f.ndim - 1))
    return jnp.sum(jnp.broadcast_to(weight, f[1:].shape) * (f[1:] + f[:-1]), axis=0) / 2
