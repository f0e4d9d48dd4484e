"""Without 64-bit floats: gradients of both modes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lgsens as lg
from lgsens.examples import PROBLEMS

SINGLE = float(np.finfo(np.float32).eps)
TOP = "spinning_top_brulls.l_1.0_reproduces_published_number"


def slopes(name: str, num_steps: int, mode) -> np.ndarray:
    """p dΨ/dp of all criteria, rows, and all parameters, relative to the largest of each row."""
    problem = PROBLEMS[name]
    parameters = {key: jnp.asarray(value, dtype=float) for key, value in problem.parameters.items()}
    psi = lambda p: problem.evaluate(problem.simulate(p, num_steps=num_steps), p)
    found = jax.jit(mode(psi))(parameters)
    rows = np.array([[own[key] * value for key, value in problem.parameters.items()] for own in found.values()])
    assert all(leaf.dtype == jnp.zeros(()).dtype for leaf in jax.tree.leaves(found))
    return rows / np.abs(rows).max(axis=1, keepdims=True)


def test_gradients_warn():
    criterion = lg.Criterion(terminal=lambda s, p: s.body("mass").position[2])
    build = lambda mass: lg.Model({"mass": lg.RigidBody(mass, None)}, {}, {"gravity": lg.Gravity((0.0, 0.0, -9.81))})
    with jax.enable_x64(False), pytest.warns(UserWarning, match="single precision.*jax_enable_x64"):
        lg.differentiate(criterion, build, 2.0, t1=0.1, num_steps=4)
    refused = lambda mass: 1 / 0  # the warning is before all work
    with jax.enable_x64(False), pytest.warns(UserWarning, match="single precision"), pytest.raises(ZeroDivisionError):
        lg.certify(criterion, refused, 2.0, t1=0.1, num_steps=8)


@pytest.mark.filterwarnings("ignore:lgsens runs in single precision")
@pytest.mark.slow
def test_gradients_of_the_top():
    num_steps = 20
    expected = slopes(TOP, num_steps, jax.jacrev)
    with jax.enable_x64(False):
        for mode in (jax.jacrev, jax.jacfwd):
            difference = np.abs(slopes(TOP, num_steps, mode) - expected).max(axis=1)
            # a step is solved to 64 round-offs; the sensitivities themselves add ten
            assert (difference > 0.0).all()
            assert (difference < num_steps * 64 * SINGLE).all()
