"""What a criterion makes use of, read off its program; and whether a method can treat that."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax._src.interpreters.partial_eval import dce_jaxpr  # there is no public way to ask

from lgsens.criteria._criterion import Criterion
from lgsens.dynamics import AbstractSystem, State
from lgsens.sensitivity import ContinuousAdjoint


class Dependence(NamedTuple):
    """Whether F or G of a criterion depends on v̇ and on λ, by the operations that lead to its value."""

    accelerations: bool
    multipliers: bool

    @classmethod
    def of(cls, function, system: AbstractSystem, t, p) -> "Dependence":
        q, v = system.reference()
        lam = jnp.zeros(len(system.constraint_names), v.dtype)
        at = lambda vdot, lam: function(system, State(q, v, vdot, lam, vdot), t, p)
        jaxpr = jax.make_jaxpr(at)(jnp.zeros_like(v), lam).jaxpr
        return cls(*dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[1])  # inside of functions that are called, too


class Use(NamedTuple):
    """What F and G of a criterion depend on."""

    integrand: Dependence
    terminal: Dependence

    @classmethod
    def of(cls, criterion: Criterion, *at) -> "Use":
        return cls(Dependence.of(criterion.rate, *at), Dependence.of(criterion.final, *at))


def checked_for(method: Any, uses: dict[str, Use]) -> None:
    """Raise `ValueError` for a criterion that the continuous adjoint method cannot treat."""
    if not isinstance(method, ContinuousAdjoint):
        return
    others = (
        "DirectDifferentiation() and AdjointVariable() treat it exactly, and ContinuousAdjoint('state') at second order"
    )
    for name, use in uses.items():
        if method.accelerations is None and use.integrand.accelerations:
            raise ValueError(
                f"{name}: its integrand uses accelerations, which eqs. (39)–(43) cannot treat as they are: "
                f"{others}, 'derivatives' and 'first_order' too."
            )
        if method.accelerations != "state" and any(use.terminal):
            what = "accelerations" if use.terminal.accelerations else "multipliers"
            raise ValueError(
                f"{name}: its terminal term uses {what}, which ContinuousAdjoint({method.accelerations!r}) cannot "
                f"treat: {others}."
            )
