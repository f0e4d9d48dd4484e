"""A motion in known steps that is gone over several times: simulated once, and its steps linearized once."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens.criteria._packed import Packed
from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate import AbstractGrid, AbstractIntegrator, Variation
from lgsens.sensitivity import Given, KnownRun, Parameters
from lgsens.simulation import Begin, Trajectory, as_system, begin, run


class KnownMotion(NamedTuple):
    """The run, how it began, and the linear map from a change of p, a vector, to those of its parameters and of state0.

    Criteria, their errors and products along a direction are functions of (states, system, p), p by itself.
    """

    known: KnownRun
    begun: Begin
    of_scene: Callable
    t1: Float[Array, ""]

    def trajectory(self, integrator: AbstractIntegrator, states: State, system: AbstractSystem) -> Trajectory:
        """That of these states, which may have derivatives."""
        given = Given(states, self.known.stats)
        return run(system, self.begun, *self._interval, integrator, given)[0]

    def grid(self, integrator: AbstractIntegrator, system: AbstractSystem) -> AbstractGrid:
        """Where steps begin and end, as a function of the system."""
        return integrator.lay(system, self.begun.start, *self._interval).grid

    @property
    def _interval(self) -> tuple[Any, Any, int]:
        grid = self.known.parameters.grid
        return grid.t0, self.t1, grid.num_steps

    def along(self, direction: Float[Array, " p"]) -> tuple[State, AbstractSystem, Array]:
        """The tangents of (states, system, p) along a direction of p, by the direct differentiation method."""
        d, d_state0 = self.of_scene(direction)
        return self.known.forwards(d_state0, d), d.system, direction

    def gradients(self, rows: Any, p: Float[Array, " p"]) -> tuple[Float[Array, "c p"], Variation]:
        """Derivatives by p of functions whose derivatives by (states, system, p) are these rows, by the adjoint
        variable method, and their adjoint variables μ."""
        to_p = jax.linear_transpose(self.of_scene, p)

        def one(of_states, of_system, of_p):
            mu, of_state0, of_parameters = self.known.backwards(of_states)
            of_system = jax.tree.map(jnp.add, of_parameters.system, of_system)
            return of_p + to_p((of_parameters._replace(system=of_system), of_state0))[0], mu

        return jax.vmap(one)(*rows)


@eqx.filter_jit
def known_motion(
    build: Callable[[Any], Any],
    start: Callable[[Any], State] | None,
    p: Any,
    t0,
    t1,
    num_steps: int,
    integrator: AbstractIntegrator,
) -> tuple[Packed, KnownMotion]:
    """A `KnownMotion` for programs to come, its numbers packed: a program of its own, which all criteria share."""
    flat, unravel = ravel_pytree(p)

    def scene(flat):
        p = unravel(flat)
        system = as_system(build(p))
        begun = begin(integrator.scheme, system, t0, None if start is None else start(p))
        grid = integrator.lay(system, begun.start, t0, t1, num_steps).grid
        return (Parameters(system, grid), begun.start.at(system, grid.first_size)), begun

    (parameters, state0), of_scene, begun = jax.linearize(scene, flat, has_aux=True)
    known = KnownRun.of(integrator.scheme, state0, parameters)
    motion = KnownMotion(known, begun, eqx.filter_closure_convert(of_scene, flat), t1)
    numbers, functions = eqx.partition(motion, eqx.is_array)
    return Packed.of(numbers), functions


def unpacked(motion: tuple[Packed, KnownMotion]) -> KnownMotion:
    return eqx.combine(motion[0].unpacked, motion[1])
