"""Criteria of a trajectory (paper, §5)."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lgsens._validate import as_float, require
from lgsens._xla import one_program
from lgsens.dynamics import AbstractSystem, State, breaks_of
from lgsens.integrate import nearest_ends
from lgsens.sensitivity import Functional
from lgsens.simulation import Instant, Trajectory

Pointwise = Callable[[Instant, Any], Float[Array, ""]]


class Criterion(eqx.Module):
    """A criterion with its integrand and its terminal term apart, eq. (31).

        Ψ = G(q, v, p)|_{t1} + ∫ F(q, v, v̇, λ, p) dt

    Arguments:
        integrand: F(s, p) → scalar; `s` is an `Instant` (`s.body(name)`, `s.point(body, at)`,
            `s.joint(name)`, `s.multiplier(joint)`, `s.force(name)`, `s.state`, `s.t`), `p` the design parameters. None:
            no integral.
        terminal: G(s, p) → scalar, of the instant t1. None: no terminal term.

    `criterion(trajectory, p)` is Ψ, by `time_integral` of the order of the trajectory or, where this has `stages`, by
    the quadrature of its Runge–Kutta scheme. It can be differentiated like any function of a trajectory;
    `differentiate` gives its value and gradient by every method of the paper. Numbers that F and G depend on come
    through `p`, or are constants.

    Raises `ValueError` if both are None or one cannot be called so, and, when it is evaluated, for a value that is
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
            if function is not None and not _takes_two(function):
                raise ValueError(f"Criterion: `{name}` must take two arguments, (instant, parameters): lambda s, p: …")

    def rate(self, system: AbstractSystem, state: State, t, p) -> Float[Array, ""]:
        """F at one state, shape ()."""
        return _scalar("integrand", self.integrand, system, state, t, p)

    def final(self, system: AbstractSystem, state: State, t, p) -> Float[Array, ""]:
        """G at one state, shape ()."""
        return _scalar("terminal", self.terminal, system, state, t, p)

    def __call__(self, trajectory: Trajectory, p: PyTree = None) -> Float[Array, ""]:
        """Ψ of a trajectory, shape (), or of each of a batch; `p`: the design parameters, if F or G use them."""
        if trajectory.t.ndim > 1:
            if p is not None:
                raise ValueError(
                    "Criterion: this is a batch of trajectories, of shape "
                    f"{trajectory.t.shape[:-1]}; say whose `p` is whose: jax.vmap(criterion)(trajectories, p), with "
                    "in_axes=(0, None) where all have one."
                )
            return jax.vmap(self)(trajectory)
        t, states, system = trajectory.t, trajectory.states, trajectory.system
        value = self.final(system, trajectory.state(-1), t[-1], p)
        if self.integrand is None:
            return value
        rate = jax.vmap(lambda state, t: self.rate(system, state, t, p))
        if trajectory.stages is not None:
            stages = trajectory.stages
            return value + stages.weights @ rate(stages.states, stages.t)
        rates = rate(states, t)
        breaks = breaks_of(system) if trajectory.order == 4 else None  # the trapezoidal rule has no use for them
        return value + time_integral(t, rates, order=trajectory.order, breaks=breaks)


def _takes_two(function: Pointwise) -> bool:
    try:
        inspect.signature(function).bind(None, None)
    except TypeError:
        return False
    except ValueError:  # of a builtin it is not known
        pass
    return True


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


def time_integral(
    t: Float[Array, " n"], f: Float[Array, " n ..."], *, order: int = 2, breaks: Float[Array, " k"] | None = None
) -> Float[Array, " ..."]:
    """∫ f dt: by the trapezoidal rule, second order like the integrator, or by Gregory's rule of fourth order.

        order 2:  T = Σ_n (t_{n+1} − t_n) (f_n + f_{n+1})/2
        order 4:  T − h/12 (∇f_N − Δf_0) − h/24 (∇²f_N + Δ²f_0)   for each piece of equal steps, from 0 to N

    Arguments:
        t: times [s], shape (n,), `Trajectory.t`.
        f: the integrand at these times, shape (n, …).
        order: 2 or 4, static; `Trajectory.order` says what the states deserve. 4 needs equidistant times, three at
            least, or pieces of such (`AlignedSteps`), and an integrand whose slope jumps from one piece to the next
            only; with a slope that jumps elsewhere both rules are of second order. Unlike Simpson's rule it weighs all
            times inside of a piece alike.
        breaks: times at which the slope of the integrand jumps [s], shape (k,): pieces end at those of them at which a
            step does, also where steps before and behind are equal. None: pieces are told from sizes of steps alone.

    Returns the integral [unit of f × s], shape (…). Raises `ValueError` for lengths that differ, another order, breaks
    of another shape, and for order 4 with too few times, or a step that is equal to none beside it. Sources: Sonneville
    & Brüls (2014), eq. (31); Hildebrand, Introduction to Numerical Analysis (1974), §5.8 (Gregory).
    """
    t, f = as_float(t, None, "`t`"), as_float(f, None, "`f`")
    if t.ndim != 1 or f.ndim < 1 or t.shape[0] != f.shape[0]:
        raise ValueError(
            f"`time_integral`: `t` must have shape (n,) and `f` shape (n, …), got {t.shape} and {f.shape}."
        )
    breaks = None if breaks is None else as_float(breaks, None, "`breaks`").astype(t.dtype)
    if breaks is not None and breaks.ndim != 1:
        raise ValueError(f"`time_integral`: `breaks` must have shape (k,), got {breaks.shape}.")
    if order not in (2, 4):
        raise ValueError(f"`time_integral`: `order` must be 2 (trapezoidal) or 4 (Gregory), got {order!r}.")
    if order == 2:
        return _trapezoidal(t, f)
    if t.shape[0] < 3:
        raise ValueError(f"`time_integral`: order 4 needs at least 3 times, got {t.shape[0]}; order=2 does with fewer.")
    require(
        lambda t: _in_pieces(np.asarray(t)),
        "`time_integral`: order 4 needs times `t` that are equidistant, or pieces of such, as `Trajectory.t`; use "
        "order=2 for others.",
        t,
    )
    return _gregory(t, f, breaks)


def _along_time(sizes, f):
    return sizes.reshape((-1,) + (1,) * (f.ndim - 1))


@one_program
def _trapezoidal(t, f):
    return jnp.sum(jnp.broadcast_to(_along_time(jnp.diff(t), f), f[1:].shape) * (f[1:] + f[:-1]), axis=0) / 2


@one_program
def _gregory(t, f, breaks):
    h = jnp.diff(t)
    equal = _equal_to_next(jax.lax.stop_gradient(t))  # of the steps from t_n and t_{n+1}
    if breaks is not None and breaks.size:
        nearest, met = nearest_ends(*jax.lax.stop_gradient((t, breaks)), 1e-3)
        equal &= ~jnp.zeros(t.size, bool).at[nearest].max(met)[1:-1]
    begins = jnp.where(equal & ~jnp.pad(equal, (1, 0))[:-1], h[:-1], 0.0)
    ends = jnp.where(equal & ~jnp.pad(equal, (0, 1))[1:], h[1:], 0.0)
    slopes, bends = jnp.diff(f, axis=0), jnp.diff(f, 2, axis=0)
    corrected = _along_time(begins, f) * (slopes[:-1] / 12.0 - bends / 24.0)
    corrected -= _along_time(ends, f) * (slopes[1:] / 12.0 + bends / 24.0)
    return _trapezoidal(t, f) + jnp.sum(corrected, axis=0)


def _equal_to_next(t):
    """Whether each step is as long as the next, up to round-off of their times."""
    xp = np if isinstance(t, np.ndarray) else jnp
    h = xp.diff(t)
    return xp.abs(xp.diff(h)) <= 1e-6 * h[1:] + 32 * float(np.finfo(t.dtype).eps) * xp.max(xp.abs(t))


def _in_pieces(t: np.ndarray) -> bool:
    """Whether each step is as long as one beside it."""
    equal = _equal_to_next(t)
    return bool(np.all(np.pad(equal, (1, 0)) | np.pad(equal, (0, 1))))


def soft_maximum(values: Float[Array, " n"], sharpness: float | Float[Array, ""]) -> Float[Array, ""]:
    """A smooth bound of the largest value from above, the function of Kreisselmeier and Steinhauser.

        KS_ρ(g) = ln(Σ_i exp(ρ g_i))/ρ,       max g ≤ KS_ρ(g) ≤ max g + ln(n)/ρ

    One constraint KS_ρ(g) ≤ 0 keeps all of g ≤ 0, at all times of a path constraint and of several, and its gradient is
    one, the mean of theirs with weights exp(ρ (g_i − KS)). It holds the design back by up to ln(n)/ρ more than g does;
    a larger ρ less, at the price of curvature ∼ ρ.

    Arguments:
        values: g, any shape but empty; scaled so that 1 is large.
        sharpness: ρ [1/unit of g], positive; 50 to 500 for constraints scaled to 1.

    Returns KS [unit of g], shape (). Raises `ValueError` for no values or a sharpness that is not positive. Source:
    Kreisselmeier & Steinhauser, Systematic control design by optimizing a vector performance index (IFAC 1979).
    """
    values, sharpness = as_float(values, None, "`values`"), as_float(sharpness, (), "`sharpness`")
    if values.size == 0:
        raise ValueError("`soft_maximum`: `values` is empty; there is no largest value.")
    require(lambda rho: rho > 0, lambda: f"`soft_maximum`: `sharpness` must be positive, got {sharpness}.", sharpness)
    return _kreisselmeier_steinhauser(values, sharpness)


@one_program
def _kreisselmeier_steinhauser(values, sharpness):
    return jax.nn.logsumexp(sharpness * values) / sharpness


def stacked(criteria: tuple[Criterion, ...], unravel: Callable[[Any], Any]) -> Functional:
    """All criteria as one function of the flat vector of parameters."""

    def of(which):
        def function(p, system, state, t):
            return jnp.stack([getattr(c, which)(system, state, t, unravel(p)) for c in criteria])

        return function

    return Functional(rate=of("rate"), final=of("final"))
