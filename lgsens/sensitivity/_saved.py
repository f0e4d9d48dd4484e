"""A run that keeps what was asked of each state, and no state.

The scan of the integrator stacks the outputs of a function of the state instead of the states themselves, so that a
batch of designs does not stack whole trajectories. Derivatives need the states (`_methods.py`), so the rule makes the
trajectory and takes the same function of it: the values are the same, and so is what is differentiated.
"""

from functools import partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lgsens.dynamics import State
from lgsens.integrate import AbstractScheme, Stats, march
from lgsens.linear import LinearEquations, linear_solve
from lgsens.sensitivity._failed import Sound
from lgsens.sensitivity._linearization import Parameters
from lgsens.sensitivity._methods import AbstractSensitivity, AdjointVariable, DirectDifferentiation
from lgsens.sensitivity._rules import decoded, encoded
from lgsens.sensitivity._segments import (
    Output,
    Segments,
    adjoint_in_segments,
    direct_in_segments,
    run_in_segments,
)


class SavedRun(NamedTuple):
    """The outputs, stacked along a leading axis n + 1, the final state, and Newton's statistics."""

    outputs: Any
    final: State
    stats: Stats


class _Shown(eqx.Module):
    """An output of physical states as one of the scheme's; equal, for one compilation, where both are."""

    output: Output = eqx.field(static=True)
    scheme: AbstractScheme = eqx.field(static=True)

    def __call__(self, system, state: State, t, numbers: Any = None):
        """`numbers`: those of the output."""
        output = self.output if numbers is None else eqx.combine(numbers, self.output)
        return output(system, self.scheme.physical(system, state), t)


def saved_run(
    method: AbstractSensitivity, output: Output, scheme: AbstractScheme, state0: State, parameters: Parameters
) -> SavedRun:
    """`output(system, state, t)` at all times of the grid; arrays that it holds are differentiated like parameters.

    The default method does without the states where nothing is differentiated, those with `checkpoints` always. The
    latter raise `ValueError` for an output with arrays.
    """
    numbers, fixed = eqx.partition(output, eqx.is_array)
    shown = _Shown(fixed, scheme)
    if isinstance(method, DirectDifferentiation | AdjointVariable) and method.checkpoints is not None:
        if jax.tree.leaves(numbers):
            raise ValueError(
                "`save` depends on numbers that are traced besides those of the instant, which `checkpoints` do not "
                "differentiate. Give them to the model, use them on what `save` returns, or leave `checkpoints` out."
            )
        segments = Segments.of(parameters.grid.num_steps, method.checkpoints)
        rule = _direct_segments if isinstance(method, DirectDifferentiation) else _adjoint_segments
        run, _ = cast(tuple[SavedRun, Any], rule(shown, scheme, segments, state0, parameters))
    elif method == DirectDifferentiation():
        run = _saved(shown, scheme, numbers, state0, parameters)
    else:
        return _from_states(method, shown, scheme, numbers, state0, parameters)
    return run._replace(stats=decoded(run.stats))


def _from_states(
    method: AbstractSensitivity, output: Output, scheme, numbers: Any, state0, parameters: Parameters
) -> SavedRun:
    states, stats = method.trajectory(scheme, state0, parameters)
    sound = Sound.of(states, parameters.system)
    at = lambda state, t: output(parameters.system, state, t, numbers)
    asked, others = eqx.partition(jax.vmap(at)(sound.states, parameters.grid.times()), eqx.is_inexact_array)
    outputs = eqx.combine(sound.lost(asked), others)
    return SavedRun(outputs, jax.tree.map(lambda leaf: leaf[-1], states), stats)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _saved(output, scheme, numbers, state0, parameters) -> SavedRun:
    system, grid = parameters
    outputs, final, stats = march(scheme, system, grid, state0, lambda state, t: output(system, state, t, numbers))
    return SavedRun(outputs, final, encoded(stats, final.v.dtype))


@_saved.defjvp
def _rule(output, scheme, primals, tangents):
    def whole(*given):
        run = _from_states(DirectDifferentiation(), output, scheme, *given)
        return run._replace(stats=encoded(run.stats, run.final.v.dtype))

    return jax.jvp(whole, primals, tangents)


# With checkpoints the linear map from the tangents x of (state0, parameters) to those y of outputs and final state,
# y = A x, is the solution of [[I, 0], [−A, I]] [x; y] = [b; 0]: so `linear_solve` again carries both sweeps, and
# takes second derivatives of A by the rule above, which keeps all states.


def _segmented(output, scheme, segments: Segments, state0, parameters) -> tuple[SavedRun, Any]:
    outputs, final, stats, marks = run_in_segments(output, scheme, segments, state0, parameters)
    return SavedRun(outputs, final, encoded(stats, final.v.dtype)), marks


def _without_derivative(tree):
    """Zero tangents, of the type that JAX asks for."""

    def zero(leaf):
        inexact = jnp.issubdtype(leaf.dtype, jnp.inexact)
        return jnp.zeros_like(leaf) if inexact else np.zeros(leaf.shape, jax.dtypes.float0)

    return jax.tree.map(zero, tree)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1, 2))
def _direct_segments(output, scheme, segments, state0, parameters) -> tuple[SavedRun, Any]:
    return _segmented(output, scheme, segments, state0, parameters)


class _Kept(eqx.Module):
    """The equations for (x, y), and what of a run solves them."""

    output: Any = eqx.field(static=True)
    scheme: Any = eqx.field(static=True)
    segments: Segments = eqx.field(static=True)
    marks: Any
    final: State
    primals: Any

    def product(self, unknown):
        x, y = unknown

        def whole(state0, parameters):
            found = _saved(self.output, self.scheme, None, state0, parameters)
            return eqx.filter((found.outputs, found.final), eqx.is_inexact_array)

        return x, jax.tree.map(jnp.subtract, y, jax.jvp(whole, self.primals, x)[1])

    def solve(self, rhs):
        b, y = rhs
        run = self.output, self.scheme, self.segments
        return b, jax.tree.map(jnp.add, y, direct_in_segments(*run, self.marks, self.primals[1], b))

    def transposed(self, rhs):
        c, bar = rhs
        run = self.output, self.scheme, self.segments
        found = adjoint_in_segments(*run, self.marks, self.final, self.primals[1], bar)
        return jax.tree.map(jnp.add, c, found), bar


_IN_SEGMENTS = LinearEquations(_Kept.product, _Kept.solve, _Kept.transposed)


@_direct_segments.defjvp
def _direct_segments_rule(output, scheme, segments, primals, tangents):
    run, marks = _direct_segments(output, scheme, segments, *primals)
    floats = eqx.filter((run.outputs, run.final), eqx.is_inexact_array)
    kept = _Kept(output, scheme, segments, *lax.stop_gradient((marks, run.final)), primals)
    _, found = linear_solve(_IN_SEGMENTS, kept, (tangents, jax.tree.map(jnp.zeros_like, floats)))
    d_outputs, d_final = eqx.combine(found, _without_derivative((run.outputs, run.final)))
    return (run, marks), (SavedRun(d_outputs, d_final, _without_derivative(run.stats)), _without_derivative(marks))


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _adjoint_segments(output, scheme, segments, state0, parameters) -> tuple[SavedRun, Any]:
    return _segmented(output, scheme, segments, state0, parameters)


def _adjoint_segments_forward(output, scheme, segments, state0, parameters):
    run, marks = _segmented(output, scheme, segments, state0, parameters)
    return (run, marks), (marks, run.final, parameters)


def _adjoint_segments_backward(output, scheme, segments, kept, cotangents):
    marks, final, parameters = kept
    run, _ = cotangents
    floats = eqx.filter((run.outputs, run.final), lambda leaf: leaf.dtype != jax.dtypes.float0)
    return adjoint_in_segments(output, scheme, segments, marks, final, parameters, floats)


_adjoint_segments.defvjp(_adjoint_segments_forward, _adjoint_segments_backward)
