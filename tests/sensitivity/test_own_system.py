"""A user's own equations on a Lie group of one's own: DDM and AVM come with the abstract system."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import central
from jaxtyping import Array, Float

import lgsens as lg
from lgsens.dynamics import autodiff_constraint_jacobian, autodiff_tangents
from lgsens.liegroups import SO3, Product, Rn


class Gyropendulum(lg.AbstractSystem):
    """A rotor on SO(3) whose angular velocity drives a mass point on a circle of R²: Φ = |x| − l."""

    mass: Float[Array, ""]
    length: Float[Array, ""]
    coupling: Float[Array, ""]
    inertia: Float[Array, "3"]
    assembled: bool = eqx.field(static=True, default=True)

    @property
    def group(self):
        return Product((Rn(2), SO3()))

    @property
    def constraint_names(self):
        return ("circle",)

    def reference(self):
        x = jnp.stack([self.length, jnp.zeros_like(self.length)])
        return (x, jnp.eye(3)), jnp.array([0.0, 1.0, 0.3, 2.0, -0.5])

    def coordinate_scale(self):
        return jnp.ones(5)

    def mass_matrix(self):
        return jnp.diag(jnp.concatenate([jnp.stack([self.mass, self.mass]), self.inertia]))

    def residual(self, q, v, vdot, lam, t):
        x, rotation = q
        spin = v[2:]
        gyroscopic = jnp.cross(spin, self.inertia * spin)
        pull = self.coupling * rotation[0, :2]
        torque = self.coupling * jnp.cross(jnp.eye(3)[0], rotation.T @ jnp.concatenate([x, jnp.zeros(1)]))
        force = jnp.concatenate([pull * jnp.cos(t), gyroscopic + torque])
        return self.mass_matrix() @ vdot + force + lam @ self.constraint_jacobian(q, t)

    def constraint(self, q, t):
        return (jnp.linalg.norm(q[0]) - self.length)[None]

    def constraint_jacobian(self, q, t):
        return autodiff_constraint_jacobian(self, q, t)

    def tangents(self, q, v, vdot, lam, t):
        return autodiff_tangents(self, q, v, vdot, lam, t)


def make(p):
    return Gyropendulum(
        mass=p[0],
        length=p[1],
        coupling=p[2],
        inertia=jnp.stack([p[3], 2.0 * jnp.ones_like(p[3]), jnp.asarray(1.5)]),
    )


P = (1.3, 0.8, 2.0, 1.1)


def value(p, sensitivity):
    trajectory = lg.simulate(make(p), t1=1.0, num_steps=40, sensitivity=sensitivity)
    states = trajectory.states
    integrand = states.q[0][:, 0] ** 2 + states.q[1][:, 0, 1] + states.lam[:, 0] ** 2 + states.vdot[:, 3] ** 2
    return lg.time_integral(trajectory.t, integrand)


@pytest.mark.slow
def test_sensitivities():
    p = jnp.array(P)
    compiled = jax.jit(lambda p: value(p, lg.DirectDifferentiation()))
    expected = np.array([central(lambda s, e=e: compiled(p + s * e), 1e-3) for e in jnp.eye(4)])
    assert np.abs(expected).min() > 1e-3
    forward = jax.jit(jax.jacfwd(lambda p: value(p, lg.DirectDifferentiation())))(p)
    # differences: δ⁶ = 1e-18 × seventh derivative, round-off 1e-15/1e-3
    np.testing.assert_allclose(forward, expected, rtol=1e-8)
    for method in (lg.DirectDifferentiation(), lg.AdjointVariable()):
        reverse = jax.jit(jax.grad(lambda p, method=method: value(p, method)))(p)
        np.testing.assert_allclose(reverse, forward, rtol=1e-11)  # the same systems, other order of round-off
