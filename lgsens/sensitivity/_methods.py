"""How a trajectory is differentiated, as a value."""

import abc
from typing import ClassVar

import equinox as eqx

from lgsens._validate import require_setting
from lgsens.dynamics import State, require_independent, require_linear
from lgsens.integrate import AbstractScheme, Stats
from lgsens.sensitivity._continuous_adjoint import Cotangents, continuous_adjoint_sweep
from lgsens.sensitivity._criterion_terms import Functional, OfState, derivative_terms, plain_terms, points
from lgsens.sensitivity._first_order_adjoint import first_order_adjoint_sweep
from lgsens.sensitivity._linearization import Parameters
from lgsens.sensitivity._rules import (
    AT_ONCE,
    SWEEPS,
    adjoint_trajectory,
    continuous_trajectory,
    decoded_run,
    direct_trajectory,
    encoded_run,
    linear_scheme,
)

_TREATMENTS = ("state", "derivatives", "first_order", None)


class AbstractSensitivity(eqx.Module):
    """A method to differentiate a trajectory."""

    @abc.abstractmethod
    def trajectory(
        self, scheme: AbstractScheme, state0: State, parameters: Parameters, found: tuple[State, Stats] | None = None
    ) -> tuple[State, Stats]:
        """The states and statistics of all steps, with this method as their derivative.

        `found`: the states and statistics of this very run, if they are known already.
        """


class AbstractDiscrete(AbstractSensitivity):
    """The derivative of the numerical trajectory itself, from all of its states or from those of some steps."""

    checkpoints: str | int | None = eqx.field(static=True, default=None, kw_only=True)

    def __check_init__(self):
        given = self.checkpoints
        valid = given in (None, "sqrt") or (isinstance(given, int) and not isinstance(given, bool) and given > 0)
        require_setting(self, "checkpoints", valid, "None, 'sqrt' or a number of states, at least 1")

    def _require_all_states(self) -> None:
        if self.checkpoints is not None:
            raise ValueError(
                f"{type(self).__name__}: `checkpoints` = {self.checkpoints!r} is for `simulate(…, save=…)`: a "
                "trajectory has all its states anyway. Ask for what the criterion needs with `save`, or leave it out."
            )


class DirectDifferentiation(AbstractDiscrete):
    """The hand-derived linearization L of the scheme, in both modes; the default.

    Forward mode (`jvp`, `jacfwd`) is the direct differentiation method of §6.2, forward substitution with L; JAX
    transposes it (`grad`, `jacrev`) to back substitution with Lᵀ, the discrete adjoint variable method. The derivative
    is that of the numerical solution, to round-off. Supports every JAX transformation, nested too (`hessian`).

    Arguments:
        checkpoints: keep the state of some steps only, for `simulate(…, save=…)`, and integrate the steps between them
            again when the derivative needs them: "sqrt", about √n of n steps, or the largest number of states to keep.
            Costs about one more simulation. Second derivatives keep all. None: all states are kept. Static.

    Raises `ValueError` for other `checkpoints`, and for a trajectory, which has all states anyway, with any.
    """

    def trajectory(self, scheme, state0, parameters, found=None):
        self._require_all_states()
        return decoded_run(direct_trajectory(SWEEPS, scheme, state0, parameters, found))


class AssociativeScan(AbstractSensitivity):
    """The derivative of `DirectDifferentiation` in O(log n) depth, for devices with room for many steps at once.

        δ_{n+1} = A_n δ_n + f_n,     (A', f') ∘ (A, f) = (A' A, A' f + f')

    All n steps are linearized at once, and composed by an associative scan, in forward mode and, transposed, in reverse
    mode. Supports every JAX transformation, nested too. The simulation itself takes one step after the other, as ever.

    The matrices A have s rows, 2 f of a system with f freedoms and RadauIIA, up to 4 k of one with k coordinates and
    generalized-α (`_carried`). The n s² numbers of all of them are held at once, two to three times over, besides the
    factors of all steps, and n s³ products take the place of n solutions: that pays where a product of matrices costs
    little more time than the beginning of an operation does, as on accelerators with small systems and many steps. On
    a CPU it costs more than the sweeps (`benchmarks/log_depth.py`). Compiled for each number of steps.

    Sources: Blelloch, CMU-CS-90-190 (1990); Särkkä & García-Fernández, IEEE Trans. Autom. Control 66 (2021) 299.
    """

    def trajectory(self, scheme, state0, parameters, found=None):
        return decoded_run(direct_trajectory(AT_ONCE, scheme, state0, parameters, found))


class AdjointVariable(AbstractDiscrete):
    """The backward sweep with Lᵀ as an explicit `custom_vjp`: reverse mode, and forward mode over it (`jax.hessian`).

    The same numbers as `DirectDifferentiation` in reverse mode, from a rule that JAX does not take apart until it
    differentiates it once more. Forward mode alone, and reverse mode over either, raise JAX's errors.

    Arguments:
        checkpoints: as in `DirectDifferentiation`.

    Raises `ValueError` as `DirectDifferentiation`.
    """

    def trajectory(self, scheme, state0, parameters, found=None):
        self._require_all_states()
        return decoded_run(adjoint_trajectory(scheme, state0, parameters, found))


class ContinuousDirect(AbstractSensitivity):
    """The differentiated equations of motion, integrated (§6.1): forward mode, first derivatives.

    Its derivative is second-order accurate, but not that of the numerical trajectory: for comparison with the
    paper, and for equations whose scheme cannot be linearized. It has an iteration matrix of its own. `grad` through
    it is the transpose of the forward sweep.
    """

    def trajectory(self, scheme, state0, parameters, found=None):
        _require_positions("ContinuousDirect", parameters)
        return decoded_run(continuous_trajectory(scheme, state0, parameters))


class Autodiff(AbstractSensitivity):
    """What JAX makes of the scheme's own loops: forward mode only, for comparison.

    Newton's iteration is differentiated as it runs, so the derivative is exact up to the last increment of each step:
    ask the integrator for a tolerance of 1e-14 or so. It is always full Newton, which alone converges as fast in its
    derivative as in its value.
    """

    def trajectory(self, scheme, state0, parameters, found=None):
        return decoded_run(encoded_run(scheme.for_autodiff(), state0, parameters))


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
        require_setting(self, "accelerations", self.accelerations in _TREATMENTS, f"one of {_TREATMENTS}")

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
        _require_positions("ContinuousAdjoint", parameters)
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


def _require_positions(method: str, parameters: Parameters) -> None:
    """Raise `ValueError` where the constraints of a motion are not those of the paper: of positions, independent."""
    require_independent(parameters.system, method)
    require_linear(parameters.system, method)
    if parameters.system.num_velocity_rows:
        raise ValueError(
            f"{method} integrates the differentiated equations of motion with constraints of position level only: "
            "leave `Rolling` out, or take DirectDifferentiation() or AdjointVariable()."
        )
