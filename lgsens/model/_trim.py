"""Preloads that hold a model at rest in its reference configuration."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens._validate import as_float, suggestion
from lgsens.model._forces import SpringDamper, TyreSpring
from lgsens.model._model import Model
from lgsens.model._system import MultibodySystem


def static_preload(model: Model, forces: Sequence[str], *, t0=0.0) -> tuple[Model, Float[Array, ""]]:
    """The model with the preloads of the named springs chosen so that it rests in its reference configuration.

    The preloads F and the joint forces λ solve r(q_ref, 0, 0, λ, t0; F) = 0, which is linear in both:
    A [λ; F] = −r_0, in the sense of least squares through [[I, A], [Aᵀ, 0]].

    Arguments:
        model: the scene.
        forces: names of `SpringDamper` or `TyreSpring` elements, as many as the mechanism has degrees of freedom that
            weight or other forces move.
        t0: the time at which time-dependent forces are taken [s].

    Returns the model and the largest force [N] or moment [N m] that remains unbalanced. Differentiable: a gradient
    through it keeps the static equilibrium. Raises `ValueError` for a name that is not a spring.
    """
    for name in forces:
        if not isinstance(model.forces.get(name), SpringDamper | TyreSpring):
            springs = [n for n, f in model.forces.items() if isinstance(f, SpringDamper | TyreSpring)]
            raise ValueError(f"`static_preload`: {suggestion(name, springs)}.")

    values, unbalanced = _solve(model, tuple(forces), as_float(t0, (), "`t0`"))
    return _preloaded(model, forces, values), unbalanced


def _preloaded(model: Model, forces: Sequence[str], values) -> Model:
    members = dict(model.forces)
    for name, value in zip(forces, values):
        spring = members[name]
        assert isinstance(spring, SpringDamper | TyreSpring)  # checked by the caller
        members[name] = _with_preload(spring, value)
    return eqx.tree_at(lambda m: m.forces, model, members)


@eqx.filter_jit  # outside a jit the many small operations would be compiled one by one: 17 s instead of 2
def _solve(model: Model, forces: tuple[str, ...], t):
    """The preloads, and the largest force or moment they leave unbalanced."""
    rest = _preloaded(model, forces, jnp.zeros(len(forces), t.dtype)).system()
    where = [_place(rest, name) for name in forces]
    q, v = rest.reference()
    zero = jnp.zeros_like(v)
    jacobian = rest.constraint_jacobian(q)
    lam = jnp.zeros(jacobian.shape[0], v.dtype)

    def residual(values):
        # the preloads are set in the assembled system: assembling it anew would be compiled for each of them
        system = rest
        for (stack, element), value in zip(where, values):
            leaf = lambda s, stack=stack: s.loads[stack].elements.preload
            system = eqx.tree_at(leaf, system, leaf(system).at[element].set(value))
        return system.residual(q, zero, zero, lam, t)

    no_preload = jnp.zeros(len(forces), v.dtype)
    unbalanced, by_preload = residual(no_preload), jax.jacfwd(residual)(no_preload)
    a = jnp.concatenate([jacobian.T, by_preload], axis=1)
    k, n = a.shape
    matrix = jnp.block([[jnp.eye(k, dtype=v.dtype), a], [a.T, jnp.zeros((n, n), v.dtype)]])
    solution = jnp.linalg.solve(matrix, jnp.concatenate([-unbalanced, jnp.zeros(n, v.dtype)]))
    return solution[k + len(lam) :], jnp.max(jnp.abs(solution[:k]))


def _place(system: MultibodySystem, force: str) -> tuple[int, int]:
    """The stack of loads and the element in it that belong to a force element."""
    found = [(i, stack.owners.index(force)) for i, stack in enumerate(system.loads) if force in stack.owners]
    return found[0]


def _with_preload(force: SpringDamper | TyreSpring, value):
    """The same spring, with a preload in place of its free length or radius."""
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
