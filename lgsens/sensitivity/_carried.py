"""What one step hands to the next, in coordinates: no more of them than there are.

A step reads the parts of δ that its scheme `carries`. Where ends of steps satisfy Φ = 0 at fixed parameters, B w = 0,
and where they satisfy their velocities, c = [B v + Φ_t; A v + b] = 0, J v + D_q c w = 0 with J = [B; A]
(`AbstractScheme.satisfies`). Let S be the sizes of coordinates (`coordinate_scale`), in which metres and radians
compare. From complete factors (J S)ᵀ = [Q_1 Q_2] [T; 0], those of B alone for Z,

    w = Z x,           Z = S Q_2,                                     x = Q_2ᵀ S⁻¹ w = Zᵀ S⁻² w,
    v = N ν + P x,     N = S Q_2,     P = −S Q_1 T⁻ᵀ D_q c Z,         ν = Nᵀ S⁻² v,     as Nᵀ S⁻² P = 0.

How many, with k coordinates of a configuration and f freedoms: of (q, v) on independent coordinates 2 f; of
generalized-α with stabilized constraints, which carries (w, v, v̇, a), 2 f + 2 k; of index 3 f + 3 k. There v, v̇ and a
are not on independent coordinates: B v is O(h²) and not zero, and in the normal direction, where w = w⁺ = 0, eqs. (24)
and (28) say x' = h v' + h² ((½ − β) a' + β u') = 0 and v'⁺ = v' + h ((1 − γ) a' + γ u'), which hand v' and a' on.
Dynamic equilibrium along Z says f things more of v̇', and no more: a step reads 3 k combinations, its w, v' and v̇' at
u' = 0. That is not used, as it is little where joints are many.

The coordinates are those of `analysis.step_jacobians` in another metric. There they are differentiated, and compared
from state to state; here nobody sees them, and factors without pivoting, which accelerators have, are enough.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens.dynamics import AbstractSystem, State, constraint_velocity, full_jacobian
from lgsens.integrate import AbstractScheme, Variation


class Carried(eqx.Module):
    """The coordinates y about one state: E and R."""

    parts: tuple[str, ...] = eqx.field(static=True)
    scale: Float[Array, " k"]
    position: Float[Array, "k f"] | None = None  # Z; None: x is w
    velocity: Float[Array, "k g"] | None = None  # N; None: ν is v
    drag: Float[Array, "k f"] | None = None  # P

    @classmethod
    def of(cls, scheme: AbstractScheme, system: AbstractSystem, state: State, t, *, reduced: bool) -> "Carried":
        """About a state at t, on independent coordinates where it is `reduced` and the scheme allows it."""
        parts, scale = scheme.carries, system.coordinate_scale()
        positions, velocities = scheme.satisfies(system)
        if not (reduced and positions and system.constraint_names):
            return cls(parts, scale)
        rows = full_jacobian(system, state.q, t) * scale[None, :]
        holonomic = rows.shape[0] - system.num_velocity_rows
        _, _, free = _factors(rows[:holonomic])
        position = scale[:, None] * free
        if not velocities:
            return cls(parts, scale, position)
        normal, triangle, free = _factors(rows)

        def rate(x):
            return constraint_velocity(system, system.group.retract(state.q, position @ x), state.v, t)

        bend = jax.jacfwd(rate)(jnp.zeros(position.shape[1], scale.dtype))
        drag = -scale[:, None] * (normal @ jsl.solve_triangular(triangle, bend, trans=1))
        return cls(parts, scale, position, scale[:, None] * free, drag)

    def _apart(self, delta: Variation) -> dict[str, Any]:
        """The parts of δ on coordinates."""
        found = {name: getattr(delta, name) for name in self.parts}
        for name, basis in (("w", self.position), ("v", self.velocity)):
            if basis is not None:
                found[name] = (found[name] / self.scale**2) @ basis
        return found

    def back(self, delta: Variation) -> Float[Array, " s"]:
        """R δ."""
        return ravel_pytree(self._apart(delta))[0]

    def into(self, y: Float[Array, " s"], like: Variation) -> Variation:
        """E y, in the shapes of `like`."""
        none = jax.tree.map(jnp.zeros_like, like)
        found = ravel_pytree(self._apart(none))[1](y)
        x = found["w"]
        if self.position is not None:
            found["w"] = self.position @ x
        if self.velocity is not None:
            found["v"] = self.velocity @ found["v"] + self.drag @ x
        return none._replace(**found)


def _factors(rows: Float[Array, "m k"]):
    """Q_1, T and Q_2 of the transpose."""
    m = rows.shape[0]
    q, triangle = jnp.linalg.qr(rows.T, mode="complete")
    return q[:, :m], triangle[:m], q[:, m:]
