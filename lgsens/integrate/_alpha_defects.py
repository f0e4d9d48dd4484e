"""What generalized-α of index 3 misses in each step: the load of the equation that its error satisfies.

Let the true motion take the place of the numerical one in eqs. (24)–(29), with the algorithmic acceleration that
eq. (29) gives a smooth motion, Δ = α_m − α_f,

    a_n = v̇ + Δ h v̈ + κ h² v⃛ + O(h³),     κ = Δ (α_m − ½).

What the scheme misses in one step is then, from (27), with ẋ = T⁻¹(x) v, T⁻¹ = I + ½ ad(x) + …, and from (28),

    x:  h³ c,     c = (1/6 − β − Δ/2) v̈ + ad(v) v̇/12,
    v:  h³ l,     l = (Δ² − κ − 1/12) v⃛,

and O(h⁴) in (29); (25) and (26) hold exactly. Subtract the equations of the numerical motion: its error
e = numerical − true satisfies, up to higher powers of h, the linearized trajectory of `lgsens.sensitivity`

    L e = b,     b.w = −h³ T(x) c,   b.v = −h³ l,   all other rows 0.

**Start.** e is h² times a smooth function of time if it starts as one; else it has transients (−ρ∞)ⁿ in v̇ and λ. As
h → 0, L e = b is the linear differential equation for (η, ν, ω, μ) h² = (e.w, e.v, e.v̇, e.λ)

    η̇ + ad(v) η = ν − c,     ν̇ = ω − l,     M ω + C_t ν + K_t η + Bᵀμ = 0,     B η = 0.

With η = 0 at t0 the third line and the derivatives of the last, B (ν − c) = 0 and B (ω − l − ċ) = −Ḃ (ν − c), give

    ν_0 = c − P c − Δ (½ − α_f) P v̈,     [[M, Bᵀ], [B, 0]] [ω_0; μ_0] = [−C_t ν_0;  B (l + ċ) − Ḃ (ν_0 − c)],

P the M-orthogonal projection on what the joints allow; e.a_0 = e.v̇_0 + O(h³). The last term of ν_0 is what is left by
the part of v̈ that a_0 lacks (`AbstractGeneralizedAlpha.start`). The first state of the run itself has e.v̇ = 0: the
transients in which it goes from there to here are not estimated.

v̈ and v⃛ are differences of v̇, at the middle of each step. That of v⃛, on equal steps
(v̇_{n+2} − v̇_{n+1} − v̇_n + v̇_{n−1})/(2h²), does not see the part (−1)ⁿ in which transients of v̇ remain
for ρ∞ close to 1. On steps whose sizes change slowly, h_{n+1}/h_n = 1 + O(h), all of this holds with the size of each
step.

Sources: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.8 (the principal error term
solves the variational equation with the local error as its load); Arnold, Brüls & Cardona, Numerische Mathematik 129
(2015), doi:10.1007/s00211-014-0633-1, for the local errors on a Lie group.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, full_jacobian, kkt_solve, split_velocity
from lgsens.integrate._alpha import AbstractAlpha
from lgsens.integrate._grid import AbstractGrid
from lgsens.integrate._linearized import Variation


def _second_differences(t: Float[Array, " n+1"], f: Float[Array, "n+1 ..."]) -> Float[Array, "n ..."]:
    """f̈ in the middle of each step, from the four values around it; those at the ends from their neighbours."""
    sized = lambda dt: dt.reshape((-1,) + (1,) * (f.ndim - 1))
    middle = (t[1:] + t[:-1]) / 2.0
    slopes = jnp.diff(f, axis=0) / sized(jnp.diff(t))
    found = (slopes[2:] - slopes[:-2]) / sized(middle[2:] - middle[:-2])
    return jnp.concatenate([found[:1], found, found[-1:]])


def alpha_defects(scheme: AbstractAlpha, system: AbstractSystem, grid: AbstractGrid, states: State) -> Variation:
    """b, the first row that of the start; three steps at least."""
    group, t = system.group, grid.times()
    h = jnp.diff(t)[:, None]
    kappa = scheme.delta * (scheme.alpha_m - 0.5)
    middle = lambda f: (f[1:] + f[:-1]) / 2.0
    v, vdot = middle(states.v), middle(states.vdot)
    jerk = jnp.diff(states.vdot, axis=0) / h
    missed_x = jax.vmap(lambda *at: scheme.missed_increment(system, *at))(v, vdot, jerk)  # c
    missed_v = (scheme.delta**2 - kappa - 1.0 / 12.0) * _second_differences(t, states.vdot)  # l
    first = jax.tree.map(lambda leaf: leaf[0], states)
    slope = lambda f: (f[1] - f[0]) / (middle(t)[1] - middle(t)[0])
    at_start = lambda f: f[0] - 0.5 * h[0] * slope(f)
    lacking = -scheme.delta * (0.5 - scheme.alpha_f) * at_start(jerk)
    nu, omega = _start(system, first, t[0], at_start(missed_x), slope(missed_x) + missed_v[0], lacking)
    rows = lambda start, steps: jnp.concatenate([(h[0] ** 2 * start)[None], steps])
    none = jnp.zeros_like(states.v)
    return Variation(
        w=rows(none[0], -(h**3) * jax.vmap(group.tangent_mv)(h * v, missed_x)),
        v=rows(nu, -(h**3) * missed_v),
        vdot=none.at[0].set(h[0] ** 2 * omega),
        lam=jnp.zeros_like(states.lam),
        a=none.at[0].set(h[0] ** 2 * omega),
    )


def _start(system: AbstractSystem, first: State, t0, c, rate, lacking):
    """ν_0 and ω_0 for c, l + ċ and −Δ (½ − α_f) v̈ at t0."""
    q = first.q
    nu = c + split_velocity(system, q, lacking - c, t0)[0]
    jacobian = full_jacobian(system, q, t0)
    motion = system.group.to_ambient(q, first.v), jnp.ones_like(t0)
    _, change = jax.jvp(lambda q, t: full_jacobian(system, q, t) @ (c - nu), (q, t0), motion)
    damping = system.tangents(q, first.v, first.vdot, first.lam, t0).damping
    omega, _ = kkt_solve(system.mass_matrix(), jacobian, -damping @ nu, jacobian @ rate + change)
    return nu, omega
