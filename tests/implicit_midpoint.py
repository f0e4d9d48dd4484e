"""A scheme that lgsens does not ship, said by its equations alone."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp

import lgsens as lg
from lgsens.dynamics import constraint_velocity
from lgsens.integrate import AbstractScheme, Start


class ImplicitMidpoint(AbstractScheme):
    """The implicit midpoint rule on stabilized index 2, with q_m = q exp(h v_m/2) and v_m = (v + v⁺)/2:

    q⁺ = q exp(h (v_m + M⁻¹B(q)ᵀν)),   r(q_m, v_m, (v⁺ − v)/h, λ, t + h/2) = 0,   Φ(q⁺, t⁺) = 0,   B v⁺ + Φ_t = 0.
    """

    tolerance: float = eqx.field(static=True, default=1e-10)
    max_iterations: int = eqx.field(static=True, default=10)

    @property
    def convergence_order(self):
        return 2

    def equations(self, system, node, previous, state):
        h, m = node.h, len(system.constraint_names)
        middle, vdot = (previous.v + state.v) / 2.0, (state.v - previous.v) / h
        push = jnp.linalg.solve(
            system.mass_matrix(), state.lam[m:] @ system.constraint_jacobian(previous.q, node.begin)
        )
        there = system.group.retract(previous.q, h / 2.0 * middle)
        kept = system.constraint(state.q, node.t) / h, constraint_velocity(system, state.q, state.v, node.t)
        return lg.State(
            q=system.group.retract(previous.q, h * (middle + push)),
            v=system.residual(there, middle, vdot, state.lam[:m], node.begin + h / 2.0),
            vdot=state.vdot - vdot,
            lam=jnp.concatenate(kept),
            a=state.a - vdot,
        )

    def start(self, system, initial, t0):
        return Start(self.complete(system, initial.state))

    def complete(self, system, state):
        return dataclasses.replace(state, lam=jnp.concatenate([state.lam, jnp.zeros_like(state.lam)]))

    def physical(self, system, states):
        return dataclasses.replace(states, lam=states.lam[..., : len(system.constraint_names)])
