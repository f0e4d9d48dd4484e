"""The steps of a known trajectory, linearized, in both directions: what is gone through in turn, or all at once.

A step follows the one before (`StepLink`: δ_n* from δ_n) and solves its linearized equations (`AbstractLinearizedStep`)
for δ_{n+1}, with the loads E_p p' of the parameters; an empty one is δ_{n+1} = δ_n + b. Backwards it takes the
cotangent c of δ_{n+1} to the multipliers μ of its rows, and to what it adds to the cotangents of δ_n and of p.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from lgsens.integrate import AbstractLinearizedStep, AbstractScheme, Variation
from lgsens.sensitivity._linearization import Parameters, Step, node_tangent


class Backward(NamedTuple):
    """What a step makes of the cotangent of its end."""

    previous: Variation  # what it adds to the cotangent of δ_n
    mu: Variation
    of_loads: Any
    of_ratio: Any  # None: steps are equal


class LinearizedSteps(NamedTuple):
    """The equations of steps, of which each function takes one, but the last, which takes many."""

    scheme: AbstractScheme
    parameters: Parameters
    shared: Any  # what all steps share

    @classmethod
    def of(cls, scheme: AbstractScheme, parameters: Parameters) -> "LinearizedSteps":
        return cls(scheme, parameters, scheme.shared(parameters.system))

    def linearized(self, step: Step) -> AbstractLinearizedStep:
        """Its matrices, with what solves them."""
        system, grid = self.parameters
        return self.scheme.linearized(system, self.shared, grid.node(step.place), step.begun, step.state)

    def loads(self, step: Step, d: Parameters, d_place: Any) -> Any:
        """E_p p'."""
        system, grid = self.parameters
        node, d_node = grid.node(step.place), node_tangent(grid, d.grid, step.place, d_place)
        loads = self.scheme.loads(self.shared, step.begun, step.state)
        return jax.jvp(loads, (system, node), (d.system, d_node))[1]

    def forward(
        self,
        linearized: AbstractLinearizedStep,
        step: Step,
        previous: Variation,
        loads: Any,
        row: Variation,
        d_place: Any,
    ) -> Variation:
        """δ_{n+1}."""
        begun = step.link.begun(previous, d_place)
        current = linearized.forward(self.shared, self.parameters.grid.node(step.place), begun, loads, row)
        return step.link.unless_empty(current, jax.tree.map(jnp.add, previous, row))

    def backward(self, linearized: AbstractLinearizedStep, step: Step, c: Variation, loads: Any) -> Backward:
        """The transpose of `forward`; `loads`: in shape."""
        node = self.parameters.grid.node(step.place)
        begun, of_loads, mu = linearized.backward(self.shared, node, c, loads)
        previous, of_ratio = step.link.begun_transposed(begun)
        previous = step.link.unless_empty(previous, c)
        of_loads = step.link.unless_empty(of_loads, jax.tree.map(jnp.zeros_like, of_loads))
        return Backward(previous, step.link.unless_empty(mu, c), of_loads, of_ratio)

    def pull_back(self, steps: Step) -> tuple[Any, Callable[[Backward], tuple[Parameters, Any]]]:
        """The loads of a step, in shape; and for stacked steps what they add to p̄, and the cotangents of places."""

        def all_loads(system, grid, places):
            at = lambda step, place: self.scheme.loads(self.shared, step.begun, step.state)(system, grid.node(place))
            return jax.vmap(at)(steps, places)

        loads, transposed = jax.vjp(all_loads, *self.parameters, steps.place)

        def pulled(found: Backward):
            of_system, of_grid, of_places = transposed(found.of_loads)
            if found.of_ratio is not None:
                of_places = of_places._replace(ratio=of_places.ratio + found.of_ratio)
            return Parameters(of_system, of_grid), of_places

        return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), loads), pulled
