"""Preloads that hold a model at rest in its reference configuration."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens._validate import as_float, require, suggestion
from lgsens.dynamics import full_jacobian
from lgsens.model._model import Model


def static_preload(model: Model, forces: Sequence[str], *, t0=0.0) -> tuple[Model, Float[Array, ""]]:
    """The model with the preloads of the named springs chosen so that it rests in its reference configuration.

    The preloads F and the joint forces λ solve r(q_ref, 0, 0, λ, t0; F) = 0, which is linear in both:
    A [λ; F] = −r_0, in the sense of least squares through [[I, A], [Aᵀ, 0]]. Where bushings are named that resist
    rotations, there are more of F than equations. Of all equilibria it is then the one of least energy ½ Σ F_i²/k_i in
    the bushings, with rigid joints, springs of constant length and x the displacement that goes with it,

        A [λ; F] = −r_0,     F_i = k_i a_iᵀ x,     B x = 0,     a_jᵀ x = 0 of the springs:

    what the bushings bear if they were free of stress without load, to first order.

    Arguments:
        model: the scene.
        forces: names of elements with a preload (`SpringDamper`, `TyreSpring`, `Bushing`, `BeamElement`, one's own), as
            many as the mechanism has degrees of freedom that weight or other forces move; a bushing counts for three.
            Bushings that resist rotations, and elements of beams, may be any number if they, joints and the springs
            named let nothing move that a load moves.
        t0: the time at which time-dependent forces are taken [s].

    Returns the model and the largest force [N] or moment [N m] that remains unbalanced. Differentiable: a gradient
    through it keeps the static equilibrium. Raises `ValueError` for a name that is not a spring, and for preloads that
    are not determined.
    """
    springs = [name for name, force in model.forces.items() if force.preload_shape is not None]
    for name in forces:
        if name not in springs:
            raise ValueError(f"`static_preload`: {suggestion(name, springs)}.")

    values, unbalanced = _solve(model, tuple(forces), as_float(t0, (), "`t0`"))
    require(
        np.isfinite,
        f"`static_preload`: the reference configuration does not determine the preloads of {list(forces)}: one has no "
        "direction there (a spring of no length), or several and the joints hold the same. Name others.",
        unbalanced,
    )
    return _preloaded(model, forces, values), unbalanced


def _preloaded(model: Model, forces: Sequence[str], values) -> Model:
    members = dict(model.forces)
    for name, value in zip(forces, values):
        members[name] = members[name].with_preload(value)
    return eqx.tree_at(lambda m: m.forces, model, members)


@eqx.filter_jit  # outside a jit the many small operations would be compiled one by one: 17 s instead of 2
def _solve(model: Model, forces: tuple[str, ...], t):
    """The preloads, and the largest force or moment they leave unbalanced."""
    no_preload, each = ravel_pytree([jnp.zeros(model.forces[name].preload_shape, t.dtype) for name in forces])

    def residual(values):
        system = _preloaded(model, forces, each(values)).system()
        q, v = system.reference()
        jacobian = full_jacobian(system, q, t)
        zero, lam = jnp.zeros_like(v), jnp.zeros(jacobian.shape[0], v.dtype)
        return system.residual(q, zero, zero, lam, t), jacobian

    unbalanced, by_preload, jacobian = jax.linearize(residual, no_preload, has_aux=True)
    eye = jnp.eye(no_preload.size, dtype=no_preload.dtype)
    by_preload = jax.vmap(by_preload, out_axes=1)(eye)
    named = [model.forces[name] for name in forces]
    rates = [force.preload_rates for force in named]
    yields = [np.full(force.preload_shape, rate is not None) for force, rate in zip(named, rates)]
    yields = np.concatenate(yields, axis=None)
    a = jnp.concatenate([jacobian.T, by_preload[:, ~yields]], axis=1)
    k, n = a.shape
    if yields.any():
        soft, rate = by_preload[:, yields], jnp.concatenate([one for one in rates if one is not None])
        rate = rate / jnp.max(rate)
        upper = (soft * rate[None]) @ soft.T
    else:
        upper = jnp.eye(k, dtype=a.dtype)
    matrix = jnp.block([[upper, a], [a.T, jnp.zeros((n, n), a.dtype)]])
    rhs = jnp.concatenate([-unbalanced, jnp.zeros(n, a.dtype)])
    solution = _shortest(matrix, rhs) if yields.any() else jnp.linalg.solve(matrix, rhs)
    values = no_preload.at[~yields].set(solution[k + jacobian.shape[0] :])
    if yields.any():
        values = values.at[yields].set(rate * (soft.T @ solution[:k]))
    left = unbalanced + jacobian.T @ solution[k : k + jacobian.shape[0]] + by_preload @ values
    return each(values), jnp.max(jnp.abs(left))


def _shortest(matrix, rhs):
    """The shortest solution of symmetric equations, in the sense of least squares.

    They are singular where something moves freely that no load moves, a wheel on its hinge. No force depends on how far
    it does, so that the derivative is that of regular equations, A δx = δb − δA x.
    """
    largest = lax.stop_gradient(jnp.max(jnp.abs(matrix), axis=1))
    scale = lax.rsqrt(jnp.where(largest > 0.0, largest, 1.0))  # rates of a beam along and across it differ by 1e6

    def solve(_, b):
        scaled = scale[:, None] * matrix * scale[None, :]
        return scale * (jnp.linalg.pinv(scaled, rtol=64 * float(jnp.finfo(matrix.dtype).eps)) @ (scale * b))

    return lax.custom_linear_solve(lambda x: matrix @ x, rhs, solve, symmetric=True)
