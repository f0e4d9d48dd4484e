"""What a value and its gradient are worth: errors estimated from the run itself, and what may spoil them.

**Errors.** Let Ψ be the criterion of the numerical motion y(p), and Ψ̂ that of the motion corrected by its estimated
error e, L e = b (`_error_estimate`), with a quadrature of fourth order. Both are functions of p that can be
differentiated exactly, e by the rule of `linear_solve`, e' = L⁻¹ (b' − L' e), with products L' and no other run. So

    true Ψ ≈ Ψ + (Ψ̂ − Ψ),     true dΨ/dp ≈ dΨ/dp + (dΨ̂/dp − dΨ/dp).

Errors of a scheme of order p have an expansion h^p e(t; p) + … whose terms are smooth in the parameters, and the
derivative of the leading term is that of the error of the derivative. Of a scheme that does not know what its steps
miss Ψ̂ is extrapolated from a second run (`_refined_run`), each with its own quadrature over stages. Where the motion is
not smooth, or not resolved, there is no such expansion: this is looked for, below.

**Newton.** What the steps leave of their equations, r = E(y_n, y_{n+1}), moves the trajectory by −L⁻¹ r, and Ψ by
−Ψ_y L⁻¹ r = −μ·r, μ = L⁻ᵀ Ψ_yᵀ the adjoint variables of Ψ.

**Duality.** Along a random direction the derivative by the direct differentiation method and the product with the
gradient by the adjoint variable method are the same number, computed with L and with Lᵀ.

**Growth.** The variation of the motion along that direction, g(t) = max |δq|/scale up to t: where it grows by more than
16 times in the second half of the run, growth is exponential (`sensitivity_growth`).

**Kinks** of forces between two steps are looked for in second differences, jumps of integrands in first ones
(`_kinks`).

Sources: Eriksson, Estep, Hansbo & Johnson, Introduction to adaptive methods for differential equations, Acta Numerica 4
(1995) (errors of functionals by adjoint equations); Cao & Petzold, SIAM J. Sci. Comput. 26 (2004) 359 (a posteriori
errors of solutions of differential equations by the adjoint method).
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from lgsens._validate import as_count, as_parameters
from lgsens.criteria._certificate import Certificate
from lgsens.criteria._criterion import Criterion
from lgsens.criteria._error_estimate import corrected, error_by_defects, smooth_defects
from lgsens.criteria._kinks import breaks_apart, jumps_of, kinks, roughness
from lgsens.criteria._known_motion import known_motion, unpacked
from lgsens.criteria._refined_run import extrapolated, refined_run, require_order
from lgsens.dynamics import State
from lgsens.integrate import (
    AbstractIntegrator,
    GeneralizedAlpha,
    Variation,
    earlier,
    later,
    rows,
    singular_steps,
)
from lgsens.sensitivity import KnownRun
from lgsens.simulation import Trajectory, check_integrator, interval, raise_if_failed, warn_of_single_precision

_LEAST_STEPS = 8
_REGULAR = 16.0  # of twice the time; in a regular motion sensitivities grow like t, under a constant force like t²


def certify(
    criterion: PyTree,
    build: Callable[[Any], Any],
    p: PyTree,
    *,
    t0=0.0,
    t1,
    num_steps: int,
    integrator: AbstractIntegrator = GeneralizedAlpha(),
    state0: Callable[[Any], State] | None = None,
    tolerance: float = 1e-3,
    throw: bool = True,
) -> Any:
    """Ψ and dΨ/dp of a simulation, how wrong each of them is, and whether the gradient can be trusted at all.

    ```python
    print(lg.certify(criterion, build, p, t1=1.0, num_steps=400))
    ```

    Arguments:
        criterion: a `Criterion`, or another smooth function (trajectory, p) ↦ Ψ, scalar, which follows the `order` of
            the trajectory in its integrals (`time_integral(…, order=trajectory.order)`); or a pytree of them, all of
            one run.
        build, p, t0, t1, num_steps, state0: as in `differentiate`.
        integrator: one with equal steps, or such between breaks of the scene (`AlignedSteps`).
        tolerance: the relative error of value and gradient that is wanted.
        throw: raise if the simulation fails; with False the certificate says so.

    The errors are those of the discretization in time, to leading order: from this one run for `GeneralizedAlpha` of
    index 3 in equal steps where no driver breaks, else from a second one in steps half as long, whose criteria are
    extrapolated. What the model leaves out is no part of them. Kinks are told from second differences of accelerations,
    in steps that resolve what is around, but not next to breaks at which steps end.

    Returns a `Certificate`, or a pytree of them as the criteria. `differentiate(…, certificate=True)` has it beside its
    own result. Raises `ValueError` as `differentiate`, for an integrator with other steps or fewer than eight of them,
    and inside of `jit`, `grad` and `vmap`.
    """
    criteria, structure = jax.tree.flatten(criterion, is_leaf=callable)
    if not (criteria and all(map(callable, [*criteria, build]))):
        raise ValueError(f"`criterion` and `build` must be functions, got {criterion!r} and {build!r}.")
    num_steps = as_count(num_steps, "num_steps", " (it is static)")
    check_integrator(integrator, num_steps)
    check_certifiable(integrator, num_steps, (p, t0, t1))
    if not (isinstance(tolerance, float | int) and 0.0 < tolerance < 1.0):
        raise ValueError(f"`tolerance` must be a number between 0 and 1, got {tolerance!r}.")
    t0, t1 = interval(t0, t1)
    warn_of_single_precision(t0.dtype)
    p = as_parameters(p)
    motion = known_motion(build, state0, p, t0, t1, num_steps, integrator)
    found, shared, trajectory, rough = _certified(tuple(criteria), motion, p, integrator)
    if throw:
        raise_if_failed(trajectory)
    own = {"tolerance": float(tolerance), "kinks": kinks(trajectory, rough)}
    at = lambda jumps: tuple(np.asarray(trajectory.t)[np.asarray(jumps)].tolist())
    times, apart = map(np.asarray, shared["coincident"])
    shared = shared | {"coincident": tuple(times[apart].tolist())}
    return structure.unflatten([Certificate(**one | {"jumps": at(one["jumps"])}, **shared, **own) for one in found])


def check_certifiable(integrator: AbstractIntegrator, num_steps: int | None, numbers: PyTree) -> None:
    """Raise `ValueError` for what `certify` has no answer to; `num_steps` None: enough of them."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(numbers)):
        raise ValueError("A certificate is of known numbers: ask for it outside of `jit`, `grad` and `vmap`.")
    if not integrator.equal_pieces or integrator.extrapolated:
        raise ValueError(
            f"`integrator` must be a scheme with equal steps, or AlignedSteps(…), got {integrator!r}; certify the "
            "scheme that it lays or extrapolates, `integrator.scheme`."
        )
    require_order(integrator.scheme)
    if num_steps is not None and num_steps < _LEAST_STEPS:
        raise ValueError(f"`num_steps` must be at least {_LEAST_STEPS} for an estimate, got {num_steps}.")


@eqx.filter_jit
def _certified(criteria, motion, p, integrator: AbstractIntegrator) -> tuple[list[dict], dict[str, Any], Any, Any]:
    """What is known of each criterion, and of the motion; the motion, and how rough it is."""
    motion = unpacked(motion)
    known, each = motion.known, len(criteria)
    system, states = known.parameters.system, known.states
    flat, unravel = ravel_pytree(p)

    def values_of(trajectory, flat):
        return jnp.stack([jnp.asarray(criterion(trajectory, unravel(flat))) for criterion in criteria])

    def computed(states, system, flat):
        trajectory = motion.trajectory(integrator, states, system)
        return values_of(trajectory, flat), trajectory

    def improved(states, system, flat):
        trajectory = motion.trajectory(integrator, states, system)
        parameters = known.parameters._replace(system=system)
        defects = smooth_defects(known.scheme, system, parameters.grid, trajectory.states)
        if defects is None:
            finer = refined_run(known.scheme, trajectory, motion.grid(integrator, system))
            return extrapolated(known.scheme, values_of(trajectory, flat), values_of(finer, flat))
        error = error_by_defects(known.scheme, trajectory.states, parameters, defects, known.linear)
        return values_of(corrected(trajectory, error), flat)

    at = states, system, flat
    values, pull_back, trajectory = jax.vjp(computed, *at, has_aux=True)
    improved_values, pull_back_improved = jax.vjp(improved, *at)
    unit = list(jnp.eye(each, dtype=flat.dtype))
    of_each = [pull(row) for pull in (pull_back, pull_back_improved) for row in unit]
    gradients, mu = motion.gradients(jax.tree.map(lambda *rows: jnp.stack(rows), *of_each), flat)
    gradient, better = gradients[:each], gradients[each:]

    random = jax.random.normal(jax.random.key(0), flat.shape, flat.dtype)
    direction = random * jnp.where(flat == 0.0, 1.0, jnp.abs(flat))
    tangents = motion.along(direction)
    along = jax.jvp(lambda *at: computed(*at)[0], at, tangents)[1]
    terms = gradient * direction[None]
    largest = jnp.maximum(jnp.max(jnp.abs(terms), axis=1), jnp.finfo(flat.dtype).tiny)
    duality = jnp.abs(along - jnp.sum(terms, axis=1)) / largest
    w = jax.vmap(system.group.from_ambient)(states.q, tangents[0].q)
    grown = lax.cummax(jnp.max(jnp.abs(w) / system.coordinate_scale()[None], axis=1))
    growth = grown[-1] / jnp.max(jnp.abs(random))
    margins = known.stats.margin
    margin = jnp.min(margins) / jnp.max(
        margins, where=jnp.isfinite(margins), initial=0.0
    )  # infinite: none was looked at
    margin = jnp.where(jnp.any(singular_steps(margins)), 0.0, margin)
    newton = jnp.full(each, jnp.nan, flat.dtype)
    if known.scheme.physical(system, states) is states:  # nothing of them was left out
        newton = _left_by_newton(known, jax.tree.map(lambda leaf: leaf[:each], mu))
    told = known.parameters.grid.begins_pieces
    rough = roughness(trajectory, told)
    found = [
        {
            "value": values[i],
            "gradient": unravel(gradient[i]),
            "value_error": improved_values[i] - values[i],
            "gradient_error": unravel(better[i] - gradient[i]),
            "duality": duality[i],
            "newton": newton[i],
            "jumps": jumps_of(_integrand(criteria[i], trajectory, p), told),
        }
        for i in range(each)
    ]
    shared = {
        "growth": growth,
        "exponential": grows_exponentially(grown),
        "margin": margin,
        "unresolved": rough.unresolved,
        "begin": rough.begin,
        "result": trajectory.result,
        "coincident": breaks_apart(trajectory, tangents[1]),
    }
    return found, shared, trajectory, rough


def _integrand(criterion: Callable, trajectory: Trajectory, p) -> Float[Array, " n+1"]:
    """At all times; 0 of what has none that is known."""
    if not isinstance(criterion, Criterion):
        return jnp.zeros_like(trajectory.t)
    rate = lambda state, t: criterion.rate(trajectory.system, state, t, p)
    return jax.vmap(rate)(trajectory.states, trajectory.t)


def grows_exponentially(factor: Float[Array, " n+1"]) -> Bool[Array, ""]:
    """Whether g, the largest change so far on equal steps, grows by more than a regular motion's in the second half."""
    return factor[-1] > _REGULAR * factor[(factor.shape[0] - 1) // 2]


def _left_by_newton(known: KnownRun, mu: Variation) -> Float[Array, " c"]:
    """−μ·r, one for each criterion."""
    (system, grid), states = known.parameters, known.states

    def left(place, before, state):
        return rows(known.scheme, system, grid.node(place), grid.begun(known.scheme, system, place, before), state)

    residual = jax.vmap(left)(grid.places(), earlier(states), later(states))
    products = jax.tree.map(lambda mu, r: jnp.einsum("cnk,nk->c", mu[:, 1:], r), mu, residual)
    return -jnp.sum(jnp.stack(jax.tree.leaves(products)), axis=0)
