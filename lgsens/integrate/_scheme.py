"""A scheme: one step E(y_n, y_{n+1}; system, t_n, h) = 0, and all that the march, grids and sensitivities ask of it.

A new scheme is one class. What it must say are its equations, a function of both states; from these follow, for scenes
that are not large, Newton's iteration of a step, the exact linearization that forward and transposed sweeps solve, and
the product with it that second derivatives are taken of. Schemes that want to be fast say more.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from lgsens._brief import brief
from lgsens._xla import while_loop
from lgsens.dynamics import RESULTS, AbstractSystem, Initial, State, finite
from lgsens.integrate._grid import AbstractGrid, Start
from lgsens.integrate._integrator import AbstractIntegrator
from lgsens.integrate._linearized import AbstractLinearizedStep, DenseLinearizedStep, Node, Variation


class Stats(NamedTuple):
    """What Newton did in each step (of one step: in one).

    Attributes:
        iterations: iterations of each step, those of modified Newton included, shape (n,), int32; 0 after a failure.
        increment: the last increment of each step, relative as in `GeneralizedAlpha.tolerance`, shape (n,).
        residual: the largest entry of the residual r before that increment [N or N m], shape (n,).
        converged: whether each step converged, shape (n,), bool.
        margin: how far the step is from a singular configuration (`_singular`), infinite where that was not looked at
            and without joints, shape (n,).
    """

    iterations: Int[Array, " n"]
    increment: Float[Array, " n"]
    residual: Float[Array, " n"]
    converged: Bool[Array, " n"]
    margin: Float[Array, " n"]

    __repr__ = brief

    @classmethod
    def none(cls, like) -> "Stats":
        """Of no step, with floats like one given."""
        zero = jnp.zeros_like(like)
        return cls(jnp.zeros((), jnp.int32), zero, zero, jnp.ones((), bool), jnp.full_like(like, jnp.inf))


class Memory(NamedTuple):
    """What the iteration of a step knows of those before it.

    Attributes:
        past: what is small; of the last step taken, and kept where a run is to go on from.
        matrix: what is large; of the last step, taken or not, and not kept.
    """

    past: Any = None
    matrix: Any = None


class Stages(NamedTuple):
    """The stages of Runge–Kutta steps: ∫ F dt = Σ w F(stage), of the order of the scheme, is its own quadrature.

    A stage on its own is of low order; only the sum over all of them is of that of the scheme.

    Attributes:
        t: times [s], shape (s,), in the order of the steps.
        weights: w [s], shape (s,).
        states: the states, stacked along a leading axis.
    """

    t: Float[Array, " s"]
    weights: Float[Array, " s"]
    states: State


def scheme_of(owner: str, integrator: Any) -> "AbstractScheme":
    """The scheme that an integrator is to lay steps for; `ValueError` where that is none."""
    if not isinstance(integrator, AbstractScheme):
        raise ValueError(
            f"{owner}: `integrator` must be a scheme, as GeneralizedAlpha() and RadauIIA() are, got {integrator!r}."
        )
    integrator.require_steps()
    return integrator


class AbstractScheme(AbstractIntegrator):
    """A one-step scheme on a constrained system; static and hashable.

    Attributes:
        tolerance: the last Newton increment of a configuration, relative to 1 rad or the length of the scene.
        max_iterations: Newton iterations per step before the step has failed.
        order: 2, or 4 where the states deserve a rule of fourth order (`Trajectory.order`).
        failure: what a step that failed is called.
        has_stages: whether criteria are integrated over `stages`.
        state_is_motion: whether the steps that follow a state depend on nothing of it but q and v.
        carries: the parts of δ_n that a linearized step reads; all, unless a scheme knows better. (v̇ may be one of them
            and the state a motion all the same, as that of q and v.)
        error_power: p of `step_error`.
    """

    tolerance: eqx.AbstractVar[float]
    max_iterations: eqx.AbstractVar[int]
    order: ClassVar[int] = 2
    failure: ClassVar[RESULTS] = RESULTS.newton_failed
    has_stages: ClassVar[bool] = False
    state_is_motion: ClassVar[bool] = False
    carries: ClassVar[tuple[str, ...]] = Variation._fields
    error_power: ClassVar[int] = 3

    @property
    def scheme(self):
        return self

    def require_steps(self) -> None:
        """Raise `ValueError` where the steps are not those of a grid."""
        return

    @property
    def convergence_order(self) -> int | None:
        """p: errors of states are of the order of h^p; None: not said, and then errors cannot be estimated."""
        return None

    @abc.abstractmethod
    def equations(self, system: AbstractSystem, node: Node, previous: State, state: State) -> State:
        """E: the configuration that the step predicts as `q`, what is left of all other equations elsewhere.

        As many equations as unknowns, in the shapes of the state. Differentiable; its derivative by q_{n+1} at the
        solution is the exact linearization.
        """

    # How a motion begins, and what is seen of it.

    def start(self, system: AbstractSystem, initial: Initial, t0) -> Start:
        """What the scheme starts from, given consistent values."""
        return Start(self.complete(system, initial.state))

    def resumed(self, system: AbstractSystem, given: Start, t0) -> Start:
        """What the scheme starts from, given the state of another run."""
        return given._replace(state=self.complete(system, given.state))

    def complete(self, system: AbstractSystem, state: State) -> State:
        """A state with what else the scheme carries."""
        return state

    def physical(self, system: AbstractSystem, states: State) -> State:
        """A state, or stacked ones, without what else the scheme carries."""
        return states

    def statistics(self, stats: Stats) -> Any:
        """What the trajectory shows of them."""
        return stats

    def stages(self, system: AbstractSystem, grid: AbstractGrid, states: State) -> Stages | None:
        """Those of all steps, if criteria are integrated over them."""

    def caution(self, system: AbstractSystem) -> str | None:
        """What may go wrong with a system, and what to take instead, if anything is known."""

    def resized(self, system: AbstractSystem, state: State, t, factors: Any = None) -> Start:
        """A state at t as steps begin with it that are r times as long as the one that led there; 1: as it is."""
        return Start(state)

    def resizing_factors(self, system: AbstractSystem, state: State, t) -> Any:
        """What `resized` factorizes, if anything, without derivative."""
        return None

    def restarts(self, system: AbstractSystem) -> Float[Array, " k"] | None:
        """The times of breaks of the system after which a step begins anew; None: it has nothing to renew."""
        return None

    def renewed(self, system: AbstractSystem, state: State, node: Node, factors: Any = None) -> State:
        """A state as the first step after a break begins with it, from one that belongs to its size."""
        return state

    def step_error(self, system: AbstractSystem, begun: State, state: State, memory: Memory, node: Node) -> Array:
        """c, shape (k,), of a step from `begun` to `state` that left that memory: the error of its configuration is
        h^p c, p = `error_power`; for the control of step sizes. Here from v̈ ≈ (a_{n+1} − a_n)/h."""
        return self.missed_increment(system, begun.v, begun.vdot, (state.a - begun.a) / node.h)

    def first_error(self, system: AbstractSystem, v, vdot, jerk) -> Array:
        """The c that is expected of a first step."""
        return self.missed_increment(system, v, vdot, jerk)

    def missed_increment(self, system: AbstractSystem, v, vdot, jerk) -> Float[Array, " k"]:
        """c, where the increment of a configuration misses the true one by h³ c. Here that of the trapezoidal rule,
        (v̈ + ad(v) v̇)/12, which a scheme of second order has or has less of."""
        return (jerk + system.group.ad_mv(v, vdot)) / 12.0

    def defects(self, system: AbstractSystem, grid: AbstractGrid, states: State) -> Variation | None:
        """b: the error of a run solves L e = b to leading order, e = numerical − true, L the linearized trajectory.

        What each step misses if the true motion takes the place of the numerical one, after the row of the start. None:
        not known, and errors are those against a second run. At least three steps.
        """
        return None

    def mismatch(self, before: tuple[Any, Any], after: tuple[Any, Any], ratio: Any) -> Any:
        """What is zero of (v̇, a) at both ends of a step, in NumPy or JAX: whether a run is of this scheme.

        `ratio`: of its size to the one before, of shape (…, 1). None: v̇ and a do not tell.
        """
        return None

    # The march.

    def shared(self, system: AbstractSystem) -> Any:
        """What all steps share."""
        return None

    def memory(self, shared: Any, state: State, node: Node, *, uneven: bool, exact: bool = False) -> Memory:
        """What the iteration of the next step knows of the steps before, at the start; `uneven`: not all are equal.

        `exact`: that of runs in which `remembered` is told of the linearization of each step.
        """
        return Memory()

    def remembered(
        self, shared: Any, memory: Memory, linearized: Any, node: Node, stats: Stats
    ) -> tuple[Memory, Stats]:
        """With what the linearization of the last step is good for in the next one."""
        return memory, stats

    def take(
        self, system: AbstractSystem, shared: Any, before: State, begun: State, memory: Memory, node: Node, running
    ) -> tuple[State, Memory, Stats]:
        """The state at the end of a step that begins with `begun` (`before`, resized), and what Newton did; NaN unless
        `running` and converged. Here: full Newton with the matrix of the equations."""
        scale = system.coordinate_scale()
        tolerance = max(self.tolerance, 64 * float(jnp.finfo(scale.dtype).eps))
        x = node.h * begun.v
        guess = dataclasses.replace(begun, q=system.group.retract(begun.q, x), v=begun.v + node.h * begun.vdot)

        def corrected(carry):
            state, _, _, count, _ = carry
            left, unravel = ravel_pytree(rows(self, system, node, begun, state))
            step = unravel(jnp.linalg.solve(self._matrix(system, node, begun, state), left))
            size = jnp.max(jnp.abs(step.w) / scale)
            new = _moved(system, state, jax.tree.map(jnp.negative, step))
            going = (size > tolerance) & (count + 1 < self.max_iterations)
            return new, size, jnp.max(jnp.abs(left)), count + 1, going

        none = jnp.zeros((), jnp.int32)
        first = (guess, jnp.inf * node.h, jnp.inf * node.h, none, running)
        state, size, left, count, _ = while_loop(lambda carry: carry[-1], corrected, first)
        converged = running & finite(state) & (size <= tolerance)
        state = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), state)
        return state, memory, Stats(jnp.where(running, count, 0), size, left, converged, jnp.full_like(node.h, jnp.inf))

    # Sensitivities.

    def satisfies(self, system: AbstractSystem) -> tuple[bool, bool]:
        """Whether the end of a step satisfies the constraints of positions, and those of velocities: as equations of
        the step, to round-off, which therefore hold for their derivatives."""
        return False, False

    def for_autodiff(self) -> "AbstractScheme":
        """The scheme whose own loops are differentiated, where they are."""
        return self

    def numbers(self, system: AbstractSystem) -> int:
        """How many numbers one linearized step keeps."""
        return 2 * (4 * system.group.dim + len(system.constraint_names)) ** 2

    def loads(self, shared: Any, previous: State, state: State) -> Callable[[AbstractSystem, Node], Any]:
        """(system, node) ↦ what E depends on them by, at a fixed converged step that begins with `previous`."""
        return lambda system, node: rows(self, system, node, previous, state)

    def linearized(
        self, system: AbstractSystem, shared: Any, node: Node, previous: State, state: State
    ) -> AbstractLinearizedStep:
        """The exact linearization at a converged step that begins with `previous`."""

        def of_previous(delta):
            return ravel_pytree(rows(self, system, node, _moved(system, previous, delta), state))[0]

        zero, unravel = ravel_pytree(Variation.none(previous))
        by_previous = jax.jacfwd(lambda delta: of_previous(unravel(delta)))(zero)
        return DenseLinearizedStep(jsl.lu_factor(self._matrix(system, node, previous, state)), by_previous)

    def _matrix(self, system, node: Node, previous: State, state: State):
        """E_{y⁺}."""
        zero, unravel = ravel_pytree(Variation.none(state))

        def of_state(delta):
            return ravel_pytree(rows(self, system, node, previous, _moved(system, state, unravel(delta))))[0]

        return jax.jacfwd(of_state)(zero)


def _moved(system: AbstractSystem, state: State, delta: Variation) -> State:
    """q exp(w̃), v + v', …"""
    parts = jax.tree.map(jnp.add, tuple(Variation.of(state.v, state)[1:]), tuple(delta[1:]))
    return State(system.group.retract(state.q, delta.w), *parts)


def rows(scheme: AbstractScheme, system: AbstractSystem, node: Node, previous: State, state: State):
    """E as a `Variation`: its w is log(q_n exp(x̃)⁻¹ q_{n+1}), whose derivative is w' of q_{n+1} less that predicted."""
    left, group = scheme.equations(system, node, previous, state), system.group
    w = group.log(group.compose(group.inverse(left.q), state.q))
    return Variation.of(w, left)
