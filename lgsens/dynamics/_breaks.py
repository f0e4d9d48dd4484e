"""Times at which the equations of motion are not smooth, as far as what they follow in time knows them."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import as_float


class AbstractTimeFunction(eqx.Module):
    """What a system follows in time."""

    @property
    def breaks(self) -> Float[Array, " k"]:
        """The times [s] at which it, or a derivative of it, jumps, shape (k,), in any order; here those of functions of
        time that it holds. `AlignedSteps` and steps under error control end at them and move with them, so they are
        to be functions of its numbers that JAX can differentiate; and the forces of a driver that follows it ring
        behind those that it does not tell."""
        return breaks_of([getattr(self, field.name) for field in dataclasses.fields(self)])


class Breaking(NamedTuple):
    """Constraints that follow functions of time which break.

    Attributes:
        times: when they do [s], shape (k,).
        constraint: Φ(q, t) of them, zeros in the other rows of position level.
    """

    times: Float[Array, " k"]
    constraint: Callable[[Any, Any], Float[Array, " m_p"]]


def told_breaks(function: AbstractTimeFunction) -> Float[Array, " *k"]:
    """What `breaks` says, which may be numbers, and a method; of many of a kind those of each along the last axis."""
    breaks = function.breaks() if callable(function.breaks) else function.breaks
    return as_float(breaks, None, f"`breaks` of a {type(function).__name__}")


def breaks_of(tree: Any) -> Float[Array, " k"]:
    """The breaks of all functions of time in a pytree, a system say, one or many of a kind. What is a function of
    something else (`over` in the metadata of its field) has none."""
    found = [breaks.astype(float) for breaks in _breaks(tree)]  # whatever the precision of each
    return jnp.concatenate(found) if found else jnp.zeros(0)


def _breaks(node: Any) -> Iterator[Array]:
    if isinstance(node, AbstractTimeFunction):
        yield jnp.ravel(told_breaks(node))
    elif dataclasses.is_dataclass(node) and not isinstance(node, type):
        fields = [field for field in dataclasses.fields(node) if field.metadata.get("over", "time") == "time"]
        yield from _breaks([getattr(node, field.name) for field in fields])
    elif isinstance(node, tuple | list | dict):
        for part in node.values() if isinstance(node, dict) else node:
            yield from _breaks(part)
