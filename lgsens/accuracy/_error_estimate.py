"""The error of one generalized-α run, from the run itself: its defects, propagated by its own linearization.

(Other runs are estimated by `_refined_run.py`.)

Let the true motion take the place of the numerical one in eqs. (24)–(29), with the algorithmic acceleration that
eq. (29) gives a smooth motion, Δ = α_m − α_f,

    a_n = v̇ + Δ h v̈ + κ h² v⃛ + O(h³),     κ = Δ (α_m − ½).

What the scheme misses in one step is then, from (27), with ẋ = T⁻¹(x) v, T⁻¹ = I + ½ ad(x) + …, and from (28),

    x:  h³ c,     c = (1/6 − β − Δ/2) v̈ + ad(v) v̇/12,
    v:  h³ l,     l = (Δ² − κ − 1/12) v⃛,

and O(h⁴) in (29); (25) and (26) hold exactly. Subtract the equations of the numerical motion: its error
e = numerical − true satisfies, up to higher powers of h, the linearized trajectory of `lgsens.sensitivity`

    L e = b,     b.w = −h³ T(x) c,   b.v = −h³ l,   all other rows 0.

Forward substitution with L is the direct differentiation method: one factorization and one solve per step, no
iteration, as much as one more parameter in forward mode.

**Start.** e is h² times a smooth function of time if it starts as one; else it has transients (−ρ∞)ⁿ in v̇ and λ. As
h → 0, L e = b is the linear differential equation for (η, ν, ω, μ) h² = (e.w, e.v, e.v̇, e.λ)

    η̇ + ad(v) η = ν − c,     ν̇ = ω − l,     M ω + C_t ν + K_t η + Bᵀμ = 0,     B η = 0.

With η = 0 at t0 the third line and the derivatives of the last, B (ν − c) = 0 and B (ω − l − ċ) = −Ḃ (ν − c), give

    ν_0 = c − P c,     [[M, Bᵀ], [B, 0]] [ω_0; μ_0] = [−C_t ν_0;  B (l + ċ) − Ḃ (ν_0 − c)],

P the M-orthogonal projection on what the joints allow; e.a_0 = e.v̇_0 + O(h³). The first state of the run itself has
e.v̇ = 0: the transients in which it goes from there to here are not estimated.

v̈ and v⃛ are differences of v̇, at the middle of each step. That of v⃛, (v̇_{n+2} − v̇_{n+1} − v̇_n + v̇_{n−1})/(2h²), does not
see the part (−1)ⁿ in which transients of v̇ remain for ρ∞ close to 1.

Sources: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.8 (the principal error term
solves the variational equation with the local error as its load); Arnold, Brüls & Cardona, Numerische Mathematik 129
(2015), doi:10.1007/s00211-014-0633-1, for the local errors on a Lie group.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens._validate import is_concrete, require
from lgsens.accuracy._refined_run import refined_error
from lgsens.dynamics import AbstractSystem, State, full_jacobian, kkt_solve, split_velocity
from lgsens.integrate import (
    AbstractAlpha,
    AbstractIntegrator,
    EqualGrid,
    GeneralizedAlpha,
    IndexReducedODE,
    Variation,
)
from lgsens.sensitivity import Parameters, linearized_trajectory
from lgsens.simulation import StateError, Trajectory

_LEAST_STEPS = 3


def error_estimate(trajectory: Trajectory, integrator: AbstractIntegrator = GeneralizedAlpha()) -> StateError:
    """What is to be added to a trajectory to make it better by an order.

        true ≈ v + e.v,  v̇ + e.vdot,  λ + e.lam,  q exp(ẽ.w)

    Arguments:
        trajectory: a motion in three steps or more. One that has its own estimate (`Richardson`) is answered with that.
        integrator: the one that it is from; this is checked as far as a and v̇ tell.

    Of `GeneralizedAlpha` of index 3 in equal steps from this one run: −e solves L e = b, the scheme's defects its load,
    at the price of one more parameter in forward mode. Of every other integrator from a second run
    that divides each step in two, those that `AdaptiveSteps` chose too (`_refined_run.py`).

    The estimate is the leading term of the error in the motion, h^p times a function of time, p the order of the
    scheme, right up to O(h^{p+1}). It does not see round-off, Newton's tolerance, the trapezoidal rule of a criterion,
    forces that jump between two steps, a step with which the scheme does not resolve the motion at all, or the
    transients (−ρ∞)ⁿ h² of v̇ and λ in the first steps. Where sizes of steps are no smooth function of time, errors of
    v̇ and λ of index 3 are told in part only. The configuration and the velocity at t0 count as exact.

    Returns a `StateError` on the times of the trajectory; `corrected` adds it. Raises `ValueError` for a trajectory by
    another integrator, in unequal steps where the integrator has equal ones, or with too few steps; under a trace the
    first two give NaN. `IndexReducedODE` with `rtol` has steps inside those of the trajectory, which are not known.
    """
    if trajectory.error is not None:
        return trajectory.error
    num_steps = trajectory.t.shape[0] - 1
    if not isinstance(integrator, AbstractIntegrator):
        raise ValueError(f"`integrator` must be a GeneralizedAlpha or another integrator, got {integrator!r}.")
    integrator.scheme.require_steps()
    if num_steps < _LEAST_STEPS:
        raise ValueError(f"`error_estimate` needs at least {_LEAST_STEPS} steps, got {num_steps}.")
    valid = _is_by(integrator, trajectory)
    require(
        bool,
        f"`integrator`: the trajectory is not one of {integrator!r}"
        f"{' in equal steps' if integrator.equal_steps else ''}; give the one that it is from (`GivenSteps.of` has the "
        "steps of a trajectory).",
        valid,
    )
    scheme = integrator.scheme
    linear = not trajectory.system.reads_multipliers  # as `_start` takes them to be
    if isinstance(scheme, GeneralizedAlpha) and not scheme.stabilized and integrator.equal_steps and linear:
        found = _estimated(scheme, trajectory)
    else:
        found = refined_error(scheme, trajectory)
    return found if is_concrete(valid) else jax.tree.map(lambda leaf: jnp.where(valid, leaf, jnp.nan), found)


def _is_by(integrator: AbstractIntegrator, trajectory: Trajectory):
    """Whether steps are equal if they should be, and eq. (29) or a = v̇ holds, up to round-off and what is NaN."""
    t, a, vdot = jax.lax.stop_gradient((trajectory.t, trajectory.states.a, trajectory.states.vdot))
    xp = jnp
    if is_concrete(t, a, vdot):  # inside `jit` operations of JAX are traced even so
        xp, (t, a, vdot) = np, map(np.asarray, (t, a, vdot))
    scheme, eps, h = integrator.scheme, float(jnp.finfo(vdot.dtype).eps), xp.diff(t)
    before = xp.concatenate([h[:1], h[:-1]])
    taken = (h > 0.0) & (before > 0.0)
    left, right = a[1:], a[1:]
    if isinstance(scheme, AbstractAlpha):
        ratio = xp.where(taken, h / xp.where(taken, before, 1.0), 1.0)
        begun = scheme.resized(vdot[:-1], a[:-1], ratio[:, None])
        left = (1.0 - scheme.alpha_m) * a[1:] + scheme.alpha_m * begun
        right = (1.0 - scheme.alpha_f) * vdot[1:] + scheme.alpha_f * vdot[:-1]
    elif isinstance(scheme, IndexReducedODE):
        right = vdot[1:]
    differ = xp.abs(left - right) > 1e3 * eps * xp.nanmax(xp.abs(a), initial=0.0)
    same = ~xp.any(taken[:, None] & differ)
    equal = xp.ptp(h) <= 1e-6 * h.mean() + 16 * eps * xp.abs(t).max()
    return xp.asarray(same & (equal | (not integrator.equal_steps)))


@eqx.filter_jit
def _estimated(scheme: GeneralizedAlpha, trajectory: Trajectory) -> StateError:
    states, system, t = trajectory.states, trajectory.system, trajectory.t
    group, h = system.group, (t[-1] - t[0]) / (t.shape[0] - 1)
    delta = scheme.alpha_m - scheme.alpha_f
    kappa = delta * (scheme.alpha_m - 0.5)
    middle = lambda f: (f[1:] + f[:-1]) / 2.0
    vdot = states.vdot
    vddot = jnp.diff(vdot, axis=0) / h
    third = (vddot[2:] - vddot[:-2]) / (2.0 * h)
    third = jnp.concatenate([third[:1], third, third[-1:]])  # the first and the last step lack a neighbour
    bracket = jax.vmap(group.ad_mv)(middle(states.v), middle(vdot))
    missed_x = (1.0 / 6.0 - scheme.beta - delta / 2.0) * vddot + bracket / 12.0  # c
    missed_v = (delta**2 - kappa - 1.0 / 12.0) * third  # l
    x = h * middle(states.v)
    first = jax.tree.map(lambda leaf: leaf[0], states)
    slope = (missed_x[1] - missed_x[0]) / h
    nu, omega = _start(system, first, t[0], missed_x[0] - 0.5 * h * slope, slope + missed_v[0])
    rows = lambda start, steps: jnp.concatenate([(h**2 * start)[None], steps])
    none = jnp.zeros_like(states.v)
    defects = Variation(
        w=rows(none[0], -(h**3) * jax.vmap(group.tangent_mv)(x, missed_x)),
        v=rows(nu, -(h**3) * missed_v),
        vdot=none.at[0].set(h**2 * omega),
        lam=jnp.zeros_like(states.lam),
        a=none.at[0].set(h**2 * omega),
    )
    parameters = Parameters(system, EqualGrid(t[0], h, t.shape[0] - 1))
    e = linearized_trajectory(scheme, states, parameters, defects, jax.tree.map(jnp.zeros_like, parameters))
    return StateError(-e.w, -e.v, -e.vdot, -e.lam)


def _start(system: AbstractSystem, first: State, t0, c, rate):
    """ν_0 and ω_0 for c and l + ċ at t0."""
    q = first.q
    allowed, nu = split_velocity(system, q, c, t0)
    jacobian = full_jacobian(system, q, t0)
    motion = system.group.to_ambient(q, first.v), jnp.ones_like(t0)
    _, change = jax.jvp(lambda q, t: full_jacobian(system, q, t) @ allowed, (q, t0), motion)
    damping = system.tangents(q, first.v, first.vdot, first.lam, t0).damping
    omega, _ = kkt_solve(system.mass_matrix(), jacobian, -damping @ nu, jacobian @ rate + change)
    return nu, omega


def corrected(trajectory: Trajectory, error: StateError) -> Trajectory:
    """The trajectory with an error of its states taken out, q exp(ẽ.w), v + e.v, v̇ + e.vdot, λ + e.lam.

    Ψ of this one minus Ψ of the trajectory estimates the error of a criterion, the quadrature included, if Ψ follows
    the `order` of the trajectory, as `Criterion` does. a is v̇. `error` is kept, as `Trajectory.error`.
    """
    states, group = trajectory.states, trajectory.system.group
    q = jax.vmap(group.retract)(states.q, error.w)
    vdot = states.vdot + error.vdot
    better = State(q, states.v + error.v, vdot, states.lam + error.lam, vdot)
    return dataclasses.replace(trajectory, states=better, error=error, order=4, stages=None)
