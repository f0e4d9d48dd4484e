"""`simulate(…, save=…)`: the same values and derivatives as of the trajectory, without the trajectory."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import says

import lgsens as lg
from lgsens.examples import spinning_top

SETTINGS = {"t1": 0.2, "num_steps": 37}  # not a multiple of a block or of `factor_every`


def asked(s):
    return {"side": s.body("top").position[0], "force": s.multiplier("pivot"), "time": s.t}


def of_trajectory(alpha, **settings):
    trajectory = lg.simulate(spinning_top(alpha), **(SETTINGS | settings))
    return {
        "side": trajectory.body("top").position[:, 0],
        "force": trajectory.multiplier("pivot"),
        "time": trajectory.t,
    }


def saved(alpha, **settings):
    return lg.simulate(spinning_top(alpha), save=asked, **(SETTINGS | settings))


def same(found, wanted):
    # the same operations in another program: round-off, which multipliers carry as eps/(βh²) = 4e-11 of 300 N
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max()), found, wanted)


def test_values_and_final_state():
    run, trajectory = saved(0.7), lg.simulate(spinning_top(0.7), **SETTINGS)
    same(run.values, of_trajectory(0.7))
    same(run.final, trajectory.state(-1))
    np.testing.assert_array_equal(run.t, trajectory.t)
    assert run.result == lg.RESULTS.successful and run.stats.converged.shape == (37,)


@pytest.mark.parametrize(
    "derivative", [pytest.param(jax.jacfwd, marks=pytest.mark.slow), jax.jacrev], ids=["forward", "reverse"]
)
def test_derivatives(derivative):
    both = jax.jit(lambda alpha: [derivative(of)(alpha) for of in (lambda alpha: saved(alpha).values, of_trajectory)])
    same(*both(0.7))


@pytest.mark.slow  # as reverse mode above
def test_adjoint_variable_method():
    total = lambda values: jnp.sum(values["side"] ** 2) + jnp.sum(values["force"])
    method = {"sensitivity": lg.AdjointVariable()}
    found = jax.grad(lambda alpha: total(saved(alpha, **method).values))(0.7)
    np.testing.assert_allclose(found, jax.grad(lambda alpha: total(of_trajectory(alpha)))(0.7), rtol=1e-9)


class Weighted(eqx.Module):
    weights: jax.Array

    def __call__(self, s):
        return self.weights @ s.body("top").position


def weighted(save, **settings):
    """An output that depends on a number in the model and in itself; and of the trajectory."""

    def of(a):
        run = lg.simulate(spinning_top(0.1 * a), save=save(a), **(SETTINGS | settings))
        return run.values[-1]

    def expected(a):
        trajectory = lg.simulate(spinning_top(0.1 * a), **SETTINGS)
        return jnp.array([a, a**2, 3.0]) @ trajectory.body("top").position[-1]

    return of, expected


def in_a_closure(a):
    return lambda s: jnp.array([a, a**2, 3.0]) @ s.body("top").position


def in_a_module(a):
    return Weighted(jnp.array([a, a**2, 3.0]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("save", "derivative"),
    [
        (in_a_closure, lambda f: jax.jit(jax.grad(f))),
        (in_a_closure, jax.grad),
        (in_a_closure, jax.jacfwd),
        (in_a_module, lambda f: jax.jit(jax.jacfwd(f))),
        (in_a_module, jax.grad),
        (in_a_closure, lambda f: lambda a: jax.vmap(jax.grad(f))(a[None])[0]),
    ],
)
def test_traced_numbers_in_what_is_asked_have_derivatives(save, derivative):
    of, expected = weighted(save)
    np.testing.assert_allclose(
        derivative(of)(jnp.asarray(7.0)), jax.jit(jax.grad(expected))(7.0), rtol=1e-9
    )  # two programs


def test_traced_numbers_in_what_is_asked_are_refused_with_checkpoints():
    of, _ = weighted(in_a_closure, sensitivity=lg.DirectDifferentiation(checkpoints="sqrt"))
    with pytest.raises(ValueError, match=says("`save` depends on numbers", "`checkpoints`", "Give them to the model")):
        jax.grad(of)(7.0)


def memory(num_steps):
    """Of a batch of 8 runs, of which one number a step is asked [bytes]."""
    side = lambda s: s.body("top").position[0]
    run = lambda alpha: lg.simulate(spinning_top(alpha), t1=0.2, num_steps=num_steps, save=side, throw=False).values
    compiled = jax.jit(jax.vmap(run)).lower(jnp.linspace(0.5, 1.0, 8)).compile()
    return compiled.memory_analysis().temp_size_in_bytes


def test_batch_stores_no_states():
    """What is asked is one number a step; a trajectory of which the program wants one leaves it three."""
    assert memory(2000) < 8 * 2000 * 2 * 8  # lanes × steps × 2 numbers of 8 bytes


@pytest.mark.slow  # two programs; small version: test_batch_stores_no_states
def test_batch_stores_what_was_asked():
    """In a batch the memory of a run is that of its outputs and statistics, not of its states."""
    assert memory(2000) - memory(1000) <= 8 * 1000 * 8 * 8  # lanes × steps × 8 numbers of 8 bytes


def test_failure_is_said_and_data_end():
    impatient = lg.GeneralizedAlpha(max_iterations=1, factor_every=0)
    long_steps = {"t1": 40.0, "integrator": impatient}
    with pytest.raises(lg.SimulationError, match=says("did not converge", "step")):
        saved(0.7, **long_steps)
    run = saved(0.7, throw=False, **long_steps)
    first = int(jnp.argmin(run.stats.converged))
    assert run.result == lg.RESULTS.newton_failed
    assert np.all(np.isfinite(run.values["side"][: first + 1])) and np.all(np.isnan(run.values["side"][first + 1 :]))


def test_one_compilation_for_one_function():
    traces = []

    def counted(s):
        traces.append(s)
        return s.t

    for alpha in (0.6, 0.7):
        lg.simulate(spinning_top(alpha), save=counted, **SETTINGS)
    count = len(traces)
    lg.simulate(spinning_top(0.8), save=counted, **SETTINGS)
    assert len(traces) == count


def test_bad_input():
    with pytest.raises(ValueError, match=says("`save` must be a function", "'side'", "Leave it out")):
        lg.simulate(spinning_top(0.7), **(SETTINGS | {"save": "side"}))
    with pytest.raises(ValueError, match=says("`save` must return numbers and arrays", "got 'x'")):
        lg.simulate(spinning_top(0.7), **(SETTINGS | {"save": lambda s: {"name": "x"}}))
