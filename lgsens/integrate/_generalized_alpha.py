"""The Lie-group generalized-α scheme as a value, eqs. (24)–(30).

With u = a_{n+1}, one step from (q, v, v̇, a) at t_n solves for u and λ

    x   = h v + h² ((½ − β) a + β u)                      (27)
    q⁺  = q exp(x̃)                                       (24)
    v⁺  = v + h ((1 − γ) a + γ u)                         (28)
    v̇⁺  = ((1 − α_m) u + α_m a − α_f v̇) / (1 − α_f)       (29)
    r(q⁺, v⁺, v̇⁺, λ⁺, t⁺) = 0,   Φ(q⁺)/(βh²) = 0          (25), (26)

The unknown is u and not x, and the constraint is divided by βh²: with ∂x/∂u = βh² the matrix S of eq. (30), written out
in `_index3.py`, does not degenerate as h → 0 (Bottasso, Bauchau & Cardona 2007; its condition at h = 1e-3 would else be
1e18). Its constraint rows and multipliers are further scaled by the size of M.
"""

import dataclasses
import functools
import math
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from lgsens._validate import require_setting
from lgsens.dynamics import softness
from lgsens.integrate._alpha import AbstractEquations, Matrix, Wear
from lgsens.integrate._alpha_begin import AbstractAlphaBegin
from lgsens.integrate._alpha_defects import alpha_defects
from lgsens.integrate._guess import Guess
from lgsens.integrate._index3 import Index3
from lgsens.integrate._levels import Levels
from lgsens.integrate._newton import take_step
from lgsens.integrate._scheme import Memory
from lgsens.integrate._singular import Watch
from lgsens.linear import LU, Inverse


class Past(NamedTuple):
    """What is known of the steps before, besides the matrix."""

    guess: Guess
    watch: Watch


class AbstractGeneralizedAlpha(AbstractAlphaBegin):
    """What the scheme is for the march and the sweeps."""

    carries: ClassVar[tuple[str, ...]] = ("w", "v", "vdot", "a")

    def shared(self, system) -> AbstractEquations:
        return self._kind(system).of(self, system)

    def equations(self, system, node, previous, state):
        return self.shared(system).step(previous, node).left(state)

    @property
    def convergence_order(self):
        return 2

    def defects(self, system, grid, states):
        """Of index 3 where no force depends on the multipliers, as the start takes it."""
        if self.stabilized or system.reads_multipliers:
            return None
        return alpha_defects(self, system, grid, states)

    def mismatch(self, before, after, ratio):
        """Of eq. (29)."""
        (vdot, a), (next_vdot, next_a) = before, after
        a = self.resized_acceleration(vdot, a, ratio)
        left = (1.0 - self.alpha_m) * next_a + self.alpha_m * a
        return left - (1.0 - self.alpha_f) * next_vdot - self.alpha_f * vdot

    def memory(self, shared, state, node, *, uneven, exact=False):
        matrix = shared.no_matrix(state, node, self.factor_every, LU if exact else Inverse)
        return Memory(Past(Guess.first(state, uneven=uneven), Watch.first(node.begin)), matrix)

    def remembered(self, shared, memory, linearized, node, stats):
        """Its exact matrix serves the next step, and is the first of which no other one is made."""
        if memory.matrix is None:
            return memory, stats
        none = Wear.unused()
        once = none._replace(steps=none.steps + 1)
        matrix = Matrix(linearized.factors, node.h, once, LU)
        margin = linearized.margin(shared.scale)
        stats = stats if margin is None else stats._replace(margin=margin)
        return memory._replace(matrix=matrix), stats

    def take(self, system, shared, before, begun, memory, node, running):
        (guess, watch), matrix = memory
        due = matrix is not None and self._due(memory, node, before.a.size + before.lam.size)
        equations = shared.step(begun, node)
        state, next_guess, stats, matrix, made = take_step(equations, before, guess, matrix, due, running)
        if matrix is not None:
            watch = jax.tree.map(partial(jnp.where, made), watch.after(stats.margin, node.t), watch)
        return state, Memory(Past(next_guess, watch), matrix), stats

    def _due(self, memory: Memory, node, unknowns: int) -> Bool[Array, ""]:
        """Whether a step wants a new matrix."""
        (guess, watch), matrix = memory
        due = (matrix.wear.steps == 0) | (matrix.wear.steps >= self.factor_every)
        due = due | watch.ends_by(node.t, (2.0 * self.factor_every) * node.h) | guess.pace.changed(node.h, matrix.h)
        return due if self.iterations is not None else due | matrix.wear.out(unknowns)

    def satisfies(self, system):
        """Positions, unless joints give way for what they carry; and velocities where they are stabilized."""
        independent = softness(system) is None
        return independent, independent and self.stabilized

    def numbers(self, system):
        return self._kind(system).numbers(self, system)

    def loads(self, shared, previous, state):
        return shared.loads(previous, state)

    def linearized(self, system, shared, node, previous, state):
        return shared.linearized(node, previous, state)

    def _kind(self, system) -> type[AbstractEquations]:
        """The equations of a step: those of index 3, or those with rows of velocity level."""
        return Levels if self.stabilized or system.num_velocity_rows else Index3


class GeneralizedAlpha(AbstractGeneralizedAlpha):
    """The generalized-α integrator: numerical damping and the settings of its Newton iteration.

        α_m = (2ρ − 1)/(ρ + 1),  α_f = ρ/(ρ + 1),  γ = ½ + α_f − α_m,  β = (γ + ½)²/4

    Arguments:
        rho_inf: spectral radius ρ∞ at infinite frequency, in [0, 1): 0 damps the fastest modes in one step,
            values near 1 keep energy and let noise in the multipliers persist.
        tolerance: the last Newton increment of a configuration, relative to 1 rad or the length of the
            scene, at which a step has converged. The error left is its square; below 64 round-offs
            it is raised to that (single precision).
        max_iterations: full Newton iterations per step before the step has failed.
        iterations: a fixed budget instead, so many iterations in every step and no test between them: of modified
            Newton, with a matrix renewed every `factor_every` steps and at no other time, or of full Newton where that
            is 0. Every step then costs the same, in each lane of a batch too. A step whose last increment is above
            `tolerance` has failed all the same, and `Stats.increment` says what it was; with a larger tolerance the
            motion is off by about the last increment times the contraction of one iteration, and so is its derivative,
            which is that of converged steps. Too few feed their error to the steps that follow: at h = 1 ms a top
            takes 2 full ones, or 4 with a matrix up to 20 steps old (with 3 it diverges). None: as many as it takes.
        factor_every: the most steps that share one inverse of the iteration matrix (modified Newton); a new one is made
            earlier where the iterations that it saves are worth it. Its iterations cost a tenth of a full one, and go
            on until the error left is what full Newton would leave; a step that they do not bring there is finished by
            full Newton. 0: full Newton always. The sensitivities do not depend on it: theirs is always the exact
            matrix of the converged step.
        second_order_start: start with what the constraints ask of v̈ in a₀, because a_n stands for the acceleration at
            t_n + (α_m − α_f) h, and with v₀ moved by O(h²) along the constraint directions, where the scheme keeps
            it anyway: positions, velocities and multipliers are then second order from the first step.
            Where steps change their size the velocity is moved likewise, which takes a factorization per step, and so
            are both behind the breaks of drivers (`renewed`).
            False: a₀ = v̇₀ and v₀ as it is; multipliers are first order in the first steps (Arnold,
            Brüls & Cardona, Numerische Mathematik 129, 2015, doi:10.1007/s00211-014-0633-1), and after each change of
            the size.
        stabilized: satisfy B v = 0 in every step besides Φ = 0 (stabilized index 2, after Gear, Gupta & Leimkuhler),
            at the price of m more unknowns in a step; see `_level_step.py`. Larger scenes are solved in blocks, unless
            forces depend on multipliers. False: index 3, where B v is O(h²).

    All static and hashable. Raises `ValueError` for ρ∞ outside [0, 1), a tolerance that is not positive, fewer than 1
    iteration, a negative `factor_every`, or a `stabilized` that is not a bool. Source: Sonneville & Brüls (2014), §4;
    Brüls, Cardona & Arnold (2012).
    """

    rho_inf: float = eqx.field(static=True, default=0.9)
    tolerance: float = eqx.field(static=True, default=1e-10, kw_only=True)
    max_iterations: int = eqx.field(static=True, default=10, kw_only=True)
    factor_every: int = eqx.field(static=True, default=20, kw_only=True)
    second_order_start: bool = eqx.field(static=True, default=True, kw_only=True)
    iterations: int | None = eqx.field(static=True, default=None, kw_only=True)
    stabilized: bool = eqx.field(static=True, default=False, kw_only=True)

    def __check_init__(self):
        number = lambda value: isinstance(value, int | float)
        count = lambda value, least: isinstance(value, int) and value >= least
        check = partial(require_setting, self)
        valid = number(self.rho_inf) and 0.0 <= self.rho_inf < 1.0
        check("rho_inf", valid, "a number in [0, 1)", "; 0.9 damps little, 0 most")
        valid = number(self.tolerance) and 0.0 < self.tolerance < math.inf
        check("tolerance", valid, "positive", "; 1e-10 is the default")
        check("max_iterations", count(self.max_iterations, 1), "an int, at least 1")
        check("factor_every", count(self.factor_every, 0), "an int, at least 0 (0: full Newton always)")
        valid = self.iterations is None or count(self.iterations, 1)
        check("iterations", valid, "an int, at least 1, or None (until they converge)")
        check("stabilized", isinstance(self.stabilized, bool), "True (index 2) or False (index 3)")

    # No arguments, where the base has fields.
    alpha_m: ClassVar[Any] = property(lambda self: (2.0 * self.rho_inf - 1.0) / (self.rho_inf + 1.0))
    alpha_f: ClassVar[Any] = property(lambda self: self.rho_inf / (self.rho_inf + 1.0))
    gamma: ClassVar[Any] = property(lambda self: 0.5 + self.alpha_f - self.alpha_m)
    beta: ClassVar[Any] = property(lambda self: (self.gamma + 0.5) ** 2 / 4.0)
    delta: ClassVar[Any] = property(lambda self: self.alpha_m - self.alpha_f)
    inertia_factor: ClassVar[Any] = property(lambda self: (1.0 - self.alpha_m) / (1.0 - self.alpha_f))

    def for_autodiff(self):
        """Full Newton, which alone converges as fast in its derivative as in its value."""
        return dataclasses.replace(self, factor_every=0)

    def caution(self, system):
        """Rolling in an articulated mechanism couples the rows of index 3, whose errors fall like n² ρ∞ⁿ, to those of
        velocity level; a bicycle at 5 m/s is unstable with ρ∞ = 0.9 at h = 5 ms and 0.8 at 10 ms, and is right with 0.5
        and with every `stabilized` one at 20 ms. One body that rolls is right with all of them."""
        one_body = system.group.dim - system.num_states <= 6
        if not system.num_velocity_rows or one_body or self.stabilized or self.rho_inf <= 0.5:
            return None
        return (
            "Constraints of velocities (`Rolling`, gears without teeth) between several bodies may be unstable with "
            f"{self!r}, with positions in index 3: take GeneralizedAlpha(stabilized=True), rho_inf = 0.5 or less, or "
            "RadauIIA()."
        )

    def as_data(self, dtype):
        return _as_data(self, jnp.dtype(dtype))


class AlphaOfData(AbstractGeneralizedAlpha):
    """A `GeneralizedAlpha` of which the numbers are data of a program, and not constants in it."""

    alpha_m: Any
    alpha_f: Any
    gamma: Any
    beta: Any
    delta: Any
    inertia_factor: Any
    tolerance: Any
    max_iterations: Any
    factor_every: int = eqx.field(static=True)
    second_order_start: bool = eqx.field(static=True)
    iterations: int | None = eqx.field(static=True)
    stabilized: bool = eqx.field(static=True)


@functools.lru_cache(maxsize=64)
def _as_data(scheme: GeneralizedAlpha, dtype) -> AlphaOfData:
    fields = dataclasses.fields(AlphaOfData)
    values: dict[str, Any] = {field.name: getattr(scheme, field.name) for field in fields}
    for name in (field.name for field in fields if not field.metadata.get("static")):
        values[name] = jnp.asarray(values[name], jnp.int32 if name == "max_iterations" else dtype)
    return AlphaOfData(**values)
