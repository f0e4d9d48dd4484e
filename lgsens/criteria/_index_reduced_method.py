"""`IndexReduced` as a method of `differentiate`."""

import functools

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from lgsens.criteria._by_parts import Task
from lgsens.criteria._criterion import stacked
from lgsens.criteria._reference_methods import IndexReduced
from lgsens.simulation import as_system


def by_index_reduced(task: Task, p, method: IndexReduced):
    """Values and gradients of the criteria of a task."""
    from lgsens.criteria._index_reduced import integrate_index_reduced  # diffrax takes its time to import

    if task.start is not None:
        raise ValueError("IndexReduced starts from the consistent initial state of the model; leave `state0` out.")
    flat, unravel = ravel_pytree(p)
    shapes = tuple(leaf.shape for leaf in jax.tree.leaves(p))
    scene = (task.criteria, task.build, jax.tree.structure(p), shapes)
    rate, final, system = (_functions if _hashable(scene) else _functions.__wrapped__)(*scene)
    settings = {"rtol": method.rtol, "atol": method.atol, "breaks": method.breaks}
    found = integrate_index_reduced(rate, final, system, flat, task.t0, task.t1, **settings)
    return tuple(found.value), tuple(unravel(row) for row in found.gradient)


def _hashable(scene) -> bool:
    """False of a method of a pytree, which has numbers: that scene compiles anew."""
    try:
        hash(scene)
    except TypeError:
        return False
    return True


@functools.lru_cache(maxsize=64)
def _functions(criteria, build, structure, shapes):
    """F, G and the system as functions of the flat vector; the same ones for the same scene, so compiled once."""
    _, unravel = ravel_pytree(jax.tree.unflatten(structure, [np.zeros(shape) for shape in shapes]))
    return *stacked(criteria, unravel), lambda p: as_system(build(unravel(p)))
