"""Two-level checkpointing: a run in segments, of which only the beginnings are kept.

The sweeps of the sensitivities need the states of all n steps. A run that keeps the mark at every s-th state (`Mark`:
what the integrator needs to go on from there) has the n/s segments between them integrated again, one at a time, when a
sweep comes to them: n/s + s states at a time instead of n, least for s = √n, for one more integration.

Segments are whole multiples of `factor_every`, so the steps of the second integration are those of the first one. A
segment that begins at step n₀ starts at t₀ + n₀ h: with p̄ of its sweep, the long run receives t̄₀ and h̄ + n₀ t̄₀. The
steps after the last one, which fill its segment, are replaced by its state, with no cotangent.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from lgsens.dynamics import State
from lgsens.integrate import GeneralizedAlpha, Mark, Stats, integrate_onward
from lgsens.sensitivity._adjoint import adjoint_sweep
from lgsens.sensitivity._blocks import padded
from lgsens.sensitivity._direct import direct_sweep
from lgsens.sensitivity._linearization import (
    Parameters,
    Variation,
    cotangent_to_algebra,
    cotangent_to_ambient,
    to_algebra,
    to_ambient,
    zeros_like_trajectory,
)

Output = Callable[..., Any]  # (system, state, t) ↦ pytree


class Segments(NamedTuple):
    """How `num_steps` steps are divided: `count` segments of `length`."""

    num_steps: int
    length: int

    @classmethod
    def of(cls, scheme: GeneralizedAlpha, num_steps: int, checkpoints: str | int) -> "Segments":
        """At most `checkpoints` segments; "sqrt": about √n."""
        length = math.isqrt(num_steps - 1) + 1 if checkpoints == "sqrt" else -(-num_steps // int(checkpoints))
        unit = max(1, scheme.factor_every)
        return cls(num_steps, -(-length // unit) * unit)

    @property
    def count(self) -> int:
        return -(-self.num_steps // self.length)

    @property
    def filling(self) -> int:
        return self.count * self.length - self.num_steps

    def split(self, rows: Any) -> Any:
        """Rows of steps 1 … n by segment; zeros after the last one."""
        shape = lambda leaf: leaf.reshape(self.count, self.length, *leaf.shape[1:])
        return jax.tree.map(shape, padded(rows, self.filling, repeat=False))

    def joined(self, rows: Any) -> Any:
        """The rows of steps 1 … n."""
        flat = lambda leaf: leaf.reshape(self.count * self.length, *leaf.shape[2:])[: self.num_steps]
        return jax.tree.map(flat, rows)


class _Segment(NamedTuple):
    """The states at n₀, n₀ + 1, …; the last one that is not filling; the `Parameters` of a run that begins there."""

    states: State
    last: Int[Array, ""]
    parameters: Parameters

    @property
    def later(self) -> State:
        return jax.tree.map(lambda leaf: leaf[1:], self.states)


def _integrated(scheme, segments: Segments, parameters: Parameters, mark: Mark) -> tuple[_Segment, Mark, Stats]:
    system, t0, h = parameters
    states, end, stats = integrate_onward(scheme, segments.length, system, mark, t0, h, lambda state, _: state)
    last = jnp.minimum(segments.num_steps - mark.n.astype(int), segments.length)
    rows = jnp.minimum(jnp.arange(segments.length + 1), last)
    states = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest])[rows], mark.state, states)
    return _Segment(states, last, Parameters(system, t0 + mark.n * h, h)), end, stats


def _times(segments: Segments, n, t0, h):
    """t after each step of a segment that begins at step n."""
    return t0 + (n + jnp.arange(1, segments.length + 1, dtype=h.dtype)) * h


def run_in_segments(output: Output, scheme, segments: Segments, state0: State, parameters: Parameters):
    """Outputs of all states, the final state, Newton's statistics; and the marks, stacked."""
    system, t0, h = parameters

    def segment(mark: Mark, _):
        found, end, stats = _integrated(scheme, segments, parameters, mark)
        outputs = jax.vmap(partial(output, system))(found.later, _times(segments, mark.n, t0, h))
        return end, (mark, outputs, stats, jax.tree.map(lambda leaf: leaf[found.last], found.states))

    _, (marks, outputs, stats, ends) = lax.scan(segment, Mark.first(state0), length=segments.count)
    first = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], output(system, state0, t0))
    outputs = jax.tree.map(lambda first, later: jnp.concatenate([first, later]), first, segments.joined(outputs))
    return outputs, jax.tree.map(lambda leaf: leaf[-1], ends), segments.joined(stats), marks


def _differentiable(output: Output) -> Output:
    """The outputs that are floats."""
    return lambda system, state, t: eqx.filter(output(system, state, t), eqx.is_inexact_array)


def direct_in_segments(output: Output, scheme, segments: Segments, marks: Mark, parameters: Parameters, tangents):
    """Tangents of the outputs and of the final state from those of (state0, parameters): `direct_sweep`, by segment."""
    d_state0, d = tangents
    output, group = _differentiable(output), parameters.system.group
    state0 = jax.tree.map(lambda leaf: leaf[0], marks.state)

    def segment(delta: Variation, mark: Mark):
        found, _, _ = _integrated(scheme, segments, parameters, mark)
        b = jax.tree.map(lambda zeros, leaf: zeros.at[0].set(leaf), zeros_like_trajectory(found.states), delta)
        begin = Parameters(d.system, d.t0 + mark.n * d.h, d.h)
        deltas, _ = direct_sweep(scheme, found.states, found.parameters, b, begin)
        d_states = jax.vmap(partial(to_ambient, group))(found.states, deltas)
        later = jax.tree.map(lambda leaf: leaf[1:], d_states)

        def all_outputs(system, states, t0, h):
            return jax.vmap(partial(output, system))(states, _times(segments, mark.n, t0, h))

        _, d_outputs = jax.jvp(
            all_outputs, (parameters.system, found.later, *parameters[1:]), (d.system, later, *d[1:])
        )
        ends = jax.tree.map(lambda leaf: leaf[found.last], (deltas, d_states))
        return ends[0], (d_outputs, ends[1])

    delta0 = to_algebra(group, state0, d_state0)
    _, (d_outputs, ends) = lax.scan(segment, delta0, marks)
    d_state0 = to_ambient(group, state0, delta0)
    _, first = jax.jvp(output, (parameters.system, state0, parameters.t0), (d.system, d_state0, d.t0))
    d_outputs = jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), first, segments.joined(d_outputs))
    return d_outputs, jax.tree.map(lambda leaf: leaf[-1], ends)


def adjoint_in_segments(output: Output, scheme, segments: Segments, marks: Mark, final: State, parameters, cotangents):
    """Cotangents of (state0, parameters) from those of outputs and of the final state: `adjoint_sweep`, by segment."""
    c_outputs, c_final = cotangents
    output, group = _differentiable(output), parameters.system.group
    state0 = jax.tree.map(lambda leaf: leaf[0], marks.state)
    zero = jax.tree.map(jnp.zeros_like, parameters)
    first, later = (jax.tree.map(lambda leaf, part=part: leaf[part], c_outputs) for part in (0, slice(1, None)))

    def segment(carry, inputs):
        c, bar = carry
        mark, c_outputs = inputs
        found, _, _ = _integrated(scheme, segments, parameters, mark)

        def all_outputs(system, states, t0, h):
            return jax.vmap(partial(output, system))(states, _times(segments, mark.n, t0, h))

        _, pull_back = jax.vjp(all_outputs, parameters.system, found.later, *parameters[1:])
        of_system, of_states, *of_times = pull_back(c_outputs)
        rows = jax.vmap(partial(cotangent_to_algebra, group))(found.later, of_states)
        after_first = lambda row: jnp.concatenate([jnp.zeros_like(row[:1]), row])
        rows = jax.tree.map(lambda row, c: after_first(row).at[found.last].add(c), rows, c)
        mu, own = adjoint_sweep(scheme, found.states, found.parameters, rows, zero)
        own = own._replace(h=own.h + mark.n * own.t0)
        bar = jax.tree.map(lambda *terms: sum(terms), bar, own, Parameters(of_system, *of_times))
        return (jax.tree.map(lambda leaf: leaf[0], mu), bar), None

    start = (cotangent_to_algebra(group, final, c_final), zero)
    (c, bar), _ = lax.scan(segment, start, (marks, segments.split(later)), reverse=True)
    _, pull_back = jax.vjp(output, parameters.system, state0, parameters.t0)
    of_system, of_state0, of_t0 = pull_back(first)
    c = jax.tree.map(jnp.add, c, cotangent_to_algebra(group, state0, of_state0))
    bar = jax.tree.map(jnp.add, bar, Parameters(of_system, of_t0, jnp.zeros_like(bar.h)))
    return cotangent_to_ambient(group, state0, c), bar
