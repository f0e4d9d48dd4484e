"""A mass on a spring along z, one unknown: everything is known in closed form, and programs compile in seconds.

z = z_0 + v/ω sin ωt,     ω² = k/m,     Ψ = ∫ (z − z_0)² dt = v²/ω² (t/2 − sin 2ωt/(4ω))
"""

import jax
import jax.numpy as jnp
import numpy as np

import lgsens as lg

P = {"k": 40.0, "m": 2.0}
V, T1 = 0.3, 1.0
CRITERION = lg.Criterion(integrand=lambda s, p: (s.body("mass").position[2] - 1.0) ** 2)


def build(p, damping=0.0):
    """`damping` [N s/m]: an option of the model, of which the closed form knows nothing."""
    spring = lg.SpringDamper(
        None, "mass", at_a=(0, 0, 0), at_b=(0, 0, 1), stiffness=p["k"], damping=damping, free_length=1.0
    )
    body = lg.RigidBody(p["m"], (1.0, 1.0, 1.0), position=(0, 0, 1), velocity=(0, 0, V), free="z")
    return lg.Model({"mass": body}, {}, {"spring": spring})


def exact(p):
    """Ψ."""
    w = jnp.sqrt(p["k"] / p["m"])
    return V**2 / w**2 * (T1 / 2 - jnp.sin(2 * w * T1) / (4 * w))


def exact_with_gradient():
    """Ψ, and dΨ/dp times p, flat in the order of the names."""
    value, gradient = jax.value_and_grad(exact)(jax.tree.map(jnp.asarray, P))
    return float(value), np.array([float(gradient[name]) * P[name] for name in sorted(P)])
