"""Driven mechanisms: where their driven numbers are, and what values and rates of them are given."""

import dataclasses
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lgsens._validate import as_float, require, suggestion
from lgsens.dynamics import RESULTS, AbstractDrive, coming_to_half_a_turn, jumped
from lgsens.model import AbstractJoint, AbstractSignal, Model, MultibodySystem


class Drive(AbstractDrive):
    """A model's system, and where its driven numbers are: whether in a constraint, the stack and the element in it."""

    system: MultibodySystem
    where: tuple[tuple[str, int, int], ...] = eqx.field(static=True)

    @property
    def own(self):
        at = [getattr(self.system, kind)[stack].elements.driven[i] for kind, stack, i in self.where]
        return jnp.stack(at) if at else jnp.zeros_like(self.system.mass, shape=0)

    def at(self, values):
        system = self.system
        for kind, stack in dict.fromkeys((kind, stack) for kind, stack, _ in self.where):
            leaf = lambda s, kind=kind, stack=stack: getattr(s, kind)[stack].elements.driven
            own = {element: i for i, (*of, element) in enumerate(self.where) if of == [kind, stack]}
            # One selection for each stack: the derivative of a scatter takes as long as that of an element.
            old = leaf(system)
            new = [values[own[i]] if i in own else old[i] for i in range(old.shape[0])]
            system = eqx.tree_at(leaf, system, jnp.stack(new))
        return system


def with_numbers(model: Model, t, names: Iterable[str] | None = None) -> Model:
    """The model with numbers in place of the signals of time of these joints; None: of all."""
    is_signal = lambda leaf: isinstance(leaf, AbstractSignal)
    number = lambda leaf: leaf(t) if is_signal(leaf) else leaf

    def numbers(joint: AbstractJoint) -> AbstractJoint:
        leaves = lambda name: jax.tree.leaves(getattr(joint, name), is_leaf=is_signal)
        over_time = [field.name for field in dataclasses.fields(joint) if field.metadata.get("over", "time") == "time"]
        fields = [name for name in over_time if any(map(is_signal, leaves(name)))]
        some = lambda joint: [getattr(joint, name) for name in fields]
        return eqx.tree_at(some, joint, jax.tree.map(number, some(joint), is_leaf=is_signal)) if fields else joint

    joints = {name: numbers(joint) if names is None or name in names else joint for name, joint in model.joints.items()}
    return eqx.tree_at(lambda model: model.joints, model, joints)


def unless_jumped(system: MultibodySystem, q: Any, first, result, starts: Sequence[int] = ()):
    """The first configuration that is wrong, and the result: of those that succeeded also where an angle that poses
    tell within half a turn jumps, from one to the next, the first from the reference, those at `starts` from the first.
    """
    home, after = jax.lax.stop_gradient((system.branches(system.reference()[0]), jax.vmap(system.branches)(q)))
    before = np.arange(after.shape[0])  # among the reference and all of them
    before[[at for at in starts if at > 0]] = 1
    every = jnp.concatenate([home[None], after])
    found = jumped(every[before], after)
    an_angle = jnp.any(found) & (result == RESULTS.successful)
    # where it comes to half a turn, at the rate of the position before, and there is no position then
    last = jnp.stack([jnp.maximum(first - 1, 0), first])
    lost = coming_to_half_a_turn(*every[last][:, None])[0] & (result == RESULTS.position_failed)
    return jnp.where(an_angle, jnp.argmax(found), first), jnp.where(an_angle | lost, RESULTS.angle_jumped, result)


def drivers(system: MultibodySystem, kind: str = "constraints") -> dict[str, tuple[str, int, int]]:
    """By the name of each driver, or of each load ("loads") with a factor, where its number is."""
    stacks = [(k, stack) for k, stack in enumerate(getattr(system, kind)) if stack.elements.driven is not None]
    return {owner: (kind, k, i) for k, stack in stacks for i, owner in enumerate(stack.owners)}


def columns(argument: str, given: Mapping[str, Any], known: Collection[str], what: str) -> dict[str, jax.Array]:
    """Values by name, in sorted order; `what` the known names are."""
    for name in given:
        if not known:
            raise ValueError(f"`{argument}`: {name!r} is not one of {what}: there are none, add one.")
        if name not in known:
            raise ValueError(f"`{argument}`: {suggestion(name, known)}, {what}.")
    values = {name: as_float(given[name], None, f"`{argument}[{name!r}]`") for name in sorted(given)}
    for name, value in values.items():
        require(
            lambda value: np.isfinite(value).all(),
            lambda name=name, value=value: (
                f"`{argument}[{name!r}]` must be finite, got {value[~np.isfinite(value)][0]} at place "
                f"{np.argwhere(~np.isfinite(value))[0].tolist()}."
            ),
            value,
        )
    return values


def require_distances(joints: Mapping[str, AbstractJoint], values: Mapping[str, jax.Array]) -> None:
    """Raise `ValueError` for a driven distance that is not positive."""
    for name, value in values.items():
        if name in joints and joints[name].distance:
            require(
                lambda value: np.all(value > 0),
                lambda name=name, value=value: (
                    f"`driven[{name!r}]` is the distance of two points and must be positive, got {value.min()} m."
                ),
                value,
            )


def of_one_length(given: Mapping[str, jax.Array], more: str = "") -> tuple[int, ...]:
    """The shape (n,) of all vectors. Raises `ValueError` for another one."""
    shape = next(iter(given.values())).shape
    if len(shape) != 1 or not shape[0] or any(of.shape != shape for of in given.values()):
        shapes = {name: of.shape for name, of in given.items()}
        raise ValueError(f"`driven` must hold vectors of one length ≥ 1{more}, got shapes {shapes}.")
    return shape


def speeds(names: Sequence[str], given: Mapping[str, Any] | None, shape: tuple[int, ...]) -> list[jax.Array]:
    """The rates of the driven values by name, each of shape (n,); those left out are 0, None: 1 for all."""
    if unknown := sorted(set(given or ()) - set(names)):
        raise ValueError(f"`rates`: {unknown} are not among the driven ones {list(names)}.")
    rates = [as_float(1.0 if given is None else given.get(name, 0.0), None, f"`rates[{name!r}]`") for name in names]
    if any(rate.shape not in ((), shape) for rate in rates):
        raise ValueError(f"`rates` must have shape () or {shape}, got {[rate.shape for rate in rates]}.")
    return [jnp.broadcast_to(rate, shape) for rate in rates]


def table(rows: Iterable[jax.Array], shape: tuple[int, ...], dtype) -> jax.Array:
    """The vectors as columns, of none of them an array without columns."""
    return jnp.stack([jnp.zeros(shape, dtype), *rows], axis=1)[:, 1:]


def refuse_history(system: MultibodySystem) -> None:
    """Raise `ValueError` where positions or forces depend on the motion before."""
    if system.num_velocity_rows:
        rolling = sorted(set(system.constraint_names[-system.num_velocity_rows :]))
        raise ValueError(
            f"`model`: {rolling} constrain velocities, so the positions depend on the way to them and not on driven "
            "values alone; use `simulate`."
        )
    if system.num_states:
        raise ValueError(
            f"`model`: the force elements {sorted(system.places_of_states())} have states, whose values depend on the "
            "motion before; use `simulate`, or leave them out."
        )
