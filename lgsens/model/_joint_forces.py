"""What a joint does to its body b: the force and moment of −Bᵀλ."""

from collections.abc import Iterable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lgsens.dynamics import least_norm
from lgsens.liegroups import cross
from lgsens.linear import chosen
from lgsens.model._frames import BODY_DIM, Frame
from lgsens.model._stack import at_ends, constraint_force
from lgsens.model._system import MultibodySystem


@eqx.filter_jit
def _wrenches(system: MultibodySystem, q, lam, t) -> list[Float[Array, "n e 6"]]:
    """−Bᵀλ of each constraint on its body b: force [N], and moment about the inertial origin [N m], inertial frame."""

    def of_element(element, a: Frame, b: Frame, *args):
        _, _, force, moment = jnp.split(-constraint_force(element.here(a, b), a, b, *args)[: 2 * BODY_DIM], 4)
        return jnp.concatenate([force, cross(b.position, force) + b.axis(moment)])

    def at_time(q, lam, t):
        stacks = system.constraints
        every = zip(stacks, at_ends(stacks, q), system.topology.rows)
        return [stack.map(of_element, ends, (chosen(lam, rows), t)) for stack, ends, rows in every]

    return jax.vmap(at_time)(system._placed(q), lam, t)


def joint_wrenches(system: MultibodySystem, names: Iterable[str], q, v, vdot, lam, t) -> dict[str, Float[Array, "n 6"]]:
    """Force and moment of joints as in `_wrenches`, (n, 6) each, along leading axes of a motion; of equations that
    freed bodies cannot violate, and of joints that have no others, zero."""
    lam = jax.vmap(partial(least_norm, system))(q, lam, t)
    whole, *motion = system.of_parts(q, v, vdot)
    merged = () if system.parts is None else system.parts.joints

    def total(of: MultibodySystem, wrenches, name: str):
        own = [
            wrench[:, i]
            for stack, wrench in zip(of.constraints, wrenches)
            for i, owner in enumerate(stack.owners)
            if owner == name
        ]
        return sum(own, jnp.zeros((*lam.shape[:-1], 6), lam.dtype))

    every, found = _wrenches(system, q, lam, t), {}
    for name in names:
        if name in merged:
            own = system.multiplier(name, q, v, vdot, lam, t)
            zeros = jnp.zeros((*lam.shape[:-1], len(whole.constraint_names)), lam.dtype)
            full = zeros.at[:, whole.multiplier_rows(name)].set(own)
            found[name] = total(whole, _wrenches(whole, motion[0], full, t), name)
        else:
            found[name] = total(system, every, name)
    return found
