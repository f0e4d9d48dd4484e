"""Criteria of a trajectory and their derivatives in reverse mode, by programs that serve others as well.

    scene p ↦ (system, y_0),     motion (system, y_0) ↦ y,     criteria (y, system, p) ↦ Ψ,

and the pull-back of each of them. Another criterion, another number of steps or other numbers of the scheme compile
what depends on them and no more, another scene with elements of the same kinds its own program only. Inside of `jit`
they are parts of the user's program.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from lgsens.criteria._criterion_use import Use
from lgsens.criteria._packed import Packed
from lgsens.dynamics import RESULTS, AbstractSystem, State, is_redundant, names_of_all, softness
from lgsens.integrate import AbstractIntegrator, Steps
from lgsens.sensitivity import AbstractSensitivity
from lgsens.simulation import Begin, Trajectory, as_system, begin, cut, for_any_number, run


class Parts(NamedTuple):
    """Values and gradients, a tuple with one for each criterion, and how the simulation went."""

    value: tuple[Any, ...]
    gradient: tuple[Any, ...]
    result: Any
    details: dict[str, Any]
    labels: tuple[str, ...]
    note: str


class Task(NamedTuple):
    """Criteria, functions of (trajectory, p), and what they are criteria of; `start`: p ↦ state0, or None.

    The methods are of the flat vector of parameters.
    """

    criteria: tuple[Any, ...]  # a `Criterion` is one, too
    build: Callable[[Any], Any]
    start: Callable[[Any], State] | None
    integrator: AbstractIntegrator
    num_steps: Any  # an int or `Steps`
    t0: Any
    t1: Any
    unravel: Any = None  # set inside of `jit`, where it is no key of the cache

    def system(self, p) -> AbstractSystem:
        return as_system(self.build(self.unravel(p)))

    def begin(self, p) -> tuple[AbstractSystem, Begin]:
        """The system and how its motion begins."""
        system = self.system(p)
        state0 = None if self.start is None else self.start(self.unravel(p))
        return system, begin(self.integrator.scheme, system, self.t0, state0)

    def simulate(self, p, sensitivity: AbstractSensitivity):
        """Ψ of all criteria, and the run."""
        system, begun = self.begin(p)
        trajectory, details = run(system, begun, self.t0, self.t1, self.num_steps, self.integrator, sensitivity)
        values = jnp.stack([criterion(trajectory, self.unravel(p)) for criterion in self.criteria])
        return values, (trajectory, details)


def reverse_by_parts(
    task: Task, p, method: AbstractSensitivity, names: tuple[str, ...] = (), call: Callable = lambda f, *a: f(*a)
) -> tuple[Parts, Trajectory]:
    """Ψ and dΨ/dp of each criterion of a task in reverse mode, and the motion (`cut` is to be).

    `names`: of criteria that are asked what they use; `call`: makes the calls, and sees the programs.
    """
    t0, t1 = task.t0, task.t1
    numbers, functions = eqx.partition((task.build, task.start), eqx.is_array)  # a method of a pytree has numbers
    (system, state0), of_p = call(_scene, functions, numbers, p)
    given = for_any_number(task.num_steps, task.integrator, method, None, (system, state0, t0, t1 - t0))
    exact = given[0] if isinstance(given[0], int) else None
    steps = None if exact else given[0]
    found, times, details, of_scene = call(_motion, system, state0, t0, t1, steps, given[1], method, exact)
    count = None if exact else task.num_steps
    value, rows, result, note = call(_values, task.criteria, names, found, times, system, details["jacobian"], p, count)
    gradient = call(_pulled_to_p, of_p, call(_pulled_to_scene, of_scene, rows), rows)
    parts = Parts(value, gradient, result, details, names_of_all(system), note)
    return parts, dataclasses.replace(found, system=system)


@partial(jax.jit, static_argnums=0)
def _scene(functions, numbers, p):
    build, start = eqx.combine(functions, numbers)

    def of(p):
        return as_system(build(p)), None if start is None else start(p)

    scene, pull_back = jax.vjp(of, p)
    return scene, Packed.of(pull_back)


@partial(jax.jit, static_argnums=7)
def _motion(system, state0, t0, t1, steps: Steps | None, integrator, method, exact: int | None):
    """The trajectory, its times if they depend on the scene, and what is said of it; and how it is pulled back."""

    def of(system, state0):
        begun = begin(integrator.scheme, system, t0, state0)
        found, details = run(system, begun, t0, t1, exact or steps or 0, integrator, method)
        times = found.t if integrator.moves(system) else None
        motion = _Motion(found.states, found.stages, found.error, times)
        return motion, (dataclasses.replace(found, system=None), times, details)

    _, pull_back, found = jax.vjp(of, system, state0, has_aux=True)
    return *found, Packed.of(pull_back)


class _Motion(NamedTuple):
    """What of a trajectory depends on the scene."""

    states: State
    stages: Any
    error: Any
    t: Any  # None: they are constant


class _Rows(NamedTuple):
    """dΨ by what criteria depend on, one row for each criterion."""

    motion: _Motion
    system: Any
    p: Any


@eqx.filter_jit
def _values(criteria, names, found: Trajectory, times, system, jacobian, p, count: int | None):
    def of(motion, system, p):
        own = {name: part for name, part in motion._asdict().items() if part is not None}
        trajectory = dataclasses.replace(found, system=system, **own)
        trajectory = trajectory if count is None else cut(trajectory, count)
        values = jnp.stack([criterion(trajectory, p) for criterion in criteria])
        return values, values

    at = _Motion(found.states, found.stages, found.error, times), system, p
    rows, values = jax.jacrev(of, argnums=(0, 1, 2), has_aux=True)(*at)
    uses = [Use.of(criterion, system, found.t[0], p) for criterion in criteria if names]
    return tuple(values), _Rows(*rows), *unique(found.result, system, jacobian, names, uses)


def _each(pull_back: Callable, rows: Any) -> Any:
    """The pull-back of each row; of one alone in a program without a batch."""
    if jax.tree.leaves(rows)[0].shape[0] > 1:
        return jax.vmap(pull_back)(rows)
    return jax.tree.map(lambda leaf: leaf[None], pull_back(jax.tree.map(lambda leaf: leaf[0], rows)))


@jax.jit
def _pulled_to_scene(pull_back: Packed, rows: _Rows):
    of_system, of_state0 = _each(pull_back.unpacked, rows.motion)
    return jax.tree.map(jnp.add, of_system, rows.system), of_state0


@jax.jit
def _pulled_to_p(pull_back: Packed, of_scene, rows: _Rows):
    (of_p,) = _each(pull_back.unpacked, of_scene)
    total = jax.tree.map(jnp.add, of_p, rows.p)
    return tuple(jax.tree.map(lambda leaf, i=i: leaf[i], total) for i in range(jax.tree.leaves(total)[0].shape[0]))


def unique(result, system: AbstractSystem, jacobian, names: tuple[str, ...], uses: list[Use]):
    """The result, a failure where criteria use multipliers that are not unique, and the note that says so."""
    of_multipliers = [name for name, use in zip(names, uses) if use.integrand.multipliers or use.terminal.multipliers]
    if not of_multipliers:
        return result, ""
    # a given state0 has not been asked
    redundant = softness(system) is None and is_redundant(system, jacobian)
    result = jnp.where(redundant, RESULTS.redundant_constraints, result).astype(jnp.int32)
    return result, f"{' and '.join(of_multipliers)}: multipliers are used."
