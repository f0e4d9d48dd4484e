"""Finite differences of functions of a model, leaf by leaf; orientations are perturbed by retraction."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lgsens.liegroups import SO3

# Central differences of sixth order: f' = (45 (f₁ − f₋₁) − 9 (f₂ − f₋₂) + (f₃ − f₋₃))/(60 δ) + O(δ⁶)
STENCIL = ((1, 45.0), (-1, -45.0), (2, -9.0), (-2, 9.0), (3, 1.0), (-3, -1.0))


def central(f, step):
    """f'(0) of a function of a number, sixth order."""
    return sum(weight * f(k * step) for k, weight in STENCIL) / (60 * step)


class Direction(NamedTuple):
    """An independent perturbation of one leaf: its name, the tangent, and the model at a distance."""

    leaf: str
    tangent: object  # of the structure of the model, zero but in this leaf
    moved: object


def directions(model):
    """Every perturbation of every float leaf; an `orientation` moves on SO(3), in three directions."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(model)
    values = [value for _, value in leaves]
    for i, (path, leaf) in enumerate(leaves):
        name = jax.tree_util.keystr(path)
        if name.endswith("orientation"):
            moves = [(SO3().to_ambient(leaf, e), _retraction(leaf, e)) for e in jnp.eye(3)]
        else:
            entries = [jnp.zeros_like(leaf).at[index].set(1.0) for index in np.ndindex(leaf.shape)]
            moves = [(entry, _shift(leaf, entry)) for entry in entries]
        for tangent, move in moves:
            whole = [tangent if j == i else jnp.zeros_like(value) for j, value in enumerate(values)]
            yield Direction(name, jax.tree.unflatten(structure, whole), _mover(values, structure, i, move))


def _retraction(leaf, e):
    return lambda s: SO3().retract(leaf, e * s)


def _shift(leaf, entry):
    return lambda s: leaf + s * entry


def _mover(values, structure, i, move):
    return lambda s: jax.tree.unflatten(structure, [*values[:i], move(s), *values[i + 1 :]])


def inner(gradient, tangent):
    """The derivative that a gradient gives along a tangent."""
    return float(sum(jnp.sum(g * t) for g, t in zip(jax.tree.leaves(gradient), jax.tree.leaves(tangent))))


def every_leaf(value, model, gradient, step):
    """{leaf: (derivatives by `gradient`, by differences of `value`)}; `step(leaf name, leaf)` is the distance."""
    found: dict[str, list[tuple[float, float]]] = {}
    leaves = dict((jax.tree_util.keystr(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(model))
    for direction in directions(model):
        distance = step(direction.leaf, leaves[direction.leaf])
        estimate = central(lambda s, moved=direction.moved: float(value(moved(s))), distance)
        found.setdefault(direction.leaf, []).append((inner(gradient, direction.tangent), estimate))
    return {name: tuple(np.array(pairs).T) for name, pairs in found.items()}
