"""Derivatives of a function of a model: forward mode, reverse mode, differences and Taylor's remainder."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lgsens._validate import as_float, leaf_name
from lgsens.testing._differences import (
    NODES,
    NOISE_POINTS,
    SAFETY,
    Difference,
    Direction,
    default_step,
    difference,
    is_rotation,
    noise,
    noise_spacing,
)
from lgsens.testing._report import Check, Report

MODES = ("forward", "reverse")
# Differences that are less certain than this share of the largest derivative decide nothing.
DECISIVE = 1e-3
TAYLOR = (16.0, 8.0, 4.0)  # distances for the remainder, in steps: far above its round-off
LARGEST_RATE_ERROR = 0.25  # a remainder that falls at rate 1 is not taken for one at rate 2
RATE_ERROR = 0.01  # of the terms after the next, where those of s³ and s⁴ make both rates the same by accident


def check_sensitivities(
    fn: Callable[[PyTree], PyTree],
    at: PyTree,
    *,
    modes: Sequence[str] = MODES,
    scale: PyTree | None = None,
    step: float | None = None,
    seed: int = 0,
) -> Report:
    """Compare the derivatives of a function leaf by leaf: forward mode, reverse mode and differences.

    Every leaf p is moved along a random direction d of its own size (an `orientation` on SO(3)). With J the derivative
    of fn and w random weights of its values,

        J d = (fn(p + h d) − …)/h,     w·(J d) = (Jᵀ w)·d,     |fn(p + s d) − fn(p) − s J d| ∝ s²

    the last along all leaves at once. With simulations in fn the forward mode is the direct differentiation method,
    the reverse mode the adjoint variable method. A custom rule that drops a leaf has derivative zero there, differences
    have not.

    Arguments:
        fn: what to differentiate, a pytree of floats (a `Model`, design parameters) ↦ floats of any shape; jit must
            be able to trace it.
        at: where, a pytree of floats.
        modes: "forward", "reverse", or both. A `custom_vjp` (`AdjointVariable`) has the reverse mode only.
        scale: the size of a large change of each leaf, a pytree as `at` of arrays of shape (); None: the largest entry
            of each leaf, or 1 if it is zero.
        step: h as a fraction of the scale; None: the fifth root of round-off, 7e-4 in 64 bits.
        seed: of the random directions and weights.

    Returns a `Report` whose errors are relative to the largest derivative by any leaf, so that a scale matters there:
    `print` it, `assert` it, or let it `raise_if_failed`. Tolerances come from the round-off of fn, measured, and from
    two orders of differences; where they exceed a thousandth the differences decide nothing, and the check fails:
    choose another `step`, or fewer simulated steps. Raises `ValueError` for unknown modes, an `at` without arrays, and
    values that are not finite.
    """
    modes = tuple(modes)
    if not modes or not set(modes) <= set(MODES):
        raise ValueError(f"`modes` must be among {MODES}, got {modes}.")
    at = jax.tree.map(lambda leaf: as_float(leaf, None, "`at`"), at)
    directions, structure = _directions(at, scale, np.random.default_rng(seed))
    dtype = directions[0].leaf.dtype
    h = default_step(dtype) if step is None else float(step)
    delta = noise_spacing(dtype)

    def vector(x):
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(fn(x))])

    value = jax.jit(vector)
    forward = jax.jit(lambda x, d: jax.jvp(vector, (x,), (d,))[1])
    reverse = jax.jit(lambda x, w: jax.vjp(vector, x)[1](w)[0])
    rebuild = lambda leaves: jax.tree.unflatten(structure, list(leaves))

    def moved(s, only=None):
        return rebuild(d.moved(s) if only in (None, i) else d.leaf for i, d in enumerate(directions))

    def tangent(only=None):
        return rebuild(d.tangent() if only in (None, i) else jnp.zeros_like(d.leaf) for i, d in enumerate(directions))

    points = [moved(k * delta) for k in range(NOISE_POINTS)]
    near = np.stack([value(x) for x in points])
    if not np.all(np.isfinite(near)):
        raise ValueError(f"`fn` must be finite at `at`, got {near[0]}.")
    sigma = noise(near)
    slopes = [difference(np.stack([value(moved(k * h, i)) for k in NODES]), h, sigma) for i in range(len(directions))]
    size = _sizes(slopes, near[0])
    weights = np.random.default_rng(seed + 1).standard_normal(size.shape) / size

    by_forward = [np.asarray(forward(at, tangent(i))) for i in range(len(directions))] if "forward" in modes else None
    by_reverse = sigma_reverse = None
    if "reverse" in modes:
        pulled = [jax.tree.leaves(reverse(x, jnp.asarray(weights))) for x in points]
        along = [[d.tangent(k * delta) for d in directions] for k in range(NOISE_POINTS)]
        products = np.array([[np.sum(g * d) for g, d in zip(*pair)] for pair in zip(pulled, along)])
        # a derivative that vanishes by cancellation is round-off of the others
        by_reverse, sigma_reverse = products[0], noise(products) + np.finfo(dtype).eps * np.abs(products).max()

    checks = []
    for i, (direction, slope) in enumerate(zip(directions, slopes)):
        name = direction.name
        if by_forward is not None:
            checks.append(_against_differences(name, "forward, differences", by_forward[i], slope, size))
        if by_reverse is None or sigma_reverse is None:
            continue
        if by_forward is None:
            weighted = Difference(
                np.atleast_1d(weights @ slope.value), np.atleast_1d(np.abs(weights) @ slope.tolerance)
            )
            checks.append(_against_differences(name, "reverse, differences", by_reverse[i][None], weighted, np.ones(1)))
        else:
            terms = weights * by_forward[i]
            # both modes are as rough as each other; adding up the products adds its own round-off
            own = np.finfo(dtype).eps * terms.size * np.abs(terms).sum()
            error = abs(terms.sum() - by_reverse[i])
            checks.append(Check(name, "reverse, forward", float(error), float(SAFETY * 2 * sigma_reverse[i] + own)))
    if by_forward is not None:
        remainder = lambda s: np.asarray(value(moved(s))) - near[0] - s * np.sum(by_forward, axis=0)
        sizes = [float(np.linalg.norm(remainder(factor * h) / size)) for factor in TAYLOR]
        checks.append(_taylor(sizes, float(SAFETY * 2 * np.linalg.norm(sigma / size))))
    return Report(f"Sensitivities of {getattr(fn, '__name__', type(fn).__name__)}", tuple(checks))


def _sizes(slopes: list[Difference], value: np.ndarray) -> np.ndarray:
    """The largest derivative of each entry of fn; of one that depends on no leaf, its own size, or 1."""
    largest = np.max([np.abs(slope.value) for slope in slopes], axis=0)
    uncertain = np.max([slope.tolerance for slope in slopes], axis=0)
    own = np.where(value == 0.0, 1.0, np.abs(value))
    return np.where(largest > uncertain, largest, own)


def _directions(at: PyTree, scale: PyTree | None, rng):
    """A random direction for each leaf, of the size of the leaf."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(at)
    if not leaves:
        raise ValueError("`at` has no arrays; there is nothing to differentiate.")
    sizes = [None] * len(leaves) if scale is None else structure.flatten_up_to(scale)
    directions = []
    for (path, leaf), size in zip(leaves, sizes):
        name = leaf_name(path, "x")
        turns = is_rotation(name, leaf)
        if turns:
            size = 1.0  # radian
        elif size is None:
            size = np.abs(leaf).max(initial=0.0) or 1.0
        along = rng.standard_normal((3,) if turns else leaf.shape) * float(size)
        directions.append(Direction(name, leaf, jnp.asarray(along, leaf.dtype), turns))
    return directions, structure


def _against_differences(name, compared, derivative, slope: Difference, size) -> Check:
    """The entry that is closest to failing, relative to the size of its value's derivatives."""
    error = np.abs(derivative - slope.value) / size
    # both differ by the round-off of the derivative itself, also where the function is a straight line
    tolerance = slope.tolerance / size + SAFETY * np.finfo(error.dtype).eps
    j = int(np.argmax(np.where(np.isnan(error), np.inf, error / tolerance)))
    where = f"value {j}: {derivative[j]:.6g}, differences {slope.value[j]:.6g}" if error.size > 1 else ""
    where = where or f"{derivative[j]:.6g}, differences {slope.value[j]:.6g}"
    if tolerance.max() > DECISIVE:
        return Check(name, compared, float("nan"), float(tolerance.max()), "undecided: choose another `step`")
    return Check(name, compared, float(error[j]), float(tolerance[j]), where)


def _taylor(sizes: list[float], round_off: float) -> Check:
    """2 − the rate at which the remainder a s² + b s³ falls.

    Halving s twice gives 2 + b s/(2a ln 2) and half of that excess, so the second rate is off by the difference of the
    two. A remainder at round-off is that of a function which is linear here.
    """
    compared = "rate of the remainder: 2"
    if sizes[0] <= round_off:
        return Check("all leaves", compared, 0.0, LARGEST_RATE_ERROR)
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = np.log2(np.array(sizes[:-1]) / np.array(sizes[1:]))
        tolerance = 2 * abs(first - second) + round_off / sizes[-1] / np.log(2)
    tolerance = float(min(max(tolerance, RATE_ERROR), LARGEST_RATE_ERROR))
    return Check("all leaves", compared, float(max(2.0 - second, 0.0)), tolerance, f"{second:.3f}")
