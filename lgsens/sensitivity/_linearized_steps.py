"""The steps of a known trajectory, linearized, in both directions: what is gone through in turn, or all at once.

A step begins with what its grid makes of the state before (δ_n* from δ_n and p') and solves its linearized equations
(`AbstractLinearizedStep`) for δ_{n+1}, with the loads E_p p' of the parameters; an empty one is δ_{n+1} = δ_n + b.
Backwards it takes the cotangent c of δ_{n+1} to the multipliers μ of its rows, and to what it adds to the cotangents of
δ_n and of p. Between equal steps δ_n* = δ_n; else y_n* is a function that JAX differentiates, with factors that are
made once.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lgsens.dynamics import State
from lgsens.integrate import AbstractLinearizedStep, AbstractScheme, Variation
from lgsens.sensitivity._linearization import Parameters, Step, node_tangent, to_algebra, to_ambient


class LinearStep(NamedTuple):
    """A step, linearized."""

    step: Step
    begun: State
    factors: Any  # what `begun` is found with
    equations: AbstractLinearizedStep


class Loads(NamedTuple):
    """What parameters add: to the equations of a step, and to the variation that it begins with."""

    equations: Any
    begun: Variation | None  # None: nothing


class Backward(NamedTuple):
    """What a step makes of the cotangent of its end."""

    previous: Variation  # what it adds to the cotangent of δ_n
    mu: Variation
    loads: Loads


class LinearizedSteps(NamedTuple):
    """The equations of steps, of which each function takes one, but the last, which takes many."""

    scheme: AbstractScheme
    parameters: Parameters
    shared: Any  # what all steps share

    @classmethod
    def of(cls, scheme: AbstractScheme, parameters: Parameters) -> "LinearizedSteps":
        return cls(scheme, parameters, scheme.shared(parameters.system))

    def linearized(self, step: Step) -> LinearStep:
        """Its matrices, with what solves them."""
        system, grid = self.parameters
        factors = grid.factors(self.scheme, system, step.place, step.before)
        begun = grid.begun(self.scheme, system, step.place, step.before, factors)
        node = grid.node(step.place)
        equations = self.scheme.linearized(system, self.shared, node, begun, step.state)
        return LinearStep(step, begun, factors, equations)

    def loads(self, linear: LinearStep, d: Parameters | None, d_place: Any) -> Loads:
        """E_p p', and what p' makes of y_n*; d None: nothing."""
        if d is None:
            none = jax.tree.map(jnp.zeros_like, (self.parameters, linear.step.place))
            shapes = jax.eval_shape(self.loads, linear, *none)
            return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        system, grid = self.parameters
        step, begun = linear.step, None
        node, d_node = grid.node(step.place), node_tangent(grid, d.grid, step.place, d_place)
        loads = self.scheme.loads(self.shared, linear.begun, step.state)
        if grid.resizes:
            at = lambda system, place: grid.begun(self.scheme, system, place, step.before, linear.factors)
            _, d_begun = jax.jvp(at, (system, step.place), (d.system, d_place))
            begun = to_algebra(system.group, linear.begun, d_begun)
        return Loads(jax.jvp(loads, (system, node), (d.system, d_node))[1], begun)

    def _begun(self, linear: LinearStep, previous: Variation) -> Variation:
        """δ_n* at given parameters, of a step of another size than the one before."""
        (system, grid), step = self.parameters, linear.step
        at = lambda state: grid.resized(self.scheme, system, step.place, state, linear.factors)
        d_begun = jax.jvp(at, (step.before,), (to_ambient(system.group, step.before, previous),))[1]
        return to_algebra(system.group, linear.begun, d_begun)

    def forward(self, linear: LinearStep, previous: Variation, loads: Loads, row: Variation) -> Variation:
        """δ_{n+1}."""
        grid, place = self.parameters.grid, linear.step.place
        begun = grid.where_resized(place, partial(self._begun, linear), previous)
        if loads.begun is not None:
            begun = jax.tree.map(jnp.add, begun, loads.begun)
        current = linear.equations.forward(self.shared, grid.node(place), begun, loads.equations, row)
        return grid.unless_empty(place, current, jax.tree.map(jnp.add, previous, row))

    def backward(self, linear: LinearStep, c: Variation, loads: Loads) -> Backward:
        """The transpose of `forward`; `loads`: in shape."""
        grid, place = self.parameters.grid, linear.step.place
        begun, of_equations, mu = linear.equations.backward(self.shared, grid.node(place), c, loads.equations)
        pulled = lambda begun: jax.vjp(partial(self._begun, linear), Variation.none(linear.begun))[1](begun)[0]
        previous = grid.where_resized(place, pulled, begun)
        found = Loads(of_equations, begun if grid.resizes else None)
        found = grid.unless_empty(place, found, jax.tree.map(jnp.zeros_like, found))
        return Backward(grid.unless_empty(place, previous, c), grid.unless_empty(place, mu, c), found)

    def pull_back(self, linear: LinearStep) -> tuple[Loads, Callable[[Backward], tuple[Parameters, Any]]]:
        """The loads of a step, in shape; and for stacked steps what they add to p̄, and the cotangents of places."""
        resizes, group = self.parameters.grid.resizes, self.parameters.system.group

        def all_loads(system, grid, places):
            def of_one(linear: LinearStep, place):
                step = linear.step
                loads = self.scheme.loads(self.shared, linear.begun, step.state)(system, grid.node(place))
                if not resizes:
                    return Loads(loads, None)
                begun = grid.begun(self.scheme, system, place, step.before, linear.factors)
                return Loads(loads, Variation.of(group.from_ambient(linear.begun.q, begun.q), begun))

            return jax.vmap(of_one)(linear, places)

        loads, transposed = jax.vjp(all_loads, *self.parameters, linear.step.place)

        def pulled(found: Backward):
            of_system, of_grid, of_places = transposed(found.loads)
            return Parameters(of_system, of_grid), of_places

        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), loads), pulled
