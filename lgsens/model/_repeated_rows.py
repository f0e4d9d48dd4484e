"""Which equations of joints repeat others, and are left out: `Model(redundant="remove")`.

Which ones can be left out, and which of them leave equations that are far from singular wherever the mechanism goes,
`dynamics.repeated_rows` says. Among these, weights prefer what holds directions to what holds points, as pins carry
forces before moments; and conditions of one equation, the teeth of a gear or a rod, to one component of a point, which
holds it in another direction when its body has turned, and not at all what the others hold by then; of what is alike,
the joints that are last by name. What drives is never left out: where it repeats others, they determine already what it
prescribes.
"""

import dataclasses
import warnings
from collections.abc import Callable, Collection, Iterable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from lgsens._validate import is_concrete
from lgsens.dynamics import jacobians_on_the_way, of_unit_rows, rank_near_reference, redundant_names, repeated_rows
from lgsens.model._constraints import AbstractRows
from lgsens.model._frames import ROTATION
from lgsens.model._joints import AbstractJoint
from lgsens.model._signals import AbstractSignal
from lgsens.model._stack import Stack
from lgsens.model._system import MultibodySystem

# Of each equation its joint, which of the joint's basic constraints, and which row of that.
Equations = tuple[tuple[str, int, int], ...]
# Singular values of unit rows that would repeat others but for as much; beside a dead centre there are such, too.
_NEARLY, _NEARLY_IF_IT_MOVES = 1e-3, 1e-5
_POINT, _ALONE, _FIRST = 0.1, 0.3, 0.9  # of a direction, and of the last joint, 1
_REDUNDANT = ("refuse", "minimum_norm", "remove")


def as_redundant(given: Any, joints: Collection[str]) -> str | Equations:
    """What `Model(redundant=…)` is: one of the three words, or the equations."""
    if isinstance(given, str) and given in _REDUNDANT:
        return given
    is_row = lambda row: isinstance(row, tuple) and tuple(map(type, row)) == (str, int, int)
    if isinstance(given, str) or not isinstance(given, Iterable) or not all(map(is_row, given := tuple(given))):
        raise ValueError(
            f"Model: `redundant` must be one of {_REDUNDANT}, or the equations `removed` of another model, "
            f"got {given!r}."
        )
    if unknown := sorted({name for name, *_ in given} - set(joints)):
        raise ValueError(f"Model: `redundant` names {unknown}; the joints are {sorted(joints)}.")
    return given


def driven_equations(system: MultibodySystem) -> Bool[np.ndarray, " m"]:
    """Which equations prescribe a motion: of drivers, and where there is a signal of time."""
    prescribing = {name for name, joint in system.joints.items() if _prescribes(joint)}
    return np.array([name in prescribing for name in system.constraint_names], bool)


def repeated_equations(system: MultibodySystem) -> Equations:
    """The equations of a scene that follow from the others near the reference, at t = 0.

    Raises `ValueError` where what drives is among those that repeat each other, and for traced numbers.
    """
    if not is_concrete(system):
        raise ValueError(
            "Model: redundant='remove' looks for equations that repeat others, and its numbers are traced (jit, vmap, "
            "grad). Build the model once where they are known, and give redundant=model.removed here."
        )
    scene, t = dataclasses.replace(system, minimum_norm=True), jnp.zeros((), system.mass.dtype)
    driven = driven_equations(scene)
    found = rank_near_reference(scene, t, driven)
    locked = found.near >= found.jacobian.shape[1] and not driven.any()
    jacobian = found.jacobian * np.asarray(system.coordinate_scale())
    _warn_of_nearly_repeated(jacobian, system.constraint_names, _NEARLY if locked else _NEARLY_IF_IT_MOVES)
    if found.near == len(found.jacobian):
        return ()
    equations: dict[int, tuple[str, int, int]] = {}
    alone = np.zeros(len(found.jacobian), bool)
    for stack, rows in zip(system.constraints, system.topology.rows):
        for owner, place, own in zip(stack.owners, stack.places, rows):
            equations |= {int(row): (owner, place, i) for i, row in enumerate(own) if row >= 0}
            alone[own[own >= 0]] = len(own) == 1
    repeating = redundant_names(found.jacobian, system.constraint_names)
    prescribing = {name for name, of in zip(system.constraint_names, driven) if of}
    if conflicts := [name for name in repeating if name in prescribing]:
        raise ValueError(
            f"Model: redundant='remove': {conflicts} prescribe what the other joints determine already; leave one out "
            f"of {repeating}; or axes that should be parallel, and points that should coincide, do not quite."
        )
    jacobians = np.stack(jacobians_on_the_way(scene, found, t, driven)) * np.asarray(system.coordinate_scale())
    translations = system.index[:, : ROTATION.start]
    directions = ~np.any(jacobians[..., translations[translations >= 0]] != 0.0, axis=(0, 2))
    order = np.argsort(sorted(equations, key=equations.__getitem__))
    weights = np.where(directions, 1.0, np.where(alone, _ALONE, _POINT))
    weights = weights * (_FIRST + (1.0 - _FIRST) * order / len(order))
    return tuple(sorted(equations[row] for row in repeated_rows(jacobians, weights)))


def _warn_of_nearly_repeated(jacobian: np.ndarray, names: tuple[str, ...], most: float) -> None:
    """Where equations would repeat others but for a little, and are kept. (In single precision that is round-off.)"""
    if jacobian.dtype != np.float64:
        return
    left, singular = of_unit_rows(jacobian)
    nearly = (singular > np.sqrt(np.finfo(jacobian.dtype).eps)) & (singular < most)
    if nearly.any():
        weight = np.abs(left[:, : len(singular)][:, nearly]).max(axis=1)
        joints = sorted({name for name, w in zip(names, weight) if w > 0.1})
        warnings.warn(
            f"Model: redundant='remove': equations of {joints} would repeat each other but for "
            f"{singular[nearly].min():.0e}: axes or points are out of line by about that, or the reference is as near "
            "to a dead centre. They are kept, and what they leave may not move. Make axes parallel and points "
            "coincide, or give the `removed` of a model where they do: Model(…, redundant=exact.removed).",
            stacklevel=5,
        )


def _prescribes(joint: AbstractJoint) -> bool:
    """Whether it is a driver, or has a signal of time."""
    prescribed = [field.name for field in dataclasses.fields(joint) if field.metadata.get("prescribed")]
    return joint.drives or any(isinstance(getattr(joint, name), AbstractSignal) for name in prescribed)


def without(system: MultibodySystem, equations: Equations) -> MultibodySystem:
    """The equations of motion without those of joints, also of parts that are merged."""
    if not equations:
        return system
    gone, constraints, repeated = frozenset(equations), [], []
    for i, stack in enumerate(system.constraints):
        constraints += _those(stack, lambda row: row not in gone)
        repeated += _those(stack, lambda row: row in gone) if i < system.topology.num_positions else []
    parts = system.parts
    if parts is not None:
        parts = dataclasses.replace(parts, system=without(parts.system, equations))
    return dataclasses.replace(system, constraints=tuple(constraints), repeated=tuple(repeated), parts=parts)


def _those(stack: Stack[AbstractRows], chosen: Callable[[tuple[str, int, int]], bool]) -> list[Stack[AbstractRows]]:
    """The elements of a stack with those of its equations; none, or one stack."""
    kept = tuple(
        tuple(own and chosen((owner, place, i)) for i, own in enumerate(of))
        for owner, place, of in zip(stack.owners, stack.places, stack.kept)
    )
    which = [i for i, of in enumerate(kept) if any(of)]
    return [dataclasses.replace(stack, kept=kept).only(*which)] if which else []
