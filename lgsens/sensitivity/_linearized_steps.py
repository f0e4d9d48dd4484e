"""The steps of a known trajectory, linearized, in both directions: what is gone through in turn, or all at once.

A step begins with what its grid makes of the state before (δ_n* from δ_n and p') and solves its linearized equations
(`AbstractLinearizedStep`) for δ_{n+1}, with the loads E_p p' of the parameters; an empty one is δ_{n+1} = δ_n + b.
Backwards it takes the cotangent c of δ_{n+1} to the multipliers μ of its rows, and to what it adds to the cotangents of
δ_n and of p. Between equal steps δ_n* = δ_n; else y_n* is a function of y_n, p and the place that JAX differentiates by
all of them at once, with factors that are made once.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from lgsens.dynamics import State
from lgsens.integrate import AbstractLinearizedStep, AbstractScheme, Variation
from lgsens.sensitivity._linearization import (
    Parameters,
    Step,
    cotangent_to_algebra,
    cotangent_to_ambient,
    node_tangent,
    to_algebra,
    to_ambient,
)


class LinearStep(NamedTuple):
    """A step, linearized."""

    step: Step
    begun: State
    factors: Any  # what `begun` is found with
    equations: AbstractLinearizedStep


class Loads(NamedTuple):
    """What parameters add to a step, or a cotangent of it: E_p p', and the tangent of its place."""

    equations: Any
    place: Any


class Backward(NamedTuple):
    """What a step makes of the cotangent of its end."""

    begun: Variation  # the cotangent of δ_n*
    mu: Variation
    loads: Any  # that of E_p p'


class Before(NamedTuple):
    """What the cotangent of δ_n* adds to those of δ_n, of all parameters as one vector, and of the place."""

    previous: Variation
    parameters: Any
    place: Any


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
        """E_p p'; d None: nothing."""
        if d is None:
            none = jax.tree.map(jnp.zeros_like, (self.parameters, linear.step.place))
            shapes = jax.eval_shape(self.loads, linear, *none)
            return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
        system, grid = self.parameters
        step = linear.step
        node, d_node = grid.node(step.place), node_tangent(grid, d.grid, step.place, d_place)
        loads = self.scheme.loads(self.shared, linear.begun, step.state)
        return Loads(jax.jvp(loads, (system, node), (d.system, d_node))[1], d_place)

    def _begins(self, linear: LinearStep) -> Callable[[State, Parameters, Any], State]:
        """y_n* of y_n, the parameters and the place, where a step begins with another state than the last one ended
        with."""
        return lambda state, parameters, place: parameters.grid.resized(
            self.scheme, parameters.system, place, state, linear.factors
        )

    def _begun(self, linear: LinearStep, previous: Variation, *of: Any) -> Variation:
        """δ_n* there, from δ_n, and p' and the tangent of the place, if they vary."""
        group, step = self.parameters.system.group, linear.step
        constant = (self.parameters, step.place)[len(of) :]
        at = lambda *varied: self._begins(linear)(*varied, *constant)
        varied = (step.before, self.parameters, step.place)[: 1 + len(of)]
        return to_algebra(group, linear.begun, jax.jvp(at, varied, (to_ambient(group, step.before, previous), *of))[1])

    def forward(
        self, linear: LinearStep, previous: Variation, loads: Loads, row: Variation, d: Parameters | None
    ) -> Variation:
        """δ_{n+1}; d None: `previous` is all that moves what the step begins with."""
        grid, place = self.parameters.grid, linear.step.place
        of = () if d is None else (d, loads.place)
        begun = grid.where_varied(place, lambda previous: self._begun(linear, previous, *of), previous)
        current = linear.equations.forward(self.shared, grid.node(place), begun, loads.equations, row)
        return grid.unless_empty(place, current, jax.tree.map(jnp.add, previous, row))

    def backward(self, linear: LinearStep, c: Variation, loads: Any) -> Backward:
        """The transpose of the equations; `loads`: in shape."""
        grid, place = self.parameters.grid, linear.step.place
        begun, of_equations, mu = linear.equations.backward(self.shared, grid.node(place), c, loads)
        nothing = jax.tree.map(jnp.zeros_like, (begun, of_equations))
        begun, of_equations = grid.unless_empty(place, (begun, of_equations), nothing)
        return Backward(begun, grid.unless_empty(place, mu, c), of_equations)

    def before(self, linear: LinearStep, c: Variation, found: Backward, bar: Any) -> Before:
        """The transpose of what a step begins with, added to the cotangent `bar` of the parameters."""
        (system, grid), (place, state, _) = self.parameters, linear.step

        def pulled(before: Before) -> Before:
            _, transposed = jax.vjp(self._begins(linear), state, self.parameters, place)
            of_state, of_parameters, of_place = transposed(
                cotangent_to_ambient(system.group, linear.begun, before.previous)
            )
            previous = cotangent_to_algebra(system.group, state, of_state)
            return Before(previous, before.parameters + ravel_pytree(of_parameters)[0], of_place)

        of_place = jax.tree.map(jnp.zeros_like, place)
        before = grid.where_varied(place, pulled, Before(found.begun, bar, of_place))
        return before._replace(previous=grid.unless_empty(place, before.previous, c))

    def pull_back(self, linear: LinearStep) -> tuple[Any, Callable[[Any], tuple[Parameters, Any]]]:
        """E_p p' of a step, in shape; and for stacked steps what they add to p̄, and the cotangents of places."""

        def all_loads(system, grid, places):
            of_one = lambda linear, place: self.scheme.loads(self.shared, linear.begun, linear.step.state)(
                system, grid.node(place)
            )
            return jax.vmap(of_one)(linear, places)

        loads, transposed = jax.vjp(all_loads, *self.parameters, linear.step.place)

        def pulled(found):
            of_system, of_grid, of_places = transposed(found)
            return Parameters(of_system, of_grid), of_places

        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), loads), pulled
