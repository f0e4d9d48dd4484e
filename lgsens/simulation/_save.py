"""`simulate(…, save=…)`: what is asked of each instant, as a function of the state and of the numbers in it.

A rule for derivatives sees what a function is given, not what it has from where it was defined. So traced numbers that
`save` depends on besides the instant are taken out of it and given to it again (`jax.closure_convert`): else their
derivatives would be zero without a word.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from lgsens.dynamics import AbstractSystem, State, Unseen
from lgsens.simulation._trajectory import Instant

Save = Callable[[Instant], Any]


class _Given(eqx.Module):
    """`save` as a function of an instant and of the arrays that it holds, if it is a module; equal where it is."""

    fixed: Any = eqx.field(static=True)  # of a function all of it
    structure: Any = eqx.field(static=True)

    def __call__(self, instant: Instant, *own):
        return eqx.combine(jax.tree.unflatten(self.structure, own), self.fixed)(instant)


class Output(eqx.Module):
    """`save` as a function of the state, and what tells its turns; equal, for one compilation, where `function` is."""

    function: Callable[..., Any] = eqx.field(static=True)  # of an instant and the numbers
    numbers: list[Array]

    @classmethod
    def of(cls, save: Save, system: AbstractSystem, t) -> "Output":
        from jax._src.core import trace_state_clean  # there is no public way to ask

        numbers, fixed = eqx.partition(save, eqx.is_array)
        own, structure = jax.tree.flatten(numbers)
        call = _Given(fixed, structure)
        if trace_state_clean():
            return cls(call, own)
        q, v = system.reference()
        lam = jnp.zeros(len(system.constraint_names), v.dtype)
        instant = Instant(t=t, state=State(q=q, v=v, vdot=v, lam=lam, a=v), system=system)
        closed, hidden = jax.closure_convert(call, instant, *own)
        return cls(closed, [*own, *hidden]) if hidden else cls(call, own)

    def __call__(self, system, state: State, t):
        found = self.function(Instant(t=t, state=state, system=system), *self.numbers)
        for leaf in jax.tree.leaves(found):
            if not eqx.is_array_like(leaf):
                raise ValueError(
                    f"`save` must return numbers and arrays, or a dict or another pytree of them, got {leaf!r}."
                )
        return found, Unseen.at(system, state, t)
