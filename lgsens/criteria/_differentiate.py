"""`differentiate`: the value and the gradient of criteria, by any method through one call."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int, PyTree

from lgsens._brief import brief
from lgsens._validate import as_count, as_parameters
from lgsens._xla import tracing
from lgsens.criteria._advice import direct_or_adjoint
from lgsens.criteria._by_parts import Parts, Task, reverse_by_parts, unique
from lgsens.criteria._certify import certify, check_certifiable
from lgsens.criteria._criterion import Criterion, stacked
from lgsens.criteria._criterion_use import Use, checked_for
from lgsens.criteria._index_reduced_method import by_index_reduced
from lgsens.criteria._not_finite import require_finite
from lgsens.criteria._reference_methods import STENCIL, FiniteDifferences, IndexReduced
from lgsens.criteria._to_accuracy import differentiate_to
from lgsens.dynamics import RESULTS, AbstractSystem, Faults, State, names_of_all
from lgsens.integrate import AbstractIntegrator, EqualGrid, GeneralizedAlpha, UnevenGrid
from lgsens.model import Model
from lgsens.sensitivity import (
    AbstractSensitivity,
    AdjointVariable,
    ContinuousAdjoint,
    DirectDifferentiation,
    Parameters,
    configuration_cotangent,
    direct_on_the_fly,
)
from lgsens.simulation import (
    Reached,
    aligned,
    check_accuracy,
    check_integrator,
    for_any_number,
    interval,
    outcome,
    throw_if_failed,
    warn_of_single_precision,
)

Method = AbstractSensitivity | ContinuousAdjoint | FiniteDifferences | IndexReduced


class Sensitivities(NamedTuple):
    """Values and gradients of criteria.

    Attributes:
        value: Ψ, a pytree as the criteria, leaves of shape ().
        gradient: dΨ/dp, a pytree as the criteria, each leaf a pytree as p.
        method: the method that was used.
        result: a value of `RESULTS`, shape (), int32; 0 is success.
        reached: the accuracy, where one was asked for; else None.
        certificate: what value and gradient are worth, where that was asked for, a `Certificate` for each criterion.
    """

    value: PyTree
    gradient: PyTree
    method: Method
    result: Int[Array, ""]
    reached: Reached | None = None
    certificate: PyTree = None

    __repr__ = brief


def differentiate(
    criteria: PyTree,
    build: Callable[[Any], Model | AbstractSystem],
    p: PyTree,
    *,
    t0=0.0,
    t1,
    num_steps: int | None = None,
    integrator: AbstractIntegrator = GeneralizedAlpha(),
    method: Method | None = None,
    state0: Callable[[Any], State] | None = None,
    accuracy: float | None = None,
    certificate: bool = False,
    throw: bool = True,
) -> Sensitivities:
    """Ψ and dΨ/dp of one or several criteria with respect to one or several parameters, by any method.

    Arguments:
        criteria: a `Criterion`, or a pytree of them (a dict, say): all are differentiated at once, with one
            factorization per step.
        build: p ↦ the scene, a `Model` or an `AbstractSystem`; `lambda model: model` for every number of a model. It
            may be a method of a pytree (an `eqx.Module`), whose numbers are data of the programs.
        p: the design parameters, a pytree of floats.
        t0, t1, num_steps, integrator: as in `simulate`.
        method: `DirectDifferentiation()`: on the fly, no trajectory is stored (unless criteria are integrated over
            stages, as those of `IndexReducedODE`). `AdjointVariable()`: one forward
            and one backward sweep. `ContinuousDirect()`, `ContinuousAdjoint()`: the equations of motion
            differentiated, then integrated. For comparison: `Autodiff()`, `FiniteDifferences()`, `IndexReduced()`.
            None: as `direct_or_adjoint` advises for these numbers, or the adjoint gradient that a certificate has.
        state0: p ↦ the state at t0 (one of `equilibrium`, say). None: the consistent initial state.
        accuracy: take as many steps as the criteria take to have this error, outside of `jit`, and extrapolate where
            that is less work: the largest relative error of a value and of a gradient, of this by its norm, as far as
            runs in n, 2n, 4n, … steps tell. `reached` says what was reached and how. `num_steps` is then the first
            number of steps, 64 by default: enough of them to see the shortest event. Edges of roads and signals are
            seen, and steps end there (`AlignedSteps`).
        certificate: also say what value and gradient are worth, outside of `jit`: their errors, what may spoil them,
            and whether they are good to `accuracy`, or to 1e-3 (`certify`; a run of its own where a `method` is given
            or an `accuracy`). Runs are not extrapolated then.
        throw: raise if the simulation fails. With False, and inside `jit`, `result` says so, and values and gradients
            are NaN.

    The first two methods give the derivative of the numerical solution, to round-off; the continuous ones and
    `IndexReduced` that of the motion, to their own accuracy. Compiled once for the same functions: define
    `criteria` and `build` outside the loop that calls this.

    What it returns has derivatives in forward mode, `jax.jacfwd`. Reverse mode does not pass through it, but through
    `simulate`: `jax.grad` of the criterion there.

    Raises `ValueError` for criteria that are not scalar, parameters that are not numbers, a criterion that the method
    cannot treat (with the alternatives), and multipliers that redundant constraints make non-unique; otherwise as
    `simulate`. Source: Sonneville & Brüls (2014), §5–7.
    """
    is_criterion = lambda leaf: isinstance(leaf, Criterion)
    paths, structure = jax.tree_util.tree_flatten_with_path(criteria, is_leaf=is_criterion)
    leaves = tuple(leaf for _, leaf in paths)
    if not leaves or not all(map(is_criterion, leaves)):
        raise ValueError(f"`criteria` must be a Criterion or a pytree of them, got {criteria!r}.")
    if not callable(build):
        raise ValueError(f"`build` must be a function of the parameters that returns a Model, got {build!r}.")
    if method is not None and not isinstance(method, Method):
        raise ValueError(f"`method` must be a method such as AdjointVariable() or ContinuousAdjoint(), got {method!r}.")
    if state0 is not None and not callable(state0):
        raise ValueError(
            f"`state0` must be a function of the parameters that returns a State, got a {type(state0).__name__}: "
            "lambda p: state0 for one that does not depend on them."
        )
    names = tuple(f"Criterion {jax.tree_util.keystr(path)}".strip() for path, _ in paths)
    t0, t1 = interval(t0, t1)
    p = as_parameters(p)
    settings = {"t0": t0, "t1": t1, "integrator": integrator, "state0": state0}
    worth = lambda **own: certify(criteria, build, p, **settings | own) if certificate else None
    if accuracy is not None:
        if not throw:
            raise ValueError("`accuracy` raises where it is not reached; leave `throw` out.")
        check_accuracy(accuracy, num_steps, integrator, (p, t0, t1))
        if certificate:
            check_certifiable(integrator, None, (p, t0, t1))
        integrator, num_steps = aligned(integrator, build(p), t0, t1, num_steps)
        own, tried = settings | {"method": method, "integrator": integrator}, []

        def run(n, throw):
            tried.append(differentiate(criteria, build, p, num_steps=n, throw=throw, **own))
            if len(tried) > 1 and int(tried[-1].result) == RESULTS.successful:  # steps may be too long for a logarithm
                each = (structure.flatten_up_to(tree) for tree in tried[-1][:2])
                require_finite(Task(leaves, build, state0, integrator, n, t0, t1), p, names, *each)
            return tried[-1]

        found = differentiate_to(run, float(accuracy), integrator, num_steps, extrapolate=not certificate)
        about = {"num_steps": found.reached.num_steps, "integrator": integrator, "tolerance": float(accuracy)}
        return found._replace(certificate=worth(**about))
    num_steps = as_count(num_steps, "num_steps", " (it is static), unless `accuracy` is given")
    check_integrator(integrator, num_steps)
    if certificate:
        check_certifiable(integrator, num_steps, (p, t0, t1))
    warn_of_single_precision(t0.dtype)
    size = sum(leaf.size for leaf in jax.tree.leaves(p))
    task = Task(leaves, build, state0, integrator, num_steps, t0, t1)
    if certificate and method is None:  # whose own value and gradient these are
        found = worth(num_steps=num_steps, throw=False)
        each = structure.flatten_up_to(found)
        own = lambda name: structure.unflatten([getattr(one, name) for one in each])
        if not throw or int(each[0].result) == RESULTS.successful:  # else a run below says which step failed
            if throw:
                require_finite(task, p, names, *zip(*((one.value, one.gradient) for one in each)))
            return Sensitivities(own("value"), own("gradient"), AdjointVariable(), each[0].result, certificate=found)
    if method is None:
        method = direct_or_adjoint(size, len(leaves)).method
    if isinstance(method, ContinuousAdjoint) and num_steps < ContinuousAdjoint.LEAST_STEPS:
        raise ValueError(
            f"ContinuousAdjoint: `num_steps` must be at least {ContinuousAdjoint.LEAST_STEPS}, got {num_steps}; its "
            "start needs four points. AdjointVariable() has no such limit."
        )
    details, labels, note = None, (), ""
    if isinstance(method, IndexReduced):
        value, gradient = by_index_reduced(task, p, method)
        result = jnp.zeros((), jnp.int32)
    else:
        with tracing():
            if isinstance(method, AdjointVariable):
                found, _ = reverse_by_parts(task, p, method, names)
            else:
                if _flies(method, integrator):
                    given = for_any_number(num_steps, integrator, DirectDifferentiation(), None, (p, t0, t1 - t0))
                    task = task._replace(num_steps=given[0], integrator=given[1])
                found = _differentiate_jit(task, p, names, method)
        value, gradient, result, details, labels, note = found
    values, gradients = (jax.tree.unflatten(structure, leaves) for leaves in (value, gradient))
    if throw and details is not None:
        values, gradients = throw_if_failed((values, gradients), result, details, labels, note)
    if throw:
        require_finite(task, p, names, value, gradient)
    return Sensitivities(values, gradients, method, result, certificate=worth(num_steps=num_steps, throw=throw))


def _flies(method: Method, integrator: AbstractIntegrator) -> bool:
    """Whether criteria are differentiated on the fly."""
    return isinstance(method, DirectDifferentiation) and not (integrator.extrapolated or integrator.scheme.has_stages)


class _Found(NamedTuple):
    """What a method returns: Ψ (c,), dΨ/dp (c, p), and how the simulation went."""

    value: Float[Array, " c"]
    gradient: Float[Array, "c p"]
    result: Int[Array, ""]
    details: dict[str, Any]


@eqx.filter_jit
def _differentiate_jit(task: Task, p, names: tuple[str, ...], method):
    flat, unravel = ravel_pytree(p)
    task = task._replace(unravel=unravel)
    system, integrator = task.system(flat), task.integrator
    uses = [Use.of(criterion, system, task.t0, p) for criterion in task.criteria]
    checked_for(method, dict(zip(names, uses)))
    if isinstance(method, FiniteDifferences):
        found = _differences(task, flat, method)
    elif isinstance(method, ContinuousAdjoint):
        found = _continuous_adjoint(task, flat, method, uses)
    elif _flies(method, integrator):
        found = _on_the_fly(task, flat, constant=not integrator.moves(system))
    else:
        found = _forwards(task, flat, method)
    result, note = unique(found.result, system, found.details["jacobian"], names, uses)
    gradient = tuple(unravel(row) for row in found.gradient)
    return Parts(tuple(found.value), gradient, result, found.details, names_of_all(system), note)


def _on_the_fly(task: Task, p, constant: bool) -> _Found:
    integrator, scheme = task.integrator, task.integrator.scheme

    def start(p):
        system, begun = task.begin(p)
        laid = integrator.lay(system, begun.start, task.t0, task.t1, task.num_steps)
        state0 = begun.start.at(system, laid.grid.first_size)
        return (state0, Parameters(system, laid.grid)), (begun, laid._replace(found=None, stats=None))

    found = direct_on_the_fly(scheme, start, stacked(task.criteria, task.unravel), p, constant)
    begun, laid = found.begun
    t = laid.grid.times()
    ended = outcome(scheme, begun, found.stats, Faults.between(t, found.unseen), t, laid)
    return _Found(found.value, found.gradient, *ended)


def _forwards(task: Task, p, method: AbstractSensitivity) -> _Found:
    """The derivative of the trajectory in forward mode, contracted by the criteria."""

    def function(p):
        values, (trajectory, details) = task.simulate(p, method)
        return values, (values, trajectory.result, details)

    gradient, (value, result, details) = jax.jacfwd(function, has_aux=True)(p)
    return _Found(value, gradient, result, details)


def _continuous_adjoint(task: Task, p, method: ContinuousAdjoint, uses: list[Use]) -> _Found:
    value, (trajectory, details) = task.simulate(p, DirectDifferentiation())

    def initial(p):
        """Everything that the motion depends on; v_0 as it is, without the scheme's own O(h²)."""
        system, begun = task.begin(p)
        return system, begun.start.state.q, begun.consistent_v

    (system, q0, _), pull_back = jax.vjp(initial, p)
    if task.integrator.by_motion:
        raise ValueError(
            "ContinuousAdjoint integrates backwards from t1, where the steps that error control has left over are "
            "empty: give it the grid found, `GivenSteps.of(trajectory)`, or take DirectDifferentiation() or "
            "AdjointVariable()."
        )
    h = (task.t1 - task.t0) / task.num_steps
    equal = task.integrator.equal_steps
    grid = EqualGrid(task.t0, h, task.num_steps) if equal else UnevenGrid.first(task.t0, jnp.diff(trajectory.t))
    cotangents = method.cotangents(
        task.integrator.scheme,
        trajectory.states,
        Parameters(system, grid),
        stacked(task.criteria, task.unravel),
        p,
        uses=(any(any(use.integrand) for use in uses), any(any(use.terminal) for use in uses)),
    )
    of_q = jax.vmap(lambda w: configuration_cotangent(system.group, q0, w))(cotangents.w0)
    (of_initial,) = jax.vmap(pull_back)((cotangents.system, of_q, cotangents.v0))
    return _Found(value, cotangents.p + of_initial, trajectory.result, details)


def _differences(task: Task, p, method: FiniteDifferences) -> _Found:
    value, (trajectory, details) = task.simulate(p, DirectDifferentiation())
    task = task._replace(integrator=task.integrator.frozen(trajectory))  # a derivative is that on the grid found
    distance = method.step * jnp.where(p == 0.0, 1.0, jnp.abs(p))

    def slope(direction):
        moved = lambda k: task.simulate(p + k * distance * direction, DirectDifferentiation())[0]
        ahead = jax.lax.map(moved, jnp.asarray([k for k, _ in STENCIL], p.dtype))
        return jnp.asarray([weight for _, weight in STENCIL], p.dtype) @ ahead / jnp.dot(distance, direction)

    gradient = jax.lax.map(slope, jnp.eye(p.shape[0], dtype=p.dtype))
    return _Found(value, gradient.T, trajectory.result, details)
