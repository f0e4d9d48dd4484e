"""What steps of generalized-α begin with: at the start, after a step of another size, and behind a break."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from lgsens.dynamics import (
    ConstrainedMass,
    consistent_velocity,
    constraint_jerk,
    given_way,
    of_position_level,
    prescribed_velocity,
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
        the scheme is under way: B v_n = h² B c there. Started with B v_0 = 0 it must do so through the first
        accelerations, and λ is off by O(h) for some steps. So `offsets` are added: h² N c to v_0 and Δ h N v̈_0 to
        a_0 = v̇_0, N the M-orthogonal projection on the constraint directions. Stabilized
        index 2 keeps B v = 0, and takes B c h³ out by its correction. Where constraints may be redundant, the joints
        start with what they give way in a step, Φ = βh² c λ.

        The rest of v̈_0 is left out of a_0. By eq. (29) what a_0 lacks, δ = −Δ h (v̈_0 − N v̈_0), is gone after some
        steps like (−α_m/(1 − α_m))ⁿ, and what it leaves is an offset of v of Σ h ((1 − γ) δ_n + γ δ_{n+1}), which is
        −Δ (½ − α_f) h² (v̈_0 − N v̈_0): of the order of the scheme. In it stands what forces make of v̈: a damper d on a
        mass m has v̈ = −(d/m) v̇, and d h/m ≫ 1 would make of a_0 a multiple of v̇_0 that no step survives, where the
        scheme itself is stable.
        """
        state = self.complete(system, initial.state)
        if not (self.second_order_start and system.constraint_names):
            return Start(state)
        a_1, v_2 = self.offsets(system, state, t0, initial.kkt)
        if self.stabilized:
            return Start(state, a_1=a_1)
        return Start(state, q_2=given_way(system, state.q, self.beta * state.lam, t0), v_2=v_2, a_1=a_1)

    def offsets(self, system, state, t, kkt=None):
        """(a − v̇)/h and (v − v_exact)/h² along the constraint directions once the scheme is under way: Δ N v̈, and the
        least x, in the metric of M, with B x = B c; A x = 0 of rows that are kept at velocity level.

        N v̈ is what the constraints ask for: the least with J v̈ + d(J v̇ + γ)/dt = 0, the latter at fixed v̈ = 0.
        """
        kkt = ConstrainedMass.of(system, state.q, t) if kkt is None else kkt
        return kkt.least(jnp.stack(self._asked(system, state, t, kkt.jacobian)))

    def _asked(self, system, state, t, jacobian):
        """B of both `offsets`: Δ B v̈ and B c."""
        asked = -constraint_jerk(system, state.q, state.v, state.vdot, t)
        turning = self.missed_increment(system, state.v, state.vdot, jnp.zeros_like(state.v))
        return self.delta * asked, of_position_level(system, self.jerk_share * asked + jacobian @ turning)

    def resumed(self, system, given, t0):
        given = super().resumed(system, given, t0)
        return given._replace(v_2=None) if self.stabilized else given

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
        c(q_n, v_n) = h² B c, c of `missed_increment` (see `start`), and with η = N v, the least change of v_n, in the
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
        v = consistent_velocity(system, state.q, state.v, t, ConstrainedMass.of(system, state.q, t, factors))
        return line._replace(state=dataclasses.replace(line.state, v=v), v_2=state.v - v)

    def restarts(self, system):
        """Where a constraint of position level breaks: the second or the third derivative of a driver."""
        breaking = system.breaking
        if not self.second_order_start or breaking is None:
            return None
        return lax.stop_gradient(breaking.times.astype(system.mass_matrix().dtype))

    def renewed(self, system, state, node, factors=None):
        """What the constraints ask for behind a break, in place of what they asked for before.

        Let c(q, v, t) = B v + Φ_t of the constraints of position level. Along their directions everything is known,
        c = 0, ċ = 0 and c̈ = 0, and with it what v, v̇ and a have in a smooth motion (see `start`; what is c there is γ
        here). So the state begins anew in these directions with what belongs to the motion behind, and goes on in all
        others, as a step of this size begins with them (`resized`): it is moved by the least x, y and z, in the metric
        of M, with

            v_n* = v_n + x,                      B x = −c + h² B γ,
            v̇_n* = v̇_n + y,                      B y = −ċ, but 0 of constraints that do not break,
            a_n* = v̇_n* + a_n − v̇_n + z,         B z = Δ h B v̈ − B (a_n − v̇_n),

        B v̈ = −c̈ at v̈ = 0, and γ, of v̇*: where v̇ jumps, c̈ of a joint that does not break does, too, by products of v
        and v̇. Without it v and a keep h² Δγ and Δ h Δv̈ too much, Δv̈ by which v̈ jumps; they fade like n (−ρ∞)ⁿ, and
        until then forces of drivers and joints are off by O(h).
        """
        q, v, vdot, h, t = state.q, state.v, state.vdot, node.h, node.behind
        breaking, carried = system.breaking, state.a - vdot
        assert breaking is not None  # or there are no `restarts`
        moving, one = system.group.to_ambient, jnp.ones_like(t)
        rate = lambda q, v, t: jax.jvp(breaking.constraint, (q, t), (moving(q, v), one))[1]
        c_dot = jax.jvp(rate, (q, v, t), (moving(q, v), vdot, one))[1]
        kkt = ConstrainedMass.of(system, q, node.begin, factors)
        none = jnp.zeros(system.num_velocity_rows, v.dtype)
        vdot = vdot + kkt.least(-jnp.concatenate([c_dot, none])[None])[0]
        a_1, off = self._asked(system, dataclasses.replace(state, vdot=vdot), t, kkt.jacobian)
        c = of_position_level(system, kkt.jacobian @ v + prescribed_velocity(system, q, node.begin))
        x, z = kkt.least(jnp.stack([h**2 * off - c, h * a_1 - kkt.jacobian @ carried]))
        v = v if self.stabilized else v + x
        return dataclasses.replace(state, v=v, vdot=vdot, a=vdot + carried + z)

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

    @property
    def jerk_share(self):
        """Of v̈ in c of `missed_increment`."""
        return 1.0 / 6.0 - self.beta - self.delta / 2.0

    def missed_increment(self, system, v, vdot, jerk):
        """c: with exact values and a_n = v̇(t_n + Δ h), Δ = α_m − α_f, the increment (27) misses the true one by h³ c.

        The true one is h v + h²/2 v̇ + h³ (v̈/6 + ad(v) v̇/12), from ẋ = T⁻¹(x) v and T⁻¹ = I + ½ ad(x) + …; hence
        c = (1/6 − β − Δ/2) v̈ + ad(v) v̇/12.
        """
        return self.jerk_share * jerk + system.group.ad_mv(v, vdot) / 12.0
