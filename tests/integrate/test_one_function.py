"""An iteration of Newton's method is such that XLA can make one function of it, and has the same numbers there."""

import json
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

import lgsens as lg
from lgsens.examples import QuarterCar, spinning_top

AS_JAX_COMES = "--xla_backend_extra_options=xla_lgsens=off"  # a choice that lgsens leaves alone


def psi(angle):
    trajectory = lg.simulate(spinning_top(angle), t1=0.1, num_steps=20)
    return lg.time_integral(trajectory.t, trajectory.body("top").position[:, 0] ** 2)


def car():
    return QuarterCar.load().model(wheel="locked")


@pytest.mark.parametrize("scene", [lambda: spinning_top(0.7), pytest.param(car, marks=pytest.mark.slow)])
def test_an_iteration_has_neither_scatter_nor_factorization(scene):
    """Nor a triangular solve: what XLA does not make part of a function on a CPU."""
    from helpers import equations  # not found where this file is a program

    program = jax.make_jaxpr(lambda system: lg.simulate(system, t1=0.1, num_steps=5, throw=False).states)(
        scene().system()
    )
    loops = [equation for equation in equations(program.jaxpr) if equation.primitive.name == "while"]
    kinds = [{each.primitive.name for each in equations(loop.params["body_jaxpr"].jaxpr)} for loop in loops]
    iterations = [kind for kind in kinds if "while" not in kind and "dot_general" in kind and "lu" not in kind]
    assert len(iterations) == 1
    # a "scatter" of constant places becomes a copy
    assert not iterations[0] & {"scatter-add", "triangular_solve", "cholesky"}


@pytest.mark.slow  # two processes that compile a gradient
def test_a_program_in_which_loops_are_functions():
    found = []
    for option in (AS_JAX_COMES, ""):
        own = os.environ | {"XLA_FLAGS": option, "JAX_PLATFORMS": "cpu"}
        run = subprocess.run([sys.executable, __file__], env=own, capture_output=True, text=True, timeout=300)
        assert run.returncode == 0, run.stderr
        found.append(json.loads(run.stdout.splitlines()[-1]))
    (*expected, before), (*actual, after) = found
    assert after >= max(before, 1)  # JAX 0.12 makes functions of small loops unasked
    # round-off of 20 steps, 1e-16/(βh²) = 2e-11 in accelerations, of which positions see βh²
    np.testing.assert_allclose(actual, expected, rtol=1e-12)


def as_program() -> None:
    """Print Ψ, its derivative, and how many loops became functions."""
    jax.config.update("jax_enable_x64", True)
    program = jax.jit(jax.value_and_grad(psi)).lower(0.7).compile()
    print(json.dumps([*map(float, program(0.7)), program.as_text().count('xla_cpu_small_call="true"')]))


if __name__ == "__main__":
    as_program()
