"""Equal steps of an explicit Runge–Kutta scheme on the index-reduced equations, with their derivative by hand.

One step, from (q, v) at t with v̇ and λ known, has the stages i and then two projections,

    x_i = h Σ_j a_ij T⁻¹(x_j) v_j,    v_i = v + h Σ_j a_ij v̇_j,    q_i = q exp(x̃_i),    E(v̇_i, λ_i; q_i, v_i, t_i) = 0,

    x = h Σ_j b_j T⁻¹(x_j) v_j,       P = [ M y + Bᵀμ; Φ + B y ] = 0             at q* = q exp(x̃),       q⁺ = q* exp(ỹ),
    u = v + h Σ_j b_j v̇_j,            R = [ M d + Bᵀν; B d + B(q⁺) u ] = 0       with B at q*,           v⁺ = u + d,

and at last E(v̇⁺, λ⁺; q⁺, v⁺, t⁺) = 0, the first stage of the next step. E is that of `factorized_accelerations`. Only
E, P and R contain the numbers of the system. Differentiated at the solution, each is a solve with the matrix
A = [[M, Bᵀ], [B, 0]] of its point, as for E:

    A [v̇'; λ'] = −E_q q' − E_v v' − ε,     ε = E_p p' + E_t t',          and P, R alike.

Derivative and factors of E, and ε, depend on the solution alone: those of all stages of a step are found at once, from
what the step has left, and the recursion over its stages is then a product and a solve each. (Quarter-car, Dopri8, per
stage of the transposed step: 58 µs with each stage linearized in its turn and ε before the loop, 45 µs so.) Transposed,
by JAX, the loop over steps carries the adjoint variables and the gradient by the numbers. Each step is linearized anew
from its stages, so that no matrix is kept.

Source: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.1; derivation: here.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import (
    AbstractSystem,
    ConstrainedInertia,
    Inertia,
    State,
    constraint_velocity,
    equations_of_motion,
    factorized_accelerations,
    full_jacobian,
)


class Coefficients(NamedTuple):
    """a, b and c of a scheme, without stages that only its error estimate uses."""

    a: np.ndarray
    b: np.ndarray
    c: np.ndarray

    @classmethod
    def of(cls, tableau) -> "Coefficients":
        used = max(np.flatnonzero(tableau.b_sol)) + 1
        a = np.zeros((used, used))
        for i, row in enumerate(tableau.a_lower[: used - 1]):
            a[i + 1, : i + 1] = row
        return cls(a, np.asarray(tableau.b_sol)[:used], np.concatenate([[0.0], tableau.c])[:used])


class Numbers(NamedTuple):
    """What all steps depend on, or a tangent of it."""

    inertia: Inertia
    system: AbstractSystem
    t0: Float[Array, ""]
    h: Float[Array, ""]


class Stage(NamedTuple):
    """One stage: its increment and its state."""

    x: Float[Array, " k"]
    q: Any
    v: Float[Array, " k"]
    vdot: Float[Array, " k"]
    lam: Float[Array, " m"]


class Projection(NamedTuple):
    """From where a step would end to the constraints: q* and u as above, the unknowns of P and of R, and q⁺."""

    x: Float[Array, " k"]
    q: Any
    v: Float[Array, " k"]
    y: Float[Array, " k"]
    mu: Float[Array, " m"]
    d: Float[Array, " k"]
    nu: Float[Array, " m"]
    projected: Any


class Step(NamedTuple):
    """The stages of a step, stacked, its projection and its end; stacked again, all steps."""

    stages: Stage
    projection: Projection
    end: State


def _weighted(h, weights, slopes):
    return jax.tree.map(lambda k: h * (weights @ k), slopes)


def _slopes(count: int, first) -> Any:
    return jax.tree.map(lambda k: jnp.zeros((count, *k.shape), k.dtype).at[0].set(k), first)


def _set(slopes, i, slope):
    return jax.tree.map(lambda k, new: k.at[i].set(new), slopes, slope)


def _kinematics(group, q, x, v):
    """q exp(x̃) and T⁻¹(x) v."""
    return group.retract(q, x), group.tangent_inv_mv(x, v)


def _with(first, rest):
    """One instant before a stack of others."""
    return jax.tree.map(lambda one, others: jnp.concatenate([one[None], others]), first, rest)


def projection(inertia: Inertia, system: AbstractSystem, x, q, v, t) -> Projection:
    """One step of Newton's iteration for q, then v, with one factorization."""
    if not system.constraint_names:
        none = jnp.zeros(0, v.dtype)
        return Projection(x, q, v, jnp.zeros_like(v), none, jnp.zeros_like(v), none, q)
    kkt = ConstrainedInertia.of(inertia, system, q, t)
    still = jnp.zeros_like(v)
    y, mu = kkt.solve(still, -system.constraint(q, t))
    projected = system.group.retract(q, y)
    d, nu = kkt.solve(still, -constraint_velocity(system, projected, v, t))
    return Projection(x, q, v, y, mu, d, nu, projected)


def _step(scheme: Coefficients, numbers: Numbers, begin: State, n) -> Step:
    system, h = numbers.system, numbers.h
    t = numbers.t0 + n * h
    count = len(scheme.b)
    first = Stage(jnp.zeros_like(begin.v), begin.q, begin.v, begin.vdot, begin.lam)

    def stage(slopes, inputs):
        i, weights, node = inputs
        x, dv = _weighted(h, weights, slopes)
        v = begin.v + dv
        q, rate = _kinematics(system.group, begin.q, x, v)
        vdot, lam = factorized_accelerations(numbers.inertia, system, q, v, t + node * h)
        return _set(slopes, i, (rate, vdot)), Stage(x, q, v, vdot, lam)

    slopes = _slopes(count, (begin.v, begin.vdot))  # T(0) is the unit matrix
    slopes, stages = lax.scan(stage, slopes, _rows(scheme, h.dtype))
    x, dv = _weighted(h, jnp.asarray(scheme.b, h.dtype), slopes)
    done = projection(
        numbers.inertia, system, x, system.group.retract(begin.q, x), begin.v + dv, numbers.t0 + (n + 1) * h
    )
    q, v = done.projected, done.v + done.d
    vdot, lam = factorized_accelerations(numbers.inertia, system, q, v, numbers.t0 + (n + 1) * h)
    return Step(_with(first, stages), done, State(q=q, v=v, vdot=vdot, lam=lam, a=vdot))


def _rows(scheme: Coefficients, dtype):
    """Number, weights and node of each stage but the first."""
    return jnp.arange(1, len(scheme.b)), jnp.asarray(scheme.a[1:], dtype), jnp.asarray(scheme.c[1:], dtype)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def equal_steps(settings: Any, num_steps: int, numbers: Numbers, first: State) -> Step:
    """All steps from the state `first` at t0, stacked; `settings.tableau` is that of the scheme, as diffrax has it."""
    scheme = Coefficients.of(settings.tableau)

    def step(begin, n):
        found = _step(scheme, numbers, begin, n)
        return found.end, found

    return lax.scan(step, first, jnp.arange(num_steps, dtype=numbers.h.dtype))[1]


def _motion(system: AbstractSystem, q, v, vdot, lam, t):
    return jnp.concatenate(equations_of_motion(system, q, v, vdot, lam, t))


def _product(mass, system: AbstractSystem, q, t, x, mu):
    """A [x; μ] at q."""
    jacobian = full_jacobian(system, q, t)
    return jnp.concatenate([mass @ x + mu @ jacobian, jacobian @ x])


def _corrections(mass, system: AbstractSystem, q, t, projected, at: Projection):
    """P and R as functions of the numbers, of q* and of q⁺."""
    still = jnp.zeros_like(at.y)
    p = _product(mass, system, q, t, at.y, at.mu) + jnp.concatenate([still, system.constraint(q, t)])
    velocity = constraint_velocity(system, projected, at.v, t)
    return p, _product(mass, system, q, t, at.d, at.nu) + jnp.concatenate([still, velocity])


class _Linear(NamedTuple):
    """E at a stage: [E_q E_v] as a function of (q', v'), the factors of A, ε."""

    equations: Any
    kkt: ConstrainedInertia
    load: Float[Array, " k+m"]


def _solve(kkt: ConstrainedInertia, residual):
    """−A⁻¹ of it, in its two parts."""
    k = kkt.inertia.mass.shape[0]
    return kkt.solve(-residual[:k], -residual[k:])


def _followed(rest, last):
    """One instant after a stack of others."""
    return jax.tree.map(lambda others, one: jnp.concatenate([others, one[None]]), rest, last)


def _varied_step(scheme: Coefficients, numbers: Numbers, dnumbers: Numbers, begin, dbegin, step: Step, n) -> Step:
    """The tangent of `_step` at the step `step`."""
    system, h, inertia = numbers.system, numbers.h, numbers.inertia
    group = system.group
    relative = dnumbers.h / h
    p, end = step.projection, step.end
    later = jax.tree.map(lambda leaf: leaf[1:], step.stages)
    point = lambda at: (at.q, at.v, at.vdot, at.lam)

    def linearized(q, v, vdot, lam, node):
        t, dt = (z.t0 + (n + node) * z.h for z in (numbers, dnumbers))
        _, equations = jax.linearize(lambda q, v: _motion(system, q, v, vdot, lam, t), q, v)
        of_numbers = lambda system, t: _motion(system, q, v, vdot, lam, t)
        _, load = jax.jvp(of_numbers, (system, t), (dnumbers.system, dt))
        return _Linear(equations, ConstrainedInertia.of(inertia, system, q, t), load)

    def kinematics(x, v):
        return jax.linearize(partial(_kinematics, group), begin.q, x, v)[1]

    nodes = jnp.asarray([*scheme.c[1:], 1.0], h.dtype)
    points = jax.vmap(linearized)(*_followed(point(later), point(end)), nodes)
    of_stages = jax.tree.map(lambda leaf: leaf[:-1], points), jax.vmap(kinematics)(later.x, later.v)
    of_end = jax.tree.map(lambda leaf: leaf[-1], points)

    def advanced(x, v, weights, slopes):
        dx, change = _weighted(h, weights, slopes)
        return dx + relative * x, dbegin.v + change + relative * (v - begin.v)

    def accelerations(at: _Linear, dq, dv):
        return _solve(at.kkt, at.equations(dq, dv) + at.load)

    def stage(slopes, inputs):
        (i, weights, _), x, v, at, kinematics = inputs
        dx, dv = advanced(x, v, weights, slopes)
        dq, rate = kinematics(dbegin.q, dx, dv)
        dvdot, dlam = accelerations(at, dq, dv)
        return _set(slopes, i, (rate, dvdot)), Stage(dx, dq, dv, dvdot, dlam)

    first = Stage(jnp.zeros_like(begin.v), dbegin.q, dbegin.v, dbegin.vdot, dbegin.lam)
    slopes = _slopes(len(scheme.b), (dbegin.v, dbegin.vdot))
    slopes, stages = lax.scan(stage, slopes, (_rows(scheme, h.dtype), later.x, later.v, *of_stages))

    dx, dv = advanced(p.x, p.v, jnp.asarray(scheme.b, h.dtype), slopes)
    _, dq = jax.jvp(group.retract, (begin.q, p.x), (dbegin.q, dx))
    if system.constraint_names:
        t, dt = (z.t0 + (n + 1) * z.h for z in (numbers, dnumbers))
        kkt = ConstrainedInertia.of(inertia, system, p.q, t)
        of_first = lambda mass, system, q, t: _corrections(mass, system, q, t, p.projected, p)
        variations = dnumbers.inertia.mass, dnumbers.system, dq, dt
        _, (change_p, change_r) = jax.jvp(of_first, (inertia.mass, system, p.q, t), variations)
        dy, dmu = _solve(kkt, change_p)
        _, dprojected = jax.jvp(group.retract, (p.q, p.y), (dq, dy))
        at_end = lambda q, v: constraint_velocity(system, q, v, t)
        _, change = jax.jvp(at_end, (p.projected, p.v), (dprojected, dv))
        dd, dnu = _solve(kkt, change_r + jnp.concatenate([jnp.zeros_like(dv), change]))
    else:
        dy, dmu, dprojected, dd, dnu = jnp.zeros_like(p.y), p.mu, dq, jnp.zeros_like(p.d), p.nu
    done = Projection(dx, dq, dv, dy, dmu, dd, dnu, dprojected)
    dv = dv + dd
    dvdot, dlam = accelerations(of_end, dprojected, dv)
    return Step(_with(first, stages), done, State(q=dprojected, v=dv, vdot=dvdot, lam=dlam, a=dvdot))


@equal_steps.defjvp
def _rule(settings, num_steps, primals, tangents):
    (numbers, first), (dnumbers, dfirst) = primals, tangents
    scheme = Coefficients.of(settings.tableau)
    steps = equal_steps(settings, num_steps, numbers, first)
    begins = jax.tree.map(lambda leaf: leaf[:-1], _with(first, steps.end))

    # In reverse mode nothing is kept of a step but its stages.
    @partial(jax.checkpoint, prevent_cse=False)
    def varied(dbegin, dnumbers, begin, step, n):
        return _varied_step(scheme, numbers, dnumbers, begin, dbegin, step, n)

    def step(dbegin, inputs):
        found = varied(dbegin, dnumbers, *inputs)
        return found.end, found

    count = jnp.arange(num_steps, dtype=numbers.h.dtype)
    return steps, lax.scan(step, dfirst, (begins, steps, count))[1]
