"""Criteria of a trajectory (paper, §5)."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lgsens._trajectory import Instant, Trajectory
from lgsens._validate import as_float
from lgsens.dynamics import AbstractSystem, State

Pointwise = Callable[[Instant, Any], Float[Array, ""]]


class Criterion(eqx.Module):
    """A criterion with its integrand and its terminal term apart, eq. (31).

        Ψ = G(q, v, p)|_{t1} + ∫ F(q, v, v̇, λ, p) dt

    Arguments:
        integrand: F(s, p) → scalar; `s` is an `Instant` (`s.body(name)`, `s.multiplier(joint)`, `s.force(name)`,
            `s.state`, `s.t`), `p` the design parameters. None: no integral.
        terminal: G(s, p) → scalar, of the instant t1. None: no terminal term.

    `criterion(trajectory, p)` is Ψ, by the trapezoidal rule, and can be differentiated like any function of a
    trajectory; `differentiate` gives its value and gradient by every method of the paper. Numbers that F and G
    depend on come through `p`, or are constants.

    Raises `ValueError` if both are None or one cannot be called, and, when it is evaluated, for a value that is
    not a scalar. Source: Sonneville & Brüls (2014), §5.
    """

    integrand: Pointwise | None = eqx.field(static=True, default=None)
    terminal: Pointwise | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.integrand is None and self.terminal is None:
            raise ValueError("Criterion: give an `integrand` F(s, p), a `terminal` G(s, p), or both.")
        for name, function in (("integrand", self.integrand), ("terminal", self.terminal)):
            if function is not None and not callable(function):
                raise ValueError(f"Criterion: `{name}` must be a function of (instant, parameters), got {function!r}.")

    def rate(self, system: AbstractSystem, state: State, t, p) -> Float[Array, ""]:
        """F at one state, shape ()."""
        return _scalar("integrand", self.integrand, system, state, t, p)

    def final(self, system: AbstractSystem, state: State, t, p) -> Float[Array, ""]:
        """G at one state, shape ()."""
        return _scalar("terminal", self.terminal, system, state, t, p)

    def __call__(self, trajectory: Trajectory, p: PyTree = None) -> Float[Array, ""]:
        """Ψ of a trajectory, shape (); `p`: the design parameters, if F or G use them."""
        t, states, system = trajectory.t, trajectory.states, trajectory.system
        value = self.final(system, trajectory.state(-1), t[-1], p)
        if self.integrand is None:
            return value
        return value + time_integral(t, jax.vmap(lambda state, t: self.rate(system, state, t, p))(states, t))


def _scalar(name: str, function: Pointwise | None, system, state: State, t, p) -> Float[Array, ""]:
    if function is None:
        return jnp.zeros_like(t)
    value = function(Instant(t=t, state=state, system=system), p)
    shape, dtype = getattr(value, "shape", ()), getattr(value, "dtype", None)
    if not isinstance(value, jax.Array | float | int) or shape != ():
        what = f"an array of shape {shape}" if isinstance(value, jax.Array) else f"{type(value).__name__}"
        raise ValueError(
            f"Criterion: `{name}` must return a scalar, got {what}; reduce it (jnp.sum), or make one Criterion of each "
            "entry: several criteria are differentiated at once."
        )
    if dtype is not None and not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"Criterion: `{name}` must return a real number, got {dtype}; convert it to float.")
    return jnp.asarray(value, t.dtype)


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
