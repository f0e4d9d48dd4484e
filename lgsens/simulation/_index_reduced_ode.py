"""The index-reduced equations by an explicit Runge–Kutta scheme, as an integrator of `simulate`.

With the constraint at acceleration level v̇ and λ are functions of the state, eq. (41). From one output time to the next
the configuration is written q = q_n exp(x̃), which keeps rotations orthogonal whatever the scheme, and

    ẋ = T⁻¹(x) v,     v̇ = v̇(q_n exp(x̃), v, t),     x(t_n) = 0                                      (9), (41)

is an ordinary differential equation in R^{2k}. At the output time the drift from the constraints, Φ = 0 and B v = 0,
is taken out again along M⁻¹Bᵀ, the directions in which the joints push: one step of Newton's iteration for q, then v,

    q ← q exp(−M⁻¹Bᵀ S⁻¹ Φ(q)),     v ← v − M⁻¹Bᵀ S⁻¹ B v,      S = B M⁻¹ Bᵀ,

with one factorization for both. Drift is of the order of the local error, what is left of the order of its square.

Each evaluation has one factorization, which serves its derivative and the transpose too (`factorized_accelerations`). A
step is recomputed in reverse mode: only the states at the output times are kept.

Sources: Sonneville & Brüls (2014), eqs. (9) and (41); Munthe-Kaas, Applied Numerical Mathematics 29 (1999),
doi:10.1016/S0168-9274(98)00030-0; Hairer & Wanner, Solving Ordinary Differential Equations II (1996), §VII.2.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lgsens._validate import as_count
from lgsens.dynamics import RESULTS, AbstractSystem, Inertia, State, factorized_accelerations
from lgsens.integrate import Coefficients, Numbers, equal_steps, projection
from lgsens.simulation._trajectory import Stages

MODES = ("reverse", "forward")


class IndexReducedODE(eqx.Module):
    """The index-reduced equations by an explicit Runge–Kutta scheme of diffrax: an integrator of `simulate`.

        q̇ = q ṽ,     [[M, Bᵀ], [B, 0]] [v̇; λ] = [ad(v)ᵀ M v − f(q, v, t); −Ḃ v]                       (41)

    For smooth motions without stiff forces: of the order of the scheme where generalized-α is of second.

    Arguments:
        solver: an explicit Runge–Kutta scheme of diffrax, `diffrax.Dopri8()` say. None: `diffrax.Tsit5()`, order 5.
        rtol: None: `num_steps` steps of equal length. Else the tolerance of a step relative to the motion, from which
            each of the `num_steps` output intervals is divided into as many steps as it needs, one at least.
        atol: the absolute tolerance [m, rad, m/s, rad/s]; None: `rtol`.
        max_steps: with `rtol`, how many steps an output interval may take.
        mode: with `rtol`, which derivatives: "reverse" (`grad`, `jacrev`) or "forward" (`jvp`, `jacfwd`). Without
            `rtol` every JAX transformation goes through, nested ones too.

    `Trajectory.order` is 4, so integrals need `time_integral(…, order=4)`. At equal steps a `Criterion` of the
    trajectory integrates over the stages instead (`Trajectory.stages`), and is of the order of the scheme. Times at
    which forces are not smooth should be output times. Joints hold to the square of the error of a step at every output
    time, rotations to round-off; no body may turn by half a revolution in an output interval. a is v̇.

    **Step size.** An explicit scheme is stable up to |h ω| of about 3 for the fastest mode. The steps also integrate
    the sensitivities, and tolerances on the motion do not see these: from rest the controller of diffrax alone takes
    steps beyond stability, with Ψ right and gradients wrong by factors. Here no step is longer than an output
    interval, so choose `num_steps` for stability, h = 5 ms for a suspension, and double it to see what gradients do.

    The derivative is that of the numerical solution, to round-off, at equal steps; with `rtol` at the steps taken, as
    if their lengths were given. All static and hashable. Raises `ValueError` for a solver that is not explicit
    Runge–Kutta and for settings out of range. Source: Sonneville & Brüls (2014), eq. (41).
    """

    solver: Any = eqx.field(static=True, default=None)
    rtol: float | None = eqx.field(static=True, default=None, kw_only=True)
    atol: float | None = eqx.field(static=True, default=None, kw_only=True)
    max_steps: int = eqx.field(static=True, default=256, kw_only=True)
    mode: str = eqx.field(static=True, default="reverse", kw_only=True)

    @property
    def tableau(self) -> Any:
        """The Butcher tableau of the scheme, as diffrax has it."""
        import diffrax  # takes its time to import

        return _tableau(diffrax.Tsit5() if self.solver is None else self.solver)

    def __check_init__(self):
        for name in ("rtol", "atol"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, int | float) or not 0.0 < value < math.inf):
                raise ValueError(
                    f"IndexReducedODE: `{name}` must be positive or None, got {value!r}; 1e-6 is a good start."
                )
        if self.atol is not None and self.rtol is None:
            raise ValueError(f"IndexReducedODE: `atol` = {self.atol!r} needs `rtol`: without it all steps are equal.")
        as_count(self.max_steps, "max_steps", " (it is static)")
        if self.mode not in MODES:
            raise ValueError(f"IndexReducedODE: `mode` must be one of {MODES}, got {self.mode!r}.")
        if self.solver is not None:
            _tableau(self.solver)


def _tableau(solver) -> Any:
    import diffrax  # takes its time to import

    if not isinstance(solver, diffrax.AbstractERK):
        raise ValueError(
            "IndexReducedODE: `solver` must be an explicit Runge–Kutta scheme of diffrax, such as diffrax.Tsit5() or "
            f"diffrax.Dopri8(), got {solver!r}."
        )
    return solver.tableau


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


class _Local(NamedTuple):
    """The state in coordinates at q_n, or its rate."""

    x: Float[Array, " k"]
    v: Float[Array, " k"]


class _Problem(eqx.Module):
    """What all steps share."""

    inertia: Inertia
    system: AbstractSystem

    def rate(self, q, local: _Local, t) -> _Local:
        group = self.system.group
        vdot, _ = factorized_accelerations(self.inertia, self.system, group.retract(q, local.x), local.v, t)
        return _Local(group.tangent_inv_mv(local.x, local.v), vdot)

    def projected(self, q, v, t):
        """q and v on the constraints, and the drift taken out."""
        found = projection(self.inertia, self.system, jnp.zeros_like(v), q, v, t)
        drift = jnp.max(jnp.abs(self.system.constraint(q, t)), initial=0.0)
        return found.projected, v + found.d, lax.stop_gradient(drift)


def _adaptive(settings: IndexReducedODE, problem: _Problem, q, v, t, h, running):
    """From one output time to the next under error control; nowhere unless `running`."""
    import diffrax  # takes its time to import

    rtol = 0.0 if settings.rtol is None else settings.rtol
    atol = rtol if settings.atol is None else settings.atol
    reverse = diffrax.RecursiveCheckpointAdjoint(checkpoints=settings.max_steps)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, local, args: args[0].rate(args[1], local, t)),
        diffrax.Tsit5() if settings.solver is None else settings.solver,
        *(t, jnp.where(running, t + h, t), h, _Local(jnp.zeros_like(v), v), (problem, q)),
        # the largest entry, so that more bodies do not loosen the control
        stepsize_controller=diffrax.PIDController(rtol, atol, norm=_largest),
        adjoint=reverse if settings.mode == "reverse" else diffrax.ForwardMode(),
        max_steps=settings.max_steps,
        throw=False,
    )
    assert solution.ys is not None
    local = jax.tree.map(lambda leaf: leaf[0], solution.ys)
    return local, solution.result == diffrax.RESULTS.successful, solution.stats["num_steps"]


def _largest(tree) -> Float[Array, ""]:
    return jnp.max(jnp.stack([jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)]))


def integrate_ode(settings: IndexReducedODE, num_steps: int, system: AbstractSystem, start: State, t0, h):
    """The states at t0 + n h, n = 0 … num_steps, stacked along a leading axis; what happened in between; the stages.

    An interval that fails ends the simulation: its end and all after it are NaN, and `StepStats` says so.
    """
    inertia = Inertia.of(system)
    vdot, lam = factorized_accelerations(inertia, system, start.q, start.v, t0)
    first = State(q=start.q, v=start.v, vdot=vdot, lam=lam, a=vdot)
    if settings.rtol is None:
        states, stats, stages = _equal(settings, num_steps, Numbers(inertia, system, t0, h), first)
    else:
        (states, stats), stages = _controlled(settings, num_steps, _Problem(inertia, system), first, t0, h), None
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), first, states), stats, stages


def _equal(settings: IndexReducedODE, num_steps: int, numbers: Numbers, first: State):
    """The ends of equal steps, and their stages, by which the scheme integrates everything else too."""
    found = equal_steps(settings, num_steps, numbers, first)
    finite = jnp.all(jnp.stack([_finite(leaf) for leaf in jax.tree.leaves(found.end)]), axis=0)
    converged = jnp.cumprod(finite.astype(jnp.int32)) == 1
    keep = lambda leaf: jnp.where(jnp.expand_dims(converged, range(1, leaf.ndim)), leaf, jnp.nan)
    system, p = numbers.system, found.projection
    ends = numbers.t0 + (1.0 + jnp.arange(num_steps, dtype=numbers.h.dtype)) * numbers.h
    violation = jax.vmap(system.constraint)(p.q, ends)
    drift = lax.stop_gradient(jnp.max(jnp.abs(violation), axis=1, initial=0.0))
    tried = jnp.concatenate([jnp.ones(1, bool), converged[:-1]])  # NaN is where a step failed, 0 after it
    scheme = Coefficients.of(settings.tableau)
    t, h = numbers.t0, numbers.h
    count = jnp.arange(num_steps, dtype=h.dtype)
    stages = Stages(
        t=(t + jnp.add.outer(count, jnp.asarray(scheme.c, h.dtype)) * h).reshape(-1),
        weights=jnp.tile(h * jnp.asarray(scheme.b, h.dtype), num_steps),
        states=jax.tree.map(
            lambda leaf: keep(leaf).reshape(num_steps * len(scheme.b), *leaf.shape[2:]),
            State(found.stages.q, found.stages.v, found.stages.vdot, found.stages.lam, found.stages.vdot),
        ),
    )
    stats = StepStats(tried.astype(jnp.int32), jnp.where(tried, drift, jnp.nan), converged)
    return jax.tree.map(keep, found.end), stats, stages


def _finite(leaf):
    return jnp.all(jnp.isfinite(leaf), axis=tuple(range(1, leaf.ndim)))


def _controlled(settings: IndexReducedODE, num_steps: int, problem: _Problem, first: State, t0, h):
    """The ends of output intervals under error control."""

    def interval(problem: _Problem, begin: State, n, running):
        local, finished, steps = _adaptive(settings, problem, begin.q, begin.v, t0 + n * h, h, running)
        end = t0 + (n + 1) * h
        q, v, drift = problem.projected(problem.system.group.retract(begin.q, local.x), local.v, end)
        vdot, lam = factorized_accelerations(problem.inertia, problem.system, q, v, end)
        return State(q=q, v=v, vdot=vdot, lam=lam, a=vdot), drift, finished, steps

    # In reverse mode nothing is kept of an interval but how it begins.
    interval = jax.checkpoint(interval, prevent_cse=False)

    def step(carry, n):
        begin, running = carry
        end, drift, finished, steps = interval(problem, begin, n, running)
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(end)]))
        converged = running & finished & finite
        end = jax.tree.map(lambda leaf: jnp.where(converged, leaf, jnp.nan), end)
        steps = jnp.where(running, steps, 0).astype(jnp.int32)
        return (end, converged), (end, StepStats(steps, drift, converged))

    count = jnp.arange(num_steps, dtype=h.dtype)
    return lax.scan(step, (first, jnp.ones((), bool)), count)[1]


def ode_failure(stats: StepStats, t0, h):
    """Whether and where the integration failed: the result code, and what its message needs."""
    failed = jnp.argmin(stats.converged)  # the first interval that failed, 0 if none did
    result = jnp.where(jnp.all(stats.converged), RESULTS.successful, RESULTS.integration_failed)
    details = {
        "step": failed + 1,
        "num_steps": jnp.asarray(stats.converged.shape[0]),
        "time": t0 + failed.astype(h.dtype) * h,
        "steps": stats.steps[failed],
    }
    return result, details
