"""Richardson extrapolation in the step size: of a trajectory, and of any function of the number of steps.

What a convergent scheme of second order computes with step h is ψ_h = ψ + c₂ h² + c₃ h³ + …, so with two runs

    ψ ≈ ψ_{h/2} + e,      e = (ψ_{h/2} − ψ_h)/3,

is at least one order better, and e estimates the error that the finer run had. For generalized-α c₃ is there, it
vanishes with the numerical damping (ρ∞ → 1): at ρ∞ = 0.9 errors fall by 13 to 16 when h is halved, at 0.3 by 8 to 10.
In a Lie group the difference of two configurations is a logarithm,

    q = q_{h/2} exp(w̃),   w = log(q_h⁻¹ q_{h/2})/3,

exact to the order of w² ~ h⁴. Both formulas are differentiated as they stand: the derivative is the same extrapolation
of the exact derivatives of the two runs.

Where c₃ is small the next power is h⁴, and a third run with h/4 removes it, and so on (Romberg's scheme):

    T_{j,1} = ψ_{h/2ʲ},     T_{j,k+1} = T_{j,k} + (T_{j,k} − T_{j−1,k})/(4ᵏ − 1).

An integral by the trapezoidal rule has an expansion in even powers itself, so criteria are extrapolated as a whole.

Sources: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.4 and §II.8; Arnold, Brüls &
Cardona, Numerische Mathematik 129 (2015), doi:10.1007/s00211-014-0633-1, for the error of generalized-α.
"""

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from lgsens._brief import brief
from lgsens._validate import as_count
from lgsens.dynamics import RESULTS, AbstractSystem, State
from lgsens.integrate import AbstractIntegrator, GeneralizedAlpha, scheme_of
from lgsens.simulation._trajectory import Saved, StateError, Trajectory


class Richardson(AbstractIntegrator):
    """Two generalized-α runs, one step half the other, extrapolated: an integrator of `simulate`.

        x ≈ x_{h/2} + (x_{h/2} − x_h)/3   for v, v̇, λ,       q ≈ q_{h/2} exp(log(q_h⁻¹ q_{h/2})~/3)

    Arguments:
        integrator: that of both runs: `GeneralizedAlpha` or another scheme of second order, in equal steps, or in
            `AlignedSteps` or `GivenSteps`, which are divided into two for the finer run.

    The trajectory has the n + 1 times of the coarser run; `Trajectory.error` is what was added to the finer run, an
    estimate of its error, and more than what is left. `Trajectory.order` is 4: criteria that are integrals need
    `time_integral(…, order=4)`, because the trapezoidal rule on n steps would cost more than extrapolation gains.
    `stats` are those of the n steps of the coarser run, then of the 2n of the finer. a is v̇, since the algorithmic
    acceleration belongs to a step size.

    Errors fall by 13 to 16 when the number of steps is doubled, at ρ∞ = 0.9 and in smooth motions; a force that is not
    smooth in time (a bump that ends) should change on a time step. In the first steps v̇ and λ have transients
    (−ρ∞)ⁿ h² that differ in the two runs and stay. Constraints are not solved for: Φ is of the
    order of w². The cost is that of 3n steps. Start from the consistent initial state of the model, or from a `state0`
    at rest: that of another run brings the a of its own step size, and one order is lost.

    Raises `ValueError` for anything else.
    """

    integrator: AbstractIntegrator = GeneralizedAlpha()

    def __check_init__(self):
        given = self.integrator
        if not isinstance(given, AbstractIntegrator) or given.extrapolated or given.by_motion:
            raise ValueError(
                "Richardson: `integrator` must be a scheme of second order, GeneralizedAlpha(), or one in steps that "
                f"are known before (AlignedSteps(), GivenSteps(…)), got {given!r}."
            )
        if scheme_of("Richardson", given.scheme).order != 2:
            raise ValueError(
                f"Richardson: `integrator` must be of second order, as GeneralizedAlpha, got {self.integrator!r}; take "
                "it as it is, in more steps."
            )

    @property
    def scheme(self):
        return self.integrator.scheme

    @property
    def equal_steps(self):
        return self.integrator.equal_steps

    def check(self, num_steps):
        self.integrator.check(num_steps)

    def lay(self, system, start, t0, t1, num_steps):
        return self.integrator.lay(system, start, t0, t1, num_steps)

    @property
    def extrapolated(self):
        return True


class Extrapolated(NamedTuple):
    """What `richardson` returns.

    Attributes:
        value: the extrapolated values, a pytree as the function returns.
        error: the last correction, as large or larger than what is left: the estimated errors of the finer of two runs,
            value − fn(2 num_steps), or of the finest values that one run less would have given.
    """

    value: PyTree
    error: PyTree

    __repr__ = brief


def richardson(fn: Callable[[int], Any], num_steps: int, runs: int = 2) -> Extrapolated:
    """The limit of a function of the number of steps, of second order, from two of its values or more.

        ψ ≈ ψ_{2n} + e,   e = (ψ_{2n} − ψ_n)/3

    Arguments:
        fn: number of steps ↦ a pytree of floats; for instance criteria, their gradients, or both:
            `lambda n: differentiate(criteria, build, p, t1=1.0, num_steps=n)[:2]`.
        num_steps: n, a Python int.
        runs: how many: `fn` is called with n, 2n, 4n, …. From three on the powers h⁴, h⁶, … are removed as well, which
            gains digits in smooth motions with little numerical damping (ρ∞ = 0.9), and few where h³ is not small.

    Every JAX transformation goes through as it does through `fn`. Raises `ValueError` for a number of steps that is not
    one, for fewer than two runs, and for values that are not floats.
    """
    num_steps = as_count(num_steps, "num_steps", " (it is static)")
    if isinstance(runs, bool) or not isinstance(runs, int) or runs < 2:
        raise ValueError(f"`runs` must be a Python int of at least 2, got {runs!r}: one run cannot be extrapolated.")
    if not callable(fn):
        raise ValueError(f"`fn` must be a function of the number of steps, got {fn!r}.")
    values = [fn(2**j * num_steps) for j in range(runs)]
    for path, leaf in jax.tree_util.tree_leaves_with_path(values[-1]):
        if not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            raise ValueError(
                f"`fn` must return floats, got {jnp.result_type(leaf)} in its value{jax.tree_util.keystr(path)}; "
                "return only what shall be extrapolated."
            )
    for k in range(1, runs):
        errors = [jax.tree.map(partial(_missing, power=k), *pair) for pair in pairwise(values)]
        values = [jax.tree.map(jnp.add, finer, error) for finer, error in zip(values[1:], errors)]
    return Extrapolated(values[0], errors[0])


def _missing(coarse, fine, power: int = 1):
    """What values miss whose errors are of order h²ᵏ, k the power."""
    return (fine - coarse) / (4.0**power - 1.0)


def extrapolate_runs(system: AbstractSystem, coarse: Any, fine: Any) -> Trajectory | Saved:
    """The run on the times of `coarse` from two of the same system, `fine` with half the step."""
    result = jnp.where(coarse.result == RESULTS.successful, fine.result, coarse.result)
    stats = jax.tree.map(lambda first, second: jnp.concatenate([first, second]), coarse.stats, fine.stats)
    if isinstance(coarse, Saved):
        is_float = lambda leaf: jnp.issubdtype(leaf.dtype, jnp.floating)
        better = lambda rough, fine: fine + _missing(rough, fine) if is_float(fine) else fine
        values = jax.tree.map(lambda rough, fine: better(rough, fine[::2]), coarse.values, fine.values)
        final, _ = _extrapolated(system, coarse.final, fine.final)
        return Saved(coarse.t, values, final, result, stats)
    halved = jax.tree.map(lambda leaf: leaf[::2], fine.states)
    states, error = jax.vmap(partial(_extrapolated, system))(coarse.states, halved)
    return Trajectory(t=coarse.t, states=states, result=result, stats=stats, system=system, error=error, order=4)


def _extrapolated(system, rough: State, better: State) -> tuple[State, StateError]:
    group = system.group
    w = group.log(group.compose(group.inverse(rough.q), better.q)) / 3.0
    v, vdot, lam = (_missing(getattr(rough, name), getattr(better, name)) for name in ("v", "vdot", "lam"))
    acceleration = better.vdot + vdot
    state = State(group.retract(better.q, w), better.v + v, acceleration, better.lam + lam, acceleration)
    return state, StateError(w, v, vdot, lam)
