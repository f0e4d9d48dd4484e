"""Tolerances: what scatter of the numbers of a design does to what is asked of it, and which scatter is allowed.

Outputs f(p) of numbers p that lie within p_i ± t_i. To first order, with the exact Jacobian J = ∂f/∂p,

    worst case  W_k = Σ_i |J_ki| t_i,        statistical  T_k = √(Σ_i (J_ki t_i)²),

the latter for independent p_i, of as many standard deviations as t_i is; (J_ki t_i)²/T_k² is the contribution of p_i.

Allocation. Costs c_i/t_i of tolerances under T_k ≤ b_k: with z = ln t

    min Σ_i c_i exp(−z_i)    with    ½ ln Σ_i (J_ki/b_k)² exp(2 z_i) ≤ 0,

both convex, so there is one minimum. For one output t_i ∝ (c_i/J_i²)^(1/3).

Sources: Chase & Parkinson, Research in Engineering Design 3 (1991) 23 (stacks by linear sensitivities); Spotts, Journal
of Engineering for Industry 95 (1973) 762 (costs c/t).
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from lgsens._validate import as_count, as_float, as_parameters, require, suggestion
from lgsens.optimize._box import entry_names
from lgsens.sweeps import SweepResult, sweep

_DISTRIBUTIONS = ("normal", "uniform")


class ToleranceStack(NamedTuple):
    """What tolerances of inputs make of outputs, to first order; `print` it.

    Attributes:
        inputs, outputs: their names, those of the leaves of p and of f(p).
        tolerances: t, in the units of the inputs, shape (n,).
        values: f at the nominal p, shape (k,).
        jacobian: J, shape (k, n).
    """

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    tolerances: Float[Array, " n"]
    values: Float[Array, " k"]
    jacobian: Float[Array, "k n"]

    @property
    def statistical(self) -> Float[Array, " k"]:
        """T = √(Σ (J t)²), of as many standard deviations as the tolerances are, shape (k,)."""
        return jnp.linalg.norm(self.jacobian * self.tolerances[None], axis=1)

    @property
    def worst_case(self) -> Float[Array, " k"]:
        """W = Σ |J| t, shape (k,)."""
        return jnp.sum(jnp.abs(self.jacobian) * self.tolerances[None], axis=1)

    @property
    def contributions(self) -> Float[Array, "k n"]:
        """The shares (J t)²/T² of the inputs in each output, shape (k, n); of an output that none moves 0."""
        squares = (self.jacobian * self.tolerances[None]) ** 2
        total = jnp.sum(squares, axis=1, keepdims=True)
        return squares / jnp.where(total > 0.0, total, 1.0)

    def ranked(self, output: str) -> list[tuple[str, float]]:
        """The inputs and their shares in an output, the largest first. Raises `ValueError` for an unknown output."""
        if output not in self.outputs:
            raise ValueError(f"`output`: {suggestion(output, self.outputs)}, the outputs.")
        shares = np.asarray(self.contributions[self.outputs.index(output)])
        return [(self.inputs[i], float(shares[i])) for i in np.argsort(-shares, kind="stable")]

    def __str__(self) -> str:
        width = max(len("output"), *map(len, self.outputs))
        lines = [f"{'output':{width}}  {'nominal':>12}  {'statistical':>12}  {'worst case':>12}  largest contributions"]
        for i, name in enumerate(self.outputs):
            shares = ", ".join(f"{which} {100 * share:.0f} %" for which, share in self.ranked(name)[:3] if share > 5e-3)
            numbers = (float(of[i]) for of in (self.values, self.statistical, self.worst_case))
            lines.append(f"{name:{width}}  " + "  ".join(f"{x:12.6g}" for x in numbers) + f"  {shares}")
        return "\n".join(lines)

    __repr__ = __str__


def _checked(p: PyTree, tolerances: PyTree) -> tuple[PyTree, PyTree]:
    """Both as arrays, tolerances in the shapes of p."""
    p = as_parameters(p)
    if jax.tree.structure(tolerances) != jax.tree.structure(p):
        raise ValueError(
            f"`tolerances` must have the structure of `p`, {jax.tree.structure(p)}, got "
            f"{jax.tree.structure(tolerances)}; 0 where a number has no tolerance."
        )

    def one(path, t, leaf):
        name = f"`tolerances`{jax.tree_util.keystr(path)}"
        t = as_float(t, None, name)
        if t.shape not in ((), leaf.shape):
            raise ValueError(f"{name} must have shape () or {leaf.shape}, got {t.shape}.")
        require(lambda t: np.all(t >= 0.0), lambda: f"{name} must be at least 0, got {t}.", t)
        return jnp.broadcast_to(t, leaf.shape)

    return p, jax.tree_util.tree_map_with_path(one, tolerances, p)


def tolerance_stack(fun: Callable[[PyTree], PyTree], p: PyTree, tolerances: PyTree) -> ToleranceStack:
    """What tolerances of the numbers of a design make of its outputs, to first order, by the exact Jacobian.

        T_k = √(Σ_i (J_ki t_i)²),     W_k = Σ_i |J_ki| t_i

    Arguments:
        fun: p ↦ a pytree of outputs, arrays of any shape; differentiable, by simulation, kinematics, statics, ….
        p: the nominal numbers, a pytree of floats.
        tolerances: t ≥ 0 in the units of p, a pytree of the same structure, each of shape () or that of its leaf.

    Returns a `ToleranceStack`. Raises `ValueError` for tolerances that do not fit or are negative.
    """
    p, tolerances = _checked(p, tolerances)
    flat, unravel = ravel_pytree(p)
    outputs = jax.eval_shape(fun, p)

    def function(flat):
        values = ravel_pytree(fun(unravel(flat)))[0]
        return values, values

    count = sum(leaf.size for leaf in jax.tree.leaves(outputs))
    derivative = jax.jacfwd if flat.size <= 2 * count else jax.jacrev
    jacobian, values = jax.jit(derivative(function, has_aux=True))(flat)
    names = lambda tree: tuple(entry_names(tree, "value"))
    return ToleranceStack(names(p), names(outputs), ravel_pytree(tolerances)[0], values, jacobian)


def monte_carlo(
    fun: Callable[[PyTree], PyTree],
    p: PyTree,
    tolerances: PyTree,
    *,
    samples: int = 10_000,
    distribution: str = "normal",
    sigmas: float = 3.0,
    seed: int = 0,
    **settings: Any,
) -> SweepResult:
    """The outputs of random designs within their tolerances, all orders included.

    Arguments:
        fun, p, tolerances: as in `tolerance_stack`.
        samples: how many designs.
        distribution: "normal", of standard deviation t/`sigmas`, or "uniform" over ± t (standard deviation t/√3).
        sigmas: of how many standard deviations a normal distribution's tolerance is.
        seed: of the random numbers.
        settings: those of `lgsens.sweep`.

    Returns the `SweepResult`. The standard deviation of N samples has itself one of 1/√(2N) of it, for normal outputs.
    Raises `ValueError` as `tolerance_stack`, for another distribution, and for numbers that are not positive.
    """
    p, tolerances = _checked(p, tolerances)
    samples = as_count(samples, "samples")
    if distribution not in _DISTRIBUTIONS:
        raise ValueError(f"`distribution` must be one of {_DISTRIBUTIONS}, got {distribution!r}.")
    if not sigmas > 0.0:
        raise ValueError(f"`sigmas` must be positive, got {sigmas!r}.")
    flat, unravel = ravel_pytree(p)
    shape = samples, flat.size
    key = jax.random.key(seed)
    if distribution == "normal":
        scatter = jax.random.normal(key, shape, flat.dtype) / sigmas
    else:
        scatter = jax.random.uniform(key, shape, flat.dtype, -1.0, 1.0)
    designs = jax.vmap(unravel)(flat[None] + ravel_pytree(tolerances)[0][None] * scatter)
    return sweep(fun, designs, **settings)


def allocate_tolerances(
    stack: ToleranceStack, bands: Mapping[str, float], *, costs: Any = None, largest: Any = None
) -> dict[str, float]:
    """The tolerances of least cost Σ c_i/t_i with which outputs stay within bands, T_k ≤ b_k.

    Arguments:
        stack: of the nominal design, whose Jacobian is used; tolerances of 0 in it stay 0.
        bands: by output b > 0, in its unit, of as many standard deviations as the tolerances are to be.
        costs: c > 0 of the inputs, by name or shape (n,); None: as the stack's own tolerances, so that the same
            relative change of each of them costs the same.
        largest: bounds of t from above, by name or shape (n,); None: 100 times the stack's own.

    Returns t by input. Raises `ValueError` for unknown outputs, bands or costs that are not positive, and without any
    input to choose.
    """
    from scipy.optimize import minimize  # takes its time to import

    for name in bands:
        if name not in stack.outputs:
            raise ValueError(f"`bands`: {suggestion(name, stack.outputs)}, the outputs.")
    own = np.asarray(stack.tolerances, float)
    chosen = own > 0.0
    if not bands or not chosen.any():
        raise ValueError("`bands` is empty, or all tolerances of the stack are 0; there is nothing to allocate.")
    b = np.asarray([float(bands[name]) for name in bands])
    c = own if costs is None else _of_inputs("costs", costs, stack)
    most = 100.0 * own if largest is None else _of_inputs("largest", largest, stack)
    for name, numbers in (("bands", b), ("costs", c[chosen]), ("largest", most[chosen])):
        if not np.all(numbers > 0.0):
            raise ValueError(f"`{name}` must be positive, got {numbers}.")
    rows = [stack.outputs.index(name) for name in bands]
    # in units of the stack's own tolerances, and of bands
    scaled = (np.asarray(stack.jacobian)[rows][:, chosen] * own[chosen] / b[:, None]) ** 2
    scaled = scaled[np.any(scaled > 0.0, axis=1)]
    weights = c[chosen] / own[chosen]
    weights = weights / weights.sum()
    squares = lambda z: scaled * np.exp(2.0 * z)[None]
    room = lambda z: -0.5 * np.log(np.sum(squares(z), axis=1))
    slope = lambda z: -squares(z) / np.sum(squares(z), axis=1, keepdims=True)
    start = np.full(chosen.sum(), np.min(room(np.zeros(chosen.sum())), initial=0.0))
    found = minimize(
        lambda z: (np.sum(weights * np.exp(-z)), -weights * np.exp(-z)),
        start,
        jac=True,
        method="SLSQP",
        bounds=[(None, bound) for bound in np.log(most[chosen] / own[chosen])],
        constraints={"type": "ineq", "fun": room, "jac": slope},
        options={"maxiter": 1000, "ftol": 1e-14},
    )
    if not found.success:
        raise ValueError(f"No allocation was found ({found.message}); bands far apart in scale may need other `costs`.")
    t = np.zeros_like(own)
    t[chosen] = own[chosen] * np.exp(found.x)
    return dict(zip(stack.inputs, t.tolist()))


def _of_inputs(argument: str, given: Any, stack: ToleranceStack) -> np.ndarray:
    """A number for each input; of those that are given by name, for each of them that has a tolerance."""
    if isinstance(given, Mapping):
        chosen = {name for name, tolerance in zip(stack.inputs, np.asarray(stack.tolerances)) if tolerance > 0}
        if wrong := sorted(set(given) - set(stack.inputs)) + sorted(chosen - set(given)):
            raise ValueError(f"`{argument}` must name the inputs that have a tolerance, {sorted(chosen)}; see {wrong}.")
        given = [given.get(name, 1.0) for name in stack.inputs]
    return np.broadcast_to(np.asarray(given, float), (len(stack.inputs),))
