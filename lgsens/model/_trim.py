"""Preloads that hold a model at rest in its reference configuration."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lgsens._validate import as_float, suggestion
from lgsens.dynamics import full_jacobian
from lgsens.model._forces import AbstractForce, Bushing, SpringDamper, TyreSpring
from lgsens.model._model import Model
from lgsens.model._system import MultibodySystem

_SPRINGS = SpringDamper | TyreSpring | Bushing


def static_preload(model: Model, forces: Sequence[str], *, t0=0.0) -> tuple[Model, Float[Array, ""]]:
    """The model with the preloads of the named springs chosen so that it rests in its reference configuration.

    The preloads F and the joint forces λ solve r(q_ref, 0, 0, λ, t0; F) = 0, which is linear in both:
    A [λ; F] = −r_0, in the sense of least squares through [[I, A], [Aᵀ, 0]].

    Arguments:
        model: the scene.
        forces: names of `SpringDamper`, `TyreSpring` or `Bushing` elements, as many as the mechanism has degrees of
            freedom that weight or other forces move; a bushing counts for three.
        t0: the time at which time-dependent forces are taken [s].

    Returns the model and the largest force [N] or moment [N m] that remains unbalanced. Differentiable: a gradient
    through it keeps the static equilibrium. Raises `ValueError` for a name that is not a spring.
    """
    for name in forces:
        if not isinstance(model.forces.get(name), _SPRINGS):
            springs = [n for n, f in model.forces.items() if isinstance(f, _SPRINGS)]
            raise ValueError(f"`static_preload`: {suggestion(name, springs)}.")

    values, unbalanced = _solve(model, tuple(forces), as_float(t0, (), "`t0`"))
    return _preloaded(model, forces, values), unbalanced


def _preloaded(model: Model, forces: Sequence[str], values) -> Model:
    members = dict(model.forces)
    for name, value in zip(forces, values):
        members[name] = _with_preload(members[name], value)
    return eqx.tree_at(lambda m: m.forces, model, members)


@eqx.filter_jit  # outside a jit the many small operations would be compiled one by one: 17 s instead of 2
def _solve(model: Model, forces: tuple[str, ...], t):
    """The preloads, and the largest force or moment they leave unbalanced."""
    none = [jnp.zeros(3 if isinstance(model.forces[name], Bushing) else (), t.dtype) for name in forces]
    no_preload, each = ravel_pytree(none)
    rest = _preloaded(model, forces, none).system()
    where = [_place(rest, name) for name in forces]
    q, v = rest.reference()
    zero = jnp.zeros_like(v)
    jacobian = full_jacobian(rest, q, t)
    lam = jnp.zeros(jacobian.shape[0], v.dtype)

    def residual(values):
        # the preloads are set in the assembled system: assembling it anew would be compiled for each of them
        system = rest
        for (stack, element), name, value in zip(where, forces, each(values)):
            (attached,) = _with_preload(model.forces[name], value).loads(model.bodies)
            leaf = lambda s, stack=stack: _own(s.loads[stack].elements).preload
            system = eqx.tree_at(leaf, system, leaf(system).at[element].set(_own(attached.load).preload))
        return system.residual(q, zero, zero, lam, t)

    unbalanced, by_preload = residual(no_preload), jax.jacfwd(residual)(no_preload)
    a = jnp.concatenate([jacobian.T, by_preload], axis=1)
    k, n = a.shape
    matrix = jnp.block([[jnp.eye(k, dtype=v.dtype), a], [a.T, jnp.zeros((n, n), v.dtype)]])
    solution = jnp.linalg.solve(matrix, jnp.concatenate([-unbalanced, jnp.zeros(n, v.dtype)]))
    return each(solution[k + len(lam) :]), jnp.max(jnp.abs(solution[:k]))


def _place(system: MultibodySystem, force: str) -> tuple[int, int]:
    """The stack of loads and the element in it that belong to a force element."""
    found = [(i, stack.owners.index(force)) for i, stack in enumerate(system.loads) if force in stack.owners]
    return found[0]


def _own(load: Any) -> Any:
    """The load on a part of a merged body, or the load itself."""
    return getattr(load, "element", load)


def _with_preload(force: AbstractForce, value) -> AbstractForce:
    """The same spring, with a preload in place of its free length or radius."""
    assert isinstance(force, _SPRINGS)  # checked by the caller
    if isinstance(force, Bushing):
        return eqx.tree_at(lambda bushing: bushing.preload, force, value)
    if isinstance(force, SpringDamper):
        return SpringDamper(
            force.a,
            force.b,
            at_a=force.at_a,
            at_b=force.at_b,
            stiffness=force.stiffness,
            damping=force.damping,
            preload=value,
        )
    return TyreSpring(force.body, at=force.at, stiffness=force.stiffness, road=force.road, preload=value)
