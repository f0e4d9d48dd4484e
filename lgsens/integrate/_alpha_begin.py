"""What steps of generalized-α begin with: at the start, after a step of another size, and behind a break."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import (
    ConstrainedMass,
    consistent_acceleration,
    consistent_velocity,
    given_way,
    normal_jerk,
)
from lgsens.integrate._alpha import AbstractAlpha
from lgsens.integrate._grid import Start


class AbstractAlphaBegin(AbstractAlpha):
    """The states that steps begin with."""

    second_order_start: eqx.AbstractVar[bool]

    def start(self, system, initial, t0):
        """The starting values of the scheme; see `second_order_start`.

        A smooth motion has a_n = v̇(t_n + Δ h), Δ = α_m − α_f, and with exact values the increment (27) misses the true
        one by h³ c (`missed_increment`). The constraint at t_{n+1} takes B c h³ out again, through the velocity once
        the scheme is under way: B v_n = −h² B c there. Started with B v_0 = 0 it must do so through the first
        accelerations, and λ is off by O(h) for some steps. So v_0 receives h² N c, N the M-orthogonal projection on the
        constraint directions, and a_0 = v̇_0 + Δ h N v̈_0. Stabilized index 2 keeps B v = 0, and takes B c h³ out by its
        correction. Where constraints may be redundant, the joints start with what they give way in a step, Φ = βh² c λ.

        The rest of v̈_0 is left out of a_0. By eq. (29) what a_0 lacks, δ = −Δ h (v̈_0 − N v̈_0), is gone after some
        steps like (−α_m/(1 − α_m))ⁿ, and what it leaves is an offset of v of Σ h ((1 − γ) δ_n + γ δ_{n+1}), which is
        −Δ (½ − α_f) h² (v̈_0 − N v̈_0): of the order of the scheme. In it stands what forces make of v̈: a damper d on a
        mass m has v̈ = −(d/m) v̇, and d h/m ≫ 1 would make of a_0 a multiple of v̇_0 that no step survives, where the
        scheme itself is stable.
        """
        state = self.complete(system, initial.state)
        if not (self.second_order_start and system.constraint_names):
            return Start(state)
        q, v, vdot = state.q, state.v, state.vdot
        turning = self.missed_increment(system, v, vdot, jnp.zeros_like(v))
        jerk, (normal,) = normal_jerk(system, q, v, vdot, t0, (turning,), initial.factors)
        a_1 = self.delta * jerk
        if self.stabilized:
            return Start(state, a_1=a_1)
        v_2 = self.missed_increment(system, v, vdot, jerk) - turning + normal  # N c, linear in v̈
        return Start(state, q_2=given_way(system, q, self.beta * state.lam, t0), v_2=v_2, a_1=a_1)

    def complete(self, system, state):
        if not self.stabilized:
            return state
        rows = len(system.constraint_names) - system.num_velocity_rows
        return dataclasses.replace(state, lam=jnp.concatenate([state.lam, jnp.zeros_like(state.lam[:rows])]))

    def physical(self, system, states):
        if not self.stabilized:
            return states
        return dataclasses.replace(states, lam=states.lam[..., : len(system.constraint_names)])

    def resized(self, system, state, t, factors=None):
        """Along the line through v̇_n at t_n and a_n at t_n + Δ h_n (eq. 29 is of second order for that alone),

            a_n* = v̇_n + r (a_n − v̇_n),

        and with the velocity off the constraints by as much as steps of the new size keep it. Under way index 3 has
        c(q_n, v_n) = −h² B c, c of `missed_increment` (see `start`), and with η = N v, the least change of v_n, in the
        metric of M, that takes it to c(q_n, v) = 0,

            v_n* = v_n + (r² − 1) η,     c(q_n, v_n*) = r² c(q_n, v_n).

        Without it the step must take B c (h_n² − h_{n−1}²) h_n out through the acceleration, as at a start with
        B v_0 = 0: λ is then off by O(r² − 1) h, and for as long as (−ρ∞)ⁿ n takes to fade. Taken along N it moves
        nothing that is stiff.

        Sources: Brüls & Arnold, Journal of Computational and Nonlinear Dynamics 3 (2008), doi:10.1115/1.2960475; Jay &
        Negrut, the same journal 2 (2007), doi:10.1115/1.2389231; for the offset of v Arnold, Brüls & Cardona,
        Numerische Mathematik 129 (2015), doi:10.1007/s00211-014-0633-1.
        """
        line = Start(dataclasses.replace(state, a=state.vdot), a_1=state.a - state.vdot)
        if not self._off_velocities(system):
            return line
        if factors is None:
            factors = self.resizing_factors(system, state, t)
        v = consistent_velocity(system, state.q, state.v, t, factors)
        return line._replace(state=dataclasses.replace(line.state, v=v), v_2=state.v - v)

    def restarts(self, system):
        """Where a constraint of position level breaks: the second or the third derivative of a driver."""
        breaks = system.constraint_breaks
        if not (self.second_order_start and breaks.shape[0]):
            return None
        return lax.stop_gradient(breaks.astype(system.mass_matrix().dtype))

    def renewed(self, system, state, node, ratio, factors=None):
        """What the constraints ask for behind a break, in place of what they asked for before.

        Along the constraint directions everything is known, B v + Φ_t = 0 and its derivatives, and with it what v and a
        have there in a smooth motion (see `start`, N as there). So the state begins anew in these directions with what
        belongs to the motion behind, and goes on in all others:

            v_n* = v + h² N c,   v̇_n* = v̇,   a_n* = v̇ + r (I − N) (a_n − v̇) + Δ h N v̈,

        v and v̇ those next to v_n and v̇_n, in the metric of M, with B v + Φ_t = 0 and its derivative. Without it v
        and a keep h² N Δc and Δ h N Δv̈ too much, Δv̈ by which v̈ jumps; they fade like n (−ρ∞)ⁿ, and until then forces
        of drivers are off by O(h).
        """
        q, h, t = state.q, node.h, node.behind
        factors = self.resizing_factors(system, state, node.begin) if factors is None else factors
        v = consistent_velocity(system, q, state.v, node.begin, factors)
        vdot = consistent_acceleration(system, q, v, state.vdot, t, factors)
        turning = self.missed_increment(system, v, vdot, jnp.zeros_like(v))
        carried = state.a - state.vdot
        jerk, (normal, of_carried) = normal_jerk(system, q, v, vdot, t, (turning, carried), factors)
        a = vdot + ratio * (carried - of_carried) + self.delta * h * jerk
        if not self.stabilized:
            v = v + h**2 * (self.missed_increment(system, v, vdot, jerk) - turning + normal)
        return dataclasses.replace(state, v=v, vdot=vdot, a=a)

    @staticmethod
    def resized_acceleration(vdot, a, ratio):
        """a* of `resized`, where that is all there is of a state."""
        return vdot + ratio * (a - vdot)

    def resizing_factors(self, system, state, t):
        return ConstrainedMass.in_steps(system, state.q, t).factors if self._off_velocities(system) else None

    def _off_velocities(self, system) -> bool:
        """Whether B v is to be kept at what belongs to the size: in index 3."""
        off = not self.stabilized and len(system.constraint_names) > system.num_velocity_rows
        return self.second_order_start and off

    def missed_increment(self, system, v, vdot, jerk):
        """c: with exact values and a_n = v̇(t_n + Δ h), Δ = α_m − α_f, the increment (27) misses the true one by h³ c.

        The true one is h v + h²/2 v̇ + h³ (v̈/6 + ad(v) v̇/12), from ẋ = T⁻¹(x) v and T⁻¹ = I + ½ ad(x) + …; hence
        c = (1/6 − β − Δ/2) v̈ + ad(v) v̇/12.
        """
        return (1.0 / 6.0 - self.beta - self.delta / 2.0) * jerk + system.group.ad_mv(v, vdot) / 12.0
