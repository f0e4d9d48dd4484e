"""How the rates of constraints change with the configuration: D_q c · (q ũ) = V u, c = B v + Φ_t, in small blocks."""

from typing import Any

import jax
import jax.numpy as jnp

from lgsens.linear import Blocks, SparseMatrix, chosen
from lgsens.model._constraints import AbstractConstraint
from lgsens.model._frames import BODY_DIM, Frame, tilted
from lgsens.model._stack import at_ends, constraint_jacobian


def rate_stiffness(system: Any, q, v, t) -> SparseMatrix:
    """V, (m, k), of a `MultibodySystem` whose rows are all of position level: one block for each element."""
    topology, parts = system.topology, []
    for stack, ends, pattern in zip(
        system.constraints, at_ends(system.constraints, system._placed(q)), topology.jacobian
    ):
        places, known = stack.ends.own, chosen(v, topology.coordinates(stack.ends))
        width = BODY_DIM * (2 + len(ends.others))
        velocities = jnp.zeros((len(known), width), known.dtype).at[:, places].set(known)
        parts.append(Blocks(stack.acting(stack.map(_by_configuration, ends, (velocities, t))), pattern))
    return SparseMatrix(tuple(parts), (topology.num_constraints, system.group.dim), system.mass.dtype)


def _by_configuration(element: AbstractConstraint, a: Frame, b: Frame, v, t, *others: Frame):
    """V of one element, shape (rows, 12), 6 more for each other body; v: their velocities."""

    def rate(x):
        a_, b_, *others_ = tilted((a, b, *others), x)
        _, driven = jax.jvp(lambda t: element.value(a_, b_, t, *others_), (t,), (jnp.ones_like(t),))
        return constraint_jacobian(element, a_, b_, t, *others_) @ v + driven

    return jax.jacfwd(rate)(jnp.zeros_like(v))
