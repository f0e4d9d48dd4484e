"""Generalized-α whatever its constraints: what position and velocity follow, eqs. (24), (27)–(29), and what Newton's
iteration and the sensitivities know of the equations of a step.

The unknowns are u = a_{n+1} and the multipliers of the equations, `State.lam`: λ, and others where they have any.
"""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lgsens.dynamics import AbstractSystem, State
from lgsens.integrate._linearized import AbstractLinearizedStep, Node, Variation
from lgsens.integrate._scheme import AbstractScheme
from lgsens.linear import LU, Inverse


class AbstractAlpha(AbstractScheme):
    """The numbers of generalized-α, and the settings of its Newton iteration; see `GeneralizedAlpha`.

    α_m = (2ρ − 1)/(ρ + 1),  α_f = ρ/(ρ + 1),  γ = ½ + α_f − α_m,  β = (γ + ½)²/4
    """

    alpha_m: eqx.AbstractVar[Any]
    alpha_f: eqx.AbstractVar[Any]
    gamma: eqx.AbstractVar[Any]
    beta: eqx.AbstractVar[Any]
    delta: eqx.AbstractVar[Any]  # Δ = α_m − α_f: a_n stands for the acceleration at t_n + Δ h
    inertia_factor: eqx.AbstractVar[Any]  # c = ∂v̇⁺/∂u
    stabilized: eqx.AbstractVar[bool]
    factor_every: eqx.AbstractVar[int]
    iterations: eqx.AbstractVar[int | None]


def at_least(value, bound: float):
    """The larger one: a Python float where `value` is a constant of the program."""
    return max(value, bound) if isinstance(value, float | int) else jnp.maximum(value, bound)


class Motion(NamedTuple):
    """The increment and the kinematic state that u gives, eqs. (24), (27)–(29)."""

    x: Float[Array, " k"]
    q: Any
    v: Float[Array, " k"]
    vdot: Float[Array, " k"]


def increment(scheme: AbstractAlpha, previous: State, u, h) -> Float[Array, " k"]:
    """x of eq. (27)."""
    return h * previous.v + h**2 * ((0.5 - scheme.beta) * previous.a + scheme.beta * u)


def advance(scheme: AbstractAlpha, system: AbstractSystem, previous: State, u, h, correction=None) -> Motion:
    """What follows from the unknown u = a_{n+1}; `correction` is added to it in x alone."""
    x = increment(scheme, previous, u if correction is None else u + correction, h)
    v = previous.v + h * ((1.0 - scheme.gamma) * previous.a + scheme.gamma * u)
    vdot = ((1.0 - scheme.alpha_m) * u + scheme.alpha_m * previous.a - scheme.alpha_f * previous.vdot) / (
        1.0 - scheme.alpha_f
    )
    return Motion(x, system.group.retract(previous.q, x), v, vdot)


class AbstractAlphaLinearizedStep(AbstractLinearizedStep):
    """Eqs. (24), (27)–(29), linearized at a converged step; the rows for (u, λ) are in between, those of S.

    δw = Ad⁻¹(exp x) δw_n + T(x) (h δv_n + h² (½ − β) δa_n + βh² δu),     δv = δv_n + h (1 − γ) δa_n + γh δu,
    δv̇ = (α_m δa_n − α_f δv̇_n)/(1 − α_f) + c δu.
    """

    x: eqx.AbstractVar[Float[Array, " k"]]

    def carried(self, shared, h, previous: Variation, loads, row: Variation, moved=0.0):
        """δw, δv, δv̇ at δu = 0; `moved`: what else is added to x."""
        scheme, group, x = shared.scheme, shared.system.group, self.x
        dx = h * previous.v + (h**2 * (0.5 - scheme.beta)) * previous.a + loads.x + moved
        w = group.Ad_inv_mv(group.exp(x), previous.w) + group.tangent_mv(x, dx) + row.w
        v = previous.v + (h * (1.0 - scheme.gamma)) * previous.a + loads.v + row.v
        vdot = (scheme.alpha_m * previous.a - scheme.alpha_f * previous.vdot) / (1.0 - scheme.alpha_f) + row.vdot
        return w, v, vdot

    def ended(self, shared, h, carried, u, lam, correction=0.0) -> Variation:
        """With the solution of the rows in between; `correction`: what is added to δu in x alone."""
        scheme, (w, v, vdot) = shared.scheme, carried
        w = w + shared.system.group.tangent_mv(self.x, (scheme.beta * h**2) * (u + correction))
        return Variation(w, v + (scheme.gamma * h) * u, vdot + scheme.inertia_factor * u, lam, u)

    def of_unknown(self, shared, h, c: Variation):
        """The transpose of `ended`: what δu is multiplied by, and the part of it by x."""
        scheme = shared.scheme
        by_x = (scheme.beta * h**2) * shared.system.group.tangent_rmv(self.x, c.w)
        return c.a + by_x + (scheme.gamma * h) * c.v + scheme.inertia_factor * c.vdot, by_x

    def carried_back(self, shared, h, mu: Variation) -> tuple[Variation, Float[Array, " k"]]:
        """The transpose of `carried`: of δ_n, and of x."""
        scheme, group, x = shared.scheme, shared.system.group, self.x
        mu_x = group.tangent_rmv(x, mu.w)
        by_a = (h**2 * (0.5 - scheme.beta)) * mu_x + (h * (1.0 - scheme.gamma)) * mu.v
        previous = Variation(
            w=group.Ad_inv_rmv(group.exp(x), mu.w),
            v=h * mu_x + mu.v,
            vdot=-(scheme.alpha_f / (1.0 - scheme.alpha_f)) * mu.vdot,
            lam=jnp.zeros_like(mu.lam),
            a=by_a + (scheme.alpha_m / (1.0 - scheme.alpha_f)) * mu.vdot,
        )
        return previous, mu_x


class Wear(NamedTuple):
    """What has been done with the matrix that steps share.

    A matrix that serves s steps of n_1, …, n_s iterations costs (R + Σ n_i)/s iterations per step if making it costs R.
    This is least where the next step would take more than that; it is taken to need as many as the last one. R is 6
    for the top (9 unknowns), 10 for 35, 20 for the quarter-car (94) and for chains in blocks, and flat: with half or
    twice of it times change by 3 %. (A new matrix wherever the contraction exceeds 0.1, the rule before, was made three
    times as often on the quarter-car, and cost 42 % more: 59 and 42 µs per step of 1 ms.)
    """

    steps: Int[Array, ""]
    iterations: Int[Array, ""]
    last: Int[Array, ""]  # of the last step

    @classmethod
    def unused(cls) -> "Wear":
        return cls(*(jnp.zeros((), jnp.int32) for _ in range(3)))

    def after(self, made, iterations) -> "Wear":
        """After a step of so many iterations, which made a new matrix or not."""
        return Wear(jnp.where(made, 0, self.steps) + 1, jnp.where(made, 0, self.iterations) + iterations, iterations)

    def out(self, unknowns: int) -> Bool[Array, ""]:
        """Whether a new matrix pays."""
        renewal = min(20, 4 + unknowns // 5)
        return (self.steps > 1) & (self.last * self.steps > renewal + self.iterations)


class Matrix(eqx.Module):
    """The matrix that modified Newton keeps, in factors."""

    solver: Any
    h: Float[Array, ""]  # of the step that it was made for
    wear: Wear
    kind: Any = eqx.field(static=True)  # LU or Inverse

    def after(self, solver, made, iterations, h) -> "Matrix":
        """After a step of size h and so many iterations, which made a new one or not."""
        return Matrix(solver, jnp.where(made, h, self.h), self.wear.after(made, iterations), self.kind)


class AbstractStep(eqx.Module):
    """The equations of one step from `previous`."""

    shared: eqx.AbstractVar["AbstractEquations"]
    previous: eqx.AbstractVar[State]
    node: eqx.AbstractVar[Node]

    @abc.abstractmethod
    def motion(self, u, lam) -> Motion:
        """What follows from the unknowns."""

    @abc.abstractmethod
    def defect(self, motion: Motion, lam) -> tuple[Float[Array, " k"], Float[Array, " m"]]:
        """What is left of the dynamic equilibrium [N or N m], and of the constraints, as accelerations."""

    @abc.abstractmethod
    def factors(self, motion: Motion, lam, kind: Any = LU) -> tuple[Any, Float[Array, ""]]:
        """The factors of the iteration matrix, whose solution for the defect is what Newton takes from the unknowns;
        and their margin (`_singular`)."""

    @abc.abstractmethod
    def change(self, du, dlam) -> Float[Array, " k"]:
        """How far increments of the unknowns move the configuration, over βh²."""

    def left(self, state: State) -> State:
        """What a state leaves of the equations, and the configuration that they predict."""
        motion = self.motion(state.a, state.lam)
        residual, violation = self.defect(Motion(motion.x, state.q, state.v, state.vdot), state.lam)
        return State(motion.q, state.v - motion.v, state.vdot - motion.vdot, violation, residual)


class AbstractEquations(eqx.Module):
    """What all steps share, and the equations of each."""

    scheme: eqx.AbstractVar[AbstractAlpha]
    system: eqx.AbstractVar[AbstractSystem]
    scale: eqx.AbstractVar[Float[Array, " k"]]

    @classmethod
    @abc.abstractmethod
    def of(cls, scheme: AbstractAlpha, system: AbstractSystem) -> "AbstractEquations":
        """Those of a system."""

    @staticmethod
    @abc.abstractmethod
    def numbers(scheme: AbstractAlpha, system: AbstractSystem) -> int:
        """How many numbers the factors of a step are."""

    @abc.abstractmethod
    def loads(self, previous: State, state: State) -> Callable[[AbstractSystem, Node], Any]:
        """See `AbstractScheme.loads`."""

    @abc.abstractmethod
    def step(self, previous: State, node: Node) -> AbstractStep:
        """The equations of the step from `previous`."""

    @abc.abstractmethod
    def linearized(self, node: Node, previous: State, state: State) -> AbstractLinearizedStep:
        """Their exact linearization at a converged step."""

    def no_matrix(self, state: State, node: Node, factor_every: int, kind: Any = Inverse) -> Matrix | None:
        """Zeros in the shapes of the factors of an iteration matrix, to begin with; None: full Newton shares none."""
        if not factor_every:
            return None
        at_state = Motion(state.v, state.q, state.v, state.vdot)
        factors = lambda: self.step(state, node).factors(at_state, state.lam, kind)[0]
        zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(factors))
        return Matrix(zeros, node.h, Wear.unused(), kind)
