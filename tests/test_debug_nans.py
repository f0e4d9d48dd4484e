"""Runs and gradients under `jax_debug_nans`, as people search for a NaN of their own: lgsens has none on the way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import some_quick

import lgsens as lg
from lgsens.examples import spinning_top

RUNS = {
    "direct": {"integrator": lg.GeneralizedAlpha(0.9)},
    "adjoint": {"integrator": lg.GeneralizedAlpha(0.9), "sensitivity": lg.AdjointVariable()},
    "stabilized": {"integrator": lg.GeneralizedAlpha(0.9, stabilized=True)},
    "radau": {"integrator": lg.RadauIIA()},
}


@pytest.mark.parametrize("name", some_quick(RUNS))
def test_no_nan_on_the_way(name):
    def last_height(mass):
        run = lg.simulate(spinning_top(jnp.asarray(0.7), mass=mass), t1=0.02, num_steps=4, **RUNS[name])
        return run.body("top").position[-1, 2]

    with jax.debug_nans(True):
        value, slope = jax.jit(jax.value_and_grad(last_height))(jnp.asarray(15.0))
    assert np.isfinite([value, slope]).all()
