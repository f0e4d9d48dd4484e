"""`step_jacobians`: how the end of each step of a motion depends on its beginning and on controls.

A one-step scheme whose state is (q, v) alone maps it to the next one, y_{n+1} = F_n(y_n, u_n). On independent
coordinates y = [x; ν] about given states, of which none is needed before the other,

    w = Z x,     v' = N ν + P x,     B Z = 0,   J N = 0,   Zᵀ M Z = I,   Nᵀ M N = I,     J P = −D_q c Z,   Nᵀ M P = 0

with B the rows of position level, J = [B; A] all of them, and c(q, v, t) = 0 what they ask of velocities: to first
order all states that satisfy the constraints are of this form (`_second_order.Bases`; P is the least in the metric
of kinetic energy). Back again

    x = Zᵀ M log(q_n⁻¹ q),     ν = Nᵀ M (v − v_n).

A_n = ∂y_{n+1}/∂y_n and B_n = ∂y_{n+1}/∂u_n are derivatives of the step itself, by its exact linearization (§6.2 of the
paper, "direct differentiation"), not of an ODE: what they say of a rollout in these steps is right to round-off.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from lgsens._validate import as_float
from lgsens.analysis._second_order import Bases
from lgsens.dynamics import (
    RESULTS,
    AbstractSystem,
    State,
    constraint_velocity,
    full_jacobian,
    kkt_solve,
    require_independent,
)
from lgsens.integrate import AbstractScheme, RadauIIA
from lgsens.linear import lost
from lgsens.model import Model
from lgsens.simulation import as_system, simulate

_RADAU = RadauIIA()
Build = Callable[[Float[Array, " p"]], Model | AbstractSystem]


class Chart(eqx.Module):
    """Independent coordinates y = [x; ν] about a state, x [√kg m] and ν [√kg m/s], from `step_jacobians`.

    Attributes:
        state: where y = 0.
        position: Z, shape (k, f).
        velocity: N, shape (k, g); states of elements last.
        drag: P, shape (k, f): what velocities change by because joints point elsewhere.
        mass: M, shape (k, k).
        system: the equations of motion.
    """

    state: State
    position: Float[Array, "k f"]
    velocity: Float[Array, "k g"]
    drag: Float[Array, "k f"]
    mass: Float[Array, "k k"]
    system: AbstractSystem

    def displaced(self, y) -> State:
        """The state with the coordinates y, shape (f + g,), to first order; v̇ and λ those of y = 0."""
        x, nu = jnp.split(y, [self.position.shape[1]])
        q = self.system.group.retract(self.state.q, self.position @ x)
        return eqx.tree_at(lambda s: (s.q, s.v), self.state, (q, self.state.v + self.velocity @ nu + self.drag @ x))

    def coordinates(self, state: State) -> Float[Array, " s"]:
        """y of a state near this one, shape (f + g,): the `displaced` one has it, to first order."""
        group, own = self.system.group, self.state
        w = group.log(group.compose(group.inverse(own.q), state.q))
        return jnp.concatenate([self.position.T @ (self.mass @ w), self.velocity.T @ (self.mass @ (state.v - own.v))])


class StepJacobians(eqx.Module):
    """y_{n+1} ≈ A_n y_n + B_n δu_n + gap_n about states and controls, from `step_jacobians`.

    Attributes:
        A, B: ∂y_{n+1}/∂y_n and ∂y_{n+1}/∂u_n, shapes (n, s, s) and (n, s, p), s = f + g.
        gap: y of the end of each step from its state about the next state, shape (n, s): zero of a motion in these
            steps; of others what multiple shooting closes.
        charts: the coordinates about all states, with a leading axis n + 1: `jax.tree.map(lambda leaf: leaf[i],
            charts)` are those of one, as a `lax.scan` hands them out.
        result: of each step a value of `RESULTS`, shape (n,), int32; 0 is success.
    """

    A: Float[Array, "n s s"]
    B: Float[Array, "n s p"]
    gap: Float[Array, "n s"]
    charts: Chart
    result: Int[Array, " n"]


def step_jacobians(
    build: Build,
    states: State,
    controls,
    t,
    *,
    integrator: AbstractScheme = _RADAU,
    throw: bool = True,
) -> StepJacobians:
    """The discrete linear system A_n, B_n of each step of a motion, exact: for LQR, iLQR, observers, shooting.

        def build(u): return lg.Model(bodies, joints, forces | {"push": lg.AppliedForce("cart", force=u * X)})

    Arguments:
        build: u ↦ the scene with these controls, held during a step; a function that is defined once. Controls may
            move anything that acts (forces, springs, signals of them), not masses and joints, which states must
            satisfy whatever the controls.
        states: at all times, stacked, n + 1: `Trajectory.states`, or what a rollout in single steps collects.
        controls: u of each step, shape (n, p).
        t: the times of the states [s], shape (n + 1,), increasing.
        integrator: a scheme whose state is (q, v), `RadauIIA` or `IndexReducedODE`, which a rollout takes as well:
            `simulate(build(u), t0=t[i], t1=t[i + 1], num_steps=1, state0=state, integrator=RadauIIA())`.
        throw: raise for a step that fails, outside of `jit`.

    All steps are taken and linearized at once, each from its own state, so states need not be those of one motion.
    Coordinates have kinetic energy |ẋ|²/2 and are chosen anew about each state (`StepJacobians.charts`). Raises
    `ValueError` for shapes that do not fit, redundant constraints and a scheme that carries more than (q, v) from step
    to step (generalized-α: v̇ and a); `SimulationError` for a step that fails; inside `jit` A, B and gap are NaN then.
    Sources: Negrut & Ortiz, J. Comput. Nonlinear Dynam. 1 (2006) 230 (linearization of constrained equations); Li &
    Todorov, ICINCO 2004 (iLQR).
    """
    if not isinstance(integrator, AbstractScheme) or not integrator.state_is_motion:
        raise ValueError(
            f"`integrator`: {type(integrator).__name__} carries more than positions and velocities from step to step, "
            "so steps from (q, v) are not those of its motion. Use RadauIIA() or IndexReducedODE()."
        )
    integrator.require_steps()
    if not isinstance(states, State):
        raise ValueError(
            f"`states` must be a State of all times, `trajectory.states` say, got {type(states).__name__}."
        )
    controls, t = as_float(controls, None, "`controls`"), as_float(t, None, "`t`")
    count = controls.shape[0] if controls.ndim == 2 else -1
    if t.shape != (count + 1,) or states.v.ndim != 2 or states.v.shape[0] != count + 1:
        raise ValueError(
            "`controls` must have shape (n, p), and `t` and `states` n + 1 entries; got shapes "
            f"{controls.shape}, {t.shape} and {states.v.shape} of velocities."
        )
    found = _step_jacobians_jit(build, states, controls, t, integrator)
    if not throw:
        return found
    failed = found.result != RESULTS.successful
    if isinstance(failed, Tracer):
        unless_failed = partial(lost, jnp.broadcast_to(jnp.any(failed), failed.shape))
        return eqx.tree_at(lambda f: (f.A, f.B, f.gap), found, replace_fn=unless_failed)
    if np.any(failed):  # the step once more, for what there is to say of it
        i = int(np.argmax(failed))
        state = jax.tree.map(lambda leaf: leaf[i], states)
        simulate(build(controls[i]), t0=t[i], t1=t[i + 1], num_steps=1, state0=state, integrator=integrator)
    return found


def _chart(system: AbstractSystem, state: State, t) -> Chart:
    mass, jacobian = system.mass_matrix(), full_jacobian(system, state.q, t)
    position, velocity = Bases.of(system, jacobian)

    def left(x):
        return constraint_velocity(system, system.group.retract(state.q, position @ x), state.v, t)

    bend = jax.jacfwd(left)(jnp.zeros(position.shape[1], mass.dtype))
    drag, _ = kkt_solve(mass, jacobian, jnp.zeros_like(position), -bend)
    return Chart(state, position, velocity, drag, mass, system)


@eqx.filter_jit
def _step_jacobians_jit(build: Build, states: State, controls, t, integrator: AbstractScheme):
    system = as_system(build(controls[0]))
    require_independent(system, "`step_jacobians`")
    charts = jax.vmap(lambda state, t: _chart(system, state, t))(states, t)

    def of_step(chart: Chart, after: Chart, u, t0, t1):
        def step(y, u):
            state = chart.displaced(y)
            run = simulate(build(u), t0=t0, t1=t1, num_steps=1, state0=state, integrator=integrator, throw=False)
            reached = after.coordinates(jax.tree.map(lambda leaf: leaf[-1], run.states))
            return reached, (reached, run.result)

        y = jnp.zeros(chart.position.shape[1] + chart.velocity.shape[1], u.dtype)
        (A, B), (gap, result) = jax.jacfwd(step, (0, 1), has_aux=True)(y, u)
        return A, B, gap, result

    earlier, later = (jax.tree.map(lambda leaf, cut=cut: leaf[cut], charts) for cut in (slice(-1), slice(1, None)))
    A, B, gap, result = jax.vmap(of_step)(earlier, later, controls, t[:-1], t[1:])
    return StepJacobians(A, B, gap, charts, result)
