"""Preloads that hold a model at rest in its reference configuration."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens._validate import as_float, suggestion
from lgsens.dynamics import full_jacobian
from lgsens.model._model import Model


def static_preload(model: Model, forces: Sequence[str], *, t0=0.0) -> tuple[Model, Float[Array, ""]]:
    """The model with the preloads of the named springs chosen so that it rests in its reference configuration.

    The preloads F and the joint forces λ solve r(q_ref, 0, 0, λ, t0; F) = 0, which is linear in both:
    A [λ; F] = −r_0, in the sense of least squares through [[I, A], [Aᵀ, 0]].

    Arguments:
        model: the scene.
        forces: names of elements with a preload (`SpringDamper`, `TyreSpring`, `Bushing`, one's own), as many as the
            mechanism has degrees of freedom that weight or other forces move; a bushing counts for three.
        t0: the time at which time-dependent forces are taken [s].

    Returns the model and the largest force [N] or moment [N m] that remains unbalanced. Differentiable: a gradient
    through it keeps the static equilibrium. Raises `ValueError` for a name that is not a spring.
    """
    springs = [name for name, force in model.forces.items() if force.preload_shape is not None]
    for name in forces:
        if name not in springs:
            raise ValueError(f"`static_preload`: {suggestion(name, springs)}.")

    values, unbalanced = _solve(model, tuple(forces), as_float(t0, (), "`t0`"))
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
    a = jnp.concatenate([jacobian.T, jax.vmap(by_preload, out_axes=1)(eye)], axis=1)
    k, n = a.shape
    matrix = jnp.block([[jnp.eye(k, dtype=a.dtype), a], [a.T, jnp.zeros((n, n), a.dtype)]])
    solution = jnp.linalg.solve(matrix, jnp.concatenate([-unbalanced, jnp.zeros(n, a.dtype)]))
    return each(solution[k + jacobian.shape[0] :]), jnp.max(jnp.abs(solution[:k]))
