"""What a criterion makes use of, read off its program; and whether a method can treat that."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Literal

from lgsens.criteria._criterion import Criterion
from lgsens.dynamics import AbstractSystem, State
from lgsens.sensitivity import ContinuousAdjoint


class _Dependence(NamedTuple):
    accelerations: bool
    multipliers: bool


class Use(NamedTuple):
    """Whether F and G of a criterion depend on v̇ and on λ."""

    integrand: _Dependence
    terminal: _Dependence

    @classmethod
    def of(cls, criterion: Criterion, system: AbstractSystem, t, p) -> "Use":
        q, v = system.reference()
        lam = jnp.zeros(len(system.constraint_names), v.dtype)

        def dependence(function) -> _Dependence:
            at = lambda vdot, lam: function(system, State(q, v, vdot, lam, vdot), t, p)
            return _Dependence(*_used_inputs(at, jnp.zeros_like(v), lam))

        return cls(dependence(criterion.rate), dependence(criterion.final))


def _used_inputs(function, *arguments) -> list[bool]:
    """Which arguments the result of a function depends on, by the operations that lead to it."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    needed = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
    for equation in reversed(jaxpr.eqns):
        if needed & set(equation.outvars):
            needed |= {v for v in equation.invars if not isinstance(v, Literal)}
    return [v in needed for v in jaxpr.invars]


_ALTERNATIVES = (
    "DirectDifferentiation() and AdjointVariable() treat it exactly, and ContinuousAdjoint('state') at second order"
)


def checked_for(method: Any, uses: dict[str, Use]) -> None:
    """Raise `ValueError` for a criterion that the continuous adjoint method cannot treat."""
    if not isinstance(method, ContinuousAdjoint):
        return
    for name, use in uses.items():
        if method.accelerations is None and use.integrand.accelerations:
            raise ValueError(
                f"{name}: its integrand uses accelerations, which eqs. (39)–(43) cannot treat as they are: "
                f"{_ALTERNATIVES}, 'derivatives' and 'first_order' too."
            )
        if method.accelerations != "state" and any(use.terminal):
            what = "accelerations" if use.terminal.accelerations else "multipliers"
            raise ValueError(
                f"{name}: its terminal term uses {what}, which ContinuousAdjoint({method.accelerations!r}) cannot "
                f"treat: {_ALTERNATIVES}."
            )
