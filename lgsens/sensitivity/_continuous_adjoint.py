"""The adjoint variable method of the equations of motion (§7).

The adjoint variables μ, ν solve, backwards in time from t_f, the linear index-3 equations (39)–(40)

    M μ̈ − r_Cᵀ μ̇ + (K_t + C_t ad(v) − Ċ_t)ᵀ μ + Bᵀν = (−F̈_M + Ḟ_C − F_K)ᵀ,        B μ = −F_λᵀ

with r_C = C_t + M ad(v). In τ = t_f − t the sign of the damping turns, and generalized-α for linear spaces solves them
with a matrix that is neither the iteration matrix of eq. (30) nor its transpose.

Final conditions. The boundary terms at t_f are b₁ δq̇ + b₂ δq with b₁ = F_M + G_C + μᵀM and
b₂ = F_C + G_K + μᵀr_C − Ḟ_M − μ̇ᵀM, and δq, δq̇ are not free: B δq = −Φ_p δp and B δq̇ = −Ḃ δq − (Φ̇)_p δp, where of a
constraint that depends on time Φ̇ = B v + Φ_t, and Ḃ its derivative along the motion, ∂B/∂t included. So b₁ = −η₁ᵀB
and b₂ + η₁ᵀḂ = −η₂ᵀB is all that can be asked for, together with eq. (40) and its derivative:

    M μ + Bᵀη₁ = −(F_M + G_C)ᵀ                                 B μ = −F_λᵀ                       (42)
    M μ̇ − Bᵀη₂ = (F_C + G_K + μᵀr_C − Ḟ_M + η₁ᵀḂ)ᵀ              B μ̇ = −Ḃ μ − Ḟ_λᵀ                (43)

solved with the pseudo-inverse, and what is left is η₁ᵀ(Φ̇)_p δp + η₂ᵀΦ_p δp. The paper has neither Ḃᵀη₁ in (43) nor
these two terms. They vanish where μ_f = μ̇_f = 0 (a criterion of positions, as on the top), not for a criterion of
velocities and a parameter in the constraints: an error that no step size removes.

Initial conditions. With ζ = q_0(p)⁻¹ q and χ = v − v_0(p), at t_0

    ρ = F_M + M μ,        π = F_C + r_Cᵀμ − Ḟ_M − M μ̇ − ad(v)ᵀρ

    dΨ/dp = G_p − πᵀw_0 − ρᵀv'_0 + η₁ᵀ(Φ̇)_p + η₂ᵀΦ_p + ∫ (F_p + μᵀr_p + νᵀΦ_p) dt.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._xla import scan
from lgsens.dynamics import AbstractSystem, State, constraint_velocity, mass_scale
from lgsens.integrate import GeneralizedAlpha, earlier, with_last
from lgsens.sensitivity._criterion_terms import Functional, PathPoint, gradients, near
from lgsens.sensitivity._linear_alpha import LinearMotion, LinearNode, advance, start
from lgsens.sensitivity._linearization import Parameters


class Cotangents(NamedTuple):
    """dΨ as it acts on what the motion depends on; a leading axis over the criteria."""

    w0: Float[Array, "c k"]  # of q_0, Lie-algebra coordinates: −π
    v0: Float[Array, "c k"]  # −ρ
    system: AbstractSystem
    p: Any


class Final(NamedTuple):
    """μ, μ̇ at t_f, and the multipliers of the constrained variations there, one column for each criterion."""

    mu: Float[Array, "k c"]
    mu_rate: Float[Array, "k c"]
    eta1: Float[Array, "m c"]
    eta2: Float[Array, "m c"]


def constrained_solve(mass, jacobian, force, level):
    """x and η with M x + Bᵀη = force and B x = level, by [(I − B⁺B) M; B]⁺ of eqs. (42)–(43)."""
    scale = mass_scale(mass)
    inverse = jnp.linalg.pinv(jacobian)
    free = jnp.eye(mass.shape[0], dtype=mass.dtype) - inverse @ jacobian
    stacked = jnp.concatenate([free @ mass, scale * jacobian])
    x = jnp.linalg.lstsq(stacked, jnp.concatenate([free @ force, scale * level]))[0]
    return x, inverse.T @ (force - mass @ x)


def jacobian_rate(system: AbstractSystem, state: State, t) -> Float[Array, "m k"]:
    """Ḃ along the motion."""
    motion = system.group.to_ambient(state.q, state.v), jnp.ones_like(t)
    return jax.jvp(system.constraint_jacobian, (state.q, t), motion)[1]


def continuous_adjoint_sweep(
    scheme: GeneralizedAlpha, path: PathPoint, parameters: Parameters, functional: Functional, p, terms
) -> Cotangents:
    """The cotangents of c criteria, by the second-order adjoint equations; `terms` is one of `_criterion_terms`."""
    system, sizes = parameters.system, jnp.diff(path.t)
    group, mass = system.group, system.mass_matrix()

    def node(point: PathPoint) -> tuple[LinearNode, Any]:
        state, t = point.state, point.t
        k_t, c_t, jacobian = system.tangents(state.q, state.v, state.vdot, state.lam, t)
        motion = (group.to_ambient(state.q, state.v), state.vdot, jnp.ones_like(t))
        damping = lambda q, v, t: system.tangents(q, v, state.vdot, state.lam, t).damping
        _, c_t_rate = jax.jvp(damping, (state.q, state.v, t), motion)
        bracket, of = group.ad(state.v), terms(functional, p, system, point)
        return LinearNode(
            damping=(c_t + mass @ bracket).T,
            stiffness=(k_t + c_t @ bracket - c_t_rate).T,
            constraint_jacobian=jacobian,
            load=of.load.T,
            level=of.level.T,
        ), of

    at = lambda n: jax.tree.map(lambda leaf: leaf[n], path)
    last, of_last = node(at(-1))
    final = _final_conditions(functional, p, system, at(-1), last, of_last)
    nodes = (last, node(at(-2))[0], node(at(-3))[0], node(at(-4))[0])
    s = [(path.t[-1] - path.t[-1 - i]) / sizes[-1] for i in (1, 2, 3)]
    begin = start(scheme, mass, nodes, s, final.mu, -final.mu_rate, sizes[-1])

    # in the time that runs backwards a step of size h[n] leads to the n-th point, and follows one of size h[n + 1]
    def step(motion: LinearMotion, inputs):
        point, h, ratio = inputs
        motion = advance(scheme, mass, motion, node(point)[0], h, ratio)
        return motion, (motion.x, motion.lam)

    inputs = (earlier(path), sizes, sizes / jnp.concatenate([sizes[1:], sizes[-1:]]))
    motion, multipliers = scan(step, begin, inputs, reverse=True)
    multipliers = with_last(multipliers, (begin.x, begin.lam))
    bar = final_cotangents(functional, p, system, at(-1), final.eta1, final.eta2)
    bar = accumulated(bar, functional, p, system, path, *multipliers)

    first, of = node(at(0))
    rho = of.f_m.T + mass @ motion.x
    pi = of.f_c.T + first.damping @ motion.x - of.df_m.T + mass @ motion.rate  # μ̇ = −dμ/dτ
    pi = pi - group.ad(at(0).state.v).T @ rho
    return Cotangents(-pi.T, -rho.T, *bar)


def _final_conditions(
    functional: Functional, p, system: AbstractSystem, point: PathPoint, node: LinearNode, of
) -> Final:
    state, mass = point.state, system.mass_matrix()
    terminal = near(functional.final, p, system, state, point.t)
    g = gradients(lambda state: terminal(p, system, state, point.t), system.group, state)
    jacobian, b_rate = node.constraint_jacobian, jacobian_rate(system, state, point.t)
    mu, eta1 = constrained_solve(mass, jacobian, -(of.f_m + g.v).T, of.level.T)
    g_k = g.w + g.v @ system.group.ad(state.v)
    force = (of.f_c + g_k - of.df_m).T + node.damping @ mu + b_rate.T @ eta1
    mu_rate, minus_eta2 = constrained_solve(mass, jacobian, force, -b_rate @ mu - of.df_lam.T)
    return Final(mu, mu_rate, eta1, -minus_eta2)


def final_cotangents(functional: Functional, p, system: AbstractSystem, point: PathPoint, eta1, eta2):
    """G_p + η₁ᵀ(Φ̇)_p + η₂ᵀΦ_p, on the numbers of the system and on p."""
    state = point.state
    terminal = near(functional.final, p, system, state, point.t)

    def ends(system, p):
        rate = constraint_velocity(system, state.q, state.v, point.t)
        return terminal(p, system, state, point.t), rate, system.constraint(state.q, point.t)

    values, pull_back = jax.vjp(ends, system, p)
    return jax.vmap(pull_back)((jnp.eye(values[0].shape[0], dtype=state.v.dtype), eta1.T, eta2.T))


def accumulated(bar, functional: Functional, p, system: AbstractSystem, path: PathPoint, mu, nu):
    """bar + ∫ (F_p + μᵀr_p + νᵀΦ_p) dt for every criterion, by the trapezoidal rule, from μ and ν of all points."""

    def add(bar, inputs):
        (state, t, *_), mu, nu, weight = inputs
        rate = near(functional.rate, p, system, state, t)

        def integrand(system, p):
            residual = system.residual(state.q, state.v, state.vdot, state.lam, t)
            return rate(p, system, state, t), residual, system.constraint(state.q, t)

        values, pull_back = jax.vjp(integrand, system, p)
        one = weight * jnp.eye(values[0].shape[0], dtype=mu.dtype)
        return jax.tree.map(jnp.add, bar, jax.vmap(pull_back)((one, weight * mu.T, weight * nu.T))), None

    sizes = jnp.pad(jnp.diff(path.t), 1)
    weights = (sizes[1:] + sizes[:-1]) / 2
    return scan(add, bar, (path, mu, nu, weights), reverse=True)[0]
