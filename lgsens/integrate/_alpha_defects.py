"""What generalized-α of index 3 misses: the load of the equation that its error satisfies.

Let the true motion take the place of the numerical one in eqs. (24)–(29), with the algorithmic acceleration that
eq. (29) gives a smooth motion, Δ = α_m − α_f,

    a_n = v̇ + Δ h v̈ + κ h² v⃛ + O(h³),     κ = Δ (α_m − ½).

What the scheme misses in one step is then, from (27), with ẋ = T⁻¹(x) v, T⁻¹ = I + ½ ad(x) + …, and from (28),

    x:  h³ c,     c = (1/6 − β − Δ/2) v̈ + ad(v) v̇/12,
    v:  h³ l,     l = (Δ² − κ − 1/12) v⃛,

in the middle of each step, and O(h⁴) in (29); (25) and (26) hold exactly. Subtract the equations of the numerical
motion: its error e = numerical − true satisfies, up to higher powers of h, the linearized trajectory of
`lgsens.sensitivity`

    L e = b,     b.w = −h³ T(x) c,   b.v = −h³ l,   all other rows but those of the start 0.

**Start.** The true motion is that through q_0 with the velocity that the constraints allow, v* (`consistent_velocity`),
and has v̇*, λ* of its equations. The run begins with other values (`AbstractAlphaBegin.start`; where it goes on from
another run all of them are others), and so does e, e.w_0 = 0. What of it is not that of a smooth e makes L repeat the
transients (−ρ∞)ⁿ of the run in v̇ and λ. They answer to B e.v_0/h and to B e.a_0, times n² while ρ∞ⁿ allows: e.v_0 is
to be right to O(h³) along the constraint directions, and by nothing else than the c and l of the steps. With B e.w = 0
at all times the rows of x and v of a smooth e = h² (η, ν, ω), η̇ + ad(v) η = F, are

    F + (h/2) Ḟ = ν − c + (h/2) (ω − ċ),     ν̇ = ω − l     ⟹     F = ν − c + (h/2) l + O(h²),

and B F = −Ḃ η = 0 at η = 0: smooth is B ν_0 = B (c − (h/2) l). Of the run B (c − Δ³ h v⃛/4) would be: by Taylor's
series (27) misses h⁴ times (1/24 − β/2 − κ/2 − β Δ) v⃛ − ċ/2 more, in fixed axes, of which b knows nothing. With N the
M-orthogonal projection on these directions, v_2 and a_1 the `offsets` of a start, h² v_2 = h² N c, h a_1 = Δ h N v̈,

    e.v_0 = v_0 − v* + h² (N (c − (h/2) l + Δ³ h v⃛/4) − v_2),     e.v̇_0 = v̇_0 − v̇*,     e.λ_0 = λ_0 − λ*,
    e.a_0 = a_0 − v̇* − h a_1 − Δ h (v̈ − N v̈) − κ h² v⃛.

**Derivatives.** v̈ and v⃛ are differences of v̇, averaged so that they do not see the part (−1)ⁿ, which is nearly what
transients are of for ρ∞ close to 1: their defects would be in resonance with L, which has the same eigenvalue. With
D and A the difference and the mean of neighbours, v̈ = A⁴ D v̇/h and v⃛ = A³ D² v̇/h², of six values around the middle
of a step, times ((1 + z)/2)⁴ and ((1 + z)/2)³ of zⁿ, z = −ρ∞: 6e-6 and 1e-4 at 0.9. Of a vibration they keep
cos⁴(ωh/2). Where that is little, since steps do not resolve it, what rings is to be told: coordinates of whose v̇ a mean
A² hides a fifth, sin²(ωh/2), have plain differences, A⁰ and A.

Sources: Hairer, Nørsett & Wanner, Solving Ordinary Differential Equations I (2008), §II.8 (the principal error term
solves the variational equation with the local error as its load); Arnold, Brüls & Cardona, Numerische Mathematik 129
(2015), doi:10.1007/s00211-014-0633-1, for the local errors on a Lie group.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lgsens.dynamics import (
    AbstractSystem,
    ConstrainedMass,
    State,
    accelerations,
    consistent_velocity,
    of_position_level,
)
from lgsens.integrate._alpha_begin import AbstractAlphaBegin
from lgsens.integrate._grid import AbstractGrid
from lgsens.integrate._linearized import Variation

_MEANS = 4  # of neighbours, in v̈
_RINGING, _LARGE = 0.2, 0.03  # what means take out of v̇, of its own size, where that is such a part of the largest


def _in_each_step(f: Float[Array, "i k"], order: int, means: int, num_steps: int) -> Float[Array, "n k"]:
    """A^means D^order f in the middle of each step, on straight lines to those at the ends."""
    for _ in range(means):
        f = (f[1:] + f[:-1]) / 2.0
    f = jnp.diff(f, order, axis=0)
    lacking = (num_steps - f.shape[0]) // 2
    far = jnp.arange(1.0, lacking + 1.0, dtype=f.dtype)[:, None]
    line = lambda end, inner: end[None] + far * (end - inner)[None]
    inner = (f[1], f[-2]) if len(f) > 1 else (f[0], f[0])
    return jnp.concatenate([line(f[0], inner[0])[::-1], f, line(f[-1], inner[1])])


def _derivatives(vdot: Float[Array, "n+1 k"], h) -> tuple[Float[Array, "n k"], Float[Array, "n k"]]:
    """v̈ and v⃛ in each step, of coordinates in comparable units."""
    n = vdot.shape[0] - 1
    smooth = min(_MEANS, 2 * (n // 2) - 2)
    (jerk, snap), (mean_jerk, mean_snap) = (
        (_in_each_step(vdot, 1, means, n) / h, _in_each_step(vdot, 2, max(means - 1, 1), n) / h**2)
        for means in (0, smooth)
    )
    size, hidden = (jnp.max(jnp.abs(x), axis=0) for x in (vdot, jnp.diff(vdot, 2, axis=0) / 4.0))
    rings = lax.stop_gradient((hidden > _RINGING * size) & (size > _LARGE * jnp.max(size)))[None]
    return jnp.where(rings, jerk, mean_jerk), jnp.where(rings, snap, mean_snap)


def alpha_defects(scheme: AbstractAlphaBegin, system: AbstractSystem, grid: AbstractGrid, states: State) -> Variation:
    """b of equal steps, the first row that of the start; three steps at least."""
    h = grid.first_size
    kappa = scheme.delta * (scheme.alpha_m - 0.5)
    scale = system.coordinate_scale()[None]
    jerk, snap = (rows * scale for rows in _derivatives(states.vdot / scale, h))
    middle = lambda f: (f[1:] + f[:-1]) / 2.0
    v, vdot = middle(states.v), middle(states.vdot)
    missed_x = jax.vmap(lambda *at: scheme.missed_increment(system, *at))(v, vdot, jerk)  # c
    missed_v = (scheme.delta**2 - kappa - 1.0 / 12.0) * snap  # l

    at_start = lambda f: 1.5 * f[0] - 0.5 * f[1]
    first, t0 = jax.tree.map(lambda leaf: leaf[0], states), grid.times()[0]
    kkt = ConstrainedMass.of(system, first.q, t0)
    v_0 = consistent_velocity(system, first.q, first.v, t0, kkt)
    vdot_0, lam_0 = accelerations(system, first.q, v_0, t0, kkt)
    a_1, v_2 = scheme.offsets(system, State(first.q, v_0, vdot_0, lam_0, vdot_0), t0, kkt)
    seen = missed_x - 0.5 * h * missed_v + scheme.delta**3 / 4.0 * h * snap
    off = of_position_level(system, kkt.jacobian @ at_start(seen))
    rows = jnp.stack([off, kkt.jacobian @ at_start(jerk)])
    normal_x, normal_jerk = jax.vmap(lambda row: kkt.solve(jnp.zeros_like(v_0), row)[0])(rows)
    lacking = scheme.delta * h * (at_start(jerk) - normal_jerk) + kappa * h**2 * at_start(snap)
    started = lambda rows, start: jnp.concatenate([start[None], rows])
    none = jnp.zeros_like(states.v)
    return Variation(
        w=started(-(h**3) * jax.vmap(system.group.tangent_mv)(h * v, missed_x), none[0]),
        v=started(-(h**3) * missed_v, first.v - v_0 + h**2 * (normal_x - v_2)),
        vdot=none.at[0].set(first.vdot - vdot_0),
        lam=jnp.zeros_like(states.lam).at[0].set(first.lam - lam_0),
        a=none.at[0].set(first.a - vdot_0 - h * a_1 - lacking),
    )
