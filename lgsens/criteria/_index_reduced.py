"""The index-reduced equations with their sensitivities as one ordinary differential equation, under error control.

With the constraint at acceleration level the multipliers are functions of the state, eq. (41), and what is left is an
ordinary differential equation for configuration, velocity and the integrals of the criteria,

    q̇ = q ṽ,     [[M, Bᵀ], [B, 0]] [v̇; λ] = [ad(v)ᵀ M v − f(q, v, t); −Ḃ v],     ψ̇ = F(p, q, v, v̇, λ, t),

written ẏ = Y(y, p, t) in the arrays of q; Ψ = ψ(t1) + G(t1). The derivatives η_j of y obey the variational equations
η̇_j = ∂Y/∂y η_j + ∂Y/∂p_j, by JAX's forward mode of Y. Only the model (r, Φ, B), the initial state and eq. (41) are
shared with the rest of the library: no generalized-α scheme, no linearization K_t, C_t and no adjoint equation. So this
is the reference for all of them, of order eight.

y and all η_j are integrated together, and every entry of them meets the tolerance. Steps that are chosen for the motion
alone can be unstable for its sensitivities (on the quarter-car: hardpoint gradients wrong by factors, Ψ right to 2e-4).

- Parameters have units, so derivatives are taken in θ, p_j = p_j0 + s_j θ_j with s_j = |p_j0| (1 where that is zero):
  the change of the motion as p_j changes by its own size, which is of the size of the motion whatever the unit.
- Criteria have units too. A first run, at 1e-6, finds the size of each integral, to which `atol` refers if it is above
  one. Otherwise an integral of 1e7 N² s would have to be right to 1e-12 from the start, in five times the steps.
- The norm is the largest entry, so more parameters do not loosen the control.

Nothing holds Φ(q) = 0, nor the rotations orthogonal: both drift with the error of the integration, at the default
tolerances 1e-14 to 1e-13 over seconds. `drift` reports the first.

Source: Sonneville & Brüls (2014), eqs. (15)–(17) and (41); Hairer, Nørsett & Wanner, Solving Ordinary Differential
Equations I (2008), §II.5 (the scheme of order eight) and §I.14 (variational equations).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from lgsens._validate import as_count, as_float, is_concrete, require
from lgsens.dynamics import RESULTS, AbstractSystem, State, accelerations, breaks_of, initial_state, names_of_all
from lgsens.simulation import SimulationError, throw_if_failed

Pointwise = Callable[[Array, AbstractSystem, State, Array], Float[Array, " c"]]

_COARSE = 1e-6  # tolerance of the first run


class IndexReducedRun(NamedTuple):
    """Criteria Ψ with their gradients dΨ/dp, and how the integration went."""

    value: Float[Array, " c"]
    gradient: Float[Array, "c p"]
    num_steps: Int[Array, ""]  # accepted, at the tolerances asked for
    drift: Float[Array, ""]  # max |Φ(q)| at t1


def integrate_index_reduced(
    rate: Pointwise,
    final: Pointwise,
    build: Callable[[Array], AbstractSystem],
    p,
    t0,
    t1,
    *,
    rtol: float = 1e-12,
    atol: float = 1e-12,
    max_steps: int = 20_000,
    breaks: Sequence[float] | Array | None = None,
) -> IndexReducedRun:
    """The criteria Ψ = G(t1) + ∫ F dt and dΨ/dp, by Dormand & Prince's scheme of order eight.

    Arguments:
        rate: F(p, system, state, t) → shape (c,), the integrands. `state`: q, v, v̇, λ, and a = v̇.
        final: G(p, system, state, t) → shape (c,), the terminal terms, of t1.
        build: p → the system.
        p: parameters, shape (p,), at least one.
        t0, t1: initial and final time [s], shape (); t1 > t0.
        rtol, atol: tolerances of one step, for each entry of the motion, the integrals and their derivatives.
        max_steps: steps to try; static.
        breaks: the times at which forces are not smooth in t, beside those that signals of the system tell (both ends
            of a bump): no step crosses one. Forces must be continuous there if the time depends on p.

    Compiled once for each triple of functions, told apart by identity: define them outside a loop. All numbers may
    change, also those in a callable `equinox.Module`. Can be called inside `jit` and under `vmap`; the result is not
    meant to be differentiated.

    Raises `ValueError` for bad arguments, tolerances beyond the precision, a mechanism that cannot be assembled or has
    redundant constraints, and `SimulationError` when `max_steps` are not enough; inside `jit` all is NaN then.
    """
    p, t0, t1 = as_float(p, None, "`p`"), as_float(t0, (), "`t0`"), as_float(t1, (), "`t1`")
    if p.ndim != 1 or p.size == 0:
        raise ValueError(f"`p` must have shape (p,) with at least one parameter, got {p.shape}.")
    require(lambda t0, t1: t1 > t0, lambda: f"`t1` must be later than `t0`, got t0 = {t0} s and t1 = {t1} s.", t0, t1)
    tolerances = as_float(rtol, (), "`rtol`"), as_float(atol, (), "`atol`")
    smallest = 8 * float(jnp.finfo(p.dtype).eps)
    require(
        lambda rtol, atol: rtol >= smallest and atol > 0,
        lambda: (
            f"`rtol` must be at least {smallest:.0e} in {p.dtype}, and `atol` positive; got {rtol} and {atol}. "
            'jax.config.update("jax_enable_x64", True) gives 64 bits.'
        ),
        *tolerances,
    )
    max_steps = as_count(max_steps, "max_steps", " (it is static)")
    jumps = as_float(() if breaks is None else breaks, None, "`breaks`").reshape(-1)
    run, finished, result, details, names = _run(rate, final, build, p, t0, t1, tolerances, max_steps, jumps)
    run = throw_if_failed(run, result, details, names)
    message = (
        f"The integration with error control did not reach `t1` in {max_steps} steps. Give the times at which forces "
        "are not smooth as `breaks`, loosen `rtol` and `atol`, or raise `max_steps`."
    )
    if is_concrete(finished) and not bool(finished):
        raise SimulationError(message)
    return run._replace(
        value=jnp.where(finished, run.value, jnp.nan), gradient=jnp.where(finished, run.gradient, jnp.nan)
    )


@eqx.filter_jit
def _run(rate, final, build, p, t0, t1, tolerances, max_steps, jumps):
    # The numbers of the system travel with their derivatives, so that `build` is not part of Y.
    _, rest = eqx.partition(build(p), eqx.is_inexact_array)

    def start(p):
        numbers = eqx.filter(build(p), eqx.is_inexact_array)
        return numbers, initial_state(eqx.combine(numbers, rest), t0)

    scale = jnp.where(p == 0.0, 1.0, jnp.abs(p))
    directions = jnp.diag(scale)
    (numbers, initial), push = jax.linearize(start, p)
    varied_numbers, varied = jax.vmap(push)(directions)
    system = eqx.combine(numbers, rest)
    jumps = jnp.concatenate([jumps, breaks_of(system).astype(p.dtype)])
    zeros = _no_integrals(rate, final, p, system, initial.state, t0)
    y, unravel = ravel_pytree((initial.state.q, initial.state.v, zeros))
    eta = jax.vmap(lambda state: ravel_pytree((state.q, state.v, zeros))[0])(varied.state)
    rows = jnp.concatenate([y[None], eta])

    def at(numbers, y, t) -> tuple[AbstractSystem, State, Array]:
        system = eqx.combine(numbers, rest)
        q, v, psi = unravel(y)
        vdot, lam = accelerations(system, q, v, t)
        return system, State(q=q, v=v, vdot=vdot, lam=lam, a=vdot), psi

    def slope(y, p, numbers, t):
        system, state, _ = at(numbers, y, t)
        return ravel_pytree((system.group.to_ambient(state.q, state.v), state.vdot, rate(p, system, state, t)))[0]

    def criteria(y, p, numbers, t):
        system, state, psi = at(numbers, y, t)
        return psi + final(p, system, state, t), system.constraint(state.q, t)

    def with_variations(function, rows, t) -> Any:
        """`function` and its derivatives, of y and η_j, the rows."""
        push = lambda *varied: jax.jvp(partial(function, t=t), (rows[0], p, numbers), varied)
        return jax.vmap(push, out_axes=(None, 0))(rows[1:], directions, varied_numbers)

    def equation(t, rows, _):
        slopes, varied = with_variations(slope, rows, t)
        return jnp.concatenate([slopes[None], varied])

    def integrate(carry, tolerance):
        size, end = carry
        rtol, atol = (jnp.maximum(asked, tolerance) for asked in tolerances)
        controller = diffrax.PIDController(rtol, atol * size, norm=lambda error: jnp.max(jnp.abs(error)))
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(equation),
            diffrax.Dopri8(),
            *(t0, end, None, rows),
            stepsize_controller=diffrax.ClipStepSizeController(controller, jump_ts=jumps if jumps.size else None),
            adjoint=diffrax.ForwardMode(),  # the plain loop: nothing is kept for a reverse mode
            max_steps=max_steps,
            throw=False,
        )
        assert solution.ys is not None
        reached, finished = solution.ys[0], solution.result == diffrax.RESULTS.successful
        # the integral, or the most that a parameter changes it by; motion and variations are taken as of size one
        integrals = jnp.max(jnp.abs(reached[:, y.size - zeros.size :]), axis=0)
        size = jnp.ones_like(rows).at[:, y.size - zeros.size :].set(jnp.maximum(integrals, 1.0)[None])
        return (size, jnp.where(finished, end, t0)), (reached, finished, solution.stats["num_accepted_steps"])

    # One program run twice, which is compiled once. A start or a first run that failed is not continued.
    end = jnp.where(initial.result == RESULTS.successful, t1, t0)
    runs = jnp.array([_COARSE, 0.0], dtype=p.dtype)
    _, (reached, finished, steps) = lax.scan(integrate, (jnp.ones_like(rows), end), runs)
    (value, violation), (varied_value, _) = with_variations(criteria, reached[-1], t1)
    run = IndexReducedRun(value, (varied_value / scale[:, None]).T, steps[-1], jnp.max(jnp.abs(violation), initial=0.0))
    details = {"violation": initial.violation, "jacobian": system.constraint_jacobian(initial.state.q, t0)}
    return run, jnp.all(finished), initial.result, details, names_of_all(system)


def _no_integrals(rate, final, p, system, state, t) -> Float[Array, " c"]:
    """Zeros, one for each criterion; the functions must agree on their number."""
    shapes = [jax.eval_shape(partial(function, p, system), state, t) for function in (rate, final)]
    if len(shapes[0].shape) != 1 or shapes[0].shape != shapes[1].shape:
        raise ValueError(
            "`rate` and `final` must both return shape (c,), one entry for each criterion; got "
            f"{shapes[0].shape} and {shapes[1].shape}."
        )
    return jnp.zeros(shapes[0].shape, t.dtype)
