"""`one_by_one`: the same numbers, without a batched call of LAPACK; and two devices that do not wait for each other."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import equations
from jax import lax

from lgsens.linear import LinearEquations, linear_solve
from lgsens.sweeps._one_by_one import one_by_one

SPECIAL = LinearEquations(lambda c, x: c @ x, jnp.linalg.solve)


@jax.custom_jvp
def doubled(x):
    return 2.0 * x


doubled.defjvp(lambda primals, tangents: (doubled(*primals), 2.0 * tangents[0]))


def solved(a, b):
    return jnp.linalg.solve(a, b)


def rest(a, b):
    """Loops whose turns differ between designs, branches, rules of their own, a scatter with a function inside."""
    a = a @ a.T + jnp.eye(3)

    def turn(carry):
        count, x = carry
        return count + 1, jnp.linalg.solve(a, x)

    # the norm falls by the least eigenvalue, at least 1, in each turn
    count, x = lax.while_loop(lambda carry: (jnp.linalg.norm(carry[1]) > 0.1) & (carry[0] < 20), turn, (0, b))
    _, rows = lax.scan(lambda x, _: (jnp.linalg.cholesky(a) @ x, x[0]), x, None, length=3)
    chosen = lax.cond(count > 3, lambda x: jnp.linalg.qr(a)[1] @ x, lambda x: x, x)
    again = jax.checkpoint(lambda x: jnp.linalg.solve(a, x))(doubled(chosen))
    found = linear_solve(SPECIAL, a, again)
    return count, rows, jnp.zeros(4).at[jnp.array([0, 0, 3])].add(found)


@pytest.mark.parametrize("function", [solved, rest])
def test_same_numbers_one_matrix_at_a_time(function):
    rng = np.random.default_rng(0)
    a, b = jnp.asarray(rng.normal(size=(5, 3, 3))), jnp.asarray(rng.normal(scale=4.0, size=(5, 3)))
    batched = jax.vmap(function)
    program = jax.make_jaxpr(batched)(a, b)
    alone = jax.make_jaxpr(one_by_one(program))(a, b)
    expected, found = jax.tree.leaves(batched(a, b)), one_by_one(program)(a, b)
    for one, other in zip(expected, found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13)  # round-off × condition of 3 × 3 matrices, about 1e2
    largest = lambda program: max(
        (place.aval.ndim for equation in equations(program.jaxpr) for place in equation.invars if factorizes(equation)),
    )
    assert (largest(program), largest(alone)) == (3, 2)


def factorizes(equation) -> bool:
    return equation.primitive.name in ("lu", "triangular_solve", "cholesky", "geqrf", "householder_product")


TWO_DEVICES = """
import jax, numpy as np
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
import equinox as eqx, lgsens as lg
from lgsens.examples import QuarterCar

def criterion(damping):
    car = eqx.tree_at(lambda car: car.damper.rate, QuarterCar.load(), damping)
    trajectory = lg.simulate(car.model(), t1=0.05, num_steps=50)
    return lg.time_integral(trajectory.t, trajectory.body("chassis").acceleration[:, 2] ** 2)

designs = np.linspace(2000.0, 8000.0, 64)
found = lg.sweep(jax.value_and_grad(criterion), designs, progress=False)
single = jax.jit(jax.value_and_grad(criterion))
for i in (0, 40):
    for batched, alone in zip(found.values, single(designs[i])):
        np.testing.assert_allclose(batched[i], alone, rtol=1e-10)
assert found.ok.all()
"""


@pytest.mark.slow
def test_two_devices_do_not_wait_for_each_other():
    """As many threads as devices: before, both stood still in a factorization."""
    environment = os.environ | {"XLA_FLAGS": "", "PJRT_NPROC": "2", "JAX_PLATFORMS": "cpu"}
    subprocess.run([sys.executable, "-c", TWO_DEVICES], env=environment, check=True, timeout=400)
