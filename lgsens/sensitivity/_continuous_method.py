"""The continuous adjoint variable method as a value."""

from typing import ClassVar

import equinox as eqx

from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme
from lgsens.sensitivity._continuous_adjoint import Cotangents, continuous_adjoint_sweep
from lgsens.sensitivity._criterion_terms import (
    Functional,
    OfState,
    derivative_terms,
    plain_terms,
    points,
)
from lgsens.sensitivity._first_order_adjoint import first_order_adjoint_sweep
from lgsens.sensitivity._linearization import Parameters
from lgsens.sensitivity._methods import linear_scheme, require_positions

TREATMENTS = ("state", "derivatives", "first_order", None)


class ContinuousAdjoint(eqx.Module):
    """The adjoint equations of motion, integrated backwards (§7); a method of `differentiate`.

    Second order, but not the derivative of the numerical trajectory, whose own adjoint is `AdjointVariable`. It needs
    F and G apart, and where F depends on accelerations, one of the treatments that §7.2 lists:

    Arguments:
        accelerations: "state" expresses v̇ and λ through q and v (eq. 41; F and G may use both); "derivatives"
            computes v̈ and v⃛ by additional differential equations; "first_order" solves the first-order adjoint
            equations of Bestle & Seybold (1992), extended to the Lie group, by BDF2; None leaves eqs. (39)–(43) as
            they are, for criteria without accelerations. Only "state" keeps second order for F of v̇ and λ; it
            also costs most. Criteria that use neither v̇ nor λ are the same in "state",
            "derivatives" and None, and cost the same.

    At least 4 steps. Raises `ValueError` for another treatment. Source: Sonneville & Brüls (2014), §7.
    """

    LEAST_STEPS: ClassVar[int] = 4

    accelerations: str | None = eqx.field(static=True, default="state")

    def __check_init__(self):
        if self.accelerations not in TREATMENTS:
            raise ValueError(
                f"ContinuousAdjoint: `accelerations` must be one of {TREATMENTS}, got {self.accelerations!r}."
            )

    def cotangents(
        self,
        scheme: AbstractScheme,
        states: State,
        parameters: Parameters,
        functional: Functional,
        p,
        *,
        uses: tuple[bool, bool],
    ) -> Cotangents:
        """dΨ as it acts on the initial state, the system and p; `uses`: whether F and G use v̇ or λ."""
        require_positions("ContinuousAdjoint", parameters)
        scheme = linear_scheme(scheme)
        t, h = parameters.grid.times(), parameters.grid.h
        if self.accelerations != "state" and h.ndim:
            raise ValueError(
                f"ContinuousAdjoint({self.accelerations!r}) takes differences in equal steps: leave GivenSteps and "
                "AdaptiveSteps out, or take ContinuousAdjoint('state'), DirectDifferentiation() or AdjointVariable()."
            )
        derivatives = uses[0] and self.accelerations in ("derivatives", None)
        path = points(scheme, states, t, h, derivatives=derivatives)
        if self.accelerations == "first_order":
            return first_order_adjoint_sweep(path, parameters, functional, p)
        if self.accelerations == "state":
            functional = Functional(*(OfState(f) if used else f for f, used in zip(functional, uses)))
        terms = derivative_terms if derivatives else plain_terms
        return continuous_adjoint_sweep(scheme, path, parameters, functional, p, terms)
