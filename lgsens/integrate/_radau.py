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
`equations_of_motion`, and of order 5 like it. How the stages are solved: `_radau_newton`, `_radau_stages`.

Linearization. With b the right-hand sides and E_p p' the loads of the rows of E, named like them, ℓ = b − E_p p', and
F_n the variation of the stages' rows with (q_n, v_n),

    stages' = F⁻¹ (ℓ.inner − F_n (w_n, v'_n)),
    w_{n+1} = Ad(exp(−x_3)) w_n + T(x_3) h Σ_j a_3j ξ'_j + ℓ.w,        v'_{n+1} = v'_n + h Σ_j a_3j w'_j + ℓ.v,
    [[M, Jᵀ], [J, 0]] [v̇'; λ']_{n+1} = (ℓ.vdot, ℓ.lam) − E_q w_{n+1} − E_v v'_{n+1},        a' = v̇' + ℓ.a,

exactly; backwards JAX transposes it.

Error of a step. The polynomials of x and v through the stages satisfy the equations at c_i h. At its begin the step
knows ẋ = v_n and v̇_n, and the polynomials, ξ and w continued to there, miss them by

    d = (v_n − Σ_i ℓ_i(0) ξ_i,  v̇_n − Σ_i ℓ_i(0) w_i) = −h³/60 · (x⁗, v⁗) + …,     ℓ_i the Lagrange polynomials of c_i,

of which the defect within the step follows, d · (1 − 9 s + 18 s² − 10 s³) at t_n + s h, zero at all c_i. Its integral
over the step is 0, and up to s = c_1, where it is largest, h d ∫ = ε h d with ε = c_1 − 9/2 c_1² + 6 c_1³ − 5/2 c_1⁴
= 0.068: so large is the error within a step, to leading order, O(h⁴). (Hairer's embedded formula of order 3 is the same
difference with a factor of 0.27, the real eigenvalue of a.) At the end of the step that of order 5 is far smaller where
the motion is smooth; where it is stiff, stages are what counts.

Stiffness k magnifies in v̇_n by h² k/m what (q_n, v_n) are off the slow motion. So ε h d is taken as an error of
(q_n, v_n) and carried through the step by its linearization, which multiplies it by R(hJ), of O(1/(hJ)) there, and
projects it onto the constraints: e = w_{n+1} of (w_n, v'_n) = ε h d, at the price of one more solution with the factors
at hand. Before the first step v‴ is unknown, and estimated from jerk: of a motion as large as the scene, s, |v̈| = s Ω³.

Sources: Hairer & Wanner, Solving Ordinary Differential Equations II (1996), §IV.5 (coefficients), §IV.8 (embedded
formula, filtered), §VII.4 (index 2: order 5 of the differential, 3 of the algebraic components); Gear, Gupta &
Leimkuhler, J. Comput. Appl. Math. 12 (1985) 77; the estimate by the linearized step: here.
"""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens._validate import as_count, require_setting
from lgsens.dynamics import (
    RESULTS,
    AbstractSystem,
    Inertia,
    State,
    constrained,
    equations_of_motion,
    factor_size,
    factorized_accelerations,
    finite,
    own_parts,
    require_independent,
    require_linear,
    with_shared,
)
from lgsens.integrate._grid import Start
from lgsens.integrate._linearized import AbstractLinearizedStep, Node, Variation
from lgsens.integrate._loops import earlier, later
from lgsens.integrate._radau_newton import no_memory, solved
from lgsens.integrate._radau_sparse import stage_factors, stage_plan
from lgsens.integrate._radau_stages import A, AbstractStageFactors, C, RadauStages, advanced, left
from lgsens.integrate._scheme import AbstractScheme, Stages

_TO_BEGIN = np.linalg.solve(np.vander(C, increasing=True).T, [1.0, 0.0, 0.0])  # ℓ_i(0)
_WITHIN = C[0] - 4.5 * C[0] ** 2 + 6.0 * C[0] ** 3 - 2.5 * C[0] ** 4  # ε


class Shared(NamedTuple):
    """What all steps share."""

    system: AbstractSystem
    inertia: Inertia | None  # None: the equations at the end of a step are solved in blocks, too


class RadauIIA(AbstractScheme):
    """The three-stage Radau IIA scheme of order 5: an integrator of `simulate`.

        M T(x) ẋ = M v + Bᵀμ,     r(q, v, v̇, λ, t) = 0,     Φ(q, t) = 0,     B v + Φ_t = 0,     q = q_n exp(x̃)

    For few and large steps: smooth motions to many digits, and stiff scenes, whose fastest modes it damps out
    (L-stable), slow ones then being of order 3. A step factorizes the constraints of three stages and a dense matrix of
    6 (k − m) rows, k coordinates and m constraints, or, where that takes less time, blocks of 36 rows for each body on
    the graph of bodies and joints, in time linear in the length of chains and beams (`Model(linear_solver=…)`).

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
    error_power: ClassVar[int] = 4

    def __check_init__(self):
        valid = isinstance(self.tolerance, int | float) and 0.0 < self.tolerance < 1e-2
        require_setting(self, "tolerance", valid, "a number between 0 and 0.01", "; 1e-12 is the default")
        as_count(self.max_iterations, "max_iterations", " (it is static)")

    @property
    def convergence_order(self):
        return 5

    def mismatch(self, before, after, ratio):
        return after[1] - after[0]

    # How a motion begins, and what is seen of it.

    def resumed(self, system, given, t0):
        """Accelerations are those of (q, v): a state of another scheme has them with its own error."""
        q, v = given.state.q, given.state.v
        vdot, lam = factorized_accelerations(self.shared(system).inertia, system, q, v, t0)
        return Start(self.complete(system, State(q, v, vdot, lam, vdot)))

    def complete(self, system, state):
        require_independent(system, "RadauIIA")
        require_linear(system, "RadauIIA")
        if len(state.lam) > len(state.v):
            raise ValueError(
                f"RadauIIA: the joints have {len(state.lam)} equations for {len(state.v)} coordinates. "
                + RESULTS.redundant_constraints.message
            )
        three = lambda leaf: jnp.zeros((3, *leaf.shape), leaf.dtype)
        mu = state.lam[: len(state.lam) - system.num_velocity_rows]
        return dataclasses.replace(state, inner=RadauStages(*map(three, (state.v, state.v, state.lam, mu))))

    def physical(self, system, states):
        return dataclasses.replace(states, inner=None)

    def stages(self, system, grid, states):
        nodes, begun, inner = jax.vmap(grid.node)(grid.places()), earlier(states), later(states).inner

        def of_step(node, begun, inner):
            x, v = advanced(node.h, begun.v, inner)
            q = jax.vmap(system.group.retract, (None, 0))(begun.q, x)
            return State(q, v, inner.v, inner.lam, inner.v)

        c, b = jnp.asarray(C, states.v.dtype), jnp.asarray(A[2], states.v.dtype)
        flat = lambda leaf: leaf.reshape(leaf.shape[0] * 3, *leaf.shape[2:])
        return Stages(
            t=flat(nodes.begin[:, None] + nodes.h[:, None] * c[None]),
            weights=flat(jnp.broadcast_to(grid.h, (grid.num_steps,))[:, None] * b[None]),
            states=jax.tree.map(flat, jax.vmap(of_step)(nodes, begun, inner)),
        )

    # The step, its equations and its error.

    def shared(self, system):
        return Shared(system, Inertia.of(system) if stage_plan(system) is None else None)

    def memory(self, shared, state, node, *, uneven, exact=False):
        return no_memory(shared.system, node, state)

    def take(self, system, shared, before, begun, memory, node, running):
        found, memory, stats = solved(self, system, node, begun, memory, running)
        x, v = advanced(node.h, begun.v, found)
        q = system.group.retract(begun.q, x[-1])
        vdot, lam = factorized_accelerations(shared.inertia, system, q, v[-1], node.t)
        state = State(q, v[-1], vdot, lam, vdot, found)
        converged = stats.converged & finite(state)
        state = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), state)
        return state, memory, stats._replace(converged=converged)

    def equations(self, system, node, previous, state):
        x, v = advanced(node.h, previous.v, state.inner)
        force, rate = equations_of_motion(system, state.q, state.v, state.vdot, state.lam, node.t)
        return State(
            q=system.group.retract(previous.q, x[-1]),
            v=state.v - v[-1],
            vdot=force,
            lam=rate,
            a=state.a - state.vdot,
            inner=left(system, node, previous, state.inner),
        )

    def step_error(self, system, begun, state, memory, node):
        factors, h = memory.matrix.factors, node.h
        to_begin = h * _WITHIN * jnp.asarray(_TO_BEGIN, h.dtype)
        w, v = (h * _WITHIN * at - to_begin @ stages for at, stages in zip((begun.v, begun.vdot), state.inner[:2]))
        carried = factors.solve(h, jax.tree.map(jnp.negative, factors.by_start(h, w, v)))
        return factors.end(h, w, v, carried)[0] / h**4

    def first_error(self, system, v, vdot, jerk):
        scale = system.coordinate_scale()
        cubed = jnp.max(jnp.abs(jerk + system.group.ad_mv(v, vdot)) / scale)
        return (_WITHIN / 60.0) * scale * cubed ** (4.0 / 3.0)

    # Sensitivities.

    def linearized(self, system, shared, node, previous, state):
        return RadauLinearizedStep.of(shared, node, previous, state)

    def satisfies(self, system):
        return True, True

    def numbers(self, system):
        k, m, plan = system.group.dim, len(system.constraint_names), stage_plan(system)
        if plan is not None:
            return plan.numbers + factor_size(system) + 16 * k
        return 3 * (5 * k**2 + m * (2 * k + m) + k * (k - m)) + 36 * (k - m) ** 2 + m * (k + m) + 16 * k


class RadauLinearizedStep(AbstractLinearizedStep):
    """The equations above."""

    stages: AbstractStageFactors
    factors: Any  # of [[M, Jᵀ], [J, 0]], at the end, with J
    end: Any  # q⁺
    motion: Any  # (q', v') ↦ E_q w + E_v v'

    @classmethod
    def of(cls, shared: Shared, node: Node, previous: State, state: State) -> "RadauLinearizedStep":
        system, q, v, t = shared.system, state.q, state.v, node.t
        motion = lambda q, v: equations_of_motion(system, q, v, state.vdot, state.lam, t)
        return cls(
            stages=stage_factors(system, node, previous, state.inner),
            factors=own_parts(constrained(shared.inertia, system, q, t)),
            end=q,
            motion=jax.linearize(motion, q, v)[1],
        )

    def forward(self, shared, node, previous, loads, row):
        row = jax.tree.map(jnp.subtract, row, loads)
        known = jax.tree.map(jnp.subtract, row.inner, self.stages.by_start(node.h, previous.w, previous.v))
        inner = self.stages.exactly(node.h, known)
        w, v = map(jnp.add, self.stages.end(node.h, previous.w, previous.v, inner), (row.w, row.v))
        force, rate = self.motion(shared.system.group.to_ambient(self.end, w), v)
        kkt = with_shared(shared.inertia, self.factors)
        vdot, lam = kkt.solve(row.vdot - force, row.lam - rate)
        return Variation(w, v, vdot, lam, vdot + row.a, inner)
