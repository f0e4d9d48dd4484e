"""What a value and its gradient are worth: errors estimated from the run itself, and what may spoil them.

**Errors.** Let Ψ be the criterion of the numerical motion y(p), and Ψ̂ that of the motion corrected by its estimated
error e, L e = b (`_error_estimate`), with a quadrature of fourth order. Both are functions of p that can be
differentiated exactly, e by the rule of `linear_solve`, e' = L⁻¹ (b' − L' e), with products L' and no other run. So

    true Ψ ≈ Ψ + (Ψ̂ − Ψ),     true dΨ/dp ≈ dΨ/dp + (dΨ̂/dp − dΨ/dp).

Errors of a scheme of order p have an expansion h^p e(t; p) + … whose terms are smooth in the parameters, and the
derivative of the leading term is that of the error of the derivative. Where the motion is not smooth, or not resolved,
there is no such expansion: this is looked for, below.

**Newton.** What the steps leave of their equations, r = E(y_n, y_{n+1}), moves the trajectory by −L⁻¹ r, and Ψ by its
derivative along that.

**Duality.** Along a random direction the derivative by the direct differentiation method and the product with the
gradient by the adjoint variable method are the same number, computed with L and with Lᵀ.

**Growth.** The variation of the motion along that direction, g(t) = max |δq|/scale up to t: where it grows by more than
16 times in the second half of the run, growth is exponential (`sensitivity_growth`).

**Kinks.** Where a force has a kink or a jump between two steps, second differences of accelerations are larger by 1/h
or 1/h² than before and after; where a motion is not resolved they are as large as the accelerations.

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
from jax.flatten_util import ravel_pytree
from jaxtyping import PyTree

from lgsens._validate import as_count, as_float
from lgsens.accuracy._certificate import Certificate
from lgsens.accuracy._error_estimate import corrected, error_estimate
from lgsens.analysis import grows_exponentially
from lgsens.dynamics import State
from lgsens.integrate import (
    AbstractIntegrator,
    AbstractScheme,
    EqualGrid,
    GeneralizedAlpha,
    Variation,
    earlier,
    later,
    rows,
    singular_steps,
    with_first,
)
from lgsens.model import MultibodySystem
from lgsens.sensitivity import Parameters, linearized_trajectory, to_ambient
from lgsens.simulation import Trajectory, check_integrator, interval, raise_if_failed, simulate

_LEAST_STEPS = 8
_SPIKE = 8.0  # second differences beside a smooth change of accelerations differ by less
_INSIDE = 0.1
_VISIBLE = 1e-4  # of the largest acceleration: smaller kinks move a value by less than the scheme does
_AS_LARGE = 0.5  # of the largest acceleration of a time: second differences that are not resolved


def certify(
    criterion: Callable[[Trajectory, Any], Any],
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
) -> Certificate:
    """Ψ and dΨ/dp of a simulation, how wrong each of them is, and whether the gradient can be trusted at all.

    ```python
    print(lg.certify(criterion, build, p, t1=1.0, num_steps=400))
    ```

    Arguments:
        criterion: a `Criterion`, or another smooth function (trajectory, p) ↦ Ψ, scalar, which follows the `order` of
            the trajectory in its integrals (`time_integral(…, order=trajectory.order)`).
        build, p, t0, t1, num_steps, state0: as in `differentiate`.
        integrator: one with equal steps.
        tolerance: the relative error of value and gradient that is wanted.
        throw: raise if the simulation fails; with False the certificate says so.

    The errors are those of the discretization in time, to leading order: from this one run for `GeneralizedAlpha` of
    index 3, from a second one in half the steps for others. What the model leaves out is no part of them. Kinks are
    told from second differences of accelerations, in steps that resolve what is around.

    Raises `ValueError` as `differentiate`, and for an integrator with unequal steps or fewer than eight of them.
    """
    if not callable(criterion) or not callable(build):
        raise ValueError(f"`criterion` and `build` must be functions, got {criterion!r} and {build!r}.")
    num_steps = as_count(num_steps, "num_steps", " (it is static)")
    check_integrator(integrator, num_steps)
    if not integrator.equal_steps or integrator.extrapolated:
        raise ValueError(
            f"`integrator` must be a scheme with equal steps, got {integrator!r}; certify the scheme that it lays or "
            "extrapolates, `integrator.scheme`."
        )
    if num_steps < _LEAST_STEPS:
        raise ValueError(f"`num_steps` must be at least {_LEAST_STEPS} for an estimate, got {num_steps}.")
    if not (isinstance(tolerance, float | int) and 0.0 < tolerance < 1.0):
        raise ValueError(f"`tolerance` must be a number between 0 and 1, got {tolerance!r}.")
    t0, t1 = interval(t0, t1)
    p = jax.tree_util.tree_map_with_path(lambda path, leaf: as_float(leaf, None, f"`p`{jax.tree_util.keystr(path)}"), p)
    if not sum(leaf.size for leaf in jax.tree.leaves(p)):
        raise ValueError(f"`p` must hold at least one number, got {p!r}.")
    found, trajectory, spikes = _certified(criterion, build, state0, p, t0, t1, num_steps, integrator)
    if throw:
        raise_if_failed(trajectory)
    names = trajectory.system.body_names if isinstance(trajectory.system, MultibodySystem) else None
    places = np.argwhere(np.asarray(spikes))
    named = lambda i: names[i] if names is not None else f"coordinate {i}"
    kinks = tuple((float(trajectory.t[n]), named(i)) for n, i in places)
    return Certificate(tolerance=float(tolerance), kinks=kinks, **found)


@eqx.filter_jit
def _certified(criterion, build, start, p, t0, t1, num_steps: int, integrator):
    flat, unravel = ravel_pytree(p)

    def both(flat):
        p = unravel(flat)
        state0 = None if start is None else start(p)
        trajectory = simulate(
            build(p), t0=t0, t1=t1, num_steps=num_steps, integrator=integrator, state0=state0, throw=False
        )
        better = corrected(trajectory, error_estimate(trajectory, integrator))
        values = jnp.stack([jnp.asarray(criterion(run, p)) for run in (trajectory, better)])
        return (values, trajectory.states), trajectory

    (values, _), derivative, trajectory = jax.linearize(both, flat, has_aux=True)
    states, system = trajectory.states, trajectory.system
    to_p = jax.linear_transpose(lambda direction: derivative(direction)[0], flat)
    gradient, better = jax.vmap(lambda row: to_p(row)[0])(jnp.eye(2, dtype=flat.dtype))
    random = jax.random.normal(jax.random.key(0), flat.shape, flat.dtype)
    direction = random * jnp.where(flat == 0.0, 1.0, jnp.abs(flat))
    along, moved = derivative(direction)
    terms = gradient * direction
    duality = jnp.abs(along[0] - jnp.sum(terms)) / jnp.maximum(jnp.max(jnp.abs(terms)), jnp.finfo(flat.dtype).tiny)
    w = jax.vmap(system.group.from_ambient)(states.q, moved.q)
    grown = lax.cummax(jnp.max(jnp.abs(w) / system.coordinate_scale()[None], axis=1))
    growth = grown[-1] / jnp.max(jnp.abs(random))
    margins = trajectory.stats.margin
    margin = jnp.min(margins) / jnp.max(
        margins, where=jnp.isfinite(margins), initial=0.0
    )  # infinite: none was looked at
    margin = jnp.where(jnp.any(singular_steps(margins)), 0.0, margin)
    newton = jnp.full((), jnp.nan, flat.dtype)
    if integrator.scheme.physical(system, states) is states:  # nothing of them was left out
        grid = EqualGrid(t0, (t1 - t0) / num_steps, num_steps)
        moved = _left_by_newton(integrator.scheme, states, Parameters(system, grid))
        by_states = lambda states: jnp.asarray(criterion(eqx.tree_at(lambda t: t.states, trajectory, states), p))
        newton = jax.jvp(by_states, (states,), (moved,))[1]
    spikes, unresolved = rough(trajectory)
    found = {
        "value": values[0],
        "gradient": unravel(gradient),
        "value_error": values[1] - values[0],
        "gradient_error": unravel(better - gradient),
        "duality": duality,
        "newton": newton,
        "growth": growth,
        "exponential": grows_exponentially(grown),
        "margin": margin,
        "unresolved": unresolved,
        "result": trajectory.result,
    }
    return found, trajectory, spikes


def _left_by_newton(scheme: AbstractScheme, states: State, parameters: Parameters) -> State:
    """The tangent of the states that would take what the steps leave of their equations away."""
    system, grid = parameters

    def left(place, before, state):
        return rows(scheme, system, grid.node(place), grid.begun(scheme, place, before), state)

    residual = jax.vmap(left)(grid.places(), earlier(states), later(states))
    b = with_first(jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0]), residual), jax.tree.map(jnp.negative, residual))
    delta: Variation = linearized_trajectory(scheme, states, parameters, b, jax.tree.map(jnp.zeros_like, parameters))
    return jax.vmap(lambda state, delta: to_ambient(system.group, state, delta))(states, delta)


def rough(trajectory: Trajectory):
    """Whether an acceleration has a kink or a jump in the step that ends at each time, of each body, (n+1, bodies); and
    the share of steps whose accelerations are not resolved."""
    system = trajectory.system
    if isinstance(system, MultibodySystem):
        scale = system.coordinate_scale()
        length = jnp.max(scale)
        motions = [trajectory.body(name) for name in system.body_names]
        a = jnp.stack([jnp.concatenate([m.acceleration / length, m.angular_acceleration], axis=1) for m in motions], 1)
    else:
        a = (trajectory.states.vdot / system.coordinate_scale()[None])[:, :, None]
    size = jnp.max(jnp.abs(a), axis=(0, 2))
    rough = jnp.mean(jnp.any(jnp.max(jnp.abs(jnp.diff(a, 2, axis=0)), axis=2) > _AS_LARGE * size[None], axis=1))
    # Of means, which do not see the (−ρ∞)ⁿ that a kink leaves behind. One at the part θ of a step changes three of
    # these second differences by (1 − θ)/2, 1/2 and θ/2; on a time, where no step is the worse for it, two.
    second = jnp.max(jnp.abs(jnp.diff((a[1:] + a[:-1]) / 2.0, 2, axis=0)), axis=2)  # (n−2, bodies)
    at = lambda k: second[3 + k : second.shape[0] - 3 + k]
    sides = jnp.minimum(at(-1), at(1)), jnp.maximum(at(-1), at(1))
    peak = (at(0) >= sides[1]) & (sides[0] > _INSIDE * at(0))
    spikes = peak & (at(0) > _SPIKE * jnp.maximum(at(-3), at(3))) & (at(0) > _VISIBLE * size[None])
    spikes = jnp.pad(spikes, ((5, 3), (0, 0)))  # the first one is of the step from the fourth to the fifth time
    return spikes, rough
