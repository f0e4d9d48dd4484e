"""Radau IIA with three stages, order 5, on stabilized index 2 in a local chart.

Within a step the configuration is written q = q_n exp(x̃), and the stabilized equations of Gear, Gupta & Leimkuhler are

    M T(x) ẋ = M v + B(q, t)ᵀ μ,     r(q, v, v̇, λ, t) = 0,     Φ(q, t) = 0,     c(q, v, t) = [B v + Φ_t; A v + b] = 0

for x, v, λ and μ, which vanishes with the error. Collocation at c_i h with the matrix a of Radau IIA: for the unknowns
ξ_i, w_i, λ_i, μ_i of three stages

    x_i = h Σ_j a_ij ξ_j,     v_i = v_n + h Σ_j a_ij w_j,     q_i = q_n exp(x̃_i),     t_i = t_n + c_i h,
    M (T(x_i) ξ_i − v_i) − B_iᵀ μ_i = 0,     r(q_i, v_i, w_i, λ_i, t_i) = 0,
    Φ(q_i, t_i)/h = 0,                       c(q_i, v_i, t_i) = 0.

The last stage is the end of the step, q⁺ = q_3 and v⁺ = v_3, at which positions and velocities satisfy their
constraints. Stage values of λ are of order 3 only; v̇⁺ and λ⁺ are those of the motion through (q⁺, v⁺), E = 0 of
`equations_of_motion`, and of order 5 like it.

The stages are solved by Newton's iteration with the matrix of their equations, of 3 (2k + m + m_p) rows; what the
sensitivities need follows from the equations (`AbstractScheme`): exact, and dense, for scenes that are not large.

Sources: Hairer & Wanner, Solving Ordinary Differential Equations II (1996), §IV.5 (coefficients), §VII.4 (index 2:
order 5 of the differential, 3 of the algebraic components); Gear, Gupta & Leimkuhler, J. Comput. Appl. Math. 12
(1985) 77.
"""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens._validate import as_count, require_setting
from lgsens._xla import while_loop
from lgsens.dynamics import (
    Inertia,
    State,
    constraint_velocity,
    equations_of_motion,
    factorized_accelerations,
    finite,
    require_independent,
    require_linear,
)
from lgsens.integrate._grid import earlier, later
from lgsens.integrate._scheme import AbstractScheme, Stages, Stats

_R = np.sqrt(6.0)
_C = np.array([(4.0 - _R) / 10.0, (4.0 + _R) / 10.0, 1.0])
_A = np.array(
    [
        [(88.0 - 7.0 * _R) / 360.0, (296.0 - 169.0 * _R) / 1800.0, (-2.0 + 3.0 * _R) / 225.0],
        [(296.0 + 169.0 * _R) / 1800.0, (88.0 + 7.0 * _R) / 360.0, (-2.0 - 3.0 * _R) / 225.0],
        [(16.0 - _R) / 36.0, (16.0 + _R) / 36.0, 1.0 / 9.0],
    ]
)


class RadauStages(NamedTuple):
    """The unknowns of three stages, or what is left of their equations."""

    x: Float[Array, "3 k"]  # ξ = ẋ
    v: Float[Array, "3 k"]  # w = v̇
    lam: Float[Array, "3 m"]
    mu: Float[Array, "3 p"]


class RadauIIA(AbstractScheme):
    """The three-stage Radau IIA scheme of order 5: an integrator of `simulate`.

        M T(x) ẋ = M v + Bᵀμ,     r(q, v, v̇, λ, t) = 0,     Φ(q, t) = 0,     B v + Φ_t = 0,     q = q_n exp(x̃)

    For few and large steps: smooth motions to many digits, and stiff scenes, whose fastest modes it damps out
    (L-stable), slow ones then being of order 3. A step costs a Newton iteration with a dense matrix of 3 (2k + 2m)
    rows, k coordinates and m constraints: for scenes of a few bodies.

    Arguments:
        tolerance: the last Newton increment of a configuration, relative to 1 rad or the length of the scene.
        max_iterations: Newton iterations per step before the step has failed.

    `Trajectory.order` is 4, so integrals of a trajectory need `time_integral(…, order=4)`; a `Criterion` integrates
    over the stages instead, to order 5. Joints hold at position and velocity level to Newton's tolerance at every time.
    No body may turn by half a revolution in a step. a is v̇. The derivative is that of the numerical solution, to
    round-off, by every method. Static and hashable.

    Raises `ValueError` for settings out of range, and for a model with redundant constraints. Source: Hairer & Wanner,
    Solving Ordinary Differential Equations II (1996), §IV.8 and §VII.4.
    """

    tolerance: float = eqx.field(static=True, default=1e-12)
    max_iterations: int = eqx.field(static=True, default=20)
    order: ClassVar[int] = 4
    has_stages: ClassVar[bool] = True
    state_is_motion: ClassVar[bool] = True
    carries: ClassVar[tuple[str, ...]] = ("w", "v")

    def __check_init__(self):
        valid = isinstance(self.tolerance, int | float) and 0.0 < self.tolerance < 1e-2
        require_setting(self, "tolerance", valid, "a number between 0 and 0.01", "; 1e-12 is the default")
        as_count(self.max_iterations, "max_iterations", " (it is static)")

    @property
    def convergence_order(self):
        return 5

    def mismatch(self, before, after):
        return after[1] - after[0]

    # How a motion begins, and what is seen of it.

    def resumed(self, system, state0, t0):
        """Accelerations are those of (q, v): a state of another scheme has them with its own error."""
        vdot, lam = factorized_accelerations(Inertia.of(system), system, state0.q, state0.v, t0)
        return self.complete(system, State(state0.q, state0.v, vdot, lam, vdot))

    def complete(self, system, state):
        require_independent(system, "RadauIIA")
        require_linear(system, "RadauIIA")
        three = lambda leaf: jnp.zeros((3, *leaf.shape), leaf.dtype)
        mu = state.lam[: len(state.lam) - system.num_velocity_rows]
        return dataclasses.replace(state, inner=RadauStages(*map(three, (state.v, state.v, state.lam, mu))))

    def physical(self, system, states):
        return dataclasses.replace(states, inner=None)

    def stages(self, system, grid, states):
        nodes, begun, inner = jax.vmap(grid.node)(grid.places()), earlier(states), later(states).inner

        def of_step(node, begun, inner):
            x, v = _advanced(node, begun, inner)
            q = jax.vmap(system.group.retract, (None, 0))(begun.q, x)
            return State(q, v, inner.v, inner.lam, inner.v)

        c, b = jnp.asarray(_C, states.v.dtype), jnp.asarray(_A[2], states.v.dtype)
        flat = lambda leaf: leaf.reshape(leaf.shape[0] * 3, *leaf.shape[2:])
        return Stages(
            t=flat(nodes.begin[:, None] + nodes.h[:, None] * c[None]),
            weights=flat(jnp.broadcast_to(grid.h, (grid.num_steps,))[:, None] * b[None]),
            states=jax.tree.map(flat, jax.vmap(of_step)(nodes, begun, inner)),
        )

    # The step, and its equations.

    def shared(self, system):
        return Inertia.of(system)

    def take(self, system, shared, before, begun, memory, node, running):
        scale = system.coordinate_scale()
        tolerance = max(self.tolerance, 64 * float(jnp.finfo(scale.dtype).eps))
        three = lambda leaf: jnp.broadcast_to(leaf, (3, *leaf.shape))
        c = jnp.asarray(_C, scale.dtype)[:, None] * node.h
        guess = RadauStages(
            begun.v[None] + c * begun.vdot[None], three(begun.vdot), three(begun.lam), begun.inner.mu * 0.0
        )
        first, unravel = ravel_pytree(guess)
        left = lambda z: ravel_pytree(self._left(system, node, begun, unravel(z)))[0]

        def corrected(carry):
            z, _, _, count, _ = carry
            rest = left(z)
            step = jnp.linalg.solve(jax.jacfwd(left)(z), rest)
            x = _advanced(node, begun, unravel(step))[0]
            size = jnp.max(jnp.abs(x) / scale[None])
            going = (size > tolerance) & (count + 1 < self.max_iterations)
            return z - step, size, jnp.max(jnp.abs(rest)), count + 1, going

        infinite = jnp.inf * node.h
        start = (first, infinite, infinite, jnp.zeros((), jnp.int32), running)
        z, size, rest, count, _ = while_loop(lambda carry: carry[-1], corrected, start)
        found = unravel(z)
        x, v = _advanced(node, begun, found)
        q = system.group.retract(begun.q, x[-1])
        vdot, lam = factorized_accelerations(shared, system, q, v[-1], node.t)
        state = State(q, v[-1], vdot, lam, vdot, found)
        converged = running & finite(state) & (size <= tolerance)
        state = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), state)
        return state, memory, Stats(jnp.where(running, count, 0), size, rest, converged, jnp.full_like(node.h, jnp.inf))

    def equations(self, system, node, previous, state):
        x, v = _advanced(node, previous, state.inner)
        force, rate = equations_of_motion(system, state.q, state.v, state.vdot, state.lam, node.t)
        return State(
            q=system.group.retract(previous.q, x[-1]),
            v=state.v - v[-1],
            vdot=force,
            lam=rate,
            a=state.a - state.vdot,
            inner=self._left(system, node, previous, state.inner),
        )

    def _left(self, system, node, previous, found: RadauStages) -> RadauStages:
        """What is left of the equations of the stages."""
        mass = system.mass_matrix()

        def stage(c, x, v, found: RadauStages):
            q, t = system.group.retract(previous.q, x), node.begin + c * node.h
            push = found.mu @ system.constraint_jacobian(q, t)
            return RadauStages(
                mass @ (system.group.tangent_mv(x, found.x) - v) - push,
                system.residual(q, v, found.v, found.lam, t),
                constraint_velocity(system, q, v, t),
                system.constraint(q, t) / node.h,
            )

        return jax.vmap(stage)(jnp.asarray(_C, node.h.dtype), *_advanced(node, previous, found), found)

    def satisfies(self, system):
        return True, True

    def numbers(self, system):
        k, m = system.group.dim, len(system.constraint_names)
        return 2 * (4 * k + m + 3 * (2 * k + 2 * m - system.num_velocity_rows)) ** 2


def _advanced(node: Any, previous: State, found: RadauStages) -> tuple[Array, Array]:
    """x_i and v_i."""
    a = node.h * jnp.asarray(_A, node.h.dtype)
    return a @ found.x, previous.v[None] + a @ found.v
