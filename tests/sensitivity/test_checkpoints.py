"""`checkpoints`: the derivative from the states of some steps, the others integrated again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg
from lgsens.examples import spinning_top
from lgsens.integrate import EqualGrid, Walk, first_mark, march_on, states_of
from lgsens.sensitivity import AbstractSensitivity
from lgsens.sensitivity._segments import Segments

DIRECT, ADJOINT = lg.DirectDifferentiation, lg.AdjointVariable
SCHEME = lg.GeneralizedAlpha()


def asked(s):
    """Floats of every kind of state, the time, and what is no float."""
    top = s.body("top")
    floats = {"side": top.position[0], "push": top.acceleration, "force": s.multiplier("pivot"), "t": s.t}
    return floats | {"n": jnp.ones(2, int)}


def psi(parameters, method: AbstractSensitivity, num_steps=67):
    """A criterion of all outputs and of the final state, by a number of the scene, the end and the first state."""
    alpha, t1, faster = parameters
    model = spinning_top(alpha)
    state0 = lg.initial_state(model, throw=False)
    state0 = lg.State(state0.q, state0.v * faster, state0.vdot, state0.lam, state0.a)
    run = lg.simulate(
        model, t0=0.01 * t1, t1=t1, num_steps=num_steps, save=asked, sensitivity=method, state0=state0, throw=False
    )
    values, final = run.values, run.final
    running = jnp.mean(values["side"] ** 2 * values["t"] + 1e-3 * values["push"][:, 1] + 1e-4 * values["force"][:, 2])
    return running + values["push"][0, 0] + final.v[0] + final.q.position[0, 1]


PARAMETERS = (jnp.asarray(0.7), jnp.asarray(0.2), jnp.asarray(1.0))


@pytest.fixture(scope="module")
def all_states():
    return jax.jit(jax.value_and_grad(lambda p: psi(p, DIRECT())))(PARAMETERS)


@pytest.mark.slow  # segments are those of the long run, below
@pytest.mark.parametrize(
    "method",
    [pytest.param(DIRECT(checkpoints="sqrt"), marks=pytest.mark.slow), ADJOINT(checkpoints=2)],
    ids=str,
)
def test_reverse_mode(method, all_states):
    """67 steps fill neither segments of 9 and 34 steps nor the blocks of the sweeps."""
    value, gradient = jax.jit(jax.value_and_grad(lambda p: psi(p, method)))(PARAMETERS)
    np.testing.assert_allclose(value, all_states[0], rtol=1e-10)
    # accelerations and multipliers carry a round-off of 1e-16/(βh²) = 4e-11, of which Ψ takes a hundredth
    np.testing.assert_allclose(gradient, all_states[1], rtol=1e-8)
    assert min(abs(float(g)) for g in gradient) > 1e-3


@pytest.mark.slow
def test_forward_mode(all_states):
    gradient = jax.jit(jax.jacfwd(lambda p: psi(p, DIRECT(checkpoints="sqrt"))))(PARAMETERS)
    np.testing.assert_allclose(gradient, all_states[1], rtol=1e-8)


@pytest.mark.slow
def test_second_derivatives_and_batches():
    """Second derivatives keep all states, and are those of the run that does; `vmap` of gradients."""
    scalar = lambda alpha, method: psi((alpha, *PARAMETERS[1:]), method, num_steps=25)
    found, expected = (
        jax.jit(jax.vmap(jax.hessian(lambda a, m=method: scalar(a, m))))(jnp.array([0.6, 0.7]))
        for method in (DIRECT(checkpoints=1), DIRECT())
    )
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    for method in (DIRECT(checkpoints=1), ADJOINT(checkpoints=1)):
        slopes = jax.jit(jax.vmap(jax.grad(lambda a, m=method: scalar(a, m))))(jnp.array([0.6, 0.7]))
        single = jax.jit(jax.grad(lambda a, m=method: scalar(a, m)))(jnp.asarray(0.6))
        np.testing.assert_allclose(slopes[0], single, rtol=1e-8)


def test_segments_are_the_long_run():
    """Integrated on from its marks, a run repeats its states to the last bit; it is the long run to round-off."""
    system = spinning_top(0.7).system()
    grid = EqualGrid(jnp.zeros(()), jnp.asarray(5e-3), 80)
    parts = Segments(80, 40).grids(grid)
    first, second = (jax.tree.map(lambda leaf, i=i: leaf[i], parts) for i in range(2))
    walk = Walk.of(SCHEME, system)

    @jax.jit
    def onward(grid, mark):
        return march_on(walk, grid, mark, lambda s, _: s)

    begin = first_mark(walk, grid, lg.initial_state(system))
    _, mark, _ = onward(first, begin)
    rows, end, counts = onward(second, mark)
    again, _, _ = onward(second, mark)
    jax.tree.map(np.testing.assert_array_equal, again, rows)
    assert float(end.n) == 80.0
    whole, _ = jax.jit(lambda s: states_of(SCHEME, system, grid, s))(lg.initial_state(system))
    np.testing.assert_allclose(rows.q.position, whole.q.position[41:], rtol=0, atol=1e-13)  # round-off of 80 steps
    # A mark is more than a state: from another guess the iteration of the first step takes longer.
    anew = mark.progress._replace(memory=begin.progress.memory)
    _, _, slower = onward(second, mark._replace(progress=anew))
    assert slower.iterations[0] > counts.iterations[0]


@pytest.mark.parametrize(
    ("num_steps", "checkpoints", "expected"),
    [(1000, "sqrt", (32, 32)), (10000, "sqrt", (100, 100)), (1000, 10, (100, 10)), (7, 100, (1, 7))],
)
def test_division(num_steps, checkpoints, expected):
    segments = Segments.of(num_steps, checkpoints)
    assert (segments.length, segments.count) == expected
    assert 0 <= segments.count * segments.length - num_steps < segments.length


@pytest.mark.parametrize("kind", [DIRECT, ADJOINT])
@pytest.mark.slow
def test_memory_grows_as_the_root(kind):
    """What a longer run adds: its outputs and their cotangents, 8 bytes each per step, and √n states."""
    side = lambda s: s.body("top").position[0] ** 2

    def memory(num_steps, method):
        total = lambda alpha: jnp.sum(
            lg.simulate(
                spinning_top(alpha), t1=1.0, num_steps=num_steps, save=side, sensitivity=method, throw=False
            ).values
        )
        return jax.jit(jax.grad(total)).lower(0.7).compile().memory_analysis().temp_size_in_bytes

    short, long = (memory(n, kind(checkpoints="sqrt")) for n in (6400, 25600))
    everything = memory(25600, kind())
    state = 8 * (12 + 6 * 3 + 3)  # position, orientation, v, v̇, a, λ
    assert everything > 25600 * state
    # twice as many marks (a state, two accelerations and multipliers more) and twice the segment, in a few copies
    assert long - short < 80 * 8 * state + (25600 - 6400) * 8 * 4
    assert long < everything / 5


def test_what_has_no_checkpoints():
    """A trajectory keeps its states; other values are refused."""
    for method in (DIRECT(checkpoints=3), ADJOINT(checkpoints="sqrt")):
        with pytest.raises(ValueError, match=says(type(method).__name__, "`simulate(…, save=…)`", "Ask")):
            lg.simulate(spinning_top(0.7), t1=0.2, num_steps=10, sensitivity=method)
    for bad in (0, -1, 2.5, "root", True):
        with pytest.raises(ValueError, match=says("`checkpoints` must be None, 'sqrt' or a number", repr(bad))):
            ADJOINT(checkpoints=bad)
    assert DIRECT(checkpoints=3) == DIRECT(checkpoints=3) != DIRECT()
