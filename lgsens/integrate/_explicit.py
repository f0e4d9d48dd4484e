"""The index-reduced equations by an explicit Runge–Kutta scheme.

With the constraint at acceleration level v̇ and λ are functions of the state, eq. (41): E(v̇, λ; q, v, t) = 0, that of
`equations_of_motion`. Within a step the configuration is written q = q_n exp(x̃), which keeps rotations orthogonal
whatever the scheme, and

    ẋ = T⁻¹(x) v,     v̇ = v̇(q_n exp(x̃), v, t),     x(t_n) = 0                                      (9), (41)

is an ordinary differential equation in R^{2k}. At the end of a step the drift from the constraints is taken out along
M⁻¹Bᵀ, the directions in which the joints push: one step of Newton's iteration for q, then v, with one factorization.
Drift is of the order of the local error, what is left of the order of its square.

Step. From (q, v) at t with v̇ and λ known, the stages i and then two projections,

    x_i = h Σ_j a_ij T⁻¹(x_j) v_j,    v_i = v + h Σ_j a_ij v̇_j,    q_i = q exp(x̃_i),    E(v̇_i, λ_i; q_i, v_i, t_i) = 0,

    x = h Σ_j b_j T⁻¹(x_j) v_j,       P = [ M y + Bᵀμ; Φ + B y ] = 0             at q* = q exp(x̃),       q⁺ = q* exp(ỹ),
    u = v + h Σ_j b_j v̇_j,            R = [ M d + Bᵀν; B d + c(q⁺, u) ] = 0      with B at q*,           v⁺ = u + d,

c the constraint at velocity level, and at last E(v̇⁺, λ⁺; q⁺, v⁺, t⁺) = 0, the first stage of the next step. Unknowns
are those of the end, of the stages but the first, and y, μ, d, ν (`Inner`). Nothing is iterated.

Linearization. Each of E, P and R is linear in its unknowns with the matrix A = [[M, Bᵀ], [B, 0]] of its point,

    A [v̇'; λ'] = b − E_p p' − E_q q' − E_v v',          and P, R alike,

so forward substitution is the recursion of the step with a product and a solve in each stage. Derivatives and factors
depend on the solution alone: those of all stages are found at once. (Quarter-car, Dopri8, per stage of the transposed
step: 58 µs with each stage linearized in its turn, 45 µs so.)

Sources: Sonneville & Brüls (2014), eqs. (9) and (41); Munthe-Kaas, Applied Numerical Mathematics 29 (1999),
doi:10.1016/S0168-9274(98)00030-0; Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.1;
Hairer & Wanner, Solving Ordinary Differential Equations II (1996), §VII.2; linearization: here.
"""

import dataclasses
import math
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lgsens._brief import brief
from lgsens._validate import as_count, require_setting
from lgsens._xla import scan
from lgsens.dynamics import (
    RESULTS,
    State,
    constrained,
    constraint_velocity,
    equations_of_motion,
    factor_size,
    factorized_accelerations,
    own_parts,
    shared_inertia,
    solves_in_blocks,
)
from lgsens.integrate._explicit_step import ExplicitLinearizedStep, Inner, corrections, ended
from lgsens.integrate._grid import Start
from lgsens.integrate._loops import earlier, later, with_first, with_last
from lgsens.integrate._scheme import AbstractScheme, Stages, Stats

_MODES = ("reverse", "forward")


class StepStats(NamedTuple):
    """What happened in each output interval.

    Attributes:
        steps: steps tried, shape (n,), int32; 0 after a failure.
        drift: max |Φ| [m, –] at its end before the projection, shape (n,).
        converged: whether its end was reached with finite numbers, shape (n,), bool.
    """

    steps: Int[Array, " n"]
    drift: Float[Array, " n"]
    converged: Bool[Array, " n"]

    __repr__ = brief


class Coefficients(NamedTuple):
    """a, b and c of a scheme, without stages that only its error estimate uses."""

    a: Any
    b: Any
    c: Any


class IndexReducedODE(AbstractScheme):
    """The index-reduced equations by an explicit Runge–Kutta scheme of diffrax: an integrator of `simulate`.

        q̇ = q ṽ,     [[M, Bᵀ], [B, 0]] [v̇; λ] = [ad(v)ᵀ M v − f(q, v, t); −Ḃ v]                       (41)

    For smooth motions without stiff forces: of the order of the scheme where generalized-α is of second.

    Arguments:
        solver: an explicit Runge–Kutta scheme of diffrax, `diffrax.Dopri8()` say. None: `diffrax.Tsit5()`, order 5.
        rtol: None: one step of the scheme is one of the `num_steps`. Else the tolerance of a step relative to the
            motion, from which each of the `num_steps` output intervals is divided into as many steps as it needs.
        atol: the absolute tolerance [m, rad, m/s, rad/s]; None: `rtol`.
        max_steps: with `rtol`, how many steps an output interval may take.
        mode: with `rtol`, which derivatives: "reverse" (`grad`, `jacrev`) or "forward" (`jvp`, `jacfwd`). Without
            `rtol` every method and every JAX transformation, nested ones too.

    `Trajectory.order` is 4, so integrals need `time_integral(…, order=4)`. Without `rtol` a `Criterion` of the
    trajectory integrates over the stages instead (`Trajectory.stages`), and is of the order of the scheme. Times at
    which forces are not smooth should be output times (`AlignedSteps`); with `rtol` steps end at those that signals
    tell, unless they are more than a quarter of `max_steps` in an interval.
    Joints hold to the square of the error of a step at every output
    time, rotations to round-off; no body may turn by half a revolution in an output interval. a is v̇.

    **Step size.** An explicit scheme is stable up to |h ω| of about 3 for the fastest mode. The steps also integrate
    the sensitivities, and tolerances on the motion do not see these: from rest the controller of diffrax alone takes
    steps beyond stability, with Ψ right and gradients wrong by factors. Here no step is longer than an output
    interval, so choose `num_steps` for stability, h = 5 ms for a suspension, and double it to see what gradients do.
    `GivenSteps` and `AdaptiveSteps` take this scheme too; the latter controls an error of second order, which is more.

    The derivative is that of the numerical solution, to round-off; with `rtol` at the steps taken, as if their lengths
    were given. All static and hashable. Raises `ValueError` for a solver that is not explicit Runge–Kutta, for settings
    out of range, and with `rtol` where steps of its own do not fit. Source: Sonneville & Brüls (2014), eq. (41).
    """

    solver: Any = eqx.field(static=True, default=None)
    rtol: float | None = eqx.field(static=True, default=None, kw_only=True)
    atol: float | None = eqx.field(static=True, default=None, kw_only=True)
    max_steps: int = eqx.field(static=True, default=256, kw_only=True)
    mode: str = eqx.field(static=True, default="reverse", kw_only=True)

    def __check_init__(self):
        for name, value in (("rtol", self.rtol), ("atol", self.atol)):
            valid = value is None or (isinstance(value, int | float) and 0.0 < value < math.inf)
            require_setting(self, name, valid, "positive or None", "; 1e-6 is a good start")
        if self.atol is not None and self.rtol is None:
            raise ValueError(f"IndexReducedODE: `atol` = {self.atol!r} needs `rtol`: without it all steps are equal.")
        as_count(self.max_steps, "max_steps", " (it is static)")
        require_setting(self, "mode", self.mode in _MODES, f"one of {_MODES}")
        if self.solver is not None:
            _tableau(self.solver)

    tolerance: ClassVar[float] = 0.0  # nothing is iterated
    max_iterations: ClassVar[int] = 1
    order = 4
    failure = RESULTS.integration_failed
    has_stages = True
    state_is_motion = True
    carries = ("w", "v", "vdot")  # the first stage has v̇_n; and joints hold to the square of a projection, not exactly

    def require_steps(self):
        if self.rtol is not None:
            raise ValueError(
                f"IndexReducedODE: with `rtol` = {self.rtol!r} diffrax chooses the steps and differentiates them in "
                "one direction only (`mode`), for `simulate` as it is. Leave `rtol` out here."
            )

    @property
    def _solver(self) -> Any:
        import diffrax  # takes its time to import

        return diffrax.Tsit5() if self.solver is None else self.solver

    @property
    def convergence_order(self):
        return self._solver.order(None)

    def mismatch(self, before, after, ratio):
        return after[1] - after[0]

    @property
    def coefficients(self) -> Coefficients:
        """Those of the solver."""
        tableau = _tableau(self._solver)
        used = max(np.flatnonzero(tableau.b_sol)) + 1
        a = np.zeros((used, used))
        for i, row in enumerate(tableau.a_lower[: used - 1]):
            a[i + 1, : i + 1] = row
        return Coefficients(a, np.asarray(tableau.b_sol)[:used], np.concatenate([[0.0], tableau.c])[:used])

    def arrays(self, dtype) -> Coefficients:
        """The same in JAX."""
        return Coefficients(*(jnp.asarray(each, dtype) for each in self.coefficients))

    # How a motion begins, and what is seen of it.

    def resumed(self, system, given, t0):
        """Accelerations are those of (q, v): a state of another scheme has them with its own error."""
        q, v = given.state.q, given.state.v
        vdot, lam = factorized_accelerations(shared_inertia(system), system, q, v, t0)
        return Start(self.complete(system, State(q, v, vdot, lam, vdot)))

    def complete(self, system, state):
        stages = len(self.coefficients.b) - 1
        none = jnp.zeros_like(state.v), jnp.zeros_like(state.lam)
        v, lam = (jnp.zeros((stages, *leaf.shape), leaf.dtype) for leaf in none)
        return dataclasses.replace(state, inner=Inner(v, v, v, lam, *none, *none))

    def physical(self, system, states):
        return dataclasses.replace(states, inner=None)

    def statistics(self, stats):
        return StepStats(stats.iterations, stats.residual, stats.converged)

    def stages(self, system, grid, states):
        if states.inner is None:  # by the control of diffrax, or without what is in between
            return None
        retract = jax.vmap(system.group.retract, (None, 0))
        _, b, c = self.arrays(states.v.dtype)
        places = grid.places()
        nodes, begun, found = jax.vmap(grid.node)(places), earlier(states), later(states).inner
        q = jax.vmap(retract)(begun.q, found.x)
        rest = State(q, found.v, found.vdot, found.lam, found.vdot)
        first = jax.tree.map(lambda leaf: leaf[:, None], dataclasses.replace(begun, a=begun.vdot, inner=None))
        empty = grid.empty(places)
        if empty is not None:  # such a step repeats the state, and the stages that led there
            among = lambda leaf: jnp.expand_dims(empty, range(1, leaf.ndim))
            rest = jax.tree.map(lambda first, rest: jnp.where(among(rest), first, rest), first, rest)
        flat = lambda leaf: leaf.reshape(leaf.shape[0] * len(b), *leaf.shape[2:])
        return Stages(
            t=flat(nodes.begin[:, None] + nodes.h[:, None] * c[None]),
            weights=flat(jnp.broadcast_to(grid.h, (grid.num_steps,))[:, None] * b[None]),
            states=jax.tree.map(lambda first, rest: flat(jnp.concatenate([first, rest], axis=1)), first, rest),
        )

    # The step, and its equations.

    def shared(self, system):
        return shared_inertia(system)

    def take(self, system, shared, before, begun, memory, node, running):
        group, h = system.group, node.h
        a, b, c = self.arrays(h.dtype)

        def stage(slopes, inputs):
            i, weights, t = inputs
            x, dv = (h * (weights @ slope) for slope in slopes)
            v = begun.v + dv
            vdot, lam = factorized_accelerations(shared, system, group.retract(begun.q, x), v, t)
            new = group.tangent_inv_mv(x, v), vdot
            return tuple(slope.at[i].set(k) for slope, k in zip(slopes, new)), (x, v, vdot, lam)

        # T(0) is the unit matrix
        slopes = tuple(jnp.zeros((len(b), *k.shape), k.dtype).at[0].set(k) for k in (begun.v, begun.vdot))
        inputs = jnp.arange(1, len(b)), a[1:], node.begin + c[1:] * h
        (rates, vdots), stages = scan(stage, slopes, inputs)
        q, u = group.retract(begun.q, h * (b @ rates)), begun.v + h * (b @ vdots)
        state, found, left = ended(shared, system, q, u, node.t)
        state = dataclasses.replace(state, inner=Inner(*stages, *found))
        converged = running & jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(state)]))
        state = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), state)
        left = jnp.where(running, left, jnp.nan)
        return state, memory, Stats(running.astype(jnp.int32), 0.0 * h, left, converged, jnp.full_like(h, jnp.inf))

    def equations(self, system, node, previous, state):
        found: Inner = state.inner
        x, u, stages = self._advanced(system, node, previous, found)
        times, points = self._points(system, node, previous, state)
        left = lambda t, q, v, vdot, lam: equations_of_motion(system, q, v, vdot, lam, t)
        force, rate = jax.vmap(left)(times, *points)
        q = system.group.retract(previous.q, x)
        (y, mu), (d, nu) = corrections(system, q, node.t, found, state.q, u)
        inner = Inner(found.x - stages[0], found.v - stages[1], force[:-1], rate[:-1], y, mu, d, nu)
        v, a = state.v - (u + found.d), state.a - state.vdot
        return State(system.group.retract(q, found.y), v, force[-1], rate[-1], a, inner)

    def _advanced(self, system, node, previous, found: Inner):
        """x and u of the end, x_i and v_i of the stages, as the slopes give them."""
        rates = with_first(previous.v, jax.vmap(system.group.tangent_inv_mv)(found.x, found.v))
        vdots = with_first(previous.vdot, found.vdot)
        a, b, _ = (node.h * each for each in self.arrays(node.h.dtype))
        return b @ rates, previous.v + b @ vdots, (a[1:] @ rates, previous.v[None] + a[1:] @ vdots)

    def _points(self, system, node, previous, state):
        """t, and (q, v, v̇, λ), where E holds: of the stages and of the end, stacked."""
        found = state.inner
        q = jax.vmap(system.group.retract, (None, 0))(previous.q, found.x)
        points = with_last((q, found.v, found.vdot, found.lam), (state.q, state.v, state.vdot, state.lam))
        c = self.arrays(node.h.dtype).c
        return with_last(node.begin + c[1:] * node.h, node.t), points

    # Sensitivities.

    def numbers(self, system):
        k, m = system.group.dim, len(system.constraint_names)
        factors = factor_size(system) if solves_in_blocks(system) else m * (k + m)
        return (len(self.coefficients.b) + 1) * (factors + 16 * k)

    def linearized(self, system, shared, node, previous, state):
        group, found = system.group, state.inner
        x, u, _ = self._advanced(system, node, previous, found)
        q = group.retract(previous.q, x)
        times, points = self._points(system, node, previous, state)

        def motion(t, q, v, vdot, lam):
            return jax.linearize(lambda q, v: equations_of_motion(system, q, v, vdot, lam, t), q, v)[1]

        def kinematics(x, v):
            function = lambda q, x, v: (group.retract(q, x), group.tangent_inv_mv(x, v))
            return jax.linearize(function, previous.q, x, v)[1]

        return ExplicitLinearizedStep(
            scheme=self,
            group=group,
            begun=previous.q,
            end=state.q,
            factors=jax.vmap(lambda t, q: own_parts(constrained(shared, system, q, t)))(
                with_last(times, node.t), with_last(points[0], q)
            ),
            motion=jax.vmap(motion)(times, *points),
            kinematics=jax.vmap(kinematics)(found.x, found.v),
            to_end=jax.linearize(group.retract, previous.q, x)[1],
            corrected=jax.linearize(group.retract, q, found.y)[1],
            corrections=jax.linearize(lambda q: corrections(system, q, node.t, found, state.q, u), q)[1],
            velocity=jax.linearize(lambda q, v: constraint_velocity(system, q, v, node.t), state.q, u)[1],
        )


def _tableau(solver) -> Any:
    import diffrax  # takes its time to import

    if not isinstance(solver, diffrax.AbstractERK):
        raise ValueError(
            "IndexReducedODE: `solver` must be an explicit Runge–Kutta scheme of diffrax, such as diffrax.Tsit5() or "
            f"diffrax.Dopri8(), got {solver!r}."
        )
    return solver.tableau
